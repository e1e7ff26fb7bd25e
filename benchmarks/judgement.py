"""How often flights are judged rightly.

Good ones, sabotaged ones, and a tank whose horizon is too short.

    .venv/bin/python -m benchmarks.judgement [good sabotaged tank cost] [--flights 100]

Good flights are those of the documentation's systems, with noise, set-point jumps,
waypoints, gusts and learning. Sabotaged ones fly well until something breaks: an input
acts the other way round, the plant's mass is another, a sensor freezes or is late, the
horizon is too short. A sabotage *shows* from the first step at which the flight's true
states are farther from those of the same flight without it than five deviations of the
noise and a twentieth of what it travels.
"""

import argparse
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from time import perf_counter
from types import SimpleNamespace
from typing import Any

import numpy as np
from rich.console import Console

from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._settings import compose, settings_folders
from gpmpc.gaussian import Gaussian
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import CasadiFunction, KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    FlightJudge,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.propagation import Linearization
from gpmpc.simulation import Disturbance, Gust, Noise, Replaced, closed_loop
from gpmpc.studies._document import Table, terminal
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.studies.study import one_thread
from gpmpc.systems import System

Array = np.ndarray


class Reversed(Disturbance):
    """From a time on an input acts the other way round, seen from its value at rest."""

    def __init__(self, input: int, start: float):
        self.input = input
        self.start = start

    def disturb_plant(self, plant: System, time: float) -> System:
        """Returns the plant with its input turned round."""
        return _reversed(plant, self.input) if time >= self.start else plant


@lru_cache(maxsize=8)
def _reversed(plant: System, input: int) -> System:
    at_rest = plant.initial_input[input]
    method_name = "successor" if hasattr(plant.dynamics, "successor") else "derivative"
    of = getattr(plant.dynamics, method_name)

    def turned(x: Any, u: Any) -> list[Any]:
        inputs = [u[j] for j in range(len(plant.input_names))]
        inputs[input] = 2.0 * at_rest - inputs[input]
        return of(x, inputs)

    names = {"state_names": plant.state_names, "input_names": plant.input_names}
    return replace(plant, dynamics=SimpleNamespace(**names, **{method_name: turned}))


