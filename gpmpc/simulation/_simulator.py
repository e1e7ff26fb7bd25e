"""Simulators of what a controller steers: a plant, or the learned model itself.

A plant has a state that is stepped, disturbed and measured with noise. A model loop, as
in the figures of Cao, Lai and Alam (2017), takes the model's own prediction for the
next state, mean and covariance carried on; the true plant never enters. It shows how a
controller and a model get on with each other, not how a vehicle flies.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, cast

import numpy as np
import torch

from gpmpc._angles import angles_of
from gpmpc._arrays import UNMEASURED, is_measured, read_array
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel, check_next_states, to_array
from gpmpc.exceptions import (
    DataError,
    Diverged,
    SettingError,
    ShapeError,
    check_method,
    check_number,
    check_numbers,
)
from gpmpc.gaussian import Gaussian, check_covariance
from gpmpc.models._past import belief_of_all, first_signals, has_past, measured_dim
from gpmpc.propagation import Propagator
from gpmpc.signals import Signals, signals_of
from gpmpc.simulation._disturbances import Disturbance
from gpmpc.systems import System, step, step_many

Array = np.ndarray

_INITIAL_DEVIATION = 0.1  # of a model loop that starts from a mean


@explains_arguments
@dataclass(frozen=True, eq=False)
class ModelLoop:
    """A learned model rolled on itself.

    Raises:
        SettingError: The time step is not positive, the model predicts something else
            than next states, or the propagator is none.

    See Also:
        ``closed_loop``, which takes one in the place of a system.
    """

    model: DynamicsModel  #: it predicts the next state
    propagator: Propagator  #: how the belief is carried on
    #: time that one step stands for [s]; by default the model's, or 1 where it has none
    time_step: float = cast(float, None)

    def __post_init__(self) -> None:
        signals = signals_of(self.model)
        if self.time_step is None:
            object.__setattr__(self, "time_step", signals.time_step or 1.0)
        check_number("time_step", self.time_step, above=0, unit="[s]")
        check_next_states(self.model)
        check_method("propagator", self.propagator, "propagate", "Linearization()")
        loop = Signals(time_step=self.time_step)
        signals.check("the model", loop, "the model loop", "time_step")

    @property
    def signals(self) -> Signals:
        """Names and time step, as far as they are known."""
        return replace(signals_of(self.model), time_step=self.time_step)


@explains_arguments
@dataclass(frozen=True)
class Noise:
    """White Gaussian noise, as standard deviations.

    Every source draws from a stream of its own.

    Raises:
        SettingError: An entry is negative or no number.

    >>> Noise(measurement=[0.002, 0.01]).process is None
    True
    """

    process: Sequence[float] | None = None  #: added to every next state (n,)
    measurement: Sequence[float] | None = None  #: added to what is measured (n,)
    #: added to every input that is applied (m,): an actuator's, or the dither that
    #: makes data informative
    input: Sequence[float] | None = None

    def __post_init__(self) -> None:
        for key, values in vars(self).items():
            if values is not None:
                listed = values.tolist() if hasattr(values, "tolist") else values
                if not isinstance(listed, Sequence) or isinstance(listed, str):
                    entry = "input" if key == "input" else "state"
                    rule = (
                        f"must be a list of standard deviations, one for every {entry}"
                    )
                    raise SettingError(f"noise.{key}", f"{rule}; got {values!r}")
                check_numbers(f"noise.{key}", listed, len(listed), least=0)


class SystemState(NamedTuple):
    """State of a simulated system: a plant's own, or the belief of a model loop."""

    mean: Array  # (n,)
    covariance: Array  # (n, n); zero of a plant

    def part(self, states: slice) -> "SystemState":
        """Returns that of some of the states."""
        return SystemState(self.mean[states], self.covariance[states, states])


