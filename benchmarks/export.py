"""Holds exported controllers to the decisions of Python, question by question.

    .venv/bin/python -m benchmarks.export [--questions 20000] [--cases quadrotor-10 ..]
                                          [--precisions double float] [--check]

Eight controllers fly in closed loops of Python: the quadrotor of the paper with a
horizon of 10 and of 20 (chance constraints of its position), and with so few points
that float takes its sums in whole numbers, a learned cart-pole that
must keep to its rail, the MuJoCo quadrotor whose residual is learned on a rigid body,
the learned pole whose input acts three steps late, four levels of a quadruple tank, and
a stirred tank whose reaction may run away. Every question of these flights (belief,
reference, last decision) goes to the compiled C as well, in double and in float. Every
flight has a seed, of its noise and of what disturbs its start, its reference or its
wind.
With ``--check`` a build with clang's sanitizers of addresses and undefined behaviour
answers every question as well, and the source is compiled strictly by gcc, linted by
cppcheck, and held to libm alone (``benchmarks.export_checks``); a fault ends the run.
Times of C then hold what it takes to hand the questions over.
Printed for each: questions, the largest difference of an input, as a share of the
input's range in brackets, other statuses, and the median time of a step of Python and
of C alone [ms]. Writes ``outputs/benchmarks/export.json``.
"""

import argparse
import runpy
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks import delayed_pole, quadrotor
from benchmarks.export_checks import CheckedController
from benchmarks.timing import use_one_thread, write_results
from gpmpc.export import CompiledController, with_points
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions, standardize
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import Affine, CasadiFunction, DelayedModel, ResidualModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise, closed_loop
from gpmpc.systems import cart_pole, step_many, stirred_tank
from gpmpc.trajectories import states_along

Array = np.ndarray
# of a flight, after which the next seed flies
STEPS = 250


class Case(NamedTuple):
    """A controller and its flights."""

    controller: GPMPC
    #: flies a controller once, with a seed
    fly: Callable[[Any, int], None]


class Comparison:
    """A controller that lets compiled ones answer every question, too.

    Attributes:
        inputs: Python's (questions, m).
        statuses: How often Python's decisions had each.
        python_seconds: Of every decision.
        answers: Of the compiled ones, by precision.
    """

    def __init__(
        self, controller: GPMPC, precisions: Sequence[Any], check: bool = False
    ):
        self.horizon = controller.horizon
        self.problem = controller.problem
        self.initial_input = controller.initial_input
        self._controller = controller
        compiled = CheckedController if check else CompiledController
        self.inputs: list[Array] = []
        self.statuses: Counter[str] = Counter()
        self.python_seconds: list[float] = []
        self.answers = {
            precision: CompiledAnswers(compiled(controller, precision))
            for precision in precisions
        }

    @property
    def signals(self):
        """Names of states and inputs."""
        return self._controller.signals

    def control(self, belief, reference, previous=None):
        """Decides by Python, and compares."""
        began = perf_counter()
        decision = self._controller.control(belief, reference, previous)
        self.python_seconds.append(perf_counter() - began)
        self.statuses[decision.status.name] += 1
        self.inputs.append(decision.input)
        for answers in self.answers.values():
            answers.compare(decision, belief, reference, previous)
        return decision


class CompiledAnswers:
    """How compiled code answers, beside Python.

    Attributes:
        differences: Of the inputs (questions, m).
        other_statuses: Pairs of names, where they differ.
        seconds: Of every step in C.
    """

    def __init__(self, compiled: CompiledController):
        self._compiled = compiled
        self.differences: list[Array] = []
        self.other_statuses: Counter[str] = Counter()
        self.seconds: list[float] = []

    def compare(self, decision, belief, reference, previous) -> None:
        """Asks what Python was asked."""
        compiled = self._compiled.control(belief, reference, previous)
        self.seconds.append(compiled.timing.solve)
        self.differences.append(np.abs(compiled.input - decision.input))
        if compiled.status is not decision.status:
            names = f"{decision.status.name}, {compiled.status.name}"
            self.other_statuses[names] += 1

    def checked(self) -> dict[str, Any]:
        """Returns what sanitised code answered, where it was asked.

        Raises:
            RuntimeError: A sanitizer found a fault.
        """
        if not isinstance(self._compiled, CheckedController):
            return {}
        questions, largest, other_statuses = self._compiled.replay.finish()
        return {
            "sanitized_questions": questions,
            "sanitized_largest": largest,
            "sanitized_other_statuses": other_statuses,
            "needed": self._compiled.replay.needed,
        }


