"""Whether flights are the same to the last bit, whatever was compiled or loaded before.

    .venv/bin/python -m benchmarks.same_bits [--only convex iterated]

In an empty, a full and a half-empty cache of kernels, where none can be kept, and with
the controllers flown in the other order, each in a process of its own with its own seed
of Python's hashes; compiling takes a minute or two in four of them. Names what differs,
and ends with 1 then.
"""

import argparse
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from benchmarks.quadrotor import (
    HOVER,
    INNER,
    NOISE,
    OUTER,
    STATE_BOUNDS,
    TRAJECTORIES,
    problem,
    trained,
)
from gpmpc.mpc import (
    GPMPC,
    Box,
    Controller,
    NonlinearGPMPC,
    PredictionSettings,
    Problem,
    Tracking,
)
from gpmpc.mpc.baselines import LQR, NMPC, StateFormMPC
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.simulation import Cascade, cascade_loop, closed_loop
from gpmpc.systems import Coupled, System
from gpmpc.trajectories import states_along

STEPS = 8
H = 6
PATH = TRAJECTORIES["lorenz"]
BOUNDS = Box(*STATE_BOUNDS["lorenz"], probability=0.95, penalty=10.0)
MATCHED = MomentMatching()
LINEARIZED = Linearization()
CONTROLLERS: dict[str, Callable[[], Controller | Cascade]] = {
    "convex": lambda: GPMPC(trained("lorenz"), LINEARIZED, problem(), H, HOVER),
    "paper": lambda: GPMPC(
        trained("lorenz"),
        MATCHED,
        problem(),
        H,
        HOVER,
        prediction=PredictionSettings(form="velocity", covariance="diagonal"),
    ),
    "full": lambda: GPMPC(
        trained("lorenz"),
        MATCHED,
        problem(),
        H,
        HOVER,
        prediction=PredictionSettings(covariance="full"),
    ),
    "iterated": lambda: GPMPC(
        trained("lorenz"), LINEARIZED, problem(BOUNDS), H, HOVER, iterations=30
    ),
    "nonlinear": lambda: NonlinearGPMPC(
        trained("lorenz"), MATCHED, problem(), H, HOVER
    ),
    "state form": lambda: StateFormMPC(trained("lorenz"), MATCHED, problem(), H, HOVER),
    "lqr": lambda: LQR(trained("lorenz"), problem(), H, HOVER),
    "nmpc": lambda: NMPC(OUTER, problem(), H, HOVER),
    "cascade": lambda: Cascade(
        GPMPC(trained("lorenz"), MATCHED, problem(), H, HOVER),
        GPMPC(
            trained("lorenz", "rotational"),
            LINEARIZED,
            Problem(Tracking([1] * 6, [1] * 3, penalized="inputs")),
            H,
            [0.0] * 3,
        ),
    ),
}


def main() -> int:
    """Flies in every state of the cache, and compares."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--only", nargs="+", choices=CONTROLLERS, default=list(CONTROLLERS)
    )
    parser.add_argument("--into", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.into:
        np.savez(arguments.into, **fly(arguments.only))
        return 0
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        states = {
            "empty": folder / "a",
            "full": folder / "a",
            "full, reversed": folder / "a",
            "half empty": folder / "a",
        }
        states |= {"empty, reversed": folder / "b", "none": folder / "none"}
        (folder / "none").write_text("no folder can be made here")
        flown = {}
        for number, (state, cache) in enumerate(states.items()):
            if state == "half empty":
                files = sorted(cache.rglob("*.nb[ci]"))
                for file in random.Random(0).sample(files, len(files) // 2):
                    file.unlink()
            order = arguments.only[::-1] if "reversed" in state else arguments.only
            into = folder / f"{number}.npz"
            environment = {"NUMBA_CACHE_DIR": str(cache), "PYTHONHASHSEED": str(number)}
            subprocess.run(
                [
                    sys.executable,
                    "-m",
                    "benchmarks.same_bits",
                    "--into",
                    into,
                    "--only",
                    *order,
                ],
                check=True,
                env=os.environ | environment,
            )
            flown[state] = dict(np.load(into))
            differing = [
                key
                for key, value in flown["empty"].items()
                if value.tobytes() != flown[state][key].tobytes()
            ]
            print(
                f"{state:16} {len(flown[state])} arrays, {len(differing)} differ",
                *differing,
                flush=True,
            )
    return int(
        any(
            v.tobytes() != of[k].tobytes()
            for of in flown.values()
            for k, v in flown["empty"].items()
        )
    )


def fly(names: list[str]) -> dict[str, np.ndarray]:
    """All arrays of the flights."""
    references = states_along(PATH, np.arange(STEPS + H + 1.0))
    arrays_by_name = {}
    for name in names:
        controller = CONTROLLERS[name]()
        if isinstance(controller, Cascade):
            plant = System(Coupled(), INNER.time_step, 1)
            start = np.concatenate([references[0], np.zeros(6)])
            flight = cascade_loop(
                plant, controller, references, start, 2, on_failure="previous_plan"
            )
            arrays = {"states": flight.states, "inputs": flight.inputs}
        else:
            flight = closed_loop(
                OUTER,
                controller,
                references,
                references[0],
                STEPS,
                noise=NOISE,
                seed=1,
                on_failure="previous_plan",
            )
            keys = ("states", "inputs", "predicted_means", "predicted_covariances")
            arrays = {key: getattr(flight, key) for key in keys}
        arrays_by_name |= {
            f"{name}.{key}": np.asarray(array) for key, array in arrays.items()
        }
    return arrays_by_name


if __name__ == "__main__":
    sys.exit(main())
