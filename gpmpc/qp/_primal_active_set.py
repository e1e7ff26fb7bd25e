"""Algorithm 1 of Cao, Lai and Alam (2017), section 4.3.

The primal active-set method, to be read beside the paper.

Which inequalities of ``min 1/2 x'Px + q'x`` subject to ``A x <= h`` hold with equality
at the minimum? Starting from a feasible x, the method minimises over the working rows
as if they were equalities, goes there as far as the others allow, adds the row that
blocks, and drops a row whose multiplier shows that the minimum lies inside its bound:

    1  d <- argmin of the QP in x + d with ``A_W d = 0``    (the KKT system, eq. (45))
    2  if d = 0: stop if no multiplier is negative,
                 else drop the row of the most negative one
    3  else:     kappa <- min(1, min over i outside W with a_i'd > 0 of
                 (h_i - a_i'x) / a_i'd);  x <- x + kappa d
    4        if kappa < 1: add the row that blocks

The printed (45b) lost the Hessian, which ``_minimise_on_rows`` keeps. ``A_W' = [Q1 Q2]
[R; 0]`` (QR with column pivoting) covers rank-deficient working sets: d = -Q2
(Q2'PQ2)^-1 Q2'(P x + q) moves in their null space, and rows that depend on others get a
zero multiplier. Plain NumPy, for reproduction and teaching; ``DualActiveSet`` is the
one to control with.

Phase 1, which the paper leaves open, is a linear program: the least t with ``A x - t <=
h``. If t = 0 its x is feasible; if not, its multipliers are Farkas' proof that no x is.
"""

from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, qr, solve_triangular
from scipy.optimize import linprog

from gpmpc._calls import explains_arguments
from gpmpc.qp import _record as layout
from gpmpc.qp._dual_rescue import inverse_power_of_two, polish
from gpmpc.qp._problem import (
    ABSENT,
    QuadraticProgram,
    as_program,
    check_iteration_limit,
    check_positive,
)
from gpmpc.qp._solution import (
    QPSolution,
    WarmStart,
    as_record,
    make_solution,
    proves_infeasibility,
)
from gpmpc.status import Status

Array = NDArray[np.float64]

# share of the largest pivot of the QR below which a working row depends on the others
_RANK = 1e-11
_STILL = 1e-13  # share of the size of x below which a direction is zero
# unhindered steps on one working set after which what is left of d is rounding
_FULL_STEPS = 2
_INSIDE = 1e-9  # share of the size of a row by which phase 1 may miss it
# steps of length zero in a row after which Bland's rule breaks a possible cycle
_ZERO_STEPS = 20


class _Rows(NamedTuple):
    """One-sided rows ``A x <= h``.

    An equality is one row that never leaves the working set.
    """

    A: Array  # (r, n), of unit length
    h: Array  # (r,)
    equality: NDArray[np.bool_]  # (r,)
    stacked: NDArray[np.intp]  # (r,) number of its stacked constraint [x; Gx]
    scale: Array  # (r,) factor by which that constraint was multiplied


class _Outcome(NamedTuple):
    """The point at which a solve ended, and how."""

    status: Status
    x: Array
    iterations: int
    multipliers: Array | None = None  # (M,) zero if None
    active: Array | None = None  # (M,) as in ``make_solution``; no row if None


