"""Flies ten robots by the README's road, and beside a controller that knows them.

    .venv/bin/python -m benchmarks.robots [tank furuta ...] [--seeds 3]

Each script of this folder is run as it stands, from an empty folder, with the seed of
its data as argument: from 300 to 500 noisy random rows to a flight. The same controller
then flies with the true model, iterated until it converges. What is compared are the
costs of both closed loops. Each flight is a line of
``outputs/benchmarks/robots.jsonl``; those that stand there are not flown again.
"""

import argparse
import json
import os
import runpy
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from gpmpc._angles import wrap
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import CasadiFunction, KnownModel
from gpmpc.mpc import GPMPC, PredictionSettings
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.systems import System, cart_pole, step_many

FOLDER = Path(__file__).parent
FLIGHTS = Path("outputs/benchmarks/robots.jsonl")
ROBOTS = (
    *("tank", "ball_and_beam", "furuta", "bicycle_car", "cart_pole"),
    *("planar_quadrotor", "arm", "wheeled_pendulum", "stirred_tank", "drone"),
)
SWINGS_UP = ("furuta", "cart_pole")
NEAR = 0.2  # [rad] of upright, through the last second
STEP = 1e-5  # of the finite differences of a simulator


class Simulated:
    """A simulator's step, with derivatives by central differences.

    Args:
        plant: Whose dynamics take many states at once.
    """

    def __init__(self, plant: System):
        self.plant = plant

    def __call__(self, states: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """Returns the next states (*batch, n)."""
        n = states.shape[-1]
        flat = states.reshape(-1, n).numpy()
        next_states = step_many(self.plant, flat, inputs.reshape(len(flat), -1).numpy())
        return torch.from_numpy(next_states).reshape(states.shape)

    def linearize(
        self, states: np.ndarray, inputs: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns next states (K, n) and derivatives (K, n, n), (K, n, m)."""
        n = states.shape[1]
        points = np.hstack([states, inputs])
        slopes = []
        for offset in STEP * np.eye(points.shape[1]):
            after, before = (
                step_many(self.plant, moved[:, :n], moved[:, n:])
                for moved in (points + offset, points - offset)
            )
            slopes.append((after - before) / (2 * STEP))
        jacobian = np.stack(slopes, axis=2)
        next_states = step_many(self.plant, states, inputs)
        return next_states, jacobian[:, :, :n].copy(), jacobian[:, :, n:].copy()


def true_model(name: str, plant: System) -> KnownModel:
    """Returns the model of a controller that knows the plant."""
    if name == "arm":
        function: Any = Simulated(plant)
    else:
        # A plan counts turns, which the sensor of the cart-pole does not show.
        prior = cart_pole() if name == "cart_pole" else plant
        function = CasadiFunction(successor_function(prior))
    return KnownModel(function, len(plant.state_names), len(plant.input_names))


def knowing_controllers(model: KnownModel, controller: GPMPC) -> list[GPMPC]:
    """Returns the same controller with the true model: iterated until it converges.

    And once as it is: where there are several ways up, to converge is no advantage.
    """
    settings: dict[str, Any] = {
        "model": model,
        "propagator": Linearization(),
        "problem": controller.problem,
        "horizon": controller.horizon,
        "initial_input": controller.initial_input,
    }
    means = PredictionSettings(covariance="none")
    converged = GPMPC(**settings, prediction=means, iterations=50, tolerance=1e-8)
    return [converged, GPMPC(**settings)]


def fly(name: str, seed: int) -> dict[str, Any]:
    """Flies one robot with its learned model and with the true one."""
    started = time.perf_counter()
    script = _run_script(name, seed)
    seconds = time.perf_counter() - started
    plant = script["plant"]
    controller = script["controller"]
    flight = script["flight"]
    cost = controller.problem.cost
    reference = script.get("reference", plant.goal)
    twins = [
        closed_loop(
            plant,
            knowing,
            reference,
            flight.states[0],
            steps=len(flight.inputs),
            on_failure="previous_plan",
        )
        for knowing in knowing_controllers(true_model(name, plant), controller)
    ]
    paid, *all_known = (
        float(each.paid(cost, controller.initial_input).sum())
        for each in (flight, *twins)
    )
    least = min(all_known)
    return {
        "robot": name,
        "seed": seed,
        "rows": len(script["model"]),
        "learned": paid,
        "known": least,
        "ratio": paid / least,
        "up": _is_up(plant, flight) if name in SWINGS_UP else None,
        "all_known": all_known,
        "failures": len(flight.failures),
        "decision_ms": 1e3 * float(np.median(flight.seconds)),
        "script_seconds": seconds,
    }


def _run_script(name: str, seed: int) -> dict[str, Any]:
    """Runs a robot's script from an empty folder; returns its names."""
    argv = sys.argv
    here = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        sys.argv = [f"{name}.py", str(seed)]
        try:
            return runpy.run_path(str(FOLDER / f"{name}.py"), run_name="__main__")
        finally:
            sys.argv = argv
            os.chdir(here)


def _is_up(plant: System, flight: Any) -> bool:
    """Whether the pendulum, the last angle, is near upright through the last second."""
    steps = round(1.0 / plant.time_step)
    angles = wrap(flight.states[-steps:, plant.angle_indices[-1]])
    return bool((np.abs(angles) < NEAR).all())


def flown_before() -> dict[tuple[str, int], dict[str, Any]]:
    """Returns the flights that stand in the file."""
    if not FLIGHTS.exists():
        return {}
    flights = map(json.loads, FLIGHTS.read_text().splitlines())
    return {(flight["robot"], flight["seed"]): flight for flight in flights}


def main() -> None:
    """Flies, and prints the table of the gallery."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", default=ROBOTS)
    parser.add_argument("--seeds", type=int, default=3)
    settings = parser.parse_args()
    FLIGHTS.parent.mkdir(parents=True, exist_ok=True)
    flights = flown_before()
    for name in settings.robots:
        for seed in range(settings.seeds):
            if (name, seed) in flights:
                continue
            with threadpool_limits(1):
                flight = flights[name, seed] = fly(name, seed)
            with FLIGHTS.open("a") as file:
                file.write(json.dumps(flight) + "\n")
            print({k: v if k != "ratio" else round(v, 3) for k, v in flight.items()})
    print_table(settings.robots, settings.seeds, flights)


def print_table(
    robots: list[str], seeds: int, flights: dict[tuple[str, int], dict[str, Any]]
) -> None:
    """Prints a row a robot, in Markdown."""
    print("| robot | rows | cost over the true model's, worst | up | decision [ms] |")
    print("| --- | --- | --- | --- | --- |")
    for name in robots:
        own = [flights[name, seed] for seed in range(seeds)]
        ratios = [flight["ratio"] for flight in own]
        up = ""
        if name in SWINGS_UP:
            up = f"{sum(flight['up'] for flight in own)} of {seeds}"
        decision = np.median([flight["decision_ms"] for flight in own])
        print(
            f"| `{name}.py` | {own[0]['rows']} | {np.median(ratios):.3f}, "
            f"{max(ratios):.3f} | {up} | {decision:.2g} |"
        )


if __name__ == "__main__":
    main()
