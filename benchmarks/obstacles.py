"""Counts how often a point touches one of three discs, one of them moving.

Each is to be missed with a probability.

    .venv/bin/python -m benchmarks.obstacles [--scenes 200] [--probability 0.95]

A mass in the plane (n = 4, m = 2) with a drag that grows with its speed is learned from
250 random steps, and steered past random discs to a set point by ``GPMPC`` over 20
stages of 0.1 s, under process noise. Where discs will be comes with each call. A scene
ends after 60 steps. Printed: steps inside a disc, of those whose plan touches a disc's
bound at some stage, the exact 95 % interval of that rate (Clopper and Pearson, 1934;
for independent decisions), scenes with any such step, the time of a decision, and how
many programs had no plan that keeps all bounds (by HiGHS, as a linear program), which
of them the decision says by its ``violation``, and which it does not.

Each scene is a line of ``outputs/benchmarks/obstacles.jsonl`` as soon as it is done: a
run of the same code that stopped goes on there.
"""

import argparse
from time import perf_counter

import casadi
import numpy as np
from scipy.optimize import linprog
from scipy.stats import beta

from benchmarks.timing import RESULTS, describe, machine, own_source
from gpmpc.gp import GPPosterior, Transitions, standardize, train
from gpmpc.mpc import GPMPC, Box, ControlLoop, Decision, Inequality, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.studies.study import TrialStore, fingerprint

# stages, [-], [s]
HORIZON = 20
STEPS = 60
STEP = 0.1
NOISE = np.array(
    [0.004, 0.02, 0.004, 0.02]
)  # standard deviations a step [m, m/s, m, m/s]
GOAL = np.array([4.0, 0.0, 0.0, 0.0])
COUNTS = (
    "active",
    "inside",
    "inside of active",
    "infeasible",
    "flagged",
    "unflagged",
    "failed",
)
# [m] of a bound, of a violation
TOUCHES = 1e-6
MISSED = 1e-6
Array = np.ndarray


def successor(x: Array, u: Array) -> Array:
    """The state 0.1 s later; the last axes are x, vx, y, vy and the accelerations."""
    v = x[..., [1, 3]]
    a = u - 0.3 * v * np.linalg.norm(v, axis=-1, keepdims=True)
    positions = x[..., [0, 2]] + STEP * v + STEP**2 / 2 * a
    return np.stack(
        [
            positions[..., 0],
            v[..., 0] + STEP * a[..., 0],
            positions[..., 1],
            v[..., 1] + STEP * a[..., 1],
        ],
        axis=-1,
    )


def learn(samples: int = 250) -> GPPosterior:
    """The model, from random states and inputs with the noise of the plant."""
    rng = np.random.default_rng(0)
    states = rng.uniform([-0.5, -2.5, -2.0, -2.5], [4.5, 2.5, 2.0, 2.5], (samples, 4))
    inputs = rng.uniform(-3, 3, (samples, 2))
    after = successor(states, inputs) + rng.normal(0, NOISE, (samples, 4))
    return train(
        Transitions(states, inputs, after), predicts="difference", scaling=standardize
    ).posterior


def discs() -> casadi.Function:
    """By how far the point is inside each disc; parameters: x, y and radius of each."""
    x = casadi.SX.sym("x", 4)
    u = casadi.SX.sym("u", 2)
    p = casadi.SX.sym("p", 9)
    inside = [
        p[3 * i + 2]
        - casadi.norm_2(casadi.vertcat(x[0] - p[3 * i], x[2] - p[3 * i + 1]))
        for i in range(3)
    ]
    return casadi.Function("discs", [x, u, p], [casadi.vertcat(*inside)])


def scene(seed: int) -> tuple[Array, Array]:
    """Draws places and radii of three discs (3, 3) apart from each other.

    The velocity of the last one (2,) [m/s] comes with them.
    """
    rng = np.random.default_rng(seed)
    while True:
        obstacles = rng.uniform([0.9, -0.6, 0.25], [3.1, 0.6, 0.5], (3, 3))
        velocity = rng.uniform(-0.3, 0.3, 2)
        gaps = [
            np.linalg.norm(obstacles[i, :2] - obstacles[j, :2])
            - obstacles[i, 2]
            - obstacles[j, 2]
            for i, j in ((0, 1), (0, 2), (1, 2))
        ]
        if min(gaps) > 0.3:
            return obstacles, velocity


