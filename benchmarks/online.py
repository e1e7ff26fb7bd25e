"""Times learning one more point while running, and forgetting one.

A factorisation from the start stands beside them.

    .venv/bin/python -m benchmarks.online [--repeats 31] [--sizes 100 200 500 1000]

One process, one thread, process CPU time; six outputs, nine features. For every size N
the posterior of N points is conditioned on one more, ten more, drops its oldest point,
and is built from the hyperparameters on N + 1 points, in turns of four calls each;
ratios are paired. The last call counts, as in a loop that learns at every step; "cold"
is the first one, after other work, when the memory of the new factor has to be asked
for. A step under a full budget (one in, one out) is timed under both rules. Writes
``outputs/benchmarks/online.json``.
"""

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch

from benchmarks.timing import write_results
from gpmpc.gp import GPPosterior, SlidingWindow, append_points, remove_points

OUTPUTS = 6
FEATURES = 9
INPUTS = 3


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=31)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 200, 500, 1000])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    print(
        "six outputs, one thread; medians of process time in ms; ratio: from "
        "hyperparameters over + 1 (paired)"
    )
    columns = (
        "N",
        "fresh N+1",
        "+ 1",
        "+ 10",
        "- oldest",
        "oldest",
        "least inf.",
        "ratio",
        "cold ratio",
    )
    print("".join(f"{column:>12}" for column in columns))
    for size in arguments.sizes:
        x, y, settings = problem(size + 10)
        gp = GPPosterior.from_hyperparameters(x[:size], y[:size], **settings)
        one = (x[size : size + 1], y[size : size + 1])
        ten = (x[size:], y[size:])
        oldest = SlidingWindow(size)
        least = SlidingWindow(size, "least_informative")
        ways: dict[str, Callable[[], GPPosterior]] = {
            "fresh": lambda s=size, x=x, y=y, h=settings: (
                GPPosterior.from_hyperparameters(x[: s + 1], y[: s + 1], **h)
            ),
            "add_one": lambda gp=gp, new=one: append_points(gp, *new),
            "add_ten": lambda gp=gp, new=ten: append_points(gp, *new),
            "drop_oldest": lambda gp=gp: remove_points(gp, 0),
            "budget_oldest": lambda gp=gp, new=one, b=oldest: b.append(gp, *new),
            "budget_least_informative": lambda gp=gp, new=one, b=least: b.append(
                gp, *new
            ),
        }
        cold, warming, repeated = ({name: [] for name in ways} for _ in range(3))
        for repeat in range(arguments.repeats + 1):
            for name, way in ways.items():
                for turn in (
                    cold,
                    warming,
                    warming,
                    repeated,
                ):  # the last finds the memory as a loop that learns at every step does
                    start = time.process_time()
                    way()
                    seconds = time.process_time() - start
                    if repeat:  # the first compiles
                        turn[name].append(seconds)
        ratios = np.array(repeated["fresh"]) / repeated["add_one"]
        medians = {
            name: float(np.median(seconds)) for name, seconds in repeated.items()
        }
        after = float(np.median(np.array(cold["fresh"]) / cold["add_one"]))
        ratios_of_size = {
            "ratio": float(np.median(ratios)),
            "least": ratios.min(),
            "ratio_after_other_work": after,
        }
        results.append({"size": size, "seconds": medians} | ratios_of_size)
        row = "".join(f"{1e3 * median:12.2f}" for median in medians.values())
        print(f"{size:12}{row}{np.median(ratios):12.1f}{after:12.1f}", flush=True)
    write_results("online", results)


def problem(rows: int) -> tuple[torch.Tensor, torch.Tensor, dict]:
    """Points, targets and hyperparameters of smooth functions of nine features."""
    generator = torch.Generator().manual_seed(0)
    x = 4 * torch.rand(rows, FEATURES, generator=generator, dtype=torch.float64) - 2
    y = torch.stack(
        [torch.sin(x[:, a] + x[:, -1]) + x[:, 0] * x[:, 1] for a in range(OUTPUTS)],
        dim=1,
    )
    return (
        x,
        y,
        {
            "lengthscales": 1.5
            + 2
            * torch.rand(OUTPUTS, FEATURES, generator=generator, dtype=torch.float64),
            "signal_variance": torch.ones(OUTPUTS, dtype=torch.float64),
            "noise_variance": torch.full((OUTPUTS,), 1e-4, dtype=torch.float64),
            "input_dim": INPUTS,
        },
    )


if __name__ == "__main__":
    main()