def paper_quadrotor(horizon: int, points: int | None = None) -> Case:
    """The quadrotor's outer loop, its position kept with 95 %.

    Args:
        horizon: H.
        points: How many of its points stay; all by default.
    """
    model = quadrotor.trained("lorenz")
    if points is not None:
        model = with_points(model, points)
    lower, upper = quadrotor.STATE_BOUNDS["lorenz"]
    box = Box(lower, upper, probability=0.95)
    controller = GPMPC(
        model,
        Linearization(),
        quadrotor.problem(box),
        horizon,
        quadrotor.HOVER,
        iterations=1,
    )
    path = quadrotor.TRAJECTORIES["lorenz"]
    references = states_along(path, np.arange(STEPS + horizon + 1.0))
    width = np.asarray(upper, dtype=float) - lower
    width[np.isinf(width)] = 1.0

    def fly(flown: Any, seed: int) -> None:
        disturbance = np.random.default_rng(seed).uniform(-0.05, 0.05, len(lower))
        closed_loop(
            quadrotor.OUTER,
            flown,
            references,
            references[0] + disturbance * width,
            STEPS,
            noise=quadrotor.NOISE,
            seed=seed,
            on_failure="previous_plan",
        )

    return Case(controller, fly)


def learned_cart_pole() -> Case:
    """A cart-pole that swings up between the ends of its rail."""
    plant = cart_pole()
    rng = np.random.default_rng(0)
    count = 300
    states = rng.uniform([-1.5, -3, -np.pi, -6], [1.5, 3, np.pi, 6], (count, 4))
    forces = rng.uniform(plant.input_lower, plant.input_upper, (count, 1))
    after = step_many(plant, states, forces) + rng.normal(0, 1e-3, (count, 4))
    model = ResidualModel.train(
        Affine.identity(4, 1),
        Transitions(states, forces, after),
        angles=[2],
        trainer=Trainer(predicts="difference", scaling=standardize, restarts=0),
    )
    problem = Problem(
        Tracking([1, 0.01, 1, 0.01], [0.01], penalized="inputs", angles=[2]),
        inputs=Box(plant.input_lower, plant.input_upper),
        constraints=[Box([-1, -np.inf, -np.inf, -np.inf], [1, np.inf, np.inf, np.inf])],
    )
    controller = GPMPC(model, Linearization(), problem, 30, [0.0], iterations=1)
    goal = np.asarray(plant.goal, dtype=float)
    start = np.asarray(plant.start, dtype=float)

    def fly(flown: Any, seed: int) -> None:
        reference = goal.copy()
        rng = np.random.default_rng(seed)
        reference[0] = rng.uniform(-1.2, 1.2)
        closed_loop(
            plant,
            flown,
            reference,
            start + rng.uniform(-0.3, 0.3, 4),
            STEPS,
            noise=Noise(measurement=[1e-3] * 4),
            seed=seed,
            on_failure="previous_plan",
        )

    return Case(controller, fly)


def reactor() -> Case:
    """The reactor at its unstable operating point, its temperature kept below."""
    plant = stirred_tank()
    rng = np.random.default_rng(0)
    count = 200
    goal = np.asarray(plant.goal, dtype=float)
    states = goal + rng.uniform([-0.25, -15], [0.25, 15], (count, 2))
    coolant = rng.uniform(plant.input_lower, plant.input_upper, (count, 1))
    after = step_many(plant, states, coolant)
    after = after + rng.normal(0, [1e-3, 0.1], (count, 2))
    calm = np.abs(after[:, 1] - goal[1]) < 60.0  # the reaction did not run away
    data = Transitions(states[calm], coolant[calm], after[calm])
    trainer = Trainer(predicts="difference", scaling=standardize, restarts=0)
    model = trainer(data, seed=0).posterior
    hot = Box(upper=[np.inf, goal[1] + 3.0], probability=0.95)
    problem = Problem(
        Tracking([100.0, 0.01], [0.001]),
        inputs=Box(plant.input_lower, plant.input_upper),
        input_rates=Box([-5.0], [5.0]),
        constraints=[hot],
    )
    settings = PredictionSettings(disturbance_gain=0.3)
    controller = GPMPC(
        model,
        Linearization(),
        problem,
        15,
        plant.initial_input,
        settings,
        iterations=1,
    )

    def fly(flown: Any, seed: int) -> None:
        offset = np.random.default_rng(seed).uniform([-0.1, -8], [0.1, 8])
        closed_loop(
            plant,
            flown,
            goal,
            goal + offset,
            STEPS,
            noise=Noise(measurement=[1e-3, 0.1]),
            seed=seed,
            on_failure="previous_plan",
        )

    return Case(controller, fly)