def fly(model: GPPosterior, probability: float, seed: int) -> dict:
    """One scene: counts of steps, and times."""
    constraint = Inequality(discs(), count=3, probability=probability)
    problem = Problem(
        Tracking([1.0, 0.3, 1.0, 0.3], [0.05, 0.05], penalized="inputs"),
        Box([-3.0] * 2, [3.0] * 2),
        constraints=[constraint],
    )
    loop = ControlLoop(GPMPC(model, Linearization(), problem, HORIZON, [0.0, 0.0]))
    (places, velocity), rng = scene(seed), np.random.default_rng([seed, 1])
    ahead = STEP * np.arange(1, HORIZON + 1)[:, None]
    x = np.zeros(4)
    milliseconds = []
    counts = dict.fromkeys(COUNTS, 0)
    for k in range(STEPS):
        p = np.tile(places.ravel(), (HORIZON, 1))
        p[:, 6:8] += velocity * (k * STEP + ahead)
        began = perf_counter()
        u = loop.input(x, GOAL, p)
        milliseconds.append(1e3 * (perf_counter() - began))
        decision = loop.last.decision
        x = successor(x, u) + rng.normal(0, NOISE)
        now = p[0].reshape(3, 3)
        inside = bool(
            (np.linalg.norm(now[:, :2] - x[[0, 2]], axis=1) < now[:, 2]).any()
        )
        active = decision.applicable and margins(decision).max() > -TOUCHES
        infeasible = least_violation(decision) > MISSED
        flagged = decision.violation > MISSED or not decision.status.solved
        found = (
            active,
            inside,
            inside and active,
            infeasible,
            flagged,
            infeasible and not flagged,
            loop.last.failed,
        )
        for key, value in zip(counts, found, strict=True):
            counts[key] += int(value)
    reached = float(np.linalg.norm(x[[0, 2]] - GOAL[[0, 2]]))
    return {
        "seed": seed,
        "probability": probability,
        "ms": milliseconds[2:],
        "from goal": reached,
    } | counts


def margins(decision: Decision) -> Array:
    """Returns the violation of each disc and stage by the plan, negative within."""
    program = decision.problem
    return program.G @ decision.solution.x - program.upper[len(program.q) :]


def least_violation(decision: Decision) -> float:
    """Returns the least possible sum of violations of a program's discs.

    Inputs are within their bounds.
    """
    program = decision.problem
    size = len(decision.problem.q)
    rows = len(program.G)
    costs = np.concatenate([np.zeros(size), np.ones(rows)])
    sides = (
        np.concatenate([program.lower[:size], np.zeros(rows)]),
        np.append(program.upper[:size], np.full(rows, np.inf)),
    )
    return float(
        linprog(
            costs,
            np.hstack([program.G, -np.eye(rows)]),
            program.upper[size:],
            bounds=np.transpose(sides),
        ).fun
    )


def main() -> None:
    """Flies what is missing, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument(
        "--probability",
        type=float,
        default=0.95,
        help="of missing each disc, at each stage",
    )
    arguments = parser.parse_args()
    RESULTS.mkdir(parents=True, exist_ok=True)
    store = TrialStore(RESULTS / "obstacles.jsonl")
    eta = arguments.probability
    model = learn()
    scenes = []
    for seed in range(arguments.scenes):
        name = fingerprint([own_source(__file__), eta, seed])
        if name not in store.records:
            store.append(name, fly(model, eta, seed))
        scenes.append(store.records[name])
    print(f"{describe(machine())}\n\n{summary(scenes, eta)}")


def summary(scenes: list[dict], eta: float) -> str:
    """The table of all scenes."""
    total = {key: sum(scene[key] for scene in scenes) for key in COUNTS}
    hits = total["inside of active"]
    active = total["active"]
    low = beta.ppf(0.025, hits, active - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, active - hits) if hits < active else 1.0
    times = np.concatenate([scene["ms"] for scene in scenes])
    touched = sum(scene["inside"] > 0 for scene in scenes)
    reached = sum(scene["from goal"] < 0.3 for scene in scenes)
    rows = [
        ("scenes, and steps", f"{len(scenes)}, {len(scenes) * STEPS}"),
        (
            f"inside a disc, of {active} decisions at a bound",
            f"{hits / max(1, active):.2%} ({low:.2%} .. {high:.2%})",
        ),
        ("allowed", f"{1 - eta:.2%}"),
        (
            "steps inside a disc, of all",
            f"{total['inside']} ({total['inside'] / len(scenes) / STEPS:.2%})",
        ),
        ("scenes with one such step or more", f"{touched}"),
        ("scenes that end within 0.3 m of the goal", f"{reached}"),
        ("programs without a plan that keeps all bounds", f"{total['infeasible']}"),
        ("of these not flagged", f"{total['unflagged']}"),
        ("decisions that failed", f"{total['failed']}"),
        (
            "a decision, median and 99 % [ms]",
            f"{np.median(times):.2f}, {np.quantile(times, 0.99):.2f}",
        ),
    ]
    return "\n".join(f"{name:50} {value}" for name, value in rows)


if __name__ == "__main__":
    main()
