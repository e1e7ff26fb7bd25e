"""How long one step through the GPs takes: exact moments and the mean, with Jacobians, beside torch and GPyTorch.

    .venv/bin/python benchmarks/gp.py [--sizes 10 50 100 189 500 1000 2000] [--seconds 2] [--torch-jacobian-up-to 500]

One process, one thread, process time. Six outputs, six states and three controls; at each size all contenders predict
with the same posterior and take turns. Above ``--torch-jacobian-up-to`` points torch's reverse mode through the closed
form is left out (it keeps all N x N products of the 21 pairs). Beside the times stands the rate of a 1000 x 1000 matrix
product, measured in between, and the largest relative difference between the contenders' results. Writes
``outputs/benchmarks/gp.json``.
"""

import argparse
import json
import os
import time

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[variable] = "1"

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from gpmpc import kernels
from gpmpc.bench.linearisations import linearisation_groups
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.provenance import provenance

STATES, INPUTS = 6, 3
LEAST = 1e-4  # s a sample, shorter calls are repeated within it


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 50, 100, 189, 500, 1000, 2000])
    parser.add_argument("--seconds", type=float, default=2.0, help="time a contender and size")
    parser.add_argument("--torch-jacobian-up-to", type=int, default=500)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    torch.set_default_dtype(torch.float64)
    results, began = [], time.perf_counter()
    gps, at, u = posterior(8).packed, belief(), np.zeros(INPUTS)
    kernels.mean_with_jacobian(gps, at.mean.numpy(), u)
    kernels.point_with_jacobian(gps, at.mean.numpy(), u)
    kernels.moments_with_jacobian(gps, at.mean.numpy(), at.covariance.numpy(), u)
    first = time.perf_counter() - began
    print(f"first calls of the three kernels: {first:.2f} s (compiled in a fresh installation, read from disk later)")
    print("process time in milliseconds, one thread")
    print(f"{'N':>5}  {'what':34}{'median':>10}{'p99':>10}{'ratio':>8}{'GFlop/s':>9}{'difference':>12}")
    for size in arguments.sizes:
        for group in contenders(size, size <= arguments.torch_jacobian_up_to):
            own = next(iter(group))
            seconds = take_turns(group, arguments.seconds)
            rate, answers = product_rate(), {name: call() for name, call in group.items()}
            for name in group:
                times = np.array(seconds[name])
                result = {
                    "size": size,
                    "what": name,
                    "median": float(np.median(times)),
                    "p99": float(np.quantile(times, 0.99)),
                    "samples": len(times),
                    "ratio": float(np.median(times) / np.median(seconds[own])),
                    "gflops": rate,
                    "difference": difference(answers[name], answers[own]),
                }
                results.append(result)
                print(
                    f"{size:5}  {name:34}{1e3 * result['median']:10.4f}{1e3 * result['p99']:10.4f}"
                    f"{result['ratio']:8.1f}{rate:9.1f}{result['difference']:12.1e}",
                    flush=True,
                )
    path = Path("outputs/benchmarks/gp.json")
    path.parent.mkdir(parents=True, exist_ok=True)
    meta = provenance() | {"threads": 1, "first_calls": first, "states": STATES, "inputs": INPUTS}
    path.write_text(json.dumps({"meta": meta, "results": results}, indent=1))
    print(f"written to {path}")


def posterior(size: int) -> GPPosterior:
    """Six GPs on smooth functions of nine inputs."""
    generator = torch.Generator().manual_seed(size)
    features = 4 * torch.rand(size, STATES + INPUTS, generator=generator) - 2
    targets = torch.stack([torch.sin(features[:, a]) + features[:, -1] * features[:, a - 1] for a in range(STATES)], 1)
    scales = 2 + 2 * torch.rand(STATES, STATES + INPUTS, generator=generator)
    signal = 1 + torch.rand(STATES, generator=generator)
    return GPPosterior.from_hyperparameters(features, targets, scales, signal, 1e-3 * signal, INPUTS)


def belief() -> Gaussian:
    """Mean near the middle of the data, standard deviations near 0.3."""
    root = 0.3 * torch.randn(STATES, STATES, generator=torch.Generator().manual_seed(1)) / STATES**0.5
    return Gaussian(torch.linspace(-0.5, 0.5, STATES), root @ root.T + 0.01 * torch.eye(STATES))


def contenders(size: int, torch_jacobian: bool) -> list[dict[str, Callable]]:
    """Groups that answer the same question, ours first; each call returns what is compared."""
    return linearisation_groups(posterior(size), belief(), torch.linspace(-0.3, 0.3, INPUTS), torch_jacobian)


def take_turns(group: dict[str, Callable], seconds: float) -> dict[str, list[float]]:
    """Process times of single calls (means over a sample where calls are short); the contenders alternate."""
    repeats = {}
    for name, call in group.items():
        call()
        start = time.process_time()
        call()
        repeats[name] = 1 + int(LEAST / max(time.process_time() - start, 1e-6))
    times = {name: [] for name in group}
    while any(sum(times[name]) * repeats[name] < seconds for name in group):
        for name, call in group.items():
            if len(times[name]) >= 5 and sum(times[name]) * repeats[name] >= seconds:
                continue
            start = time.process_time()
            for _ in range(repeats[name]):
                call()
            times[name].append((time.process_time() - start) / repeats[name])
    return times


def difference(answer, reference) -> float:
    """The largest difference of two lists of arrays, relative to each array's largest entry."""
    pairs = [(np.asarray(a), np.asarray(b)) for a, b in zip(answer, reference, strict=True)]
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


def product_rate() -> float:
    """GFlop/s of a 1000 x 1000 matrix product, best of three."""
    matrix, seconds = np.ones((1000, 1000)), []
    for _ in range(3):
        start = time.process_time()
        matrix @ matrix
        seconds.append(time.process_time() - start)
    return 2 / min(seconds)


if __name__ == "__main__":
    main()