def quadruple_tank() -> Case:
    """Four levels by two pumps: the lower ones go from set point to set point."""
    script = Path(__file__).with_name("robots") / "tank.py"
    sys.argv = [str(script), "0"]  # the seed of its data
    learned = runpy.run_path(str(script))
    plant = learned["plant"]
    problem = Problem(
        Tracking([1.0, 1.0, 0.0, 0.0], [0.1, 0.1]),
        inputs=Box(plant.input_lower, plant.input_upper),
        constraints=[Box(upper=[18.0, 18.0, np.inf, np.inf], probability=0.95)],
    )
    settings = PredictionSettings(disturbance_gain=0.3)
    controller = GPMPC(
        learned["model"],
        Linearization(),
        problem,
        20,
        plant.initial_input,
        settings,
        iterations=1,
    )
    goal = np.asarray(plant.goal, dtype=float)
    start = np.asarray(plant.start, dtype=float)

    def fly(flown: Any, seed: int) -> None:
        rng = np.random.default_rng(seed)
        references = np.tile(goal, (STEPS + controller.horizon + 1, 1))
        for first in range(0, len(references), 60):
            references[first:, :2] = rng.uniform(8.0, 17.5, 2)
        closed_loop(
            plant,
            flown,
            references,
            start * rng.uniform(0.7, 1.3, 4),
            STEPS,
            noise=Noise(measurement=[0.01] * 4),
            seed=seed,
            on_failure="previous_plan",
        )

    return Case(controller, fly)


def late_pole() -> Case:
    """MuJoCo's pole whose pushes act three steps late, its pending inputs states."""
    delay = delayed_pole.DELAY
    planned = DelayedModel(delayed_pole.learned(), delay)
    weights = np.zeros(planned.state_dim)
    weights[:4] = 1.0, 3.0, 0.3, 0.3
    pole = delayed_pole.pole
    problem = Problem(
        Tracking(weights.tolist(), [20.0]),
        Box(*(limit.tolist() for limit in pole.input_limits)),
    )
    controller = GPMPC(
        planned, Linearization(), problem, delayed_pole.HORIZON, [0.0], iterations=1
    )

    def fly(flown: Any, seed: int) -> None:
        _fly_late_pole(flown, planned, seed)

    return Case(controller, fly)


def _fly_late_pole(flown: Any, planned: DelayedModel, seed: int) -> None:
    """Flies one episode of the late pole."""
    delay = delayed_pole.DELAY
    horizon = delayed_pole.HORIZON
    pole = delayed_pole.pole
    reference = np.zeros((STEPS + horizon + 1, planned.state_dim))
    turns = np.arange(len(reference)) // delayed_pole.TURN % 2
    reference[:, 0] = np.where(turns, -delayed_pole.SIDE, delayed_pole.SIDE)
    state = pole.reset(seed)
    pending = [np.zeros(1)] * delay
    decision = None
    for k in range(STEPS):
        belief = planned.augmented(Gaussian.certain(state), np.array(pending))
        followed = Reference(reference[k : k + horizon + 1])
        decision = flown.control(belief, followed, decision)
        state = pole.successor(state, pending[0])
        pending = [*pending[1:], decision.input]
        if pole.ended:
            return