@explains_arguments
@dataclass(frozen=True)
class PrimalActiveSet:
    """The paper's Algorithm 1 with phase 1; an object holds settings only.

    Args:
        tolerance: Largest scaled KKT residual of a solution called ``SOLVED``.
        iteration_limit: Iterations before ``ITERATION_LIMIT``; ample if omitted.

    Raises:
        ProblemError: A limit or tolerance that is not positive.
    """

    tolerance: float = 1e-9
    iteration_limit: int | None = None

    def __post_init__(self):
        check_positive(self, "tolerance")
        check_iteration_limit(self.iteration_limit)

    @np.errstate(over="ignore", invalid="ignore")  # what is not finite is seen below
    def solve(
        self, problem: QuadraticProgram, warm_start: WarmStart = None
    ) -> QPSolution:
        """Solves one problem, from a warm start of any kind; see ``QPSolver``."""
        began = perf_counter()
        problem = as_program(problem)
        units = _units_of_x(problem)
        scaled = _scale(problem, units)
        rows = _one_sided(scaled)
        warm_record = as_record(warm_start, len(problem.q), len(problem.lower))
        start, labels = _read_warm_start(warm_record, problem)
        x, ray = _phase_1(rows, start / units, len(problem.lower))
        if ray is None:
            working = _guessed_rows(rows, x, labels)
            outcome = self._iterate(scaled, rows, x, working)
            multipliers = outcome.multipliers
            if multipliers is not None:
                multipliers = _unscale_multipliers(multipliers, units)
            outcome = outcome._replace(x=outcome.x * units, multipliers=multipliers)
        else:
            ray = _unscale_multipliers(ray, units)
            proven = proves_infeasibility(ray, problem.G, problem.lower, problem.upper)
            status = Status.INFEASIBLE if proven else Status.NUMERICAL_TROUBLE
            outcome = _Outcome(status, x * units, iterations=0, multipliers=ray)
        solution = self._polish_and_judge(problem, outcome)
        return solution._replace(solve_seconds=perf_counter() - began)

    def _iterate(
        self, problem: QuadraticProgram, rows: _Rows, x: Array, working: list[int]
    ) -> _Outcome:
        """Runs Algorithm 1 from a feasible x and rows that hold with equality there."""
        limit = self.iteration_limit or 200 + 20 * len(rows.h)
        zero_steps = 0
        full_steps = 0
        for iteration in range(limit):
            A = rows.A[working]
            gradient = problem.P @ x + problem.q
            try:
                d, multipliers = _minimise_on_rows(
                    problem.P, gradient, A, gap=rows.h[working] - A @ x
                )
            except ValueError:  # from SciPy: not finite, or no longer positive definite
                return _Outcome(Status.NUMERICAL_TROUBLE, x, iteration)
            if not np.isfinite(d).all():
                return _Outcome(Status.NUMERICAL_TROUBLE, x, iteration)

            is_still = np.abs(d).max() <= _STILL * max(1.0, np.abs(x).max())
            if is_still or full_steps == _FULL_STEPS:
                droppable = np.where(rows.equality[working], np.inf, multipliers)
                if not working or droppable.min() >= 0.0:
                    stacked = _stack(rows, working, multipliers, len(problem.lower))
                    active = np.zeros(len(problem.lower))
                    active[rows.stacked[working]] = np.sign(rows.scale[working])
                    return _Outcome(Status.SOLVED, x, iteration, stacked, active)
                leaving = np.argmin(droppable)
                if zero_steps > _ZERO_STEPS:  # Bland's rule
                    leaving = np.argmax(droppable < 0.0)
                working.pop(int(leaving))
                full_steps = 0
                continue

            kappa, blocking = _step_length(rows, x, d, working)
            x = x + kappa * d
            zero_steps = zero_steps + 1 if kappa == 0.0 else 0
            full_steps = full_steps + 1 if blocking is None else 0
            if blocking is not None:
                working = sorted([*working, blocking])
        return _Outcome(Status.ITERATION_LIMIT, x, limit)

    def _polish_and_judge(
        self, problem: QuadraticProgram, outcome: _Outcome
    ) -> QPSolution:
        """Returns the solution with its last digits, once its residuals are checked.

        Doubled digits follow every solve that found a point.
        """
        nothing = np.zeros(len(problem.lower))
        solution = make_solution(
            problem,
            outcome.status,
            outcome.x,
            nothing if outcome.multipliers is None else outcome.multipliers,
            active_set=nothing if outcome.active is None else outcome.active,
            iterations=outcome.iterations,
        )
        if outcome.status in (Status.SOLVED, Status.NUMERICAL_TROUBLE):
            return polish(solution, self.tolerance)
        return solution


