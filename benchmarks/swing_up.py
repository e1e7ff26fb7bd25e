"""Swings up from hanging with learned models, over many seeds.

They learned from at most 60 s of random motion.

    .venv/bin/python -m benchmarks.swing_up [pendulum circle cart_pole acrobot] [--seeds
    20]

Systems fly with the settings that ``gpmpc run system=NAME`` has; the seed is that of
data, training and noise. ``circle`` is the pendulum whose state is (cosine, sine,
rate). A flight counts as up and held where all angles are within 0.2 rad of upright
through its last second. ``in time`` is the share of decisions within the sampling
period, on one thread. Each flight is a line of ``outputs/benchmarks/swing_up.jsonl``,
and those of the same code that stand there are not flown again.
"""

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console

from benchmarks.timing import own_source
from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._settings import compose, settings_folders
from gpmpc.gp import Transitions
from gpmpc.mpc import Tracking
from gpmpc.studies._document import Table, terminal
from gpmpc.studies.flight import Experiment, run_trial
from gpmpc.studies.study import TrialStore, fingerprint, one_thread
from gpmpc.systems import System

SYSTEMS = ("pendulum", "circle", "cart_pole", "acrobot")
NEAR = 0.2  # [rad]
FLIGHTS = Path("outputs/benchmarks/swing_up.jsonl")


class Circle:
    """The pendulum of ``gpmpc.systems`` in cosine and sine of its angle.

    Args:
        pendulum: Its dynamics.
    """

    state_names = ("cosine", "sine", "rate")
    input_names = ("torque",)

    def __init__(self, pendulum: Any):
        self.pendulum = pendulum

    def derivative(self, x: Any, u: Any) -> list[Any]:
        """d/dt (cosine, sine, rate) [1/s, 1/s, rad/s^2]."""
        acceleration = self.pendulum.derivative([np.arctan2(x[1], x[0]), x[2]], u)[1]
        return [-x[1] * x[2], x[0] * x[2], acceleration]


def experiment(name: str, seed: int) -> Experiment:
    """Returns one flight with the settings of a system's file."""
    word = "pendulum" if name == "circle" else name
    with settings_folders():
        chosen = experiment_of(
            compose("run", [f"system={word}", f"seed={seed}", f"data.seed={seed}"])
        )
    if name != "circle":
        return chosen
    make: Any = chosen.controller
    flown = chosen.system
    problem = make.keywords["problem"]
    system = System(
        Circle(flown.dynamics),
        flown.time_step,
        flown.substeps,
        input_lower=flown.input_lower,
        input_upper=flown.input_upper,
        start=[-1.0, 0.0, 0.0],
        goal=[1.0, 0.0, 0.0],
    )
    angle, rate = np.diag(problem.cost.Q)
    cost = Tracking(
        [angle, angle, rate], problem.cost.R, penalized=problem.cost.penalized
    )
    controller = partial(make, problem=replace(problem, cost=cost))
    return replace(
        chosen,
        data=CircleData(chosen.data, flown),
        system=system,
        controller=controller,
    )


class CircleData:
    """The pendulum's random data in cosine and sine of its angle.

    Args:
        data: Of the pendulum.
        pendulum: With the angle as state.
    """

    note = "Data: our own, under random inputs."

    def __init__(self, data: Any, pendulum: System):
        self.data = data
        self.pendulum = pendulum

    def transitions(self, *_: Any) -> Transitions:
        """Returns them; the system that is asked for is this one."""
        rows = self.data.transitions(self.pendulum)
        both = (rows.states, rows.next_states)
        states, after = (
            torch.stack([x[:, 0].cos(), x[:, 0].sin(), x[:, 1]], dim=1) for x in both
        )
        return Transitions(states, rows.inputs, after)


def fly(name: str, seed: int) -> dict[str, Any]:
    """Returns what one flight came to, as plain data."""
    chosen = experiment(name, seed)
    with one_thread():
        flown = run_trial(chosen)
    rollout = flown.rollout
    system = chosen.system
    if name == "circle":
        errors = np.arctan2(rollout.states[:, 1], rollout.states[:, 0])[:, None]
    else:
        errors = (rollout.states - np.array(system.goal))[:, system.angle_indices]
        errors = (errors + np.pi) % (2 * np.pi) - np.pi
    largest = np.abs(errors).max(axis=1)
    away = np.flatnonzero(largest > NEAR)
    last = round(1 / system.time_step)
    settled = int(away[-1]) + 1 if len(away) else 0
    return {
        "system": name,
        "seed": seed,
        "up": bool(settled <= len(largest) - last),
        "seconds_until_up": settled * system.time_step,
        "largest_error": float(largest[-last:].max()),
        "data_seconds": len(flown.training.posterior) * system.time_step
        if flown.training
        else None,
        "in_time": float((rollout.seconds <= system.time_step).mean()),
        "median_ms": 1e3 * float(np.median(rollout.seconds)),
        "p99_ms": 1e3 * float(np.quantile(rollout.seconds, 0.99)),
        "failures": len(rollout.failures),
    }


def table(flights: list[dict[str, Any]]) -> Table:
    """Returns a line a system."""
    rows = []
    for name in SYSTEMS:
        own = [flight for flight in flights if flight["system"] == name]
        if not own:
            continue
        up = [flight for flight in own if flight["up"]]
        times = [f["seconds_until_up"] for f in up]
        errors = [f["largest_error"] for f in up]
        rows.append(
            (
                name,
                f"{own[0]['data_seconds']:.0f}",
                f"{len(up)} of {len(own)}",
                f"{np.median(times):.2f} ({max(times):.2f})" if up else "",
                f"{max(errors):.2g}" if up else "",
                f"{np.median([f['median_ms'] for f in own]):.2f}",
                f"{100 * np.mean([f['in_time'] for f in own]):.2f} %",
                str(sum(f["failures"] for f in own)),
            )
        )
    head = (
        "system",
        "data [s]",
        "up and held",
        "up after [s] (worst)",
        "error then [rad]",
        "decision [ms]",
        "in time",
    )
    return Table((*head, "failed solves"), rows)


def main() -> None:
    """Flies what is missing, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("systems", nargs="*", default=SYSTEMS, help=", ".join(SYSTEMS))
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    FLIGHTS.parent.mkdir(parents=True, exist_ok=True)
    store = TrialStore(FLIGHTS)
    flights = []
    for seed in range(arguments.seeds):
        for system in arguments.systems:
            name = fingerprint([own_source(__file__), system, seed])
            if name not in store.records:
                store.append(name, fly(system, seed))
                print(store.records[name], flush=True)
            flights.append(store.records[name])
    Console(width=120).print(terminal([table(flights)]))


if __name__ == "__main__":
    main()
