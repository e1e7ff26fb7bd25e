"""The calls that the guard times, in a process that measures on demand.

The guard starts one such process for each side, with the package of that side. A line
on standard input names a case and a number of calls, `{"case": "program", "calls":
20}`; the answer is a line with the median processor time of these calls in seconds.
Only the public doors of the package are used, so that these cases run with the code of
other commits, too.
"""

import json
import sys
import time
from collections.abc import Callable, Mapping
from itertools import cycle
from typing import Any

import numpy as np
import torch

from benchmarks.pendulums import pendulum_gp
from benchmarks.steps import (
    RECORDED_STEPS,
    STD,
    WarmStarted,
    controllers,
    record_steps,
)
from benchmarks.timing import use_one_thread
from gpmpc.gaussian import Gaussian
from gpmpc.propagation import MomentMatching, differentiate
from gpmpc.qp import DualActiveSet

STATES = 6
SIZE = 189  # training points, as in the paper
HORIZON = 10


def cases() -> dict[str, Callable[[], Any]]:
    """Returns everything that is guarded, by name."""
    gp = pendulum_gp(STATES, SIZE)
    compared = controllers(gp, HORIZON)
    steps = record_steps(gp, compared["mean only"], RECORDED_STEPS)
    programs = [compared["zero order"].control(*step).problem for step in steps]
    stepping = {
        f"step, {name}": WarmStarted(controller, steps)
        for name, controller in compared.items()
    }
    return predictions(gp) | stepping | {"program": warm_started_solves(programs)}


def predictions(gp: Any) -> dict[str, Callable[[], Any]]:
    """Returns predictions of one step, with and without derivatives."""
    moments = MomentMatching()
    input = torch.zeros(gp.state_dim // 2, dtype=torch.float64)
    covariance = STD**2 * torch.eye(STATES, dtype=torch.float64)
    belief = Gaussian(torch.zeros(STATES, dtype=torch.float64), covariance)
    state = belief.mean[None].numpy()
    inputs = input[None].numpy()
    return {
        "mean with Jacobian": lambda: gp.linearize(state, inputs, covariance=False),
        "exact moments": lambda: moments(gp, belief, input),
        "exact moments, all Jacobians": lambda: differentiate(
            moments, gp, belief, input
        ),
    }


def warm_started_solves(programs: list[Any]) -> Callable[[], Any]:
    """Returns a call that solves the next quadratic program, started from the last."""
    solver = DualActiveSet()
    upcoming = cycle(programs)
    solution = None

    def solve() -> None:
        nonlocal solution
        solution = solver.solve(next(upcoming), solution)

    return solve


def answer(request: Mapping[str, Any], calls: Mapping[str, Callable[[], Any]]) -> float:
    """Returns the median processor time of a case's calls [s]."""
    call = calls[request["case"]]
    seconds = []
    for _ in range(request["calls"]):
        start = time.thread_time_ns()
        call()
        seconds.append(time.thread_time_ns() - start)
    return 1e-9 * float(np.median(seconds))


def main() -> None:
    """Answers requests until standard input ends; the first line names the cases."""
    use_one_thread()
    calls = cases()
    print(json.dumps(list(calls)), flush=True)
    for line in sys.stdin:
        print(json.dumps(answer(json.loads(line), calls)), flush=True)


if __name__ == "__main__":
    main()
