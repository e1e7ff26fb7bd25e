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


NOISE = {  # of measurements, by system
    "double_integrator": (0.005, 0.005),
    "pendulum": (0.005, 0.02),
    "cart_pole": (0.003, 0.01, 0.003, 0.02),
    "acrobot": (0.002, 0.01, 0.002, 0.01),
    "stirred_tank": (0.002, 0.1),
    "planar_quadrotor": (0.003, 0.01, 0.003, 0.01, 0.002, 0.02),
    "translational": (0.01,) * 6,
    "rotational": (0.002, 0.02) * 3,
    "coupled": (0.003, 0.01) * 3 + (0.002, 0.02) * 3,
}


def _system_of(overrides: Sequence[str]) -> str:
    named = [text.partition("=")[2] for text in overrides if text.startswith("system=")]
    return named[0] if named else "translational"


def _gust(rates: dict[str, float], start: float, stop: float) -> Any:
    return lambda system: [Gust(rates, start, stop)]


def good_flights() -> list[Scenario]:
    """Returns a hundred flights of the documentation's kinds that come to a good end."""
    flights: list[Scenario] = []

    def add(name: str, count: int, *overrides: str, noisy: bool = True, **more: Any) -> None:
        noise = NOISE[_system_of(overrides)]
        for seed in range(count):
            own = noise if noisy and seed % 2 else None
            flights.append(Scenario(name, overrides, seed, noise=own, **more))

    for data in range(3):  # swing-ups, each with models of its own
        for system in ("pendulum", "cart_pole"):
            add(f"{system} swings up", 4, f"system={system}", f"data.seed={data}")
    add("acrobot swings up", 2, "system=acrobot", noisy=False)
    add("double integrator", 4, "system=double_integrator")
    add("reactor", 4, "system=stirred_tank")
    add("planar quadrotor", 4, "system=planar_quadrotor")
    add("planar quadrotor, gust", 4, "system=planar_quadrotor", disturbances=_gust({"vx": 1.0}, 2.0, 3.0))
    add("whole quadrotor, jump", 4, "system=coupled")
    add("whole quadrotor, gust", 4, "system=coupled", disturbances=_gust({"vx": 1.0}, 2.5, 3.5))
    for path in ("elliptical", "lorenz", "hover", "step", "waypoints"):
        add(f"quadrotor, {path}", 4, f"trajectory={path}")
    for path in ("elliptical", "lorenz"):
        add(f"attitude, {path}", 4, "system=rotational", f"trajectory={path}", "steps=200")
    for path in ("lorenz", "hover"):
        add(f"gust, {path}", 4, f"trajectory={path}", disturbances=_gust({"vx": 0.5}, 20, 40))
    add("a fifth heavier, estimated", 4, "plant.mass=0.888", "disturbance_gain=0.3")
    add("learning online in wind", 4, "learning=online", disturbances=_gust({"vx": 0.5}, 20, np.inf))
    add("process noise", 4, "trajectory=lorenz", process=(0.01,) * 6)
    add("few data", 4, "data.size=25", "horizon=5")
    for controller in ("paper", "lqr"):
        add(f"controller={controller}", 4, f"controller={controller}", "data.size=50")
    add("nmpc", 2, "controller=nmpc", "trajectory=lorenz")
    return flights
