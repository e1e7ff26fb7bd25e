"""What a step's decision costs and keeps.

Programs a step, a rotary pendulum in a narrow arm, a car in a lane.

    .venv/bin/python -m benchmarks.decisions [programs furuta car] [--seeds 5]

``programs`` flies plants of the gallery with their exact models by one program a step,
by as many as it needs (the default), and by the converged controller: closed-loop cost
relative to the last, programs a step.

``furuta`` swings a rotary pendulum up by a GP of 500 noisy rows, free and with an arm
that is to stay within a box with 95 % at every stage. ``car`` drives a figure of eight
in a lane, by a GP of 500 noisy rows, where it starts beside it or not: without the
lane, with a price of 100, with exact and with elastic bounds (the default).
"""

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from rich.console import Console

from benchmarks.coverage import car
from benchmarks.swing_up_starts import furuta, known_model
from benchmarks.timing import use_one_thread
from gpmpc._angles import wrap
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions, standardize
from gpmpc.models import Affine, ResidualModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    Decision,
    Inequality,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.propagation import Linearization
from gpmpc.studies._document import Table, terminal
from gpmpc.systems import (
    System,
    acrobot,
    cart_pole,
    pendulum,
    planar_quadrotor,
    rotational,
    step,
    stirred_tank,
    translational,
)
from gpmpc.trajectories import Lorenz

Array = np.ndarray

NEAR = 0.2  # of upright [rad]
ROWS = 500
SENSORS = 1e-3  # standard deviation of the rows of the rotary pendulum [rad, rad/s]


class Course(NamedTuple):
    """What is flown, on which references (K, n), and how it is weighed."""

    system: System
    problem: Problem
    horizon: int
    start: Array
    references: Array
    steps: int


@dataclass
class Log:
    """What happened in a flight."""

    states: list[Array] = field(default_factory=list)
    inputs: list[Array] = field(default_factory=list)
    programs: list[int] = field(default_factory=list)
    statuses: Counter = field(default_factory=Counter)
    largest_deviation: float = 0.0

    def add(self, decision: Decision, state: Array, input: Array) -> None:
        """Adds a step, and the state that it led to."""
        self.states.append(state)
        self.inputs.append(input)
        self.programs.append(decision.iterations)
        self.statuses[decision.status.name] += 1
        if decision.applicable:
            variances = np.diagonal(decision.covariances, axis1=1, axis2=2)
            largest = float(np.sqrt(variances.max()))
            self.largest_deviation = max(self.largest_deviation, largest)

    @property
    def ends(self) -> str:
        """How decisions ended, the solved ones left out."""
        others = self.statuses - Counter(SOLVED=self.statuses["SOLVED"])
        return ", ".join(f"{name} {count}" for name, count in others.items()) or "-"


def fly(
    course: Course,
    controller: GPMPC,
    sensors: Any = 0.0,
    seed: int = 0,
    parameters: Any = None,
) -> Log:
    """Flies a course.

    ``parameters`` of all steps (K, q) are handed over stage by stage.
    """
    generator = np.random.default_rng(seed)
    problem = course.problem
    state = np.array(course.start, dtype=float)
    decision = None
    log = Log()
    horizon = course.horizon
    for k in range(course.steps):
        measured = state + sensors * generator.normal(size=len(state))
        ahead = course.references[k : k + horizon + 1]
        parameters_ahead = (
            None if parameters is None else parameters[k + 1 : k + horizon + 1]
        )
        decision = controller.control(
            Gaussian.certain(measured),
            Reference(ahead),
            decision,
            parameters=parameters_ahead,
        )
        input = np.clip(decision.input, problem.inputs.lower, problem.inputs.upper)
        state = step(course.system, state, input)
        log.add(decision, state, input)
    return log


