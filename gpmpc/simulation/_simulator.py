"""Simulates what stands at the other end of a control loop: a plant, or the learned model itself.

A plant has a state that is stepped, disturbed and measured with noise. A model loop, as in the figures of Cao, Lai and
Alam (2017), takes the model's own prediction for the next state, mean and covariance carried on; the true plant never
enters. It shows how a controller and a model get on with each other, not how a vehicle flies.

A disturbance is wind, another payload, a sensor that drops out: it says, step by step, which plant really acts and what
is really measured. Times are those at which a step begins: a window that opens within a step acts from the next one on.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import SimpleNamespace
from typing import Any, Protocol

import numpy as np
import torch

from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import Diverged, SettingError, ShapeError, UnsupportedModel, check_number, check_numbers
from gpmpc.gaussian import Gaussian
from gpmpc.propagation import Propagator
from gpmpc.systems import Plant, System, step, step_many

Array = np.ndarray


class Disturbance(Protocol):
    """Something that a controller does not know of."""

    def disturb_plant(self, plant: Plant, time: float) -> Plant:
        """Returns the plant that acts in the step from a time [s] on, in the place of the given one."""
        return plant

    def disturb_measurement(self, state: np.ndarray, time: float) -> np.ndarray:
        """Returns what is measured of a state (n,) at a time [s], in the place of the given one."""
        return state


@dataclass(frozen=True)
class Gust(Disturbance):
    """A constant push on single states over a time window, integrated by the plant like any other force.

    (Where the dynamics give the next state, it is added to that.)
    """

    #: what is added to the derivative of a state, by its name: ``{"vx": 2.0}`` is an acceleration of 2 m/s^2, the force
    #: over the mass [unit of the state / s]
    rates: Mapping[str, float]
    start: float = 0.0  #: when it begins [s]
    stop: float = math.inf  #: when it ends [s]

    def __post_init__(self) -> None:
        _check_window(self.start, self.stop)
        if not isinstance(self.rates, Mapping) or not self.rates:
            raise SettingError("rates", f"must map names of states to numbers, like {{'vx': 2.0}}; got {self.rates!r}")
        for name, rate in self.rates.items():
            check_number(f"rates.{name}", rate)

    def disturb_plant(self, plant: Plant, time: float) -> Plant:
        """Returns the plant with the push, inside the window; raises where it has no such state, or no equations."""
        names = plant.dynamics.state_names
        for name in self.rates:
            if name not in names:
                raise SettingError("rates", f"must name states of the plant, {', '.join(names)}; got {name!r}")
        if not self.start <= time < self.stop:
            return plant
        key: Any = plant  # hashable as any object, though no protocol says so
        return _pushed(key, tuple(float(self.rates.get(name, 0.0)) for name in names))


@dataclass(frozen=True)
class Replaced(Disturbance):
    """Another plant over a time window: another mass, a broken arm."""

    plant: Plant  #: what acts then
    start: float = 0.0  #: when it begins [s]
    stop: float = math.inf  #: when it ends [s]

    def __post_init__(self) -> None:
        _check_window(self.start, self.stop)

    def disturb_plant(self, plant: Plant, time: float) -> Plant:
        """Returns the other plant, inside the window; raises where it has other states, inputs or time steps."""
        both = (plant, self.plant)
        ours, theirs = ((*map(tuple, (p.dynamics.state_names, p.dynamics.input_names)), p.time_step) for p in both)
        if ours != theirs:
            raise ShapeError(f"a plant must be replaced by one of the same states, inputs, step {ours}; got {theirs}")
        return self.plant if self.start <= time < self.stop else plant


@dataclass(frozen=True)
class Dropout(Disturbance):
    """Nothing is measured over a time window: entries of the state are NaN."""

    start: float  #: when it begins [s]
    stop: float  #: when it ends [s]
    #: which ones, from 0; all by default. Without position, for one: 0 to 5 of a ``Coupled`` plant
    entries: Sequence[int] | None = None

    def __post_init__(self) -> None:
        _check_window(self.start, self.stop)
        if self.entries is not None:
            entries = [int(e) if isinstance(e, np.integer) else e for e in self.entries]
            for entry in entries:
                check_number("entries", entry, least=0, whole=True)
            object.__setattr__(self, "entries", tuple(entries))

    def disturb_plant(self, plant: Plant, time: float) -> Plant:
        """Returns the plant; raises where it has no such entry."""
        n = len(plant.dynamics.state_names)
        for entry in self.entries or ():
            if entry >= n:
                raise SettingError("entries", f"must be indices of states, 0 to {n - 1}; got {entry!r}")
        return plant

    def disturb_measurement(self, state: np.ndarray, time: float) -> np.ndarray:
        """Returns NaN inside the window."""
        if not self.start <= time < self.stop:
            return state
        lost = state.copy()
        lost[slice(None) if self.entries is None else list(self.entries)] = np.nan
        return lost


@lru_cache(maxsize=8)
def _pushed(plant: Plant, rates: tuple[float, ...]) -> System:
    """A system with constants (n,) added to its right-hand side, or to its next state."""
    if not isinstance(plant, System) or getattr(plant.dynamics, "stateful", False):
        what = "a gust needs a plant that is a System with dynamics of its own"
        raise UnsupportedModel(f"{what}; got {type(plant).__name__}. Possible with any plant: Replaced")
    method = "successor" if hasattr(plant.dynamics, "successor") else "derivative"
    of = getattr(plant.dynamics, method)

    def pushed(x: Any, u: Any) -> list[Any]:
        return [entry + rate for entry, rate in zip(of(x, u), rates, strict=True)]

    names = {"state_names": plant.state_names, "input_names": plant.input_names}
    return replace(plant, dynamics=SimpleNamespace(**names, **{method: pushed}))


def _check_window(start: float, stop: float) -> None:
    check_number("start", start, unit="[s]")
    if stop != math.inf:
        check_number("stop", stop, above=start, unit="[s]")


@dataclass(frozen=True)
class ModelLoop:
    """A learned model rolled on itself.

    Raises:
        SettingError: A time step that is not positive, or a negative deviation.
    """

    model: DynamicsModel  #: it predicts the next state
    propagator: Propagator  #: how the belief is carried on
    time_step: float = 1.0  #: time that one step stands for [s]
    #: standard deviation of every state at the start where only its mean is given; the paper's 0.1
    initial_std: float = 0.1

    def __post_init__(self) -> None:
        check_number("time_step", self.time_step, above=0, unit="[s]")
        check_number("initial_std", self.initial_std, least=0)


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
        for key, of in (("process", "state"), ("measurement", "state"), ("input", "input")):
            values = getattr(self, key)
            values = values.tolist() if isinstance(values, np.ndarray) else values
            if isinstance(values, str) or (values is not None and not hasattr(values, "__len__")):
                what = f"must be a list of standard deviations, one for every {of}"
                raise SettingError(f"noise.{key}", f"{what}; got {values!r}")
            check_numbers(f"noise.{key}", values or (), len(values or ()), least=0)


class PlantSimulator:
    """Simulates a plant with noise and disturbances, each of which changes what the one before left.

    ``initial`` is a state (n,), or a belief that it is drawn from; None where the plant is a simulator, which then
    starts an episode.
    """

    def __init__(self, plant: Plant, initial: Any, disturbances: Any = (), noise: Noise | None = None, seed: int = 0):
        check_number("seed", seed, least=0, whole=True)
        if not hasattr(plant, "dynamics"):
            what = "must be a plant, such as System(dynamics, 0.1), or a ModelLoop"
            raise SettingError("system", f"{what}; got {type(plant).__name__}")
        if not isinstance(noise, Noise | None):
            raise SettingError("noise", f"must be Noise(...); got {noise!r}")
        if not isinstance(disturbances, Sequence):
            raise SettingError("disturbances", f"must be a list of them; got {disturbances!r}")
        n, m = len(plant.dynamics.state_names), len(plant.dynamics.input_names)
        self.noise = noise or Noise()
        for key, length in (("process", n), ("measurement", n), ("input", m)):
            values = getattr(self.noise, key)
            if values is not None and len(values) != length:
                raise ShapeError(f"noise.{key} must have {length} standard deviations; got {len(values)}")
        # One stream a source: whether states are measured with noise changes nothing about the wind.
        sources = "initial", "process", "measurement", "input"
        streams = np.random.SeedSequence(seed).spawn(4)
        self._streams = {source: np.random.default_rng(s) for source, s in zip(sources, streams, strict=True)}
        self.plant, self.disturbances, self._steps = plant, tuple(disturbances), 0
        if initial is None:
            dynamics: Any = plant.dynamics
            if not getattr(dynamics, "stateful", False):
                raise SettingError("initial", "must be a state; a simulator alone starts by itself")
            initial = dynamics.reset(seed)
        drawn = isinstance(initial, Gaussian)
        self.mean, self.covariance = _check_state(initial.mean if drawn else initial, n), np.zeros((n, n))
        if drawn:
            covariance = np.asarray(initial.covariance, dtype=float)
            self.mean = self._streams["initial"].multivariate_normal(self.mean, covariance)
        self._disturbed_plant(0.0)  # a disturbance that does not fit is found before the first step

    def measure(self, time: float) -> Gaussian:
        """Measures the state; the measurement is taken for certain: controllers of this package filter nothing."""
        measured = self._add_noise("measurement", self.mean)
        for disturbance in self.disturbances:
            measured = disturbance.disturb_measurement(measured, time)
        return Gaussian.certain(measured)

    def _disturbed_plant(self, time: float) -> Plant:
        plant = self.plant
        for disturbance in self.disturbances:
            plant = disturbance.disturb_plant(plant, time)
        return plant

    def _applied_input(self, input: Array) -> Array:
        if np.shape(input) != (shape := (len(self.plant.dynamics.input_names),)):
            raise ShapeError(f"the plant takes inputs of shape {shape}; got {np.shape(input)}")
        return self._add_noise("input", input)

    def _arrive(self, state: Array, applied: Array) -> Array | Diverged:
        """Returns the input that was applied, or why the plant cannot go on from its next state."""
        if not np.isfinite(state).all():
            before = f"it was {self.mean}, input {applied}"
            return Diverged(self._steps, f"the plant's state is not finite any more; {before}")
        if getattr(self.plant.dynamics, "ended", False):
            return Diverged(self._steps, f"the simulator has ended its episode, at state {state}")
        self.mean = self._add_noise("process", state)
        self._steps += 1
        return applied

    def _add_noise(self, source: str, value: Array) -> Array:
        deviations = getattr(self.noise, source)
        if deviations is None:
            return value
        return value + np.asarray(deviations, dtype=float) * self._streams[source].standard_normal(len(value))


class ModelSimulator:
    """Simulates a model loop from a mean (n,) with covariance ``initial_std``^2 I, or from a belief."""

    def __init__(self, loop: ModelLoop, initial: Any):
        self.loop, self._steps = loop, 0
        model, n = loop.model, loop.model.state_dim
        to: Any = {"device": model.device, "dtype": model.dtype}
        mean, covariance = initial, loop.initial_std**2 * torch.eye(n, **to)
        if isinstance(initial, Gaussian):
            mean, covariance = initial.mean, initial.covariance
        self._belief = Gaussian(torch.as_tensor(_check_state(mean, n), **to), covariance.to(**to))

    @property
    def mean(self) -> Array:
        """Of the belief (n,)."""
        return self._belief.mean.cpu().numpy().astype(float)

    @property
    def covariance(self) -> Array:
        """Of the belief (n, n)."""
        return self._belief.covariance.cpu().numpy().astype(float)

    def measure(self, time: float) -> Gaussian:
        """Returns the belief."""
        return self._belief

    def step(self, input: Array) -> Array | Diverged:
        """Carries the belief one step on; returns the input, or why it cannot go on."""
        control = torch.as_tensor(np.asarray(input, dtype=float)).to(self._belief.mean)
        belief = self.loop.propagator(self.loop.model, self._belief, control)
        if not bool(torch.isfinite(belief.mean).all() and torch.isfinite(belief.covariance).all()):
            return Diverged(self._steps, f"the model's belief is not finite any more; its mean is {belief.mean}")
        self._belief = belief
        self._steps += 1
        return input


Simulator = PlantSimulator | ModelSimulator


def step_together(simulators: Sequence[Any], time: float, inputs: Sequence[Array]) -> list[Array | Diverged]:
    """Steps simulators of one plant from a time [s] on, several plants in one evaluation.

    Returns the inputs that were applied, or why a simulator cannot go on.
    """
    if not simulators or isinstance(simulators[0], ModelSimulator):
        return [simulator.step(input) for simulator, input in zip(simulators, inputs, strict=True)]
    applied = [simulator._applied_input(input) for simulator, input in zip(simulators, inputs, strict=True)]
    plant = simulators[0]._disturbed_plant(time)  # disturbances look at the time, not at a trial
    with np.errstate(over="ignore", invalid="ignore"):
        if len(simulators) == 1:
            states: Any = [step(plant, simulators[0].mean, applied[0])]
        else:
            states = step_many(plant, np.array([s.mean for s in simulators]), np.array(applied))
    return [s._arrive(state, input) for s, state, input in zip(simulators, states, applied, strict=True)]


def _check_state(value: Any, n: int) -> Array:
    """Returns a finite state (n,) as an array of its own."""
    state = np.array(value.cpu().numpy() if isinstance(value, torch.Tensor) else value, dtype=float)
    if state.shape != (n,):
        raise ShapeError(f"the initial state must have shape ({n},); got {state.shape}")
    if not np.isfinite(state).all():
        raise SettingError("initial", f"must be finite; got {state}")
    return state