class PlantSimulator:
    """Simulates a plant with noise and disturbances.

    Each disturbance changes what the one before left.

    Args:
        plant: The system.
        initial: A state (n,), or a belief that it is drawn from; None for a simulator,
            which starts an episode.
        disturbances: What acts on the plant and its measurements.
        noise: On states, measurements and inputs.
        seed: Of all random numbers.

    Attributes:
        mean: The state (n,).
        covariance: Zero (n, n).
    """

    def __init__(
        self,
        plant: System,
        initial: Any,
        disturbances: Sequence[Disturbance] = (),
        noise: Noise | None = None,
        seed: int = 0,
    ):
        check_number("seed", seed, least=0, whole=True)
        if not isinstance(plant, System):
            rule = "must be a plant, such as System(dynamics, 0.1), or a ModelLoop"
            raise SettingError("system", f"{rule}; got {type(plant).__name__}")
        if not isinstance(noise, Noise | None):
            raise SettingError("noise", f"must be Noise(...); got {noise!r}")
        if not isinstance(disturbances, Sequence):
            raise SettingError(
                "disturbances", f"must be a list of them; got {disturbances!r}"
            )
        self.plant = plant
        for disturbance in disturbances:
            for method in ("disturb_plant", "disturb_measurement"):
                check_method("disturbances", disturbance, method, "Gust(...)")
        self.disturbances = disturbances
        self.noise = _read_noise(noise or Noise(), plant)
        self._steps = 0
        # One stream a source: whether states are measured with noise changes nothing
        # about the wind.
        sources = ("initial", "process", "measurement", "input")
        seeds = np.random.SeedSequence(seed).spawn(len(sources))
        self._streams = {
            source: np.random.default_rng(own_seed)
            for source, own_seed in zip(sources, seeds, strict=True)
        }
        self.mean = self._initial_state(initial, seed)
        self.covariance = np.zeros((len(self.mean), len(self.mean)))
        # A disturbance that does not fit says so before the first step, in its window
        # or not.
        self._disturbed_plant(0.0)

    def _initial_state(self, initial: Any, seed: int) -> Array:
        """Returns the state (n,) that a flight starts from."""
        plant = self.plant
        n = len(plant.state_names)
        if initial is None:
            if not plant.stateful:
                raise SettingError(
                    "initial", "must be a state; a simulator alone starts by itself"
                )
            initial = plant.dynamics.reset(seed)
        if not isinstance(initial, Gaussian):
            return _check_state(initial, n, plant.state_names)
        belief = initial.in_order(plant.state_names)
        mean = _check_state(belief.mean, n, plant.state_names)
        check_covariance("initial.covariance", belief.covariance)
        covariance = to_array(belief.covariance)
        return self._streams["initial"].multivariate_normal(mean, covariance)

    @property
    def angles(self) -> list[int]:
        """Indices of the states that are angles."""
        return self.plant.angle_indices

    @property
    def state(self) -> SystemState:
        """The state, without a covariance."""
        return SystemState(self.mean, self.covariance)

    def measure(self, time: float) -> Gaussian:
        """Returns a measurement of the state at a time [s].

        It is taken for certain: controllers of this package filter nothing (a filter is
        a ``Controller`` of one's own around one of them). What disturbances and
        controllers do to its array does nothing to the state.
        """
        measured = self._add_noise("measurement", self.mean.copy())
        for disturbance in self.disturbances:
            measured = disturbance.disturb_measurement(measured, time)
        return Gaussian.certain(measured)

    def _disturbed_plant(self, time: float) -> System:
        """Returns the plant that acts in the step from a time [s] on."""
        plant = self.plant
        for disturbance in self.disturbances:
            plant = disturbance.disturb_plant(plant, time)
        return plant

    def _noisy_input(self, input: Array) -> Array:
        """Returns what reaches the plant of an input (m,)."""
        shape = (len(self.plant.input_names),)
        if np.shape(input) != shape:
            raise ShapeError(
                f"the plant takes inputs of shape {shape}; got {np.shape(input)}"
            )
        return self._add_noise("input", np.array(input, dtype=float))

    def _clipped(self, input: Array) -> Array:
        """Returns an input (m,) as a foreign simulator takes it."""
        limits = getattr(self.plant.dynamics, "input_limits", None)
        return input if limits is None else np.clip(input, *limits)

    def _move_to(self, state: Array, input: Array) -> Diverged | None:
        """Moves to the next state (n,), with noise.

        Returns why the plant cannot go on from there, such as a state of a size that
        nothing measures; None where it can. ``input`` is what led there, for the
        message.
        """
        if not is_measured(state).all():
            before = f"it was {self.mean}, input {input}"
            return Diverged(
                self._steps,
                f"the plant's state is not finite any more, or beyond {UNMEASURED:g}; "
                f"{before}",
            )
        if getattr(self.plant.dynamics, "ended", False):
            return Diverged(
                self._steps, f"the simulator has ended its episode, at state {state}"
            )
        self.mean = self._add_noise("process", state)
        self._steps += 1
        return None

    def _add_noise(self, source: str, value: Array) -> Array:
        """Returns a value with the noise of a source."""
        deviations = getattr(self.noise, source)
        if deviations is None:
            return value
        drawn = self._streams[source].standard_normal(len(value))
        return value + np.asarray(deviations, dtype=float) * drawn


def _read_noise(noise: Noise, plant: System) -> Noise:
    """Returns noise as arrays in the order of a plant's names.

    Raises:
        ShapeError: It has another number of entries.
        DataError: It has other names.
    """
    names_by_source = {
        "process": plant.state_names,
        "measurement": plant.state_names,
        "input": plant.input_names,
    }
    ordered: dict[str, Any] = {}
    for source, names in names_by_source.items():
        deviations = getattr(noise, source)
        if deviations is None:
            continue
        if len(deviations) != len(names):
            rule = f"noise.{source} must have {len(names)} standard deviations"
            raise ShapeError(f"{rule}; got {len(deviations)}")
        ordered[source] = read_array(f"noise.{source}", deviations, names)
    return replace(noise, **ordered)


def _is_as_long(values: Any, count: int) -> bool:
    """Returns whether something has so many entries, numbers or not."""
    try:
        return len(values) == count
    except TypeError:
        return False


