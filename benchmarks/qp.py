"""How fast are the QP solvers in closed loop, beside DAQP and CVXPY with Clarabel?

    .venv/bin/python -m benchmarks.qp                      # every cell of the table, about ten minutes
    .venv/bin/python -m benchmarks.qp --quick              # short sequences, horizons 1, 10, 20: about a minute
    .venv/bin/python -m benchmarks.qp --horizons 50 --modes changing --slow-solvers 0
    .venv/bin/python -m benchmarks.qp --rows 6,3           # also with bounds on the positions only

All solvers solve one sequence of QPs in one process on one thread, each warm-started from its own last solution:
``constant`` and ``changing`` are those of ``quadrotor_sequences``, ``elliptical`` and ``lorenz`` those of a learned
controller on a flight, whose P and G change, with bounds of inputs and states. The solvers take turns, sequence by
sequence, ``--passes`` times, and the fastest of a QP's passes counts: what another process on the machine does to one
pass is not the solver's time. *Hot*: the problem has just been written to memory that stays the same, as a controller
would. *Flushed*: all caches are overwritten before every call.

Times include everything from contiguous arrays to x, so the Python layer of either side. DAQP has two paths, each with
contiguous arrays: ``Model.update`` + ``Model.solve`` (warm), and ``daqp.solve`` from nothing; ratios are to the faster
one of the cell. Written to ``--out``: qp.json and qp.png.
"""

import argparse
import gc
import json
import os
import platform
import sys
from collections.abc import Callable
from itertools import product
from pathlib import Path
from time import perf_counter

import daqp
import numpy as np

from benchmarks.quadrotor import TRAJECTORIES
from benchmarks.quadrotor_sequences import SequenceProblem, flight_sequence, quadrotor_sequence
from gpmpc.qp import CvxpySolver, DualActiveSet, PrimalActiveSet, QuadraticProgram, make_solution
from gpmpc.status import Status

OURS, DAQP_WARM, DAQP_COLD = "DualActiveSet", "DAQP update + solve", "DAQP solve"
PRIMAL, CVXPY = "PrimalActiveSet", "CVXPY + Clarabel"
TARGETS = {
    "constant": {1: 0.60, 5: 0.50, 10: 0.45, 20: 0.42, 50: 0.34},
    "changing": {1: 0.85, 5: 0.57, 10: 0.30, 20: 0.20, 50: 0.09},
    "elliptical": {1: 0.75, 5: 0.45, 10: 0.50, 20: 0.12},
    "lorenz": {1: 0.75, 5: 0.45, 10: 0.25, 20: 0.12},
}
CACHES = np.zeros(12_000_000)  # 96 MB, more than any cache of the machine

Solve = Callable[[SequenceProblem], tuple[np.ndarray, np.ndarray]]


def ours(changing: bool) -> Callable[[SequenceProblem], Solve]:
    """A warm-started ``DualActiveSet``, with a prepared program where P and G stay."""

    def begin(first: SequenceProblem) -> Solve:
        solver, last = DualActiveSet(), None
        prepared = None if changing else solver.prepare(first.P, first.G)

        def solve(problem: SequenceProblem):
            nonlocal last
            P, q, G, lower, upper = problem.P, problem.q, problem.G, problem.lower, problem.upper
            if changing:
                last = solver.solve(QuadraticProgram.unchecked(P, q, G, lower, upper), last)
            else:
                last = prepared.solve(q, lower, upper, last)
            return last.x, last

        return solve

    return begin


def daqp_warm(changing: bool) -> Callable[[SequenceProblem], Solve]:
    """DAQP's model object, which keeps its working set from one solve to the next."""

    def begin(first: SequenceProblem) -> Solve:
        model = daqp.Model()
        sense = np.zeros(len(first.lower), dtype=np.int32)
        model.setup(first.P, first.q, first.G, first.upper, first.lower, sense)

        def solve(problem: SequenceProblem):
            if changing:
                model.update(H=problem.P, f=problem.q, A=problem.G, bupper=problem.upper, blower=problem.lower)
            else:
                model.update(f=problem.q, bupper=problem.upper, blower=problem.lower)
            x, _, _, info = model.solve()
            return x, info

        return solve

    return begin


def daqp_cold(first: SequenceProblem) -> Solve:
    """DAQP's function: set-up and solve in one call."""
    sense = np.zeros(len(first.lower), dtype=np.int32)

    def solve(problem: SequenceProblem):
        x, _, _, info = daqp.solve(problem.P, problem.q, problem.G, problem.upper, problem.lower, sense)
        return x, info

    return solve


def by_protocol(solver) -> Callable[[SequenceProblem], Solve]:
    """Any ``QPSolver``; building the ``QuadraticProgram`` is not timed (see ``run_pass``)."""

    def begin(first: SequenceProblem) -> Solve:
        last = None

        def solve(problem: QuadraticProgram):
            nonlocal last
            last = solver.solve(problem, last)
            return last.x, last

        return solve

    return begin


