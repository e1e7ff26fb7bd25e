"""The whole quadrotor on learned models.

Two GPs at 1 and 20 Hz beside the same cascade on the true models.

    .venv/bin/python -m benchmarks.cascade [--steps 189] [--seeds 5]

Twelve states; outer and inner controller are convex GP-MPC, the outer one with and
without an estimate of what its model mispredicts (``disturbance_gain``), and NMPC on
the true subsystems for comparison. Flown along both trajectories as they are, with a
gust, and with a mass that is 20 % larger than the models know. RMSE of the position,
total over x, y, z, after every outer step. Writes ``outputs/benchmarks/cascade.json``.
"""

import argparse
import json

import numpy as np
import torch

from benchmarks.quadrotor import HOVER, INNER, OUTER, TRAJECTORIES, problem, trained
from benchmarks.timing import write_results
from gpmpc.exceptions import GpmpcError
from gpmpc.metrics import tracking_error
from gpmpc.mpc import GPMPC, PredictionSettings, Problem, Tracking
from gpmpc.mpc.baselines import NMPC
from gpmpc.propagation import Linearization
from gpmpc.simulation import Cascade, Gust, Noise, Replaced, cascade_loop
from gpmpc.systems import Coupled, System
from gpmpc.trajectories import states_along

PLANT = System(Coupled(), time_step=0.05, substeps=2)
HEAVY = System(Coupled(mass=1.2 * 0.74), time_step=0.05, substeps=2)
NOISE = Noise(measurement=[0.01] * 6 + [0.002, 0.01] * 3)  # [m, m/s, rad, rad/s]
INNER_PROBLEM = Problem(Tracking([1] * 6, [1] * 3))
CASES = {
    "as it is": (),
    "gust": (Gust({"vx": 0.5, "vy": -0.3}, start=40.0, stop=50.0),),
    "mass + 20 %": (Replaced(HEAVY),),
}


def main() -> None:
    """Flies and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=189, help="outer steps")
    parser.add_argument("--seeds", type=int, default=5)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    for trajectory in TRAJECTORIES:
        outer = trained(trajectory)
        inner = trained(trajectory, "rotational")
        cascades = {
            "true model": Cascade(
                NMPC(OUTER, problem(), 1, HOVER),
                NMPC(INNER, INNER_PROBLEM, 1, [0.0] * 3, tolerance=1e-8),
            ),
        }
        inner_gp = GPMPC(
            inner,
            Linearization(),
            INNER_PROBLEM,
            1,
            [0.0] * 3,
            prediction=PredictionSettings(covariance="none"),
        )
        for name, gain in (("GP", 0.0), ("GP, error estimated", 1.0)):
            outer_gp = GPMPC(
                outer,
                Linearization(),
                problem(),
                1,
                HOVER,
                prediction=PredictionSettings(disturbance_gain=gain),
            )
            cascades[name] = Cascade(outer_gp, inner_gp)
        for case in CASES:
            flown = {
                name: flights(cascade, trajectory, case, arguments)
                for name, cascade in cascades.items()
            }
            truth = flown["true model"]["rmse"]
            ratios = {name: flight["rmse"] / truth for name, flight in flown.items()}
            results.append(
                {"trajectory": trajectory, "case": case, "ratios": ratios} | flown
            )
            print(json.dumps(results[-1]), flush=True)
    write_results("cascade", results)


def flights(
    cascade: Cascade, trajectory: str, case: str, arguments: argparse.Namespace
) -> dict:
    """Returns the pooled error over the seeds, losses, failed solves and times."""
    references = states_along(
        TRAJECTORIES[trajectory], np.arange(arguments.steps + 2.0)
    )
    start = np.concatenate([references[0], np.zeros(6)])
    squares = []
    losses = 0
    failures = 0
    outer = []
    inner = []
    worst = 0.0
    cascade_loop(
        PLANT, cascade, references, start, 2, on_failure="previous_plan"
    )  # compiles and loads
    for seed in range(arguments.seeds):
        try:
            flight = cascade_loop(
                PLANT,
                cascade,
                references,
                start,
                arguments.steps,
                noise=NOISE,
                disturbances=CASES[case],
                on_failure="previous_plan",
                seed=seed,
            )
        except GpmpcError as error:
            print(f"lost: {error}")
            losses += 1
            continue
        squares.append(
            tracking_error(
                flight.outer.states, flight.outer.references, (0, 2, 4)
            ).total
            ** 2
        )
        away = (flight.outer.states - flight.outer.references)[:, ::2]
        worst = max(worst, float(np.linalg.norm(away, axis=1).max()))
        failures += len(flight.outer.failures) + len(flight.inner.failures)
        outer.append(flight.outer.seconds)
        inner.append(flight.inner.seconds)
    if not squares:
        return {"rmse": float("nan"), "lost": losses}
    return {
        "rmse": float(np.sqrt(np.mean(squares))),
        "worst": worst,
        "lost": losses,
        "failures": failures,
        "outer_ms": 1e3 * float(np.median(np.concatenate(outer))),
        "inner_ms": 1e3 * float(np.median(np.concatenate(inner))),
    }


if __name__ == "__main__":
    main()