def mujoco_quadrotor() -> Case:
    """MuJoCo's quadrotor: the data sheet's rigid body, and what it misses."""
    from benchmarks import mujoco_quadrotor as flights
    from gpmpc.systems.mujoco_quadrotor import mujoco_quadrotor as vehicle_of

    vehicle = vehicle_of()
    nominal = vehicle.nominal
    assert nominal is not None  # the rigid body of the data sheet
    rng = np.random.default_rng(0)
    rows = []
    for k in range(3):
        flown = flights.fly(
            vehicle, flights.known(nominal), flights.excitation(rng), k, dither=0.1
        )
        rows.append((flown.measured[:-1], flown.inputs[:-1], flown.measured[1:]))
    x, u, after = (np.concatenate(part) for part in zip(*rows, strict=True))
    chosen = np.sort(rng.permutation(len(x))[:200])
    model = ResidualModel.train(
        CasadiFunction(successor_function(nominal)),
        Transitions(x[chosen], u[chosen], after[chosen]),
        torch.eye(12, dtype=torch.float64)[:, flights.MOVED],
        [1, 3, 5, 6, 7, 8, 9, 10, 11],
        trainer=Trainer(predicts="difference", scaling=standardize, restarts=0),
    )
    settings = PredictionSettings(disturbance_gain=0.3)
    controller = GPMPC(
        model,
        Linearization(),
        flights.PROBLEM,
        flights.HORIZON,
        flights.HOVER,
        settings,
        iterations=1,
    )

    def fly(flown: Any, seed: int) -> None:
        wind = tuple(np.random.default_rng(seed).uniform(-3, 3, 3).tolist())
        states = flights.along(list(flights.PATHS)[seed % 2])
        closed_loop(
            vehicle_of(wind=wind),
            flown,
            states,
            None,
            min(STEPS, len(states) - flights.HORIZON - 1),
            noise=Noise(measurement=flights.MEASURED),
            seed=seed,
            on_failure="previous_plan",
        )

    return Case(controller, fly)


CASES: dict[str, Callable[[], Case]] = {
    "quadrotor-10": lambda: paper_quadrotor(10),
    "quadrotor-20": lambda: paper_quadrotor(20),
    "quadrotor-46-points": lambda: paper_quadrotor(10, points=46),
    "cart-pole": learned_cart_pole,
    "mujoco-quadrotor": mujoco_quadrotor,
    "delayed-pole": late_pole,
    "stirred-tank": reactor,
    "quadruple-tank": quadruple_tank,
}


def compare(
    name: str,
    case: Case,
    questions: int,
    precisions: Sequence[Any],
    check: bool = False,
) -> list[dict[str, Any]]:
    """Asks all of them a number of questions; returns a row for each precision."""
    comparison = Comparison(case.controller, precisions, check)
    seed = 0
    while len(comparison.inputs) < questions:
        case.fly(comparison, seed)
        seed += 1
    lower, upper = case.controller.problem.inputs.first
    inputs = np.array(comparison.inputs)
    used_ranges = inputs.max(axis=0) - inputs.min(axis=0)
    ranges = np.where(np.isfinite(upper - lower), upper - lower, used_ranges)
    rows = []
    for precision, answers in comparison.answers.items():
        differences = np.array(answers.differences)
        rows.append(
            {
                "case": name,
                "precision": precision,
                "questions": len(differences),
                "flights": seed,
                "largest": float(differences.max()),
                "share": float((differences / ranges).max()),
                "other_statuses": dict(answers.other_statuses),
                "statuses": dict(comparison.statuses),
                "python_ms": 1e3 * float(np.median(comparison.python_seconds)),
                "c_ms": 1e3 * float(np.median(answers.seconds)),
                **answers.checked(),
            }
        )
    return rows


def main() -> None:
    """Asks, compares and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--questions", type=int, default=20_000)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    parser.add_argument("--precisions", nargs="+", default=["double", "float"])
    parser.add_argument("--check", action="store_true")
    arguments = parser.parse_args()
    use_one_thread()
    table = []
    for name in arguments.cases:
        rows = compare(
            name,
            CASES[name](),
            arguments.questions,
            arguments.precisions,
            arguments.check,
        )
        table += rows
        for row in rows:
            print(
                f"{name:18}{row['precision']:8}{row['questions']:8}"
                f"{row['largest']:10.2g} ({row['share']:.2g}) "
                f"{row['other_statuses'] or 'same statuses'} {row['statuses']} "
                f"{row['python_ms']:.3f} {row['c_ms']:.3f}",
                flush=True,
            )
            if arguments.check:
                print(
                    f"    sanitised: {row['sanitized_questions']} answers, "
                    f"{row['sanitized_largest']:.2g} from the first build, "
                    f"{row['sanitized_other_statuses']} other statuses; "
                    f"needs {', '.join(row['needed'])}",
                    flush=True,
                )
    write_results("export", table)


if __name__ == "__main__":
    main()
