"""Counts what an exported controller takes on Cortex-M4F and M7, by its points.

    .venv/bin/python -m benchmarks.export_chip [--points 189 50 33 24 17 10]
                                               [--steps 50] [--precision float]

Needs ``arm-none-eabi-gcc`` with newlib, and ``qemu-system-arm``. The quadrotor of the
paper (n = 6, m = 3, H = 10) is learned from 189 points, exported with so many of them
(``with_points``), and its flight on the Lorenz path replayed in QEMU (boards
mps2-an386 and mps2-an500), where ``-icount`` gives each instruction a nanosecond.
Printed for each core: instructions of a step, median and worst, flash, RAM and stack,
and the largest difference of an input from Python's, as a share of its range; for each
number of points besides, over all points: the one-step error and the cost of the
flight, the mean and the worst of five seeds of 200 steps. They are instructions: not a
time on hardware. Writes ``outputs/benchmarks/export_chip.json``.
"""

import argparse
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks import quadrotor
from benchmarks.timing import use_one_thread, write_results
from gpmpc.export import Question, measure_footprint, with_points
from gpmpc.mpc import GPMPC, ControlLoop, Reference
from gpmpc.propagation import Linearization
from gpmpc.simulation import Rollout, closed_loop
from gpmpc.trajectories import states_along

HORIZON = 10
STEPS = 200
SEEDS = range(5)
CORES: Any = ("cortex-m4f", "cortex-m7")


def fly(path: np.ndarray, controller: Any, seed: int) -> Rollout:
    """Flies a controller along a path."""
    return closed_loop(
        quadrotor.OUTER,
        controller,
        path,
        path[0],
        len(path) - HORIZON - 1,
        noise=quadrotor.NOISE,
        on_failure="previous_plan",
        seed=seed,
    )


class Case:
    """The quadrotor of all points, its flights, and the questions of one."""

    def __init__(self, replayed: int):
        self.model = quadrotor.trained("lorenz")
        self.controller = GPMPC(
            self.model,
            Linearization(),
            quadrotor.problem(),
            HORIZON,
            quadrotor.HOVER,
            iterations=1,
        )
        trajectory = quadrotor.TRAJECTORIES["lorenz"]
        self.path = states_along(trajectory, np.arange(STEPS + HORIZON + 1.0))
        self.fly = partial(fly, self.path)
        self.flights = [self.fly(self.controller, seed) for seed in SEEDS]
        self.questions = [
            Question(state, Reference(self.path[k : k + HORIZON + 1]))
            for k, state in enumerate(self.flights[0].measured[:replayed])
        ]

    def errors(self, model: Any) -> np.ndarray:
        """Returns mean squared one-step errors of a model along the flights (n,)."""
        squares = []
        for flight in self.flights:
            states = flight.measured
            predicted = model.linearize(states[:-1], flight.inputs[:-1], False).mean
            squares.append(np.square(predicted - states[1:]))
        return np.concatenate(squares).mean(axis=0)

    def price(self, points: int) -> dict[str, Any]:
        """Returns what so many points cost, beside all."""
        model = with_points(self.model, points)
        controller = self.controller.with_model(model)
        errors = self.errors(model) / self.errors(self.model)
        costs = [
            self._cost(self.fly(controller, seed)) / self._cost(flight)
            for seed, flight in zip(SEEDS, self.flights, strict=True)
        ]
        return {
            "points": len(model),
            "error_ratio": float(np.sqrt(errors.mean())),
            "cost_ratio": float(np.mean(costs)),
            "worst_cost_ratio": max(costs),
        }

    def replay(self, points: int, core: Any, precision: Any) -> dict[str, Any]:
        """Compiles so many points for a core and replays the flight."""
        model = with_points(self.model, points)
        controller = self.controller.with_model(model)
        footprint = measure_footprint(controller, self.questions, core, precision)
        assert footprint.instructions is not None
        assert footprint.inputs is not None
        loop = ControlLoop(controller)
        inputs = np.array([loop.input(*question) for question in self.questions])
        differences = np.abs(footprint.inputs - inputs).max(axis=0)
        return {
            "core": core,
            "precision": precision,
            "median": float(np.median(footprint.instructions)),
            "worst": footprint.worst,
            "flash_bytes": footprint.flash,
            "ram_bytes": footprint.ram,
            "stack_bytes": footprint.stack,
            "share": float((differences / np.ptp(inputs, axis=0)).max()),
            "compiler": footprint.compiler,
        }

    @staticmethod
    def _cost(flight: Rollout) -> float:
        """Returns the tracking cost of a flight."""
        cost = quadrotor.problem().cost
        return float(flight.paid(cost, np.array(quadrotor.HOVER)).sum())


def rows_of(case: Case, points: Sequence[int], precision: str) -> list[dict[str, Any]]:
    """Measures all numbers of points on all cores; prints each row."""
    rows = []
    for count in points:
        price = case.price(count)
        for core in CORES:
            row = price | case.replay(count, core, precision)
            rows.append(row)
            print(row, flush=True)
    return rows


def main() -> None:
    """Learns, compiles, replays and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    points = [189, 50, 33, 24, 17, 10]
    parser.add_argument("--points", type=int, nargs="+", default=points)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--precision", default="float")
    arguments = parser.parse_args()
    use_one_thread()
    case = Case(arguments.steps)
    write_results("export_chip", rows_of(case, arguments.points, arguments.precision))


if __name__ == "__main__":
    main()
