"""Counts how often predicted intervals hold what happens.

The flights are those that nobody trained on, for each kind of noise.

    .venv/bin/python -m benchmarks.coverage [pendulum cart_pole ... car] [--flights 4]
    [--seeds 1]

Plants of the gallery are learned and flown with the settings that ``gpmpc run
system=NAME`` has, once with a noise that moves the state and once with sensors that are
as noisy; the car (a dynamic bicycle of 1:10, tyres that saturate) drives at random.
From every step of every flight 20 steps are predicted, and 95 % intervals compared with
what was measured:

* latent: the noise is left to the last step, as if it were the sensors';
* default: it moves the state at every step;
* separated: ``separate_noise`` says which part does what.

A cell is the mean over the states, and below it the least and the largest of them. It
takes four minutes of one thread.
"""

import argparse
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from rich.console import Console

from benchmarks.timing import use_one_thread
from gpmpc.calibration import Calibration, Recording, calibrate
from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._settings import compose, settings_folders
from gpmpc.datasets import RandomData
from gpmpc.estimation import SeparatedNoise, separate_noise
from gpmpc.gp import Trainer, Transitions, standardize
from gpmpc.models._residual import train_residual
from gpmpc.propagation import MomentMatching, Unscented, best_propagator
from gpmpc.simulation import Noise
from gpmpc.studies._document import Table, terminal
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.systems import System, cos, exp, sin

#: standard deviations of each state's noise, as the process's or as the sensors'
NOISES = {
    "pendulum": [0.003, 0.03],
    "cart_pole": [0.003, 0.02, 0.003, 0.02],
    "planar_quadrotor": [0.005, 0.02, 0.005, 0.02, 0.005, 0.05],
    "stirred_tank": [0.003, 0.3],
    "translational": [0.01] * 6,
    "rotational": [1e-4, 1e-3] * 3,
    "car": [0.002, 0.002, 0.004, 0.02, 0.01, 0.05],
}
KINDS = ("process", "sensors")
STEPS = (1, 5, 10, 20)


@dataclass(frozen=True)
class Bicycle:
    """A car of 1:10 whose tyres' forces saturate."""

    mass: float = 3.3  #: [kg]
    inertia: float = 0.05  #: [kg m^2]
    front: float = 0.15  #: from the centre to the axle [m]
    rear: float = 0.17
    friction: float = 0.8
    stiffness: float = 8.0  #: of a tyre at small angles, over the largest force [1/rad]

    state_names = ("x", "y", "yaw", "vx", "vy", "rate")
    input_names = ("steer", "acceleration")

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """Returns the state's derivative.

        Position [m/s], yaw [rad/s], velocities of the body [m/s^2] and yaw rate
        [rad/s^2].
        """
        _, _, yaw, vx, vy, rate = x
        length = self.front + self.rear
        largest = self.friction * self.mass * 9.81 / length
        slip = u[0] - (vy + self.front * rate) / vx
        front = self.rear * largest * _saturating(self.stiffness * slip)
        slip = -(vy - self.rear * rate) / vx
        rear = self.front * largest * _saturating(self.stiffness * slip)
        sideways = front * cos(u[0])
        return [
            vx * cos(yaw) - vy * sin(yaw),
            vx * sin(yaw) + vy * cos(yaw),
            rate,
            u[1] + vy * rate - front * sin(u[0]) / self.mass,
            (sideways + rear) / self.mass - vx * rate,
            (self.front * sideways - self.rear * rear) / self.inertia,
        ]


def _saturating(value: Any) -> Any:
    """The hyperbolic tangent."""
    return 1.0 - 2.0 / (exp(2.0 * value) + 1.0)


def car() -> System:
    """At 20 Hz."""
    return System(
        Bicycle(),
        0.05,
        5,
        name="car",
        input_lower=[-0.4, -2.0],
        input_upper=[0.4, 2.0],
        region=[[-1, -1, -np.pi, 1.2, -0.3, -2.0], [1, 1, np.pi, 2.2, 0.3, 2.0]],
        start=[0.0, 0.0, 0.0, 1.7, 0.0, 0.0],
        angles=["yaw"],
        tracked=["x", "y"],
    )


@dataclass(frozen=True)
class Learned:
    """A model, and the flights that it has not seen."""

    model: Any
    separated: SeparatedNoise
    flights: list[Recording]
    angles: list[int]


