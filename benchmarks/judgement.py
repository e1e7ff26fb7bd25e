"""How often flights are judged rightly: good ones, sabotaged ones, and a tank whose horizon is too short.

    .venv/bin/python -m benchmarks.judgement [good sabotaged tank cost] [--flights 100]

Good flights are those of the documentation's systems, with noise, set-point jumps, waypoints, gusts and learning.
Sabotaged ones fly well until something breaks: an input acts the other way round, the plant's mass is another, a
sensor freezes or is late, the horizon is too short. A sabotage *shows* from the first step at which the flight's true
states are farther from those of the same flight without it than five deviations of the noise and a twentieth of what
it travels.
"""

import argparse
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from types import SimpleNamespace
from typing import Any

import numpy as np

from gpmpc.cli._run import experiment_of
from gpmpc.cli._settings import compose, settings
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import CasadiFunction, KnownModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import Disturbance, Gust, Noise, Replaced, closed_loop
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.studies.study import one_thread
from gpmpc.systems import System

Array = np.ndarray


class Reversed(Disturbance):
    """From a time on an input acts the other way round, seen from its value at rest."""

    def __init__(self, input: int, start: float):
        self.input, self.start = input, start

    def disturb_plant(self, plant: System, time: float) -> System:
        """Returns the plant with its input turned round."""
        return _reversed(plant, self.input) if time >= self.start else plant


@lru_cache(maxsize=8)
def _reversed(plant: System, input: int) -> System:
    at_rest = plant.initial_input[input]
    known = "successor" if hasattr(plant.dynamics, "successor") else "derivative"
    of = getattr(plant.dynamics, known)

    def turned(x: Any, u: Any) -> list[Any]:
        inputs = [u[j] for j in range(len(plant.input_names))]
        inputs[input] = 2.0 * at_rest - inputs[input]
        return of(x, inputs)

    names = {"state_names": plant.state_names, "input_names": plant.input_names}
    return replace(plant, dynamics=SimpleNamespace(**names, **{known: turned}))


class Frozen(Disturbance):
    """From a time on sensors show what they showed then."""

    def __init__(self, entries: Sequence[int], start: float):
        self.entries, self.start = list(entries), start
        self._held: Array | None = None

    def disturb_measurement(self, state: Array, time: float) -> Array:
        """Returns the measurement with what is held."""
        if time < self.start:
            return state
        if self._held is None:
            self._held = state.copy()
        frozen = state.copy()
        frozen[self.entries] = self._held[self.entries]
        return frozen


class Late(Disturbance):
    """From a time on measurements come a number of steps late."""

    def __init__(self, steps: int, start: float):
        self.start = start
        self._past: deque[Array] = deque(maxlen=steps + 1)

    def disturb_measurement(self, state: Array, time: float) -> Array:
        """Returns an older measurement."""
        self._past.append(state.copy())
        return state if time < self.start else self._past[0].copy()


@dataclass(frozen=True)
class QuadrupleTank:
    """Four tanks and two pumps of which each fills a lower tank, and more of the upper one across (Johansson, 2000).

    Levels in cm, voltages in V; with less than half of the flow into the lower tanks it is of non-minimum phase.
    """

    state_names = ("level_1", "level_2", "level_3", "level_4")
    input_names = ("pump_1", "pump_2")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt levels [cm/s]."""
        outflow = [
            a * (2.0 * 981.0) ** 0.5 * h * (h * h + 1e-6) ** -0.25
            for a, h in zip((0.071, 0.057, 0.071, 0.057), (x[0], x[1], x[2], x[3]), strict=True)
        ]
        first, second = 3.14 * u[0], 3.29 * u[1]
        return [
            (-outflow[0] + outflow[2] + 0.43 * first) / 28.0,
            (-outflow[1] + outflow[3] + 0.34 * second) / 32.0,
            (-outflow[2] + 0.66 * second) / 28.0,
            (-outflow[3] + 0.57 * first) / 32.0,
        ]


def tank(horizon: int, steps: int = 120, on_step: Any = None, **more: Any) -> Any:
    """Flies the tank with its true model, five seconds a step, from rest to higher levels."""
    rest, goal = [12.6, 13.0, 4.8, 4.9], [13.6, 14.0, 4.8, 4.9]
    plant = System(
        QuadrupleTank(),
        5.0,
        5,
        input_lower=[0.0, 0.0],
        input_upper=[10.0, 10.0],
        initial_input=[3.15, 3.15],
        start=rest,
        goal=goal,
    )
    model = KnownModel(CasadiFunction(successor_function(plant)), 4, 2)
    problem = Problem(
        Tracking([1.0, 1.0, 0.0, 0.0], [0.1, 0.1]), inputs=Box([0.0, 0.0], [10.0, 10.0])
    )
    controller = GPMPC(
        model,
        Linearization(),
        problem,
        horizon,
        [3.15, 3.15],
        PredictionSettings(covariance="none"),
    )
    return closed_loop(
        plant, controller, np.array(goal), np.array(rest), steps, on_step=on_step,
        on_failure="previous_plan", **more,
    )


@dataclass(frozen=True)
class Scenario:
    """One flight: settings as on the command line, and what is done to it."""

    name: str
    overrides: tuple[str, ...]
    seed: int = 0
    noise: tuple[float, ...] | None = None  # of measurements
    process: tuple[float, ...] | None = None
    start: tuple[float, ...] | None = None
    disturbances: Callable[[System], list[Any]] | None = None
    horizon: int | None = None


@lru_cache(maxsize=64)
def _trained(overrides: tuple[str, ...]) -> Experiment:
    with settings():
        chosen = experiment_of(compose("run", [*overrides]))
    training = chosen.learn(chosen.training_rows(), chosen.seed)
    return replace(chosen, model=training.posterior)


def experiment(scenario: Scenario) -> Experiment:
    """Returns the flight, with a model that all flights of these settings share."""
    chosen = _trained(scenario.overrides)
    if scenario.start is not None:
        moved = replace(chosen.system, start=scenario.start)
        chosen = replace(chosen, system=moved, plant=chosen.plant and replace(chosen.plant, start=scenario.start))
    if scenario.noise is not None or scenario.process is not None:
        chosen = replace(chosen, noise=Noise(scenario.process, scenario.noise))
    if scenario.horizon is not None:
        chosen = replace(chosen, controller=partial(chosen.controller, horizon=scenario.horizon))
    if scenario.disturbances is not None:
        chosen = replace(chosen, disturbances=scenario.disturbances(chosen.flown))
    return replace(chosen, seed=scenario.seed)
