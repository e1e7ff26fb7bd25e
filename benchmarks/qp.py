"""How fast are the QP solvers in closed loop, beside DAQP and CVXPY with Clarabel?

    .venv/bin/python -m benchmarks.qp                      # every cell of the table,
    about ten minutes .venv/bin/python -m benchmarks.qp --horizons 50 --modes changing
    --slow-solvers 0

All solvers solve one sequence of QPs in one process on one thread, each warm-started
from its own last solution: ``constant`` and ``changing`` are those of
``quadrotor_sequences``, ``elliptical`` and ``lorenz`` those of a learned controller on
a flight, whose P and G change, with bounds of inputs and states. The solvers take
turns, sequence by sequence, ``--passes`` times, and the fastest of a QP's passes
counts: what another process on the machine does to one pass is not the solver's time.
*Hot*: the problem has just been written to memory that stays the same, as a controller
would. *Flushed*: all caches are overwritten before every call.

Times include everything from contiguous arrays to x, so the Python layer of either
side. DAQP has two paths, each with contiguous arrays: ``Model.update`` +
``Model.solve`` (warm), and ``daqp.solve`` from nothing; ratios are to the faster one of
the cell. Written to ``outputs/benchmarks/qp.json``.
"""

import argparse
import gc
from collections.abc import Callable
from itertools import product
from time import perf_counter

import daqp
import numpy as np

from benchmarks.quadrotor import TRAJECTORIES
from benchmarks.quadrotor_sequences import (
    SequenceProblem,
    flight_sequence,
    quadrotor_sequence,
)
from benchmarks.timing import write_results
from gpmpc.qp import (
    CvxpySolver,
    DualActiveSet,
    PrimalActiveSet,
    QuadraticProgram,
    make_solution,
)
from gpmpc.status import Status

OURS = "DualActiveSet"
DAQP_WARM = "DAQP update + solve"
DAQP_COLD = "DAQP solve"
PRIMAL = "PrimalActiveSet"
CVXPY = "CVXPY + Clarabel"
CACHES = np.zeros(12_000_000)  # 96 MB, more than any cache of the machine

Solve = Callable[[SequenceProblem], tuple[np.ndarray, np.ndarray]]


def ours(changing: bool) -> Callable[[SequenceProblem], Solve]:
    """A warm-started ``DualActiveSet``, with a prepared program where P and G stay."""

    def begin(first: SequenceProblem) -> Solve:
        solver = DualActiveSet()
        last = None
        prepared = None if changing else solver.prepare(first.P, first.G)

        def solve(problem: SequenceProblem):
            nonlocal last
            P = problem.P
            q = problem.q
            G = problem.G
            lower = problem.lower
            upper = problem.upper
            if changing:
                last = solver.solve(
                    QuadraticProgram.unchecked(P, q, G, lower, upper), last
                )
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
                model.update(
                    H=problem.P,
                    f=problem.q,
                    A=problem.G,
                    bupper=problem.upper,
                    blower=problem.lower,
                )
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
        x, _, _, info = daqp.solve(
            problem.P, problem.q, problem.G, problem.upper, problem.lower, sense
        )
        return x, info

    return solve


def by_protocol(solver) -> Callable[[SequenceProblem], Solve]:
    """Any ``QPSolver``; building the program is not timed (see ``run_pass``)."""

    def begin(first: SequenceProblem) -> Solve:
        last = None

        def solve(problem: QuadraticProgram):
            nonlocal last
            last = solver.solve(problem, last)
            return last.x, last

        return solve

    return begin


def run_pass(
    begin, problems: list[SequenceProblem], flush: bool, as_program: bool
) -> tuple[np.ndarray, list]:
    """Returns seconds per QP of one pass over the sequence, and the solutions."""
    first = problems[0]
    buffer = SequenceProblem(
        *(np.array(a) for a in (first.P, first.q, first.G, first.lower, first.upper))
    )
    solve = begin(buffer)
    seconds = np.empty(len(problems))
    answers = []
    gc.collect()
    gc.disable()
    for i, problem in enumerate(problems):
        for name in ("P", "q", "G", "lower", "upper"):
            np.copyto(getattr(buffer, name), getattr(problem, name))
        program = (
            QuadraticProgram.from_stacked(*vars(buffer).values())
            if as_program
            else buffer
        )
        if flush:
            CACHES[:] = i
        began = perf_counter()
        answer = solve(program)
        seconds[i] = perf_counter() - began
        x, details = (
            answer  # copied, so that no solver's memory grows with the sequence
        )
        duals = details["lam"] if isinstance(details, dict) else details.multipliers
        answers.append(
            (
                x.copy(),
                np.array(duals),
            )
        )
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
    solution = DualActiveSet().solve(
        QuadraticProgram.unchecked(*vars(problem).values())
    )
    return int(np.count_nonzero(solution.active_set))