def _units_of_x(problem: QuadraticProgram) -> Array:
    """Returns units (n,), powers of two, in which x is of order one, and P_jj alike.

    The thresholds of the method are then shares of the size of x. They are one where
    numbers in such units overflow.
    """
    P, q, G, lower, upper = problem
    units = inverse_power_of_two(np.sqrt(np.diagonal(P)))
    free_length = np.abs(q * units).max()
    # how far x must go to reach the bounds, in the metric of P's diagonal
    distances = np.maximum(np.where(lower > -ABSENT, lower, 0.0), 0.0)
    distances = np.maximum(distances, np.where(upper < ABSENT, -upper, 0.0))
    norms = np.concatenate([units, np.linalg.norm(G * units, axis=1)])
    reached = norms > 0.0
    bound_length = (distances[reached] / norms[reached]).max()
    units = units / inverse_power_of_two(max(free_length, bound_length))
    scaled_P = P * np.outer(units, units)
    extremes = [
        scaled_P.max(),
        np.abs(q * units).max(),
        np.abs(G * units).max(initial=0.0),
    ]
    return units if np.isfinite(extremes).all() else np.ones(len(q))


def _scale(problem: QuadraticProgram, units: Array) -> QuadraticProgram:
    """Returns the program of x in other units (n,)."""
    P, q, G, lower, upper = problem
    bound_units = np.concatenate([units, np.ones(len(G))])
    return QuadraticProgram.unchecked(
        P * np.outer(units, units),
        q * units,
        G * units,
        np.where(lower > -ABSENT, lower, -np.inf) / bound_units,
        np.where(upper < ABSENT, upper, np.inf) / bound_units,
    )


def _unscale_multipliers(multipliers: Array, units: Array) -> Array:
    """Returns the multipliers (M,) of the program whose x was in these units (n,)."""
    n = len(units)
    return np.concatenate([multipliers[:n] / units, multipliers[n:]])


def _read_warm_start(record: Array, problem: QuadraticProgram) -> tuple[Array, Array]:
    """Returns the point and the labels of working constraints to start from."""
    n = len(problem.q)
    M = len(problem.lower)
    if len(record) < layout.HEADER + n + 2 * M:  # none, or one that was cut off
        return np.zeros(n), np.zeros(0)
    if record[layout.VARIABLES] != n or record[layout.CONSTRAINTS] != M:
        return np.zeros(n), np.zeros(0)
    x = record[layout.HEADER : layout.HEADER + n]
    return (
        np.nan_to_num(x, posinf=0.0, neginf=0.0),
        layout.working_labels(record, n, M),
    )


def _guessed_rows(rows: _Rows, x: Array, labels: Array) -> list[int]:
    """Returns equalities and the labelled rows that hold with equality at x."""
    guessed = np.isin((rows.stacked + 1) * np.sign(rows.scale), labels)
    distance = np.abs(rows.A @ x - rows.h)
    tight = distance <= _INSIDE * np.maximum(1.0, np.abs(rows.h))
    return list(np.flatnonzero(rows.equality | (guessed & tight)))


def _one_sided(problem: QuadraticProgram) -> _Rows:
    """Returns the finite bounds as rows ``a'x <= h`` of unit length.

    Zero rows stay zero.
    """
    lower = problem.lower
    upper = problem.upper
    C = np.vstack([np.eye(len(problem.q)), problem.G])
    equal = lower == upper
    above = np.flatnonzero(np.isfinite(upper))
    below = np.flatnonzero(np.isfinite(lower) & ~equal)
    stacked = np.concatenate([above, below])
    norms = np.linalg.norm(C, axis=1)[stacked]
    scale = np.repeat([1.0, -1.0], [len(above), len(below)]) / np.where(
        norms > 0.0, norms, 1.0
    )
    h = np.concatenate([upper[above], lower[below]]) * scale
    return _Rows(C[stacked] * scale[:, None], h, equal[stacked], stacked, scale)


