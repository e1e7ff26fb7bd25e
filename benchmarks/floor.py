"""Compares one moment-matched Jacobian with the time of its instructions.

The comparison is over the number of training points.

    .venv/bin/python -m benchmarks.floor [--sizes 100 189 500 1000 2000]

One process, one thread, process CPU time. The floor counts the arithmetic that
``gpmpc._kernels`` has to issue for a pair of points and of outputs, in registers of
eight numbers, and divides it by the rate at which this machine, in the same process,
issues independent multiply-adds from registers. Loads, stores, loops and everything
that grows slower than N^2 are not in it: this is the arithmetic floor, to which
``ratio`` refers. ``streamed`` is what reading the two triangles once from memory takes,
at the rate of a sum over an array of that size; at large N they no longer fit the
caches.

Two beliefs are measured. Where all exponents are near zero, as they are for a belief
that is narrow beside the length-scales, expm1 needs no reduction; ``ratio`` then refers
to the floor without those instructions, and ``general`` to the one with them, which is
the floor of the wide belief. ``256 bits`` is the time over the general floor in vectors
of four numbers, twice as many at the same rate: those that LLVM takes by itself on
processors that have both. Writes ``outputs/benchmarks/floor.json``.
"""

import argparse
import time

import numpy as np
import torch

from benchmarks.timing import write_results
from gpmpc import _kernels as kernels
from gpmpc._compiled import compiled
from gpmpc._kernels._simd import load, store
from gpmpc.gp import GPPosterior

STATES = 6
INPUTS = 3
LANES = 8
# Vector instructions for eight pairs of points, R states:
DELTA = STATES + 1  # rise + fall + left . right
REDUCTION = (
    8  # of expm1: two bounds, rounding and its inverse, reduction, the scaling (3)
)
EXPM1 = 11  # 9 of the polynomial and r^2 and the last
SUMS = 2 + STATES  # of columns, of rows, of the vectors z
WEIGHT = 2  # a = b: P_ij, R_ij
EXPLAINED = 2  # an entry of L^-1: L^-1 q, and L^-T of it
TIMES = {"seconds": 1.0, "least": 7}  # of one size and belief
BELIEFS = {
    "narrow": 0.01,
    "wide": 3.0,
}  # variances, of points of variance 1 and length-scales of 2 to 3


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[100, 189, 300, 500, 1000, 2000]
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    print(
        f"{'N':>6} "
        f"{'belief':8}{'ms':>10}{'p99':>10}{'ns/N^2':>9}"
        f"{'floor ms':>10}{'ratio':>8}{'general':>9}"
        f"{'256 bits':>10}{'streamed ms':>13}{'with memory':>13}"
    )
    results = []
    for size in arguments.sizes:
        packed = posterior(size).packed
        for belief in BELIEFS:
            result = measured(packed, size, belief)
            print(
                f"{size:6} "
                f"{belief:8}{result['ms_median']:10.3f}{result['ms_p99']:10.3f}"
                f"{result['ns_per_square']:9.2f}"
                f"{result['floor_ms']:10.3f}{result['ratio']:8.2f}"
                f"{result['ratio_to_general']:9.2f}"
                f"{result['ratio_to_256_bits']:10.2f}{result['streamed_ms']:13.3f}"
                f"{result['ratio_with_memory']:13.2f}",
                flush=True,
            )
            results.append(result)
    write_results("floor", results)


