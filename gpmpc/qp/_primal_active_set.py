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

from contextlib import suppress
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, qr, solve_triangular
from scipy.optimize import linprog

from gpmpc.qp import _record as layout
from gpmpc.qp._dual_rescue import rescue
from gpmpc.qp._problem import ABSENT, QuadraticProgram, check_positive
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
    stacked: NDArray[np.intp]  # (r,) which stacked constraint [x; Gx] it is,
    factor: Array  # (r,) and by what that constraint was multiplied


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
        check_positive(self, "tolerance", "iteration_limit")

    @np.errstate(over="ignore", invalid="ignore")  # what is not finite is seen below
    def solve(
        self, problem: QuadraticProgram, warm_start: WarmStart = None
    ) -> QPSolution:
        """The minimiser, from a warm start of any kind; see ``QPSolver``."""
        began = perf_counter()
        n = len(problem.q)
        M = len(problem.lower)
        rows = _one_sided(problem)
        start = np.zeros(n)
        names = np.zeros(0)
        given = as_record(warm_start, n, M)
        if len(given) and (given[layout.VARIABLES], given[layout.CONSTRAINTS]) == (
            n,
            M,
        ):
            names = layout.working_names(given, n, M)
            start = np.nan_to_num(
                given[layout.HEADER : layout.HEADER + n], posinf=0.0, neginf=0.0
            )

        def finish(status, x, multipliers, active, iterations):
            solution = make_solution(
                problem,
                status,
                x,
                multipliers,
                active_set=active,
                iterations=iterations,
            )
            if status in (
                Status.SOLVED,
                Status.NUMERICAL_TROUBLE,
            ):  # it is checked, and its last digits are found
                solution.record[:] = rescue(problem, solution.caps, solution.record)
                if solution.status is not Status.INFEASIBLE and not solution.is_optimal(
                    self.tolerance
                ):
                    solution.record[layout.STATUS] = layout.NUMERICAL_TROUBLE
            return solution._replace(solve_seconds=perf_counter() - began)

        nothing = np.zeros(M)
        x, ray = _phase_1(rows, start, M)
        if ray is not None:
            proven = proves_infeasibility(ray, *problem[2:])
            return finish(
                Status.INFEASIBLE if proven else Status.NUMERICAL_TROUBLE,
                x,
                ray,
                nothing,
                0,
            )
        limit = self.iteration_limit or 200 + 20 * len(rows.h)
        guessed = np.isin(
            (rows.stacked + 1) * np.sign(rows.factor), names
        )  # and they hold with equality at x
        guessed &= np.abs(rows.A @ x - rows.h) <= _INSIDE * np.maximum(
            1.0, np.abs(rows.h)
        )
        working = list(np.flatnonzero(rows.equality | guessed))
        still = full_steps = 0
        for iteration in range(limit):
            A = rows.A[working]
            d = np.full(n, np.nan)
            multipliers = nothing
            with suppress(
                ValueError
            ):  # from SciPy: not finite, or no longer positive definite
                d, multipliers = _minimise_on_rows(
                    problem.P, problem.P @ x + problem.q, A, rows.h[working] - A @ x
                )
            if not np.isfinite(d).all():
                return finish(Status.NUMERICAL_TROUBLE, x, nothing, nothing, iteration)
            if full_steps == _FULL_STEPS or np.abs(d).max() <= _STILL * max(
                1.0, np.abs(x).max()
            ):
                droppable = np.where(rows.equality[working], np.inf, multipliers)
                if not working or droppable.min() >= 0.0:
                    stacked = _stack(rows, working, multipliers, M)
                    active = np.zeros(M)
                    active[rows.stacked[working]] = np.sign(rows.factor[working])
                    return finish(Status.SOLVED, x, stacked, active, iteration)
                drop = (
                    np.argmax(droppable < 0.0)
                    if still > _ZERO_STEPS
                    else np.argmin(droppable)
                )
                working.pop(int(drop))
                full_steps = 0
                continue
            kappa, blocking = _step_length(rows, x, d, working)
            x = x + kappa * d
            still = still + 1 if kappa == 0.0 else 0
            full_steps = full_steps + 1 if blocking is None else 0
            if blocking is not None:
                working = sorted([*working, blocking])
        return finish(Status.ITERATION_LIMIT, x, nothing, nothing, limit)


def _one_sided(problem: QuadraticProgram) -> _Rows:
    """Returns the bounds that are there as rows ``a'x <= h`` of unit length.

    Zero rows stay zero.
    """
    lower = problem.lower
    upper = problem.upper
    C = np.vstack([np.eye(len(problem.q)), problem.G])
    equal = lower == upper
    above = np.flatnonzero(upper < ABSENT)
    below = np.flatnonzero((lower > -ABSENT) & ~equal)
    stacked = np.concatenate([above, below])
    norms = np.linalg.norm(C, axis=1)[stacked]
    factor = np.repeat([1.0, -1.0], [len(above), len(below)]) / np.where(
        norms > 0.0, norms, 1.0
    )
    h = np.concatenate([upper[above], lower[below]]) * factor
    return _Rows(C[stacked] * factor[:, None], h, equal[stacked], stacked, factor)


def _phase_1(rows: _Rows, start: Array, M: int) -> tuple[Array, Array | None]:
    """Finds a feasible point, which is ``start`` if that is one.

    Returns the point and None, or ``start`` and a ray (M,) that may prove that there is
    none.
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
    _, ray = _phase_1(_one_sided(problem), np.zeros(len(problem.q)), len(problem.lower))
    return None if ray is None or not proves_infeasibility(ray, *problem[2:]) else ray


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
    """Kappa in [0, 1] and the row that blocks, if one does."""
    speed = rows.A @ d
    speed[working] = 0.0
    room = np.maximum(rows.h - rows.A @ x, 0.0)
    towards = speed > _STILL * np.linalg.norm(d)
    kappas = np.where(towards, room / np.where(towards, speed, 1.0), 1.0)
    blocking = int(
        np.argmin(np.append(kappas, 1.0))
    )  # the last where none blocks before
    return (
        (float(kappas[blocking]), blocking)
        if blocking < len(kappas) and kappas[blocking] < 1.0
        else (1.0, None)
    )


def _stack(rows: _Rows, which, multipliers: Array, M: int) -> Array:
    """Multipliers (M,) of the stacked constraints from those of some one-sided rows."""
    stacked = np.zeros(M)
    np.add.at(stacked, rows.stacked[which], multipliers * rows.factor[which])
    return stacked