def _phase_1(rows: _Rows, start: Array, M: int) -> tuple[Array, Array | None]:
    """Finds a feasible point, which is ``start`` if that is one.

    Returns the point and None, or ``start`` and a ray (M,) that may prove that there is
    none. A ray of zeros, which proves nothing, says that the linear program failed.
    """
    A = np.vstack([rows.A, -rows.A[rows.equality]])
    h = np.concatenate([rows.h, -rows.h[rows.equality]])
    if (A @ start <= h).all():
        return start, None
    n = len(start)
    least = linprog(
        np.append(np.zeros(n), 1.0),
        A_ub=np.column_stack([A, np.full(len(A), -1.0)]),
        b_ub=h - A @ start,
        bounds=[(None, None)] * n + [(0.0, None)],
        options={
            "primal_feasibility_tolerance": 1e-10,
            "dual_feasibility_tolerance": 1e-10,
        },
    )
    if least.x is None:
        return start, np.zeros(M)
    x = start + least.x[:n]
    if (A @ x - h <= _INSIDE * np.maximum(1.0, np.abs(h))).all():
        return x, None
    weights = -least.ineqlin.marginals
    ray = weights[: len(rows.h)].copy()
    ray[rows.equality] -= weights[len(rows.h) :]
    return start, _stack(rows, np.arange(len(ray)), ray, M)


def farkas_ray(problem: QuadraticProgram) -> Array | None:
    """Returns Farkas' proof (M,) that no point is feasible, from phase 1.

    None if it finds none.
    """
    units = _units_of_x(problem)
    rows = _one_sided(_scale(problem, units))
    start = np.zeros(len(problem.q))
    _, ray = _phase_1(rows, start, len(problem.lower))
    if ray is None:
        return None
    ray = _unscale_multipliers(ray, units)
    proven = proves_infeasibility(ray, problem.G, problem.lower, problem.upper)
    return ray if proven else None


def _minimise_on_rows(
    P: Array, gradient: Array, A: Array, gap: Array
) -> tuple[Array, Array]:
    """Minimises ``1/2 d'Pd + gradient'd`` with ``A d = gap``, zero but for rounding.

    Returns the minimiser d and the multipliers.

    ``P d + gradient + A' multipliers = 0``; rows of A that depend on others get
    multiplier zero.
    """
    Q, R, order = qr(A.T, pivoting=True)
    pivots = np.abs(np.diagonal(R))
    rank = int(np.sum(pivots > _RANK * pivots[0])) if len(pivots) else 0
    Q1 = Q[:, :rank]
    Q2 = Q[:, rank:]
    R = R[:rank, :rank]
    d = Q1 @ solve_triangular(R, gap[order[:rank]], trans="T")
    if Q2.shape[1]:
        reduced = cho_factor(Q2.T @ P @ Q2)
        d = d - Q2 @ cho_solve(reduced, Q2.T @ (gradient + P @ d))
    multipliers = np.zeros(len(A))
    multipliers[order[:rank]] = -solve_triangular(R, Q1.T @ (gradient + P @ d))
    return d, multipliers


def _step_length(
    rows: _Rows, x: Array, d: Array, working: list[int]
) -> tuple[float, int | None]:
    """Returns kappa in [0, 1] and the row that blocks, if one does."""
    speed = rows.A @ d
    speed[working] = 0.0
    room = np.maximum(rows.h - rows.A @ x, 0.0)
    towards = speed > _STILL * np.linalg.norm(d)
    kappas = np.where(towards, room / np.where(towards, speed, 1.0), 1.0)
    blocking = int(np.argmin(np.append(kappas, 1.0)))
    if blocking == len(kappas) or kappas[blocking] >= 1.0:
        return 1.0, None
    return float(kappas[blocking]), blocking


def _stack(rows: _Rows, which, multipliers: Array, M: int) -> Array:
    """Returns multipliers (M,) of stacked constraints from those of one-sided rows."""
    stacked = np.zeros(M)
    np.add.at(stacked, rows.stacked[which], multipliers * rows.scale[which])
    return stacked
