"""Compares two roads to one answer.

They are sequential quadratic programs, solvers and forms, and a long horizon with
bounds.

    .venv/bin/python -m benchmarks.agreement [--steps 200] [--recorded 500]

1. ``trajectory`` iterated to tolerance against SLSQP (``gpmpc.experiments.slsqp``) on
   sampled steps of flights, full covariances: the nonlinear cost at the one's plan over
   that at the other's.
2. The condensed program by our dual active set, the paper's primal one and Clarabel,
   and the state form in CVXPY, on recorded steps with active bounds of inputs and
   increments, and half as many with state bounds at a price (dual active set and state
   form): the largest difference of an input, in its own unit.
3. A horizon of 50 with state bounds: how many programs had no solution.

One process, one thread. Writes ``outputs/benchmarks/agreement.json``.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
import torch

from benchmarks.quadrotor import (
    HOVER,
    STATE_BOUNDS,
    TRAJECTORIES,
    problem,
    recorded,
    trained,
)
from benchmarks.quadrotor_sequences import TIGHT
from benchmarks.timing import write_results
from gpmpc.experiments.slsqp import SLSQP
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Request
from gpmpc.mpc.baselines import StateFormMPC
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.qp import CvxpySolver, PrimalActiveSet

PROPAGATIONS = {"linearization": Linearization(), "moment_matching": MomentMatching()}


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--steps", type=int, default=200, help="sampled steps a propagation"
    )
    parser.add_argument(
        "--recorded", type=int, default=500, help="steps for solvers and forms"
    )
    parser.add_argument(
        "--horizon", type=int, default=5, help="of the first comparison"
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    posteriors = {name: trained(name) for name in TRAJECTORIES}
    results = {
        "optimality": [
            optimality(posteriors, name, arguments) for name in PROPAGATIONS
        ],
        "solvers": solvers(posteriors, arguments.recorded),
        "long_horizon": [
            long_horizon(posteriors[name], name, l1)
            for name in TRAJECTORIES
            for l1 in (None, 1e4)
        ],
    }
    write_results("agreement", results)


def optimality(
    posteriors: dict, propagation: str, arguments: argparse.Namespace
) -> dict:
    """Returns the cost of iterated quadratic programs relative to that of SLSQP.

    Both are the nonlinear cost of a plan.
    """
    propagator = PROPAGATIONS[propagation]
    gaps = []
    times = [[], []]
    failed = {"convex": 0, "slsqp": 0}
    for trajectory, gp in posteriors.items():
        task = (problem(), arguments.horizon, HOVER)
        convex = GPMPC(
            gp,
            propagator,
            *task,
            prediction=PredictionSettings(form="trajectory", covariance="full"),
            iterations=100,
            tolerance=1e-7,
        )
        slsqp = SLSQP(gp, propagator, *task, tolerance=1e-6)
        count = arguments.steps // len(posteriors)
        flown = recorded(GPMPC(gp, Linearization(), *task), trajectory, count, std=0.01)
        for step in flown:
            plans = []
            for controller, spent in zip((convex, slsqp), times, strict=True):
                began = time.process_time()
                plans.append(
                    controller.control(step.belief, step.reference, step.previous)
                )
                spent.append(time.process_time() - began)
            failed["convex"] += not plans[0].status.solved
            failed["slsqp"] += not plans[1].status.solved
            request = Request.read(
                problem(),
                arguments.horizon,
                HOVER,
                step.belief,
                step.reference,
                step.previous,
            )
            values = [slsqp.evaluate(plan.inputs, request).cost for plan in plans]
            gaps.append(values[0] / values[1] - 1)
    gaps = np.array(gaps)
    result = {
        "propagation": propagation,
        "steps": len(gaps),
        "within_1e-4": float((gaps <= 1e-4).mean()),
        "gap_median": float(np.median(gaps)),
        "gap_95": float(np.quantile(gaps, 0.95)),
        "gap_largest": float(gaps.max()),
        "gap_smallest": float(gaps.min()),
        "failed": failed,
        "seconds_median": [float(np.median(spent)) for spent in times],
    }
    print(f"optimality: {result}", flush=True)
    return result


def solvers(posteriors: dict, count: int) -> dict:
    """Inputs by several solvers and forms on one program."""
    inputs_by_solver = {
        name: [] for name in ("primal_active_set", "clarabel", "state_form")
    }
    active = 0
    unsolved = dict.fromkeys(inputs_by_solver, 0)
    for trajectory, gp in posteriors.items():
        # Bounds that bite: of the inputs and their increments, and of positions.
        bounds = Box(
            *(0.95 * np.asarray(side) for side in STATE_BOUNDS[trajectory]),
            probability=0.95,
            penalty=1e3,
        )
        tilt, rate = TIGHT[trajectory]
        hard = (
            replace(problem(tilt=tilt), input_rates=Box(np.negative(rate), rate)),
            10,
            HOVER,
        )
        soft = (problem(bounds), 10, HOVER)
        for task, kinds, steps in (
            (hard, tuple(inputs_by_solver), count // 2),
            (soft, ("state_form",), count // 4),
        ):
            ours = GPMPC(gp, Linearization(), *task)
            others = {
                "primal_active_set": lambda a=task, g=gp: GPMPC(
                    g, Linearization(), *a, solver=PrimalActiveSet()
                ),
                "clarabel": lambda a=task, g=gp: GPMPC(
                    g, Linearization(), *a, solver=CvxpySolver()
                ),
                "state_form": lambda a=task, g=gp: StateFormMPC(g, Linearization(), *a),
            }
            others = {kind: others[kind]() for kind in kinds}
            for step in recorded(ours, trajectory, steps):
                if not step.decision.status.solved:
                    continue
                active += bool(len(step.decision.solution.active_set))
                for kind, controller in others.items():
                    again = controller.control(
                        step.belief, step.reference, step.previous
                    )
                    if again.status.solved:
                        inputs_by_solver[kind].append(
                            float(np.abs(again.inputs - step.decision.inputs).max())
                        )
                    else:
                        unsolved[kind] += 1
    result = {
        kind: {
            "steps": len(gaps),
            "unsolved": unsolved[kind],
            "within_1e-6": float((np.array(gaps) <= 1e-6).mean()),
            "median": float(np.median(gaps)),
            "largest": max(gaps),
        }
        for kind, gaps in inputs_by_solver.items()
    } | {"steps_with_active_bounds": active}
    print(f"solvers: {result}", flush=True)
    return result


def long_horizon(gp, trajectory: str, l1: float | None) -> dict:
    """H = 50 with state bounds that the reference breaks, hard or at a price."""
    limits = Box(*STATE_BOUNDS[trajectory], probability=0.95, penalty=l1)
    flown = recorded(
        GPMPC(gp, Linearization(), problem(limits), 50, HOVER), trajectory, 189
    )
    statuses = [step.decision.status.name for step in flown]
    times = [step.decision.timing.total for step in flown]
    result = {
        "trajectory": trajectory,
        "l1": l1,
        "steps": len(flown),
        "statuses": {name: statuses.count(name) for name in dict.fromkeys(statuses)},
        "ms_median": 1e3 * float(np.median(times)),
    }
    print(f"H = 50: {result}", flush=True)
    return result


if __name__ == "__main__":
    main()
