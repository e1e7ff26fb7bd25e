"""Takes a MuJoCo model as a system, by its joints or by its sensors.

Joints, with the activations of the actuators that have one, are a state that the model
can be set to; many are stepped at once by ``mujoco.rollout``. Sensors show a part of
it: the model then moves on by itself. Needs the extra ``sim``.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gpmpc.exceptions import DataError, SettingError, check_number
from gpmpc.systems._simulators import Simulator, library, numbers
from gpmpc.systems._system import System

Array = np.ndarray


class _Model:
    """A loaded MJCF file, and its named actuators."""

    def __init__(self, path: str | Path, actuators: Sequence[str]):
        self.mujoco = library("mujoco")
        try:
            self.model = self.mujoco.MjModel.from_xml_path(str(path))
        except (ValueError, OSError) as error:
            raise DataError(
                f"{path}: is no MJCF model ({' '.join(str(error).split())})"
            ) from error
        self.path = path
        self.data = self.mujoco.MjData(self.model)
        self.controls = self.indices("actuator", actuators)
        limited = self.model.actuator_ctrllimited.astype(bool)[self.controls]
        low, high = self.model.actuator_ctrlrange[self.controls].T
        lowest = np.where(limited, low, -np.inf)
        highest = np.where(limited, high, np.inf)
        self.input_limits = (lowest, highest)

    def indices(self, kind: str, names: Sequence[str]) -> list[int]:
        """Returns the indices of named parts of the model of a kind.

        Raises:
            SettingError: None is named, or one is not there.
        """
        if not names:
            raise SettingError(f"{kind}s", f"name at least one of {self.path}")
        try:
            return [getattr(self.model, kind)(name).id for name in names]
        except KeyError as error:
            raise SettingError(f"{kind}s", f"{error.args[0]} in {self.path}") from error


class _Joints(_Model):
    """Dynamics of a model by its joints, all of them hinges and slides.

    Actuators that are not named stay at zero.
    """

    def __init__(
        self,
        path: str | Path,
        joints: Sequence[str],
        actuators: Sequence[str],
        substeps: int = 1,
    ):
        super().__init__(path, actuators)
        model = self.model
        joint = self.mujoco.mjtJoint
        kinds = {int(joint.mjJNT_SLIDE), int(joint.mjJNT_HINGE)}
        indices = self.indices("joint", joints)
        if model.njnt != len(indices) or not set(model.jnt_type.tolist()) <= kinds:
            raise SettingError(
                "joints",
                f"must name all {model.njnt} joints of {path}, hinges and slides; "
                f"name sensors of other models; got {list(joints)}",
            )
        self.substeps = substeps
        q = model.jnt_qposadr[indices]
        v = model.jnt_dofadr[indices]
        # Where the states stand in MuJoCo's own: time, qpos, qvel, act.
        self._order = np.concatenate(
            [1 + q, 1 + model.nq + v, 1 + model.nq + model.nv + np.arange(model.na)]
        )
        lagging = [
            f"{model.actuator(i).name}_activation"
            for i in range(model.nu)
            if model.actuator_actadr[i] >= 0
        ]
        self.state_names = (*joints, *(f"{name}_rate" for name in joints), *lagging)
        self.input_names = tuple(actuators)

    def positions(self, state: Array) -> Array:
        """Returns the positions of MuJoCo's joints (nq,) in a state (n,)."""
        count = self.model.nq
        positions = np.empty(count)
        places = self._order[:count] - 1  # without time, which comes first
        positions[places] = state[:count]
        return positions

    def successor(self, x: Any, u: Any) -> Array:
        """Returns the next state (n,), or states (n, T), from one or T of each."""
        states, inputs = numbers(x, u)
        single = states.ndim == 1
        states = states.reshape(len(states), -1)
        inputs = inputs.reshape(len(inputs), -1)
        count = states.shape[1]
        model = self.model
        initial = np.zeros((count, 1 + model.nq + model.nv + model.na))
        initial[:, self._order] = states.T
        control = np.zeros((count, self.substeps, model.nu))
        control[:, :, self.controls] = inputs.T[:, None]
        next_states = np.full(states.shape, np.nan)
        # MuJoCo stops at the first number that is not finite.
        finite = np.isfinite(states).all(axis=0) & np.isfinite(inputs).all(axis=0)
        if finite.any():
            trajectories, _ = library("mujoco.rollout").rollout(
                model, self.data, initial[finite], control[finite]
            )
            next_states[:, finite] = trajectories[:, -1, self._order].T
        return next_states[:, 0] if single else next_states


