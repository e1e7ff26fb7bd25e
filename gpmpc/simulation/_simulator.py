"""Simulates what stands at the other end of a control loop: a plant, or the learned model itself.

A plant has a state that is stepped, disturbed and measured with noise. A model loop, as in the figures of Cao, Lai and
Alam (2017), takes the model's own prediction for the next state, mean and covariance carried on; the true plant never
enters. It shows how a controller and a model get on with each other, not how a vehicle flies.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
import torch

from gpmpc._angles import angles_of
from gpmpc._arrays import read_array
from gpmpc._dynamics import DynamicsModel, to_array
from gpmpc.exceptions import (
    Diverged,
    SettingError,
    ShapeError,
    check_number,
    check_numbers,
)
from gpmpc.gaussian import Gaussian
from gpmpc.propagation import Propagator
from gpmpc.signals import Signals, signals_of
from gpmpc.systems import System, step, step_many

Array = np.ndarray


@dataclass(frozen=True)
class ModelLoop:
    """A learned model rolled on itself.

    Raises:
        SettingError: A time step that is not positive.
    """

    model: DynamicsModel  #: it predicts the next state
    propagator: Propagator  #: how the belief is carried on
    #: time that one step stands for [s]; by default the model's, or 1 where it has none
    time_step: float = cast(float, None)

    def __post_init__(self) -> None:
        known = signals_of(self.model)
        if self.time_step is None:
            object.__setattr__(self, "time_step", known.time_step or 1.0)
        check_number("time_step", self.time_step, above=0, unit="[s]")
        loop = Signals(time_step=self.time_step)
        known.check("the model", loop, "the model loop", "time_step")

    @property
    def signals(self) -> Signals:
        """Names and time step, as far as they are known."""
        return replace(signals_of(self.model), time_step=self.time_step)


@dataclass(frozen=True)
class Noise:
    """White Gaussian noise, as standard deviations; every source draws from a stream of its own.

    Raises:
        SettingError: An entry is negative or no number.
    """

    process: Sequence[float] | None = None  #: added to every next state (n,)
    measurement: Sequence[float] | None = None  #: added to what is measured (n,)
    #: added to every input that is applied (m,): an actuator's, or the dither that makes data informative
    input: Sequence[float] | None = None

    def __post_init__(self) -> None:
        for key, values in vars(self).items():
            if values is not None:
                listed = values.tolist() if hasattr(values, "tolist") else values
                if not isinstance(listed, Sequence) or isinstance(listed, str):
                    what = f"must be a list of standard deviations, one for every {key if key == 'input' else 'state'}"
                    raise SettingError(f"noise.{key}", f"{what}; got {values!r}")
                check_numbers(f"noise.{key}", listed, len(listed), least=0)


class PlantSimulator:
    """Simulates a plant with noise and disturbances, each of which changes what the one before left.

    ``initial`` is a state (n,), or a belief that it is drawn from; None for a simulator, which starts an episode.
    """

    def __init__(
        self,
        plant: System,
        initial: Any,
        disturbances: Any = (),
        noise: Noise | None = None,
        seed: int = 0,
    ):
        check_number("seed", seed, least=0, whole=True)
        if not isinstance(plant, System):
            what = "must be a plant, such as System(dynamics, 0.1), or a ModelLoop"
            raise SettingError("system", f"{what}; got {type(plant).__name__}")
        if not isinstance(noise, Noise | None):
            raise SettingError("noise", f"must be Noise(...); got {noise!r}")
        if not isinstance(disturbances, Sequence):
            raise SettingError(
                "disturbances", f"must be a list of them; got {disturbances!r}"
            )
        n = len(plant.state_names)
        m = len(plant.input_names)
        self.plant = plant
        self.disturbances = disturbances
        self.noise = noise or Noise()
        self._steps = 0
        for key, length, names in (
            ("process", n, plant.state_names),
            ("measurement", n, plant.state_names),
            ("input", m, plant.input_names),
        ):
            values = getattr(self.noise, key)
            if values is None:
                continue
            if len(values) != length:
                raise ShapeError(
                    f"noise.{key} must have {length} standard deviations; got {len(values)}"
                )
            ordered: Any = read_array(f"noise.{key}", values, names)
            self.noise = replace(self.noise, **{key: ordered})
        # One stream a source: whether states are measured with noise changes nothing about the wind.
        sources = "initial", "process", "measurement", "input"
        streams = map(
            np.random.default_rng, np.random.SeedSequence(seed).spawn(len(sources))
        )
        self._streams: dict[str, np.random.Generator] = dict(
            zip(sources, streams, strict=True)
        )
        if initial is None:
            if not plant.stateful:
                raise SettingError(
                    "initial", "must be a state; a simulator alone starts by itself"
                )
            initial = plant.dynamics.reset(seed)
        drawn = isinstance(initial, Gaussian)
        if drawn:
            initial = initial.in_order(plant.state_names)
        state = initial.mean if drawn else initial
        self.mean = _check_state(state, n, plant.state_names)
        self.covariance = np.zeros((n, n))
        if drawn:
            self.mean = self._streams["initial"].multivariate_normal(
                self.mean, to_array(initial.covariance)
            )
        self._disturbed_plant(
            0.0
        )  # a disturbance that does not fit is found before the first step

    @property
    def angles(self) -> list[int]:
        """Indices of the states that are angles."""
        return self.plant.angle_indices

    def measure(self, time: float) -> Gaussian:
        """Measures the state; the measurement is taken for certain: controllers of this package filter nothing."""
        measured = self._add_noise("measurement", self.mean)
        for disturbance in self.disturbances:
            measured = disturbance.disturb_measurement(measured, time)
        return Gaussian.certain(measured)

    def _disturbed_plant(self, time: float) -> System:
        plant = self.plant
        for disturbance in self.disturbances:
            plant = disturbance.disturb_plant(plant, time)
        return plant

    def _applied(self, input: Array) -> Array:
        if np.shape(input) != (shape := (len(self.plant.input_names),)):
            raise ShapeError(
                f"the plant takes inputs of shape {shape}; got {np.shape(input)}"
            )
        return self._add_noise("input", input)

    def _arrive(self, state: Array, applied: Array) -> Array | Diverged:
        """Returns the input that was applied, or why the plant cannot go on from its next state."""
        if not np.isfinite(state).all():
            before = f"it was {self.mean}, input {applied}"
            return Diverged(
                self._steps, f"the plant's state is not finite any more; {before}"
            )
        if getattr(self.plant.dynamics, "ended", False):
            return Diverged(
                self._steps, f"the simulator has ended its episode, at state {state}"
            )
        self.mean = self._add_noise("process", state)
        self._steps = self._steps + 1
        return applied

    def _add_noise(self, source: str, value: Array) -> Array:
        deviations = getattr(self.noise, source)
        if deviations is None:
            return value
        return value + np.asarray(deviations, dtype=float) * self._streams[
            source
        ].standard_normal(len(value))


class ModelSimulator:
    """Simulates a model loop from a belief, or from a mean (n,) with the paper's standard deviation of 0.1."""

    def __init__(self, loop: ModelLoop, initial: Any):
        self.loop = loop
        self._steps = 0
        model = loop.model
        n = loop.model.state_dim
        to: Any = {"device": model.device, "dtype": model.dtype}
        mean = initial
        covariance = 0.1**2 * torch.eye(n, **to)
        names = signals_of(model).state_names
        if isinstance(initial, Gaussian):
            initial = initial.in_order(names)
            mean = initial.mean
            covariance = initial.covariance
        state = _check_state(mean, n, names)
        self._belief = Gaussian(torch.as_tensor(state, **to), covariance.to(**to))

    @property
    def mean(self) -> Array:
        """Of the belief (n,)."""
        return to_array(self._belief.mean)

    @property
    def covariance(self) -> Array:
        """Of the belief (n, n)."""
        return to_array(self._belief.covariance)

    @property
    def angles(self) -> list[int]:
        """Indices of the states that are angles."""
        return angles_of(self.loop.model)

    def measure(self, time: float) -> Gaussian:
        """Returns the belief."""
        return self._belief

    def step(self, input: Array) -> Array | Diverged:
        """Carries the belief one step on; returns the input, or why it cannot go on."""
        control = torch.as_tensor(np.asarray(input, dtype=float)).to(self._belief.mean)
        belief = self.loop.propagator(self.loop.model, self._belief, control)
        if not bool(
            torch.isfinite(belief.mean).all()
            and torch.isfinite(belief.covariance).all()
        ):
            return Diverged(
                self._steps,
                f"the model's belief is not finite any more; its mean is {belief.mean}",
            )
        self._belief = belief
        self._steps = self._steps + 1
        return input


