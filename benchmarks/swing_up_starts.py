"""Swing-ups from hanging with the exact model.

Plain control beside searches from many starts.

    .venv/bin/python -m benchmarks.swing_up_starts [pendulum cart_pole acrobot furuta]

Plants of the gallery and a rotary pendulum, horizons from 30 to 80 stages, three
weightings. Plain control takes one program a step; the search is that of the guide: the
same controller, and a planner of ten programs a start. A flight is up from the time on
after which all angles that are to be upright stay within 0.2 rad to its end. Each
flight is a line of ``outputs/benchmarks/swing_up_starts.jsonl``.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import casadi
import numpy as np
from rich.console import Console

from gpmpc._angles import wrap
from gpmpc.models import CasadiFunction, KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Decision,
    ManyStarts,
    PredictionSettings,
    Problem,
    Tracking,
)
from gpmpc.propagation import Linearization
from gpmpc.studies._document import Table, terminal
from gpmpc.systems import (
    GRAVITY,
    System,
    acrobot,
    cart_pole,
    cos,
    double_pendulum,
    pendulum,
    sin,
    step,
)

Array = np.ndarray

HORIZONS = (30, 45, 60, 80)
NEAR = 0.2  # [rad]
FLIGHTS = Path("outputs/benchmarks/swing_up_starts.jsonl")


@dataclass(frozen=True)
class Furuta:
    """A pendulum at the end of an arm that a motor turns, as in a QUBE-Servo.

    The rods are uniform; ``angle`` is the pendulum's from upright.
    """

    arm_mass: float = 0.095  #: [kg]
    arm_length: float = 0.085  #: [m]
    mass: float = 0.024  #: of the pendulum [kg]
    length: float = 0.129  #: of the pendulum [m]
    arm_damping: float = 1e-4  #: [N m s]
    damping: float = 1e-5  #: of the pendulum [N m s]

    state_names = ("arm", "arm_rate", "angle", "rate")
    input_names = ("torque",)

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (arm, arm_rate, angle, rate) [rad/s, rad/s^2]."""
        arm_rate = x[1]
        rate = x[3]
        s = sin(x[2])
        c = cos(x[2])
        inertia = self.mass * self.length**2 / 3
        moment = self.mass * self.length / 2
        arm_inertia = (self.arm_mass / 3 + self.mass) * self.arm_length**2
        d11 = arm_inertia + inertia * s * s
        d12 = moment * self.arm_length * c
        d22 = inertia
        r1 = (
            u[0]
            - self.arm_damping * arm_rate
            - 2 * inertia * s * c * arm_rate * rate
            + moment * self.arm_length * s * rate * rate
        )
        r2 = (
            inertia * s * c * arm_rate * arm_rate
            + moment * GRAVITY * s
            - self.damping * rate
        )
        determinant = d11 * d22 - d12 * d12
        return [
            arm_rate,
            (d22 * r1 - d12 * r2) / determinant,
            rate,
            (d11 * r2 - d12 * r1) / determinant,
        ]


def furuta(time_step: float = 0.02) -> System:
    """Makes a rotary pendulum that hangs at first."""
    return System(
        Furuta(),
        time_step,
        4,
        name="furuta",
        input_lower=[-0.05],
        input_upper=[0.05],
        start=[0.0, 0.0, np.pi, 0.0],
        angles=["angle"],
    )


class Plant(NamedTuple):
    """What flies, for how long, and what its weights are."""

    system: System
    seconds: float
    Q: list[float]
    R: list[float]
    terminal: list[float] | None = None


PLANTS = {
    "pendulum": Plant(pendulum(), 6.0, [1.0, 0.01], [0.01]),
    "cart_pole": Plant(cart_pole(), 6.0, [1.0, 0.01, 1.0, 0.01], [0.01]),
    "acrobot": Plant(
        acrobot(), 10.0, [1.0, 0.1, 0.1, 0.1], [0.01], [30.0, 10.0, 30.0, 10.0]
    ),
    "furuta": Plant(furuta(), 4.0, [0.1, 0.001, 1.0, 0.001], [10.0]),
    "double_pendulum": Plant(
        double_pendulum(), 5.0, [10.0, 0.1, 10.0, 0.1], [0.01], None
    ),
}
WEIGHTINGS = {  # factors of the weights of rates and inputs
    "gallery": (1.0, 1.0),
    "rates x 10": (10.0, 1.0),
    "inputs x 10": (1.0, 10.0),
}


def known_model(system: System) -> KnownModel:
    """The model that is the plant."""
    n = len(system.state_names)
    m = len(system.input_names)
    x = casadi.SX.sym("x", n)
    u = casadi.SX.sym("u", m)
    successor = casadi.vertcat(*system.successor(x, u))
    function = CasadiFunction(casadi.Function("f", [x, u], [successor]))
    return KnownModel(function, n, m)