class _Sensors(_Model, Simulator):
    """Dynamics of a model by its sensors, from its first keyframe or initial pose.

    Films need an attribute ``positions`` besides: from a state (n,) to the positions of
    the model's joints (nq,).
    """

    def __init__(
        self,
        path: str | Path,
        sensors: Sequence[str],
        actuators: Sequence[str],
        state_names: Sequence[str] = (),
        observe: Callable[[Array], Array] = np.array,
        substeps: int = 1,
        input_delay: int = 0,
    ):
        super().__init__(path, actuators)
        model = self.model
        indices = self.indices("sensor", sensors)
        addresses = model.sensor_adr[indices].tolist()
        sizes = model.sensor_dim[indices].tolist()
        # Where the sensors' values stand in MuJoCo's own.
        self._places = np.concatenate(
            [
                address + np.arange(size)
                for address, size in zip(addresses, sizes, strict=True)
            ]
        )
        self._observe = observe
        self.substeps = substeps
        check_number("input_delay", input_delay, least=0, whole=True)
        self._delay = input_delay
        self.state_names = tuple(state_names or _value_names(sensors, sizes))
        self.input_names = tuple(actuators)
        n = len(self.reset(0))
        if n != len(self.state_names):
            raise SettingError(
                "state_names", f"must be {n} names; got {len(self.state_names)}"
            )

    def _reset(self, seed: int) -> Array:
        if self.model.nkey:
            self.mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        else:
            self.mujoco.mj_resetData(self.model, self.data)
        self.mujoco.mj_forward(self.model, self.data)
        self._waiting = [self.data.ctrl[self.controls].copy()] * self._delay
        return self._measure()

    def _step(self, input: Array) -> tuple[Array, bool]:
        self._waiting = [*self._waiting, np.clip(input, *self.input_limits)]
        self.data.ctrl[self.controls] = self._waiting.pop(0)
        self.mujoco.mj_step(self.model, self.data, self.substeps)
        self.mujoco.mj_forward(self.model, self.data)
        return self._measure(), False

    def _measure(self) -> Array:
        return np.array(self._observe(self.data.sensordata[self._places]), dtype=float)


def _value_names(sensors: Sequence[str], sizes: Sequence[int]) -> list[str]:
    """Returns the sensors' names, numbered where they have several values."""
    names = []
    for sensor, size in zip(sensors, sizes, strict=True):
        if size > 1:
            names += [f"{sensor}{k + 1}" for k in range(size)]
        else:
            names.append(sensor)
    return names


def mujoco_system(
    path: str | Path,
    actuators: Sequence[str],
    joints: Sequence[str] = (),
    sensors: Sequence[str] = (),
    substeps: int = 1,
    observation: dict[str, Any] | None = None,
    **settings: Any,
) -> System:
    """Makes a system of a MuJoCo model, of named joints or of named sensors.

    Args:
        path: Of the MJCF file.
        actuators: Names of those that are steered; others stay at zero.
        joints: Names of all joints, hinges and slides.
        sensors: Names, in the order of the state; without joints.
        substeps: Steps of the model per time step.
        observation: Of sensors: ``observe``, from what they measure to the state (n,);
            ``state_names``, by default a sensor's own, numbered where it has several
            values; ``input_delay``, steps after which an input acts.
        settings: Of ``System``, such as ``units``, ``tracked`` and ``goal``; limits of
            the inputs are the actuators'.

    Raises:
        DataError: The file is no MJCF model.
        SettingError: A name is not there, a joint is no hinge or slide or is left out,
            or both joints and sensors are named, or neither; or an observation is of
            joints.
    """
    if bool(joints) == bool(sensors):
        raise SettingError(
            "joints, sensors",
            "name either the joints or the sensors that are the state",
        )
    if joints and observation:
        raise SettingError("observation", "is of sensors; got it beside joints")
    if joints:
        dynamics: _Joints | _Sensors = _Joints(path, joints, actuators, substeps)
        settings = {"rates": {f"{name}_rate": name for name in joints}} | settings
    else:
        dynamics = _Sensors(
            path, sensors, actuators, substeps=substeps, **(observation or {})
        )
    lower, upper = dynamics.input_limits
    defaults = {
        "name": Path(path).stem,
        "input_lower": lower,
        "input_upper": upper,
    }
    time_step = substeps * float(dynamics.model.opt.timestep)
    return System(dynamics, time_step, 1, **(defaults | settings))