class Frozen(Disturbance):
    """From a time on sensors show what they showed then."""

    def __init__(self, entries: Sequence[int], start: float):
        self.entries = list(entries)
        self.start = start
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
    """Four tanks and two pumps (Johansson, 2000).

    Each pump fills a lower tank, and more of the upper one across.

    Levels in cm, voltages in V; with less than half of the flow into the lower tanks it
    is of non-minimum phase.
    """

    state_names = ("level_1", "level_2", "level_3", "level_4")
    input_names = ("pump_1", "pump_2")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt levels [cm/s]."""
        outflow = [
            a * (2.0 * 981.0) ** 0.5 * h * (h * h + 1e-6) ** -0.25
            for a, h in zip(
                (0.071, 0.057, 0.071, 0.057), (x[0], x[1], x[2], x[3]), strict=True
            )
        ]
        first = 3.14 * u[0]
        second = 3.29 * u[1]
        return [
            (-outflow[0] + outflow[2] + 0.43 * first) / 28.0,
            (-outflow[1] + outflow[3] + 0.34 * second) / 32.0,
            (-outflow[2] + 0.66 * second) / 28.0,
            (-outflow[3] + 0.57 * first) / 32.0,
        ]


def tank(horizon: int, steps: int = 120, on_step: Any = None, **more: Any) -> Any:
    """Flies the tank with its true model from rest to higher levels.

    A step takes five seconds.
    """
    start = [12.6, 13.0, 4.8, 4.9]
    goal = [13.6, 14.0, 4.8, 4.9]
    plant = System(
        QuadrupleTank(),
        5.0,
        5,
        input_lower=[0.0, 0.0],
        input_upper=[10.0, 10.0],
        initial_input=[3.15, 3.15],
        start=start,
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
        plant,
        controller,
        np.array(goal),
        np.array(start),
        steps,
        on_step=on_step,
        on_failure="previous_plan",
        **more,
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
    with settings_folders():
        chosen = experiment_of(compose("run", [*overrides]))
    training = chosen.learn(chosen.training_rows(), chosen.seed)
    return replace(chosen, model=training.posterior)


def experiment(scenario: Scenario) -> Experiment:
    """Returns the flight, with a model that all flights of these settings share."""
    chosen = _trained(scenario.overrides)
    if scenario.start is not None:
        system = replace(chosen.system, start=scenario.start)
        chosen = replace(
            chosen,
            system=system,
            plant=chosen.plant and replace(chosen.plant, start=scenario.start),
        )
    if scenario.noise is not None or scenario.process is not None:
        chosen = replace(chosen, noise=Noise(scenario.process, scenario.noise))
    if scenario.horizon is not None:
        chosen = replace(
            chosen, controller=partial(chosen.controller, horizon=scenario.horizon)
        )
    if scenario.disturbances is not None:
        chosen = replace(
            chosen, disturbances=scenario.disturbances(chosen.plant_in_loop)
        )
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
    """Returns a hundred flights of the documentation's kinds that end well."""
    flights: list[Scenario] = []

    def add(
        name: str, count: int, *overrides: str, noisy: bool = True, **more: Any
    ) -> None:
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
    add(
        "planar quadrotor, gust",
        4,
        "system=planar_quadrotor",
        disturbances=_gust({"vx": 1.0}, 2.0, 3.0),
    )
    add("whole quadrotor, jump", 4, "system=coupled")
    add(
        "whole quadrotor, gust",
        4,
        "system=coupled",
        disturbances=_gust({"vx": 1.0}, 2.5, 3.5),
    )
    for path in ("elliptical", "lorenz", "hover", "step", "waypoints"):
        add(f"quadrotor, {path}", 4, f"trajectory={path}")
    for path in ("elliptical", "lorenz"):
        add(
            f"attitude, {path}",
            4,
            "system=rotational",
            f"trajectory={path}",
            "steps=200",
        )
    for path in ("lorenz", "hover"):
        add(
            f"gust, {path}",
            4,
            f"trajectory={path}",
            disturbances=_gust({"vx": 0.5}, 20, 40),
        )
    add("a fifth heavier, estimated", 4, "plant.mass=0.888", "disturbance_gain=0.3")
    add(
        "learning online in wind",
        4,
        "learning=online",
        disturbances=_gust({"vx": 0.5}, 20, np.inf),
    )
    add("process noise", 4, "trajectory=lorenz", process=(0.01,) * 6)
    add("few data", 4, "data.size=25", "horizon=5")
    for controller in ("paper", "lqr"):
        add(f"controller={controller}", 4, f"controller={controller}", "data.size=50")
    add("nmpc", 2, "controller=nmpc", "trajectory=lorenz")
    return flights


@dataclass(frozen=True)
class Sabotage:
    """What breaks in a flight, at a step."""

    name: str
    step: int
    make: Callable[[System, float], Any]  # from plant and time [s] to a disturbance


def _other(start: float, system: System, **changes: Any) -> Replaced:
    return Replaced(
        replace(system, dynamics=replace(system.dynamics, **changes)), start
    )


def _reversed_input(input: int) -> Callable[[System, float], Any]:
    return lambda system, start: Reversed(input, start)


def _frozen_sensor(state: int) -> Callable[[System, float], Any]:
    return lambda system, start: Frozen([state], start)


def _late_sensors(steps: int) -> Callable[[System, float], Any]:
    return lambda system, start: Late(steps, start)


def _heavier(factor: float, *names: str) -> Callable[[System, float], Any]:
    def other(system: System, start: float) -> Replaced:
        parameters = {name: getattr(system.dynamics, name) for name in names}
        changes = {
            name: tuple(factor * each for each in value)
            if isinstance(value, tuple | list)
            else factor * value
            for name, value in parameters.items()
        }
        return _other(start, system, **changes)

    return other


