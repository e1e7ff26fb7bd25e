"""What an estimate of the model's error is worth.

A vehicle that is a fifth heavier than the data say, and noise.

    .venv/bin/python -m benchmarks.wrong_model [--steps 189] [--seeds 5] [--figure
    docs/figures/wrong_mass.png]

The translational quadrotor with the plant in the loop, GPs of 189 dithered transitions
of the lighter one, convex GP-MPC with H = 10: ``trajectory`` with several gains of its
disturbance estimate, and the paper's increments, which have no offset by what they are.
Every combination of a mass and of a noise is flown on both trajectories; RMSE of the
position, total over x, y, z [m], pooled over the seeds. Writes
``outputs/benchmarks/wrong_model.json`` and a figure of how the heavier vehicle comes to
its altitude.
"""

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure

from benchmarks.quadrotor import HOVER, NOISE, OUTER, TRAJECTORIES, problem, trained
from benchmarks.timing import write_results
from gpmpc._files import write_whole
from gpmpc.metrics import tracking_error
from gpmpc.mpc import GPMPC, PredictionSettings
from gpmpc.plotting import png
from gpmpc.propagation import Linearization
from gpmpc.simulation import Noise, Replaced, Rollout, closed_loop
from gpmpc.systems import System, Translational
from gpmpc.trajectories import states_along

HORIZON = 10
ALTITUDE = 4
HEAVY = Replaced(System(Translational(mass=1.2 * 0.74), 1.0, 1))
MASSES = {"as learned": (), "20 % heavier": (HEAVY,)}
NOISES = {
    "process 0.01": NOISE,
    "measured 0.01": Noise(measurement=[0.01] * 6),
    "measured 0.03": Noise(measurement=[0.03] * 6),
}
WAYS = {
    "trajectory, L = 0": PredictionSettings(),
    "trajectory, L = 0.3": PredictionSettings(disturbance_gain=0.3),
    "trajectory, L = 1": PredictionSettings(disturbance_gain=1.0),
    "velocity": PredictionSettings("velocity", "none"),
}
LINES = ("C6-.", "C1-", "C0-", "C2--")


def main() -> None:
    """Flies, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=189)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument(
        "--figure", type=Path, default=Path("outputs/benchmarks/wrong_mass.png")
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    shown = {}
    print(f"{'':34}" + "".join(f"{mass:>28}" for mass in MASSES))
    print(f"{'':34}" + "".join(f"{noise:>14}" for _ in MASSES for noise in NOISES))
    for trajectory in TRAJECTORIES:
        model = trained(trajectory)
        for way, settings in WAYS.items():
            controller = GPMPC(
                model, Linearization(), problem(), HORIZON, HOVER, settings
            )
            row = []
            for mass in MASSES:
                for noise in NOISES:
                    flown = flights(controller, trajectory, mass, noise, arguments)
                    row.append(pooled(flown))
                    shown[trajectory, way, mass, noise] = flown[0]
                    keys = {
                        "trajectory": trajectory,
                        "way": way,
                        "mass": mass,
                        "noise": noise,
                    }
                    results.append(
                        keys
                        | {
                            "rmse": row[-1],
                            "failures": sum(len(flight.failures) for flight in flown),
                        }
                    )
            print(
                f"{trajectory:12}{way:22}" + "".join(f"{rmse:14.4f}" for rmse in row),
                flush=True,
            )
    write_results("wrong_model", results)
    arguments.figure.parent.mkdir(parents=True, exist_ok=True)
    write_whole(arguments.figure, png(altitudes(shown)))
    print(f"written to {arguments.figure}")


def flights(
    controller: GPMPC,
    trajectory: str,
    mass: str,
    noise: str,
    arguments: argparse.Namespace,
) -> list[Rollout]:
    """One a seed."""
    references = states_along(
        TRAJECTORIES[trajectory], np.arange(arguments.steps + HORIZON + 1.0)
    )
    return [
        closed_loop(
            OUTER,
            controller,
            references,
            references[0],
            arguments.steps,
            noise=NOISES[noise],
            disturbances=MASSES[mass],
            on_failure="previous_plan",
            seed=seed,
        )
        for seed in range(arguments.seeds)
    ]


def pooled(flown: list[Rollout]) -> float:
    """RMSE over all flights [m]."""
    squares = [
        tracking_error(flight.states, flight.references, (0, 2, 4)).total ** 2
        for flight in flown
    ]
    return float(np.sqrt(np.mean(squares)))


def altitudes(shown: dict[tuple, Rollout]) -> Figure:
    """Returns the error of the heavier vehicle's altitude, for the first seed."""
    plt.style.use("gpmpc.plotting.gpmpc")
    figure, axes = plt.subplots(1, len(TRAJECTORIES), sharey=True, figsize=(8, 3.6))
    for axis, trajectory in zip(axes, TRAJECTORIES, strict=True):
        for way, look in zip(WAYS, LINES, strict=True):
            flight = shown[trajectory, way, "20 % heavier", "process 0.01"]
            away = (flight.states - flight.references)[:41, ALTITUDE]
            axis.plot(np.arange(len(away)), away, look, label=way)
        axis.axhline(0, color="black", linewidth=0.5)
        axis.set(title=trajectory, xlabel="time [s]")
    axes[0].set_ylabel("error of z, downwards [m]")
    figure.suptitle(
        "A quadrotor a fifth heavier than its model; L: gain of the disturbance "
        "estimate"
    )
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4
    )
    return figure


if __name__ == "__main__":
    main()