def cost_of(course: Course, log: Log) -> float:
    """What a flight cost."""
    cost = course.problem.cost
    errors = np.array(log.states) - course.references[1 : course.steps + 1]
    angles = list(cost.angle_indices)
    errors[:, angles] = wrap(errors[:, angles])
    inputs = np.array(log.inputs)
    if cost.penalized == "increments":
        before = np.vstack([course.system.initial_input, inputs[:-1]])
        inputs = inputs - before
    of_states = np.einsum("ki,ij,kj->", errors, cost.Q, errors)
    return float(of_states + np.einsum("ki,ij,kj->", inputs, cost.R, inputs))


def courses() -> Iterator[tuple[str, Course]]:
    """Plants of the gallery."""
    swings: dict[str, tuple] = {
        "pendulum": (pendulum(), [1.0, 0.01], [0.01], None, 30),
        "cart-pole": (cart_pole(), [1.0, 0.01, 1.0, 0.01], [0.01], None, 30),
        "acrobot": (
            acrobot(),
            [1.0, 0.1, 0.1, 0.1],
            [0.01],
            [30.0, 10.0, 30.0, 10.0],
            35,
        ),
        "furuta": (furuta(), [1.0, 0.01, 10.0, 0.01], [10.0], None, 25),
    }
    for name, (system, Q, R, last, horizon) in swings.items():
        cost = Tracking(Q, R, last, penalized="inputs", angles=system.angle_indices)
        problem = Problem(cost, Box(system.input_lower, system.input_upper))
        references = np.zeros((300, len(Q)))
        start = np.array(system.start)
        yield name, Course(system, problem, horizon, start, references, 200)

    system = planar_quadrotor()
    references = np.zeros((200, 6))
    references[:, [0, 2]] = np.array([[0, 0], [1, 0.5], [0, 0], [-1, 0.5]]).repeat(
        50, axis=0
    )
    cost = Tracking([10.0, 1.0, 10.0, 1.0, 1.0, 0.1], [0.1, 0.1])
    problem = Problem(cost, Box(system.input_lower, system.input_upper))
    yield "planar quadrotor", Course(system, problem, 20, np.zeros(6), references, 160)

    system = stirred_tank()
    references = np.tile(np.array(system.goal), (120, 1))
    cost = Tracking([100.0, 0.01], [0.001])
    problem = Problem(cost, Box(system.input_lower, system.input_upper))
    start = np.array(system.start)
    yield "stirred tank", Course(system, problem, 10, start, references, 100)

    system = translational()
    references = np.asarray(system.reference_states(Lorenz(), 120))
    cost = Tracking([1.0] * 6, [1.0] * 3)
    problem = Problem(cost, Box(system.input_lower, system.input_upper))
    yield "Lorenz path", Course(system, problem, 10, references[0], references, 100)

    system = rotational()
    references = np.zeros((240, 6))
    references[:, 2] = np.where((np.arange(240) // 40) % 2, 0.6, -0.6)
    problem = Problem(cost, Box(system.input_lower, system.input_upper))
    yield "attitude jumps", Course(system, problem, 10, np.zeros(6), references, 200)


def programs() -> Table:
    """One program a step, as many as it needs, and the converged controller."""
    ways: dict[str, dict[str, Any]] = {
        "one": {"iterations": 1},
        "needed": {},
        "converged": {"iterations": 100, "tolerance": 1e-6},
    }
    rows = []
    for name, course in courses():
        logs = {}
        for way, settings in ways.items():
            controller = GPMPC(
                known_model(course.system),
                Linearization(),
                course.problem,
                course.horizon,
                course.system.initial_input,
                PredictionSettings(covariance="none"),
                **settings,
            )
            logs[way] = fly(course, controller)
        costs = {way: cost_of(course, log) for way, log in logs.items()}
        needed = logs["needed"]
        rows.append(
            [
                name,
                f"{costs['one'] / costs['converged']:.3f}",
                f"{costs['needed'] / costs['converged']:.3f}",
                f"{np.mean(needed.programs):.2f} ({max(needed.programs)})",
                f"{np.mean(logs['converged'].programs):.2f}",
                needed.ends,
            ]
        )
    header = ["plant", "cost, one", "cost, as needed", "programs (most)"]
    header += ["programs, converged", "ends other than SOLVED"]
    return Table(header, rows, "Closed-loop cost over the converged controller's")


def rows_of_furuta(seed: int) -> Transitions:
    """Noisy rows under random torques from random starts."""
    generator = np.random.default_rng(seed)
    system = furuta()
    states = []
    inputs = []
    after = []
    while len(states) < ROWS:
        spread = [0.5, 4.0, 2.5, 8.0]
        x = generator.normal(size=4) * spread + [0.0, 0.0, np.pi, 0.0]
        for _ in range(10):
            u = generator.uniform(-0.05, 0.05, 1)
            following = step(system, x, u)
            states.append(x + SENSORS * generator.normal(size=4))
            inputs.append(u)
            after.append(following + SENSORS * generator.normal(size=4))
            x = following
    return Transitions(np.array(states), np.array(inputs), np.array(after))


def furuta_in_a_box(seeds: int) -> Table:
    """A rotary pendulum whose arm is to stay within a box."""
    system = furuta()
    cost = Tracking([1.0, 0.01, 10.0, 0.01], [10.0], penalized="inputs", angles=[2])
    rows = []
    for seed in range(seeds):
        trainer = Trainer(predicts="value", scaling=standardize, restarts=0)
        model = ResidualModel.train(
            Affine.identity(4, 1),
            rows_of_furuta(seed),
            trainer=trainer,
            seed=seed,
            angles=[2],
        )
        for horizon in (20, 25, 40):
            for bound in (np.inf, 1.5, 0.5):
                limit = np.array([bound, np.inf, np.inf, np.inf])
                box = Box(-limit, limit, probability=0.95)
                problem = Problem(
                    cost,
                    Box(system.input_lower, system.input_upper),
                    constraints=[box] if np.isfinite(bound) else [],
                )
                start = np.array(system.start)
                course = Course(
                    system, problem, horizon, start, np.zeros((260, 4)), 200
                )
                controller = GPMPC(model, Linearization(), problem, horizon, [0.0])
                log = fly(course, controller, SENSORS, seed)
                states = np.array(log.states)
                away = np.flatnonzero(np.abs(wrap(states[:, 2])) > NEAR)
                up = (away[-1] + 2) * system.time_step
                rows.append(
                    [
                        seed,
                        horizon,
                        bound,
                        f"{up:.2f}" if away[-1] < len(states) - 25 else "never",
                        f"{np.mean(np.abs(states[:, 0]) <= bound):.3f}",
                        f"{log.largest_deviation:.2g}",
                        log.ends,
                    ]
                )
    header = ["seed", "H", "arm within", "up after [s]", "kept", "deviation"]
    return Table([*header, "ends other than SOLVED"], rows, "Rotary pendulum")


def eight(speed: float, steps: int, radius: float = 1.45) -> Array:
    """A figure of eight as references of the car (steps, 6)."""
    time_step = car().time_step
    distance = speed * time_step * np.arange(steps)
    turns = np.tanh(2.0 * np.sin(distance / (2.0 * radius)))
    curvature = turns / radius
    change = curvature * speed * time_step
    yaw = np.concatenate([[0.0], np.cumsum(change)])[:steps]
    middle = yaw + change / 2
    forward = speed * time_step * np.stack([np.cos(middle), np.sin(middle)], axis=1)
    places = np.vstack([np.zeros(2), np.cumsum(forward, axis=0)])[:steps]
    still = np.zeros(steps)
    speeds = np.full(steps, speed)
    return np.column_stack([places, yaw, speeds, still, curvature * speed])


def rows_of_car(seed: int) -> Transitions:
    """Noisy rows under random steering from random headings and speeds."""
    generator = np.random.default_rng(seed)
    system = car()
    spread = 0.002 * np.array([1.0, 1.0, 1.0, 5.0, 5.0, 10.0])
    states = []
    inputs = []
    after = []
    while len(states) < ROWS:
        x = np.zeros(6)
        x[2] = generator.uniform(-np.pi, np.pi)
        x[3] = generator.uniform(1.0, 2.6)
        u = np.zeros(2)
        for _ in range(12):
            u = 0.6 * u + generator.normal(size=2) * [0.15, 1.2]
            u = np.clip(u, system.input_lower, system.input_upper)
            following = step(system, x, u)
            if following[3] < 0.5:
                break
            states.append(x + spread * generator.normal(size=6))
            inputs.append(u)
            after.append(following + spread * generator.normal(size=6))
            x = following
    return Transitions(np.array(states), np.array(inputs), np.array(after))


def beside(x: torch.Tensor, u: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
    """How far a car is to the left of its path.

    P are a point of the path and the normal there.
    """
    return p[:, 2] * (x[:, 0] - p[:, 0]) + p[:, 3] * (x[:, 1] - p[:, 1])


def car_in_a_lane(seeds: int, width: float = 0.05) -> Table:
    """A car that is to stay within a lane with 95 %, under several prices."""
    system = car()

    def lane(x: torch.Tensor, u: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
        left = beside(x, u, p)
        return torch.stack([left - width, -left - width], dim=1)

    cost = Tracking([10.0, 10.0, 1.0, 1.0, 0.01, 0.01], [0.5, 0.02], angles=[2])
    prices: dict[str, Any] = {"no lane": None, "100": 100.0, "exact": "exact"}
    prices["elastic"] = "elastic"
    rows = []
    for seed in range(seeds):
        trainer = Trainer(predicts="difference", scaling=standardize, restarts=0)
        model = trainer(rows_of_car(seed), seed=0).posterior
        for speed, offset in ((1.6, 0.0), (2.2, 0.0), (2.2, 0.2)):
            references = eight(speed, 200)
            normals = [-np.sin(references[:, 2]), np.cos(references[:, 2])]
            path = np.column_stack([references[:, :2], *normals])
            for name, price in prices.items():
                bounds = []
                if name != "no lane":
                    bounds = [
                        Inequality(h=lane, count=2, probability=0.95, penalty=price)
                    ]
                problem = Problem(
                    cost,
                    Box(system.input_lower, system.input_upper),
                    constraints=bounds,
                )
                controller = GPMPC(model, Linearization(), problem, 20, [0.0, 0.0])
                start = references[0] + [0.0, offset, 0.0, 0.0, 0.0, 0.0]
                course = Course(system, problem, 20, start, references, 150)
                sensors = 0.002 * np.array([1.0, 1.0, 1.0, 5.0, 5.0, 10.0])
                given = path if bounds else None
                log = fly(course, controller, sensors, seed, given)
                states = torch.from_numpy(np.array(log.states))
                left = beside(states, states, torch.from_numpy(path[1:151]))
                rows.append(
                    [
                        seed,
                        speed,
                        offset,
                        name,
                        f"{left.square().mean().sqrt():.3f}",
                        f"{left.abs().max():.2f}",
                        f"{(left.abs() > width).double().mean():.2f}",
                        log.ends,
                    ]
                )
    header = ["seed", "speed", "starts beside", "bound", "RMS [m]", "most", "outside"]
    return Table([*header, "ends other than SOLVED"], rows, "Car")


def main() -> None:
    """Flies and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    names = ["programs", "furuta", "car"]
    parser.add_argument("tables", nargs="*", default=names)
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    use_one_thread()
    console = Console()
    if "programs" in arguments.tables:
        console.print(terminal([programs()]))
    if "furuta" in arguments.tables:
        console.print(terminal([furuta_in_a_box(arguments.seeds)]))
    if "car" in arguments.tables:
        console.print(terminal([car_in_a_lane(arguments.seeds)]))


if __name__ == "__main__":
    main()