def run_pass(begin, problems: list[SequenceProblem], flush: bool, as_program: bool) -> tuple[np.ndarray, list]:
    """Seconds per QP of one pass over the sequence, and what the solver returned for each."""
    first = problems[0]
    buffer = SequenceProblem(*(np.array(a) for a in (first.P, first.q, first.G, first.lower, first.upper)))
    solve = begin(buffer)
    seconds, answers = np.empty(len(problems)), []
    gc.collect()
    gc.disable()
    for i, problem in enumerate(problems):
        for name in ("P", "q", "G", "lower", "upper"):
            np.copyto(getattr(buffer, name), getattr(problem, name))
        given = QuadraticProgram.from_stacked(*vars(buffer).values()) if as_program else buffer
        if flush:
            CACHES[:] = i
        began = perf_counter()
        answer = solve(given)
        seconds[i] = perf_counter() - began
        x, rest = answer  # copied, so that no solver's memory grows with the sequence
        answers.append((x.copy(), np.array(rest["lam"] if isinstance(rest, dict) else rest.multipliers)))
    gc.enable()
    return seconds, answers


def worst_residual(problem: SequenceProblem, answer) -> float:
    """The largest scaled KKT residual of an answer."""
    x, multipliers = answer
    program = QuadraticProgram.from_stacked(*vars(problem).values())
    solution = make_solution(program, Status.SOLVED, x, multipliers)
    return max(solution.residuals())


def active_rows(problem: SequenceProblem) -> int:
    """Number of active constraints at the minimiser."""
    solution = DualActiveSet().solve(QuadraticProgram.unchecked(*vars(problem).values()))
    return int(np.count_nonzero(solution.active_set))


