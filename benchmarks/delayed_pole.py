"""Balances and moves a learned pole whose inputs act three steps late.

    .venv/bin/python -m benchmarks.delayed_pole [--seeds 20] [--steps 300]

Gymnasium's InvertedPendulum-v5 (MuJoCo, 25 Hz; an episode is lost beyond 0.2 rad) is
learned from 600 steps of random pushes. The cart follows steps of 0.6 m, or stands
still; an episode begins where the environment resets it. Printed for each delay that
the controller believes in: RMSE of cart [m] and pole [rad] over the seeds, their ratios
to the loop without delay, and episodes lost. When the pole only stands, the first
second is left out: nothing that is decided acts in its first three steps. Writes
``outputs/benchmarks/delayed_pole.json``.
"""

import argparse
from collections import deque
from typing import Any

import numpy as np
import torch

from benchmarks.timing import write_results
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions
from gpmpc.models import Affine, DelayedModel, ResidualModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.systems.gymnasium_ import gymnasium_system

HORIZON = 50
DELAY = 3
SIDE = 0.3
TURN = 60
SECOND = 25
LOOPS = {
    "no delay": (0, 0),
    "delay ignored": (DELAY, 0),
    "delay planned with": (DELAY, DELAY),
    "believed a step shorter": (DELAY, DELAY - 1),
    "believed a step longer": (DELAY, DELAY + 1),
}
Array = np.ndarray
pole = gymnasium_system("InvertedPendulum-v5").dynamics


def learned(steps: int = 600) -> ResidualModel:
    """A model of 200 of the transitions under pushes that change every second step."""
    rng = np.random.default_rng(0)
    rows = []
    seed = 0
    push = np.zeros(1)
    state = pole.reset(seed)
    for k in range(steps):
        push = rng.uniform(-1, 1, 1) if k % 2 == 0 else push
        after = pole.successor(state, push)
        rows.append((state, push, after))
        if pole.ended:
            seed += 1
            after = pole.reset(seed)
        state = after
    picked = [
        rows[i] for i in sorted(np.random.default_rng(0).permutation(steps)[:200])
    ]
    data = Transitions(*map(np.array, zip(*picked, strict=True)))
    return ResidualModel.train(
        Affine.identity(4, 1), data, angles=[1], trainer=Trainer(restarts=1)
    )


def fly(
    model: Any, delay: int, believed: int, moved: bool, seed: int, steps: int
) -> Array | None:
    """Errors of cart and pole (steps, 2) of one episode; None where it is lost."""
    delayed = DelayedModel(model, believed) if believed else None
    planned = model if delayed is None else delayed
    weights = np.zeros(planned.state_dim)
    weights[:4] = 1.0, 3.0, 0.3, 0.3
    problem = Problem(
        Tracking(weights.tolist(), [20.0]),
        Box(*(limit.tolist() for limit in pole.input_limits)),
    )
    controller = GPMPC(
        planned, Linearization(), problem, HORIZON, [0.0], PredictionSettings()
    )
    reference = np.zeros((steps + HORIZON + 1, planned.state_dim))
    errors = []
    decision = None
    if moved:
        reference[:, 0] = np.where(np.arange(len(reference)) // TURN % 2, -SIDE, SIDE)
    state = pole.reset(seed)
    acting, on_their_way = (
        deque([np.zeros(1)] * count, count) for count in (delay, believed)
    )
    for k in range(steps):
        belief = Gaussian.certain(state)
        if delayed is not None:
            belief = delayed.augmented(belief, np.array(on_their_way))
        decision = controller.control(
            belief, Reference(reference[k : k + HORIZON + 1]), decision
        )
        state = pole.successor(state, acting[0] if delay else decision.input)
        acting.append(decision.input)
        on_their_way.append(decision.input)
        errors.append(state[:2] - reference[k + 1, :2])
        if pole.ended:
            return None
    return np.array(errors)


def main() -> None:
    """Learns, flies and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--steps", type=int, default=300)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    model = learned()
    results = []
    print(
        f"{'':38}{'cart [m]':>10}{'ratio':>7}{'pole [rad]':>12}{'ratio':>7}{'lost':>6}"
    )
    for task, moved in (("from side to side", True), ("standing", False)):
        against = np.full(2, np.nan)
        for name, (delay, believed) in LOOPS.items():
            flown = [
                fly(model, delay, believed, moved, seed, arguments.steps)
                for seed in range(arguments.seeds)
            ]
            completed = [
                errors if moved else errors[SECOND:]
                for errors in flown
                if errors is not None
            ]
            rmse = (
                np.sqrt(np.mean(np.concatenate(completed) ** 2, axis=0))
                if completed
                else np.full(2, np.nan)
            )
            against = rmse if name == "no delay" else against
            (cart, angle), (one, other), losses = (
                rmse,
                rmse / against,
                len(flown) - len(completed),
            )
            print(
                f"{task + ', ' + name:38}{cart:10.4f}{one:7.2f}"
                f"{angle:12.5f}{other:7.2f}{losses:6}",
                flush=True,
            )
            row = {
                "task": task,
                "loop": name,
                "cart": cart,
                "pole": angle,
                "cart_ratio": one,
                "pole_ratio": other,
            }
            results.append(
                {key: v if isinstance(v, str) else float(v) for key, v in row.items()}
                | {"lost": losses}
            )
    write_results("delayed_pole", results)


if __name__ == "__main__":
    main()