# settings of a flight, what is reversed, heavier, frozen and late, and when
SABOTAGED = {
    "double integrator": (("system=double_integrator",), 5, 0, ("mass",), 0, 3),
    "pendulum": (("system=pendulum",), 20, 0, ("mass",), 0, 2),
    "cart-pole": (("system=cart_pole",), 15, 0, ("cart_mass", "pole_mass"), 2, 2),
    "reactor": (("system=stirred_tank", "steps=140"), 80, 0, ("heat",), 1, 3),
    "planar quadrotor": (("system=planar_quadrotor",), 8, 0, ("mass",), 4, 3),
    "quadrotor": (("trajectory=lorenz",), 40, 1, ("mass",), 0, 3),
    "attitude": (
        ("system=rotational", "trajectory=lorenz", "steps=200"),
        60,
        0,
        ("inertia",),
        0,
        3,
    ),
    "whole quadrotor": (
        ("system=coupled", "trajectory.step.at=3.0"),
        58,
        1,
        ("mass",),
        0,
        3,
    ),
}


def sabotages(name: str) -> list[Sabotage]:
    """Returns what is done to a flight of ``SABOTAGED``.

    The heat of a reaction is half as much again.
    """
    _, step, input, masses, state, late = SABOTAGED[name]
    factor = 1.5 if masses == ("heat",) else 2.0
    return [
        Sabotage("an input's sign", step, _reversed_input(input)),
        Sabotage("twice the mass", step, _heavier(factor, *masses)),
        Sabotage("a frozen sensor", step, _frozen_sensor(state)),
        Sabotage("late sensors", step, _late_sensors(late)),
    ]


def first_shown(flown: Array, twin: Array, noise: Array) -> int | None:
    """Returns the first step at which two flights differ visibly, if there is one."""
    count = min(len(flown), len(twin))
    difference = np.abs(flown[:count] - twin[:count])
    visible = np.maximum(5.0 * noise, 0.05 * np.ptp(twin, axis=0))
    shown = np.flatnonzero((difference > visible).any(axis=1))
    return int(shown[0]) if len(shown) else None


def _first_farther(flown: Any, twin: Any) -> int | None:
    """Returns the first step at which a tank is behind its twin.

    It is farther from its levels by a twentieth of the way.
    """
    distances = [
        np.linalg.norm((each.states - each.references)[:, :2], axis=1)
        for each in (flown, twin)
    ]
    shown = np.flatnonzero(distances[0] > distances[1] + 0.05 * distances[1][0])
    return int(shown[0]) if len(shown) else None


def first_called(flown: Any, twin: Any, since: int) -> int | None:
    """Returns the first step from which on a flight is not healthy where its twin is.

    None without one.
    """
    for k in range(since, len(flown.judgements)):
        is_twin_healthy = (
            k >= len(twin.judgements) or twin.judgements[k].level == "healthy"
        )
        if flown.judgements[k].level != "healthy" and is_twin_healthy:
            return k
    return None


def good(limit: int) -> None:
    """Prints how good flights are judged."""
    flights = good_flights()[:limit]
    rows = []
    alarms = 0
    suspicious = 0
    for scenario in flights:
        with one_thread():
            judgement = run_trial(experiment(scenario)).rollout.judgement
        alarms += judgement.level != "healthy"
        suspicious += judgement.suspicious
        if judgement.level != "healthy" or judgement.suspicious:
            rows.append(
                [
                    scenario.name,
                    str(scenario.seed),
                    judgement.level,
                    str(judgement.suspicious),
                ]
            )
    title = f"{len(flights)} good flights: {alarms} lost or suspicious at their end, "
    title += f"{suspicious} steps suspicious"
    Console().print(
        terminal([Table(("flight", "seed", "judged", "suspicious steps"), rows, title)])
    )


def sabotaged() -> None:
    """Prints when sabotaged flights are called."""
    rows = []
    for name, (overrides, *_) in SABOTAGED.items():
        for noisy in (False, True):
            noise = NOISE[_system_of(overrides)]
            base = Scenario(name, overrides, seed=1, noise=noise if noisy else None)
            with one_thread():
                twin = run_trial(experiment(base)).rollout
            for sabotage in sabotages(name):

                def made(system: System, what: Sabotage = sabotage) -> list[Any]:
                    return [what.make(system, what.step * system.time_step)]

                with one_thread():
                    flown = run_trial(
                        experiment(replace(base, disturbances=made))
                    ).rollout
                shown = first_shown(flown.states, twin.states, np.array(noise))
                rows.append(
                    _row(
                        name,
                        sabotage.name,
                        noisy,
                        shown,
                        first_called(flown, twin, sabotage.step),
                        flown,
                    )
                )
    good_twin = tank(80)
    for horizon in (5, 10, 20, 40):
        flown = tank(horizon)
        shown = _first_farther(flown, good_twin)
        rows.append(
            _row(
                "quadruple tank",
                f"H = {horizon}",
                False,
                shown,
                first_called(flown, good_twin, 0),
                flown,
            )
        )
    relevant = [row for row in rows if row[3] != "-"]
    in_time = sum(row[-1] == "yes" for row in relevant)
    title = f"{len(relevant)} sabotaged flights that show it: "
    title += f"{in_time} called within 20 steps"
    header = (
        "flight",
        "sabotage",
        "noise",
        "shows at",
        "called at",
        "judged",
        "in time",
    )
    Console().print(terminal([Table(header, rows, title)]))