def measure_cell(horizon: int, mode: str, settings: argparse.Namespace) -> dict:
    """All solvers on one sequence."""
    changing = mode != "constant"
    closing = DualActiveSet()

    def close_loop(p: SequenceProblem) -> np.ndarray:
        return closing.solve(QuadraticProgram.unchecked(*vars(p).values())).x

    if mode in TRAJECTORIES:
        problems = flight_sequence(mode, horizon, settings.length)
    else:
        problems = list(
            quadrotor_sequence(horizon, changing, settings.length, close_loop)
        )
    fast = {OURS: ours(changing), DAQP_WARM: daqp_warm(changing), DAQP_COLD: daqp_cold}
    slow = {
        PRIMAL: by_protocol(PrimalActiveSet()),
        CVXPY: by_protocol(CvxpySolver("CLARABEL", {})),
    }
    cell = {
        "horizon": horizon,
        "mode": mode,
        "n": 3 * horizon,
        "m": len(problems[0].G),
        "QPs": len(problems),
        "active rows": float(np.mean([active_rows(p) for p in problems])),
        "solvers": {},
    }
    for condition, passes in (
        ("hot", settings.passes),
        ("flushed", min(settings.passes, 2)),
    ):
        flush = condition == "flushed"
        some = problems[: max(20, len(problems) // 4)] if flush else problems
        seconds = {name: np.full(len(some), np.inf) for name in fast}
        for _ in range(passes):
            for name, begin in fast.items():
                times, answers = run_pass(begin, some, flush, False)
                seconds[name] = np.minimum(seconds[name], times)
                if not flush:
                    cell["solvers"].setdefault(name, {})["residual"] = max(
                        map(worst_residual, some, answers)
                    )
        for name, values in seconds.items():
            cell["solvers"][name][condition] = quantiles(values)
    for name, begin in slow.items():
        if settings.slow_solvers:
            some = problems[: settings.slow_solvers]
            times, answers = run_pass(begin, some, False, True)
            cell["solvers"][name] = {
                "residual": max(map(worst_residual, some, answers)),
                "hot": quantiles(times[1:]),
            }
    best = min(
        (DAQP_WARM, DAQP_COLD), key=lambda name: cell["solvers"][name]["hot"]["median"]
    )
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
    solvers = cell["solvers"]
    ratio = cell["ratio hot"]
    text = f"{cell['mode']:10s} H = {cell['horizon']:3d}, m = {cell['m']:3d}, "
    text += f"{cell['active rows']:4.1f} active: "
    text += f"{solvers[OURS]['hot']['median']:8.2f} us, {cell['best DAQP path']} "
    text += f"{solvers[cell['best DAQP path']]['hot']['median']:8.2f} us, "
    text += f"ratio {ratio['median']:.3f}"
    text += f", p99 {ratio['p99']:.3f}, flushed {cell['ratio flushed']['median']:.3f}"
    text += f", KKT {solvers[OURS]['residual']:.0e}"
    if CVXPY in solvers:
        times = solvers[CVXPY]["hot"]["median"] / solvers[OURS]["hot"]["median"]
        text += f", CVXPY {times:.0f} times slower"
    return text


def main() -> None:
    """Measures the cells asked for and writes what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--horizons", default="1,5,10,20,50", help="comma-separated")
    parser.add_argument(
        "--modes", default="constant,changing,elliptical,lorenz", help="comma-separated"
    )
    parser.add_argument("--length", type=int, default=340, help="QPs per cell")
    parser.add_argument("--passes", type=int, default=3, help="turns of each solver")
    parser.add_argument(
        "--slow-solvers",
        type=int,
        default=30,
        help="QPs for Algorithm 1 and CVXPY; 0 leaves them out",
    )
    settings = parser.parse_args()
    cells = []
    for mode, horizon in product(
        settings.modes.split(","), map(int, settings.horizons.split(","))
    ):
        cells.append(measure_cell(horizon, mode, settings))
        print(describe(cells[-1]), flush=True)
    write_results("qp", cells, unit="microseconds", numpy=np.__version__)


if __name__ == "__main__":
    main()