def of_gallery(name: str, kind: str, flights: int, seed: int) -> Learned:
    """A plant of the gallery under its own controller."""
    with settings_folders():
        chosen = experiment_of(
            compose("run", [f"system={name}", f"seed={seed}", f"data.seed={seed}"])
        )
    deviations = NOISES[name]
    process = deviations if kind == "process" else [0.0] * len(deviations)
    if name in ("translational", "rotational"):
        excitation = replace(getattr(chosen.data, name), noise=process)
        data: Any = replace(chosen.data, **{name: excitation})
    else:
        data = replace(chosen.data, noise=process)
    rows = data.transitions(chosen.system, chosen.trajectory, chosen.name)
    if kind == "sensors":
        rows = measured(rows, deviations, seed)
    chosen = replace(chosen, train=partial_of(chosen, restarts=0))
    model = chosen.learn(rows, seed).posterior
    noise = Noise(**{"process" if kind == "process" else "measurement": deviations})
    flown = []
    for flight in range(flights):
        trial = replace(chosen, model=model, noise=noise, seed=1000 + flight)
        rollout = run_trial(trial).rollout
        flown.append(Recording(rollout.measured, rollout.inputs[:-1]))
    angles = chosen.system.angle_indices
    return Learned(model, separate_noise(model, rows), flown, list(angles))


def partial_of(chosen: Experiment, restarts: int) -> Any:
    """The experiment's trainer with fewer starts."""
    train: Any = chosen.train
    return replace(train, restarts=restarts)


def of_car(kind: str, flights: int, seed: int) -> Learned:
    """Random drives."""
    system = car()
    deviations = NOISES["car"]
    process = deviations if kind == "process" else None
    rows = RandomData(400, noise=process, seed=seed).transitions(system)
    fresh = RandomData(
        30 * flights, 30, hold=5, amplitude=0.5, noise=process, seed=1000 + seed
    ).transitions(system)
    if kind == "sensors":
        rows = measured(rows, deviations, seed)
        fresh = measured(fresh, deviations, 1000 + seed)
    trainer = Trainer(
        predicts="difference", scaling=standardize, penalty=None, restarts=0
    )
    angles = list(system.angle_indices)
    model = train_residual(trainer, rows, angles, None, seed).posterior
    drives = [run for run in Recording.chained(fresh) if len(run) >= STEPS[-1]]
    return Learned(model, separate_noise(model, rows), drives, angles)


def measured(rows: Transitions, deviations: list[float], seed: int) -> Transitions:
    """The same motion as noisy sensors show it."""
    rng = np.random.default_rng(500 + seed)
    columns_by_run = []
    for run in Recording.chained(rows):
        states = run.states.numpy()
        states = states + rng.normal(0.0, 1.0, states.shape) * deviations
        columns_by_run.append((states[:-1], run.inputs.numpy(), states[1:]))
    columns = [np.concatenate(parts) for parts in zip(*columns_by_run, strict=True)]
    return Transitions(columns[0], columns[1], columns[2], rows.signals)


def calibrations(learned: Learned) -> dict[str, Calibration]:
    """By which noise the intervals hold."""
    model = learned.model
    separated = learned.separated
    latent: Any = MomentMatching(process_noise=False)
    if isinstance(best_propagator(model), Unscented):
        latent = Unscented(process_noise=False)
    longest = max(map(len, learned.flights))
    judge = partial(
        calibrate,
        recordings=learned.flights,
        horizon=min(STEPS[-1], longest),
        levels=(0.95,),
        angles=learned.angles,
    )
    sensors = separated.measurement.sqrt().tolist()
    return {
        "latent": judge(model, propagator=latent),
        "default": judge(model),
        "separated": judge(separated.model, measurement_noise=sensors),
    }


def cell(coverage: np.ndarray) -> str:
    """Mean, least and largest over the states."""
    low = coverage.min()
    high = coverage.max()
    return f"{coverage.mean():.2f} ({low:.2f}-{high:.2f})"


def main() -> None:
    """Learns, flies, predicts and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plants", nargs="*", default=list(NOISES))
    parser.add_argument("--flights", type=int, default=4)
    parser.add_argument("--seeds", type=int, default=1)
    arguments = parser.parse_args()
    use_one_thread()
    console = Console(width=130)
    rows = []
    pooled: dict[tuple[str, str], list[np.ndarray]] = {}
    for name in arguments.plants:
        for kind in KINDS:
            by_seed: dict[str, list[np.ndarray]] = {}
            for seed in range(arguments.seeds):
                if name == "car":
                    learned = of_car(kind, arguments.flights, seed)
                else:
                    learned = of_gallery(name, kind, arguments.flights, seed)
                for noise_kind, calibration in calibrations(learned).items():
                    at = [step - 1 for step in STEPS if step <= calibration.horizon]
                    by_seed.setdefault(noise_kind, []).append(
                        calibration.coverage[at, :, 0].numpy()
                    )
            for noise_kind, parts in by_seed.items():
                coverage = np.mean(parts, axis=0)
                pooled.setdefault((kind, noise_kind), []).append(coverage.mean(axis=1))
                rows.append([name, kind, noise_kind, *map(cell, coverage)])
                console.out(*rows[-1], sep="  ", highlight=False)
    for (kind, noise_kind), parts in pooled.items():
        rows.append(
            ["all", kind, noise_kind, *(f"{v:.2f}" for v in np.mean(parts, axis=0))]
        )
    table = Table(["plant", "noise", "held", *(f"{k} ahead" for k in STEPS)], rows)
    console.print(terminal([table]))


if __name__ == "__main__":
    main()