def measure_cell(horizon: int, mode: str, rows: int, settings: argparse.Namespace) -> dict:
    """All solvers on one sequence."""
    changing = mode != "constant"
    closing = DualActiveSet()

    def close_loop(p: SequenceProblem) -> np.ndarray:
        return closing.solve(QuadraticProgram.unchecked(*vars(p).values())).x

    if mode in TRAJECTORIES:
        problems = flight_sequence(mode, horizon, settings.length)
    else:
        problems = list(quadrotor_sequence(horizon, changing, settings.length, close_loop, positions_only=rows == 3))
    fast = {OURS: ours(changing), DAQP_WARM: daqp_warm(changing), DAQP_COLD: daqp_cold}
    slow = {PRIMAL: by_protocol(PrimalActiveSet()), CVXPY: by_protocol(CvxpySolver("CLARABEL", {}))}
    cell = {
        "horizon": horizon,
        "mode": mode,
        "n": 3 * horizon,
        "m": len(problems[0].G),
        "rows a stage": len(problems[0].G) // horizon,
        "QPs": len(problems),
        "active rows": float(np.mean([active_rows(p) for p in problems])),
        "solvers": {},
    }
    for condition, passes in (("hot", settings.passes), ("flushed", min(settings.passes, 2))):
        flush = condition == "flushed"
        some = problems[: max(20, len(problems) // 4)] if flush else problems
        seconds = {name: np.full(len(some), np.inf) for name in fast}
        for _ in range(passes):
            for name, begin in fast.items():
                taken, answers = run_pass(begin, some, flush, False)
                seconds[name] = np.minimum(seconds[name], taken)
                if not flush:
                    cell["solvers"].setdefault(name, {})["residual"] = max(map(worst_residual, some, answers))
        for name, values in seconds.items():
            cell["solvers"][name][condition] = quantiles(values)
    for name, begin in slow.items():
        if settings.slow_solvers:
            some = problems[: settings.slow_solvers]
            taken, answers = run_pass(begin, some, False, True)
            cell["solvers"][name] = {
                "residual": max(map(worst_residual, some, answers)), "hot": quantiles(taken[1:]),
            }  # fmt: skip
    best = min((DAQP_WARM, DAQP_COLD), key=lambda name: cell["solvers"][name]["hot"]["median"])
    cell["best DAQP path"] = best
    for condition in ("hot", "flushed"):
        mine, theirs = (cell["solvers"][name][condition] for name in (OURS, best))
        cell[f"ratio {condition}"] = {key: mine[key] / theirs[key] for key in mine}
    return cell


def quantiles(seconds: np.ndarray) -> dict[str, float]:
    """Median, p95 and p99 in microseconds."""
    median, p95, p99 = 1e6 * np.quantile(seconds, [0.5, 0.95, 0.99])
    return {"median": float(median), "p95": float(p95), "p99": float(p99)}


def describe(cell: dict) -> str:
    """One line per cell for the terminal."""
    solvers, ratio = cell["solvers"], cell["ratio hot"]
    text = f"{cell['mode']:10s} H = {cell['horizon']:3d}, m = {cell['m']:3d}, {cell['active rows']:4.1f} active: "
    text += f"{solvers[OURS]['hot']['median']:8.2f} us, {cell['best DAQP path']} "
    text += f"{solvers[cell['best DAQP path']]['hot']['median']:8.2f} us, ratio {ratio['median']:.3f}"
    if cell["horizon"] in TARGETS[cell["mode"]]:
        text += f" (target {TARGETS[cell['mode']][cell['horizon']]:.2f})"
    text += (
        f", p99 {ratio['p99']:.3f}, flushed {cell['ratio flushed']['median']:.3f}, KKT {solvers[OURS]['residual']:.0e}"
    )
    if CVXPY in solvers:
        text += f", CVXPY {solvers[CVXPY]['hot']['median'] / solvers[OURS]['hot']['median']:.0f} times slower"
    return text


def draw(cells: list[dict], path: Path) -> None:
    """Median times per solver, and the ratios to DAQP beside their targets."""
    import matplotlib.pyplot as plt

    plt.style.use("gpmpc.plotting.gpmpc")

    modes = list(dict.fromkeys(cell["mode"] for cell in cells))
    figure, axes = plt.subplots(2, len(modes), figsize=(5.5 * len(modes), 7.5), squeeze=False, sharex=True)
    for column, mode in enumerate(modes):
        chosen = [cell for cell in cells if cell["mode"] == mode]
        times, ratios = axes[:, column]
        for name in (OURS, DAQP_WARM, DAQP_COLD, PRIMAL, CVXPY):
            having = [cell for cell in chosen if name in cell["solvers"]]
            if having:
                x = [cell["horizon"] for cell in having]
                times.loglog(x, [cell["solvers"][name]["hot"]["median"] for cell in having], "o-", ms=4, label=name)
        times.set_title(f"{mode} P, G")
        x = [cell["horizon"] for cell in chosen]
        for key, style in (("median", "o-"), ("p99", "s--")):
            ratios.semilogx(x, [c["ratio hot"][key] for c in chosen], style, color="C0", ms=4, label=f"{key}, hot")
        ratios.semilogx(
            x, [c["ratio flushed"]["median"] for c in chosen], "^:", color="C1", ms=4, label="median, flushed"
        )
        targets = TARGETS[mode]
        ratios.semilogx(list(targets), list(targets.values()), "k_", ms=14, label="target for the median, hot")
        ratios.set(xlabel=f"horizon H (n = 3H, m = {chosen[0]['rows a stage']}H)", xticks=x, xticklabels=x)
        ratios.set_ylim(bottom=0.0)  # open above: where DAQP is faster has to show
        ratios.axhline(1.0, color="0.5", linewidth=0.8)
        ratios.minorticks_off()
        for axis in (times, ratios):
            axis.legend(fontsize=8)
    axes[0, 0].set_ylabel("median time per QP [us]")
    axes[1, 0].set_ylabel(f"{OURS} / best DAQP path")
    figure.savefig(path)


def main() -> None:
    """Measures the cells asked for and writes what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--horizons", default="1,5,10,20,50", help="comma-separated")
    parser.add_argument("--modes", default="constant,changing,elliptical,lorenz", help="comma-separated")
    parser.add_argument("--rows", default="6", help="bounded states a stage: 6 (positions, velocities), 3, or 6,3")
    parser.add_argument("--length", type=int, default=440, help="QPs per cell")
    parser.add_argument("--passes", type=int, default=3, help="turns of each solver")
    parser.add_argument("--slow-solvers", type=int, default=30, help="QPs for Algorithm 1 and CVXPY; 0 leaves them out")
    parser.add_argument("--quick", action="store_true", help="short sequences, horizons 1, 10, 20")
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks"))
    settings = parser.parse_args()
    if settings.quick:
        settings.horizons, settings.length, settings.slow_solvers = "1,10,20", 120, 5
    settings.out.mkdir(parents=True, exist_ok=True)
    cells = []
    families = map(int, settings.rows.split(","))
    for rows, mode, horizon in product(families, settings.modes.split(","), map(int, settings.horizons.split(","))):
        cells.append(measure_cell(horizon, mode, rows, settings))
        print(describe(cells[-1]), flush=True)
    machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count(), "threads": 1}
    versions = {"python": sys.version.split()[0], "numpy": np.__version__, "unit": "microseconds"}
    (settings.out / "qp.json").write_text(json.dumps({"machine": machine | versions, "cells": cells}, indent=1))
    first = [cell for cell in cells if cell["rows a stage"] == cells[0]["rows a stage"]]
    draw(first, settings.out / "qp.png")
    print(f"written to {settings.out}")


if __name__ == "__main__":
    main()