class ModelSimulator:
    """Simulates a model loop.

    Args:
        loop: The model and how its belief is carried on.
        initial: A belief, or its mean (n,) with the paper's standard deviation of 0.1.
        resting_input: That a model with a past remembers at first (m,); zero by
            default.
    """

    def __init__(
        self, loop: ModelLoop, initial: Any, resting_input: Array | None = None
    ):
        self.loop = loop
        self._steps = 0
        model = loop.model
        options: Any = {"device": model.device, "dtype": model.dtype}
        mean = initial.mean if isinstance(initial, Gaussian) else initial
        n = model.state_dim
        if _is_as_long(mean, measured_dim(model)):
            n = measured_dim(model)
        names = first_signals(signals_of(model), n).state_names
        covariance = None
        if isinstance(initial, Gaussian):
            belief = initial.in_order(names)
            mean = belief.mean
            covariance = belief.covariance
            check_covariance("initial.covariance", covariance)
        if covariance is None:
            covariance = _INITIAL_DEVIATION**2 * torch.eye(n, **options)
        mean = torch.as_tensor(_check_state(mean, n, names), **options)
        self._belief = Gaussian(mean, covariance.to(**options))
        self._measured_dim = n
        if has_past(model) and n < model.state_dim:
            input = resting_input
            if input is None:
                input = np.zeros(model.input_dim)
            state = model.at_rest(to_array(self._belief.mean), input)
            self._belief = belief_of_all(self._belief, state)

    @property
    def mean(self) -> Array:
        """Mean of the belief over what is measured (n,)."""
        return to_array(self._belief.mean)[: self._measured_dim]

    @property
    def covariance(self) -> Array:
        """Covariance of the belief over what is measured (n, n)."""
        n = self._measured_dim
        return to_array(self._belief.covariance)[:n, :n].copy()

    @property
    def state(self) -> SystemState:
        """The belief, as arrays."""
        return SystemState(self.mean, self.covariance)

    @property
    def angles(self) -> list[int]:
        """Indices of the states that are angles."""
        return angles_of(self.loop.model)

    def measure(self, time: float) -> Gaussian:
        """Returns the belief over what is measured, as tensors of its own."""
        n = self._measured_dim
        belief = self._belief
        return Gaussian(belief.mean[:n].clone(), belief.covariance[:n, :n].clone())

    def step(self, input: Array) -> Diverged | None:
        """Carries the belief one step on; returns why it cannot go on, if so."""
        control = torch.as_tensor(np.asarray(input, dtype=float)).to(self._belief.mean)
        try:
            propagated = self.loop.propagator.propagate(
                self.loop.model, self._belief, control
            )
        except DataError as error:  # its start was checked: it has overflowed since
            return Diverged(
                self._steps, f"the model's belief cannot be carried on: {error}"
            )
        belief = propagated.belief
        mean_is_finite = is_measured(to_array(belief.mean)).all()
        covariance_is_finite = torch.isfinite(belief.covariance).all()
        if not (mean_is_finite and covariance_is_finite):
            return Diverged(
                self._steps,
                f"the model's belief is not finite any more, or beyond {UNMEASURED:g}; "
                f"its mean is {belief.mean}",
            )
        self._belief = belief
        self._steps += 1
        return None


Simulator = PlantSimulator | ModelSimulator


class Applied(NamedTuple):
    """A step that a simulator has taken."""

    # (m,) that reached the plant: an actuator's noise included, within the limits that
    # a foreign simulator clips to
    input: Array


def step_together(
    simulators: Sequence[Any], time: float, inputs: Sequence[Array]
) -> list[Applied | Diverged]:
    """Steps simulators of one plant from a time [s] on, in one evaluation.

    Model loops are stepped one by one.

    Returns:
        What was applied to each, or why it cannot go on.
    """
    if not simulators:
        return []
    if isinstance(simulators[0], ModelSimulator):
        return [
            simulator.step(input) or Applied(input)
            for simulator, input in zip(simulators, inputs, strict=True)
        ]
    noisy_inputs = [
        simulator._noisy_input(input)
        for simulator, input in zip(simulators, inputs, strict=True)
    ]
    # All trials of a scenario share their disturbances, which look at the time alone.
    plant = simulators[0]._disturbed_plant(time)
    with np.errstate(over="ignore", invalid="ignore"):
        if len(simulators) == 1:
            # Copies: equations may calculate in place.
            state = simulators[0].mean.copy()
            next_states: Any = [step(plant, state, noisy_inputs[0].copy())]
        else:
            states = np.array([simulator.mean for simulator in simulators])
            next_states = step_many(plant, states, np.array(noisy_inputs))
    return [
        simulator._move_to(state, input) or Applied(simulator._clipped(input))
        for simulator, state, input in zip(
            simulators, next_states, noisy_inputs, strict=True
        )
    ]


def _check_state(value: Any, n: int, names: Sequence[str]) -> Array:
    """Returns a finite state (n,) as an array of its own, in the order of names."""
    state = np.array(read_array("the initial state", value, names))
    if state.shape != (n,):
        raise ShapeError(f"the initial state must have shape ({n},); got {state.shape}")
    if not np.isfinite(state).all():
        raise SettingError("initial", f"must be finite; got {state}")
    return state