def _row(
    name: str, what: str, noisy: bool, shown: int | None, called: int | None, flown: Any
) -> list[str]:
    in_time = called is not None and (shown is None or called <= shown + 20)
    judged = flown.judgement
    level = judged.level if judged.level == "lost" or called is None else "suspicious"
    return [
        name,
        what,
        "yes" if noisy else "no",
        "-" if shown is None else str(shown),
        "-" if called is None else str(called),
        level,
        "yes" if in_time else "no",
    ]


def tanks() -> None:
    """Prints how the tank is judged by its horizon."""
    rows = []
    for horizon in (5, 10, 20, 30, 40, 50, 60, 80):
        flown = tank(horizon)
        judgement = flown.judgement
        solved = sum(status.solved for status in flown.statuses)
        rows.append(
            [
                str(horizon),
                f"{solved} of {len(flown.statuses)}",
                judgement.level,
                str(judgement.step),
                judgement.reason,
            ]
        )
    header = ("H", "solved", "judged", "from step", "reason")
    Console().print(
        terminal([Table(header, rows, "A tank of non-minimum phase, 5 s a step")])
    )


COSTS = {  # settings of flights whose decisions are timed beside their judgement
    "elliptical": ("trajectory=elliptical",),
    "lorenz": ("trajectory=lorenz",),
    "lorenz, means alone": (
        "trajectory=lorenz",
        "controller.prediction.covariance=none",
    ),
}


def cost() -> None:
    """Prints what judging takes beside deciding, with the caches that deciding leaves.

    Its measurements are those of a flight before.
    """
    rows = []
    for name, overrides in COSTS.items():
        chosen = experiment(Scenario(name, overrides, noise=NOISE["translational"]))
        with one_thread():
            flown = run_trial(chosen)
            measured = flown.rollout.measured
            deciding, judging = _times(chosen, flown.controller, measured)
        shares = judging / deciding
        rows.append(
            [
                name,
                f"{1e6 * np.median(judging):.1f}",
                f"{1e6 * np.median(deciding):.0f}",
                f"{100 * np.median(shares):.1f} %",
                f"{100 * np.percentile(shares, 99):.1f} %",
            ]
        )
    header = ("flight", "judging [us]", "deciding [us]", "share", "99 % below")
    Console().print(
        terminal([Table(header, rows, "Medians of a flight, six states, H = 10")])
    )


def _times(chosen: Experiment, controller: Any, measured: Array) -> tuple[Array, Array]:
    """Returns how long decisions on measurements take (K,), and their judgements."""
    horizon = controller.horizon
    references = chosen.references(len(measured) + horizon + 1)
    judge = FlightJudge.of(controller, 6, 3)
    decision = None
    times = []
    for k, state in enumerate(measured):
        ahead = references[k : k + horizon + 1]
        begin = perf_counter()
        decision = controller.control(
            Gaussian.certain(state), Reference(ahead), decision
        )
        decided = perf_counter()
        judge.judge(state, ahead, decision)
        times.append((decided - begin, perf_counter() - decided))
    deciding, judging = np.transpose(times)
    return deciding, judging


def main() -> None:
    """Prints the tables that were asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "parts", nargs="*", default=["good", "sabotaged", "tank", "cost"]
    )
    parser.add_argument("--flights", type=int, default=1000, help="good ones, at most")
    options = parser.parse_args()
    parts = {
        "good": partial(good, options.flights),
        "sabotaged": sabotaged,
        "tank": tanks,
        "cost": cost,
    }
    for part in options.parts:
        parts[part]()


if __name__ == "__main__":
    main()