Simulator = PlantSimulator | ModelSimulator


def step_together(
    simulators: Sequence[Any], time: float, inputs: Sequence[Array]
) -> list[Array | Diverged]:
    """Steps simulators of one plant from a time [s] on, several plants in one evaluation.

    Returns the inputs that were applied, or why a simulator cannot go on.
    """
    if not simulators or isinstance(simulators[0], ModelSimulator):
        return [s.step(input) for s, input in zip(simulators, inputs, strict=True)]
    applied = [s._applied(input) for s, input in zip(simulators, inputs, strict=True)]
    plant = simulators[0]._disturbed_plant(
        time
    )  # disturbances look at the time, not at a trial
    with np.errstate(over="ignore", invalid="ignore"):
        if len(simulators) == 1:
            states: Any = [step(plant, simulators[0].mean, applied[0])]
        else:
            states = step_many(
                plant, np.array([s.mean for s in simulators]), np.array(applied)
            )
    return [
        s._arrive(state, input)
        for s, state, input in zip(simulators, states, applied, strict=True)
    ]


def _check_state(value: Any, n: int, names: Sequence[str]) -> Array:
    """Returns a finite state (n,) as an array of its own, in the order of names."""
    state = np.array(read_array("the initial state", value, names))
    if state.shape != (n,):
        raise ShapeError(f"the initial state must have shape ({n},); got {state.shape}")
    if not np.isfinite(state).all():
        raise SettingError("initial", f"must be finite; got {state}")
    return state