def measured(packed: kernels.Packed, size: int, belief: str) -> dict:
    """One moment-matched Jacobian of six GPs over ``size`` points, beside its floor."""
    S = BELIEFS[belief] * (np.eye(STATES) + 0.1)
    arguments = (
        packed,
        np.zeros((1, STATES)),
        S[None],
        np.zeros((1, INPUTS)),
        False,
        True,
    )
    kernels.gp_moments(*arguments)
    times = []
    rates = []
    began = time.process_time()
    while time.process_time() - began < TIMES["seconds"] or len(times) < TIMES["least"]:
        rates.append(issue_rate())
        start = time.process_time()
        kernels.gp_moments(*arguments)
        times.append(time.process_time() - start)
    middle = float(np.median(times))
    general = instructions(packed, reduced=True) / max(rates)
    floor = (
        general
        if belief == "wide"
        else instructions(packed, reduced=False) / max(rates)
    )
    factor = summed(packed.variance_factors.inverse_cholesky)
    centred = summed(packed.variance_factors.doubled_E)
    return {
        "N": size,
        "belief": belief,
        "ms_median": 1e3 * middle,
        "ms_p99": 1e3 * float(np.quantile(times, 0.99)),
        "ns_per_square": 1e9 * middle / size**2,
        "floor_ms": 1e3 * floor,
        "ratio": middle / floor,
        "ratio_to_general": middle / general,
        "ratio_to_256_bits": middle / (2 * general),
        "streamed_ms": 1e3 * (factor + centred),
        "ratio_with_memory": middle / (floor + factor),
        "instructions_per_second": max(rates),
    }


def instructions(packed: kernels.Packed, reduced: bool) -> float:
    """Counts the vector instructions that a Jacobian must issue over all pairs.

    They are counted with or without the reduction of expm1.
    """
    k = packed.output_dim
    padded = packed.arrays.points.shape[1]
    square = padded**2 / LANES
    triangle = padded * (padded + LANES) / 2 / LANES
    each = DELTA + EXPM1 + SUMS + (REDUCTION if reduced else 0)
    return k * (k - 1) / 2 * square * each + k * triangle * (each + WEIGHT + EXPLAINED)


def issue_rate(count: int = 200_000) -> float:
    """Independent multiply-adds of eight numbers a second."""
    values = np.full(14 * LANES, 1e-9)
    start = time.process_time()
    multiply_add(values, count)
    return 12 * count / (time.process_time() - start)


@compiled
def multiply_add(values, count):
    """Twelve chains of ``count`` multiply-adds in registers.

    Two a cycle hide a latency of four.
    """
    a = load(values, 0)
    b = load(values, 8)
    c = load(values, 16)
    d = load(values, 24)
    e = load(values, 32)
    f = load(values, 40)
    g = load(values, 48)
    h = load(values, 56)
    i = load(values, 64)
    j = load(values, 72)
    k = load(values, 80)
    m = load(values, 88)
    added = load(values, 96)
    factor = values[104]
    for _ in range(count):
        a = added + factor * a
        b = added + factor * b
        c = added + factor * c
        d = added + factor * d
        e = added + factor * e
        f = added + factor * f
        g = added + factor * g
        h = added + factor * h
        i = added + factor * i
        j = added + factor * j
        k = added + factor * k
        m = added + factor * m
    store(values, 0, a), store(values, 8, b), store(values, 16, c), store(values, 24, d)
    (
        store(values, 32, e),
        store(values, 40, f),
        store(values, 48, g),
        store(values, 56, h),
    )
    (
        store(values, 64, i),
        store(values, 72, j),
        store(values, 80, k),
        store(values, 88, m),
    )


def summed(array: np.ndarray) -> float:
    """Seconds that a sum over an array takes, the best of three."""
    times = []
    for _ in range(3):
        start = time.process_time()
        array.sum()
        times.append(time.process_time() - start)
    return min(times)


def posterior(size: int, seed: int = 0) -> GPPosterior:
    """Six GPs over random points; what they learned does not matter for the time."""
    generator = torch.Generator().manual_seed(seed)
    features = torch.randn(
        size, STATES + INPUTS, generator=generator, dtype=torch.float64
    )
    targets = torch.randn(size, STATES, generator=generator, dtype=torch.float64)
    lengthscales = 2.0 + torch.rand(
        STATES, STATES + INPUTS, generator=generator, dtype=torch.float64
    )
    ones = torch.ones(STATES, dtype=torch.float64)
    return GPPosterior.from_hyperparameters(
        features, targets, lengthscales, ones, 1e-2 * ones, INPUTS
    )


if __name__ == "__main__":
    main()
