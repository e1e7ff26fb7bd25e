"""Whether something became slower: times over those of reference kernels in the same run, against recorded limits.

    make guard                                   # exit code 1 where a ratio is above its limit
    .venv/bin/python -m benchmarks.guard --record   # after a change that is meant to change them, on a calm machine

A time says little on another machine, so each is divided by that of a kernel that no change here touches and that does
the same kind of work: ``exp`` is exponentials over a matrix of pairs, as the GPs' kernels are; ``python`` is small
NumPy calls between attribute look-ups, as a control step outside the kernels is. They take turns with what they are
compared with. A ratio may exceed the recorded one by ``MARGIN`` before it counts; what does is measured again, twice,
since a machine has bad seconds. One thread, processor time.
"""

import argparse
import json
import sys
from itertools import cycle
from pathlib import Path

import numpy as np
import torch

from benchmarks.pendulums import pendulum_gp
from benchmarks.steps import RECORDED_STEPS, STD, WarmStarted, controllers, record_steps
from benchmarks.timing import time_interleaved, use_one_thread
from gpmpc.gaussian import Gaussian
from gpmpc.propagation import MomentMatching, differentiate
from gpmpc.qp import DualActiveSet

RECORD = Path(__file__).with_name("guard.json")
MARGIN = 1.3
STATES = 6
SIZE = 189
HORIZON = 10
SECONDS = 2.0  # a group


def main() -> None:
    """Measures and judges."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--record", action="store_true", help="writes the ratios as the new record"
    )
    arguments = parser.parse_args()
    use_one_thread()
    measured = ratios()
    if arguments.record:
        RECORD.write_text(
            json.dumps(
                {name: round(ratio, 4) for name, ratio in measured.items()}, indent=1
            )
            + "\n"
        )
        print(f"written to {RECORD.name}")
        return
    record = json.loads(RECORD.read_text())
    for _ in range(2):
        if not slower(measured, record):
            break
        again = ratios()
        measured = {name: min(ratio, again[name]) for name, ratio in measured.items()}
    for name, ratio in measured.items():
        mark = "SLOWER" if name in slower(measured, record) else ""
        print(
            f"{name:44}{ratio:9.3f}   recorded {record.get(name, float('nan')):9.3f}   {mark}".rstrip()
        )
    if set(measured) != set(record):
        print(
            f"not the same as recorded: {', '.join(sorted(set(measured) ^ set(record)))}; --record anew"
        )
    sys.exit(bool(slower(measured, record)) or set(measured) != set(record))


def slower(measured: dict[str, float], record: dict[str, float]) -> list[str]:
    """What exceeds its record by more than the margin."""
    return [
        name
        for name, ratio in measured.items()
        if ratio > MARGIN * record.get(name, np.inf)
    ]


def ratios() -> dict[str, float]:
    """Median ratio of everything that is guarded to its reference kernel."""
    found = {}
    for reference, kernel, contenders in groups():
        times = time_interleaved(
            {"reference": kernel} | contenders, SECONDS, min_rounds=50, max_rounds=400
        )
        for name in contenders:
            found[f"{name} / {reference}"] = times[name].over(times["reference"])
    return found


def groups() -> list[tuple]:
    """(name of the reference, the reference, what is compared with it)."""
    gp = pendulum_gp(STATES, SIZE)
    exact = MomentMatching()
    input = torch.zeros(gp.state_dim // 2, dtype=torch.float64)
    belief = Gaussian(
        torch.zeros(STATES, dtype=torch.float64),
        STD**2 * torch.eye(STATES, dtype=torch.float64),
    )
    held = controllers(gp, HORIZON)
    steps = record_steps(gp, held["mean only"], RECORDED_STEPS)
    stepping = {
        f"step, {name}": WarmStarted(controller, steps)
        for name, controller in held.items()
    }
    programs = [held["zero order"].control(*step).problem for step in steps]
    return [
        (
            "exp",
            exponentials(),
            {
                "exact moments, all Jacobians": lambda: differentiate(
                    exact, gp, belief, input
                ),
                "exact moments": lambda: exact(gp, belief, input),
                "step, paper's form": stepping.pop("step, paper's form"),
            },
        ),
        (
            "python",
            small_calls(),
            stepping
            | {
                "mean with Jacobian": lambda: gp.linearize(
                    belief.mean[None].numpy(), input[None].numpy(), covariance=False
                ),
                "program": solving(programs),
            },
        ),
    ]


def exponentials():
    """Exponentials of all pairs of points, and sums over them."""
    pairs = np.linspace(-3.0, 0.0, SIZE * SIZE).reshape(SIZE, SIZE)
    weights = np.ones(SIZE)

    def kernel():
        for _ in range(6):
            weights @ np.exp(pairs) @ weights

    return kernel


def small_calls():
    """Forty products of small matrices, with what the interpreter does around each."""
    matrix = np.eye(6)
    vector = np.ones(6)

    def kernel():
        kept = []
        for _ in range(40):
            kept.append(matrix @ vector)
        return np.concatenate(kept)

    return kernel


def solving(programs):
    """Solves one of the quadratic programs a call, warm-started from the last."""
    solver = DualActiveSet()
    tasks = cycle(programs)
    last = [None]

    def solve():
        last[0] = solver.solve(next(tasks), last[0])

    return solve


if __name__ == "__main__":
    main()