def problem_of(plant: Plant, weighting: str) -> Problem:
    """The plant's problem under other weights."""
    rates, inputs = WEIGHTINGS[weighting]
    factors = np.where(np.arange(len(plant.Q)) % 2, rates, 1.0)
    last = None if plant.terminal is None else factors * plant.terminal
    cost = Tracking(
        factors * plant.Q,
        inputs * np.array(plant.R),
        last,
        penalized="inputs",
        angles=plant.system.angle_indices,
    )
    return Problem(cost, inputs=Box(plant.system.input_lower, plant.system.input_upper))


class CountedStarts(ManyStarts):
    """Counts its searches."""

    searches = 0

    def plans(self, *arguments: Any, **named: Any) -> Iterator[tuple[Decision, float]]:
        """Those of ``ManyStarts``."""
        self.searches += 1
        return super().plans(*arguments, **named)


def controller(
    name: str, horizon: int, weighting: str, kind: str
) -> GPMPC | CountedStarts:
    """Plain control, ``kind`` plain, or the search of the guide."""
    plant = PLANTS[name]
    problem = problem_of(plant, weighting)
    model = known_model(plant.system)

    def make(iterations: int) -> GPMPC:
        return GPMPC(
            model,
            Linearization(),
            problem,
            horizon,
            plant.system.initial_input,
            PredictionSettings(covariance="none", rolled_out=True),
            iterations=iterations,
            tolerance=1e-2,
        )

    if kind == "plain":
        return make(1)
    return CountedStarts(make(1), make(10))


def fly(name: str, horizon: int, weighting: str, kind: str) -> dict[str, Any]:
    """Returns what one flight came to, as plain data."""
    system = PLANTS[name].system
    steering = controller(name, horizon, weighting, kind)
    loop = ControlLoop(steering)
    loop.warm_up(system.start, system.goal)
    if isinstance(steering, CountedStarts):
        steering.searches = 0
    state = np.array(system.start, dtype=float)
    states = [state]
    seconds = []
    paid = 0.0
    cost = steering.problem.cost
    for _ in range(round(PLANTS[name].seconds / system.time_step)):
        begin = process_time()
        input = loop.input(state, system.goal)
        seconds.append(process_time() - begin)
        state = step(system, state, input)
        states.append(state)
        error = state - system.goal
        error[list(cost.angle_indices)] = wrap(error[list(cost.angles)])
        paid += float(error @ cost.Q @ error + input @ cost.R @ input)
    upright = [i for i in system.angle_indices if system.state_names[i] != "arm"]
    errors = np.abs(wrap(np.array(states)[:, upright] - np.array(system.goal)[upright]))
    away = np.flatnonzero(errors.max(axis=1) > NEAR)
    settled = int(away[-1]) + 1
    searches = 0
    if isinstance(steering, CountedStarts):
        searches = steering.searches
    return {
        "plant": name,
        "horizon": horizon,
        "weighting": weighting,
        "kind": kind,
        "up": settled * system.time_step if settled < len(states) - 5 else None,
        "paid": paid,
        "searches": searches,
        "worst": max(seconds),
        "median": float(np.median(seconds)),
        "failures": loop.failures,
    }


def table(flights: list[dict[str, Any]]) -> Table:
    """Returns a line for each plant, horizon and weighting."""
    head = ("plant", "H", "weighting", "plain up [s]", "many up [s]", "plain paid")
    head += ("many paid", "searches", "worst decision [ms]")
    pairs: dict[tuple[Any, ...], dict[str, Any]] = {}
    for flight in flights:
        key = (flight["plant"], flight["horizon"], flight["weighting"])
        pairs.setdefault(key, {})[flight["kind"]] = flight
    rows = []
    for key, pair in pairs.items():
        plain = pair["plain"]
        many = pair["many"]
        ups = [
            "never" if flight["up"] is None else f"{flight['up']:.2f}"
            for flight in (plain, many)
        ]
        paid = [f"{flight['paid']:.4g}" for flight in (plain, many)]
        worst = f"{1e3 * many['worst']:.0f}"
        rows.append((*map(str, key), *ups, *paid, str(many["searches"]), worst))
    return Table(head, rows)


def main() -> None:
    """Flies and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plants", nargs="*", default=list(PLANTS)[:4])
    parser.add_argument("--horizons", nargs="*", type=int, default=HORIZONS)
    parser.add_argument("--weightings", nargs="*", default=list(WEIGHTINGS))
    arguments = parser.parse_args()
    FLIGHTS.parent.mkdir(parents=True, exist_ok=True)
    flights = []
    with FLIGHTS.open("a") as file:
        for name in arguments.plants:
            for weighting in arguments.weightings:
                for horizon in arguments.horizons:
                    for kind in ("plain", "many"):
                        flights.append(fly(name, horizon, weighting, kind))
                        file.write(json.dumps(flights[-1]) + "\n")
    Console(width=120).print(terminal([table(flights)]))


if __name__ == "__main__":
    main()
