"""The package's QP solver: the dual active-set method of Goldfarb and Idnani (1983), warm-started.

In model predictive control one QP follows another and little changes in between, so the working set of the last
solution is nearly that of the next. A dual method can start from any guess: it needs no feasible point, only
multipliers of the right sign (``gpmpc.qp._dual_iteration``). What depends on P and G only can be done beforehand:
``prepared = solver.prepare(P, G)`` once, then ``prepared.solve(q, lower, upper, last_solution)``.

A solution that its own residuals do not support, one whose factors lost too many digits, and an infeasibility without
Farkas' proof are tried again with doubled digits (``gpmpc.qp._dual_rescue``); what still fails is reported as
``Status.NUMERICAL_TROUBLE``.
"""

from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpmpc._compiled import compile_for, unchecked_entry_point
from gpmpc.exceptions import ProblemError
from gpmpc.qp import _record as layout
from gpmpc.qp._dual_kernels import SIGNATURE, solve
from gpmpc.qp._dual_rescue import rescue
from gpmpc.qp._problem import QuadraticProgram, multiplier_caps
from gpmpc.qp._solution import QPSolution, WarmStart, as_record, proves_infeasibility
from gpmpc.qp._workspace import new_memory, prepare_memory

Array = NDArray[np.float64]
_Arrays = tuple[Array, Array, Array, Array, Array]  # P, q, G, lower, upper

# Local names save look-ups; ``tuple.__new__`` takes half the time of a named tuple's own constructor.
_NO_RECORD, _MISUSE, _FLOAT, _empty, _new = layout.NO_RECORD, layout.MISUSE, np.dtype(float), np.empty, tuple.__new__
_run = solve  # until it is compiled
_ITERATIONS_PER_CONSTRAINT = 10  # default limit, beyond which the iteration is taken to cycle
_ITERATIONS_PER_LOOK = 25  # iterations between two looks at the clock


@dataclass(frozen=True)
class DualActiveSet:
    """The dual active-set method; an object holds settings only and may serve many threads.

    Args:
        tolerance: Largest residual of a solution called ``SOLVED``, as a share of its size.
        iteration_limit: Changes of the working set before ``ITERATION_LIMIT``; ample if omitted.
        time_limit: Seconds before ``TIME_LIMIT``; none if omitted.

    Raises:
        ProblemError: A limit or tolerance that is not positive.
    """

    tolerance: float = 1e-9
    iteration_limit: int | None = None
    time_limit: float | None = None
    _plans: dict = field(default_factory=dict, init=False, repr=False, compare=False)

    def __post_init__(self):
        for name in ("tolerance", "iteration_limit", "time_limit"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ProblemError(f"{name} must be positive; got {value}")
        global _run
        compile_for(solve, SIGNATURE)
        _run = unchecked_entry_point(solve)

    def solve(
        self, problem: QuadraticProgram, warm_start: WarmStart = None, prices: ArrayLike | None = None
    ) -> QPSolution:
        """Solves one problem.

        Args:
            problem: The QP. ``QuadraticProgram.unchecked`` builds it in a fraction of a microsecond; its arrays are
                checked here.
            warm_start: The solution of a similar problem, or an active set; any guess is safe.
            prices: Of a violation of each row of G, per unit (m,); infinite where it is hard, as all are by default.

        Returns:
            The minimiser with status ``SOLVED``, or ``INFEASIBLE`` (the multipliers are then Farkas' proof),
            ``ITERATION_LIMIT``, ``TIME_LIMIT`` (the best dual iterate) or ``NUMERICAL_TROUBLE``.

        Raises:
            ProblemError: The problem was not checked and breaks a rule of ``QuadraticProgram``, or the prices do.
        """
        began = perf_counter()
        try:
            plan = self._plans[problem.G.shape] if prices is None else self._plan(problem.G.shape, prices)
        except (AttributeError, KeyError, TypeError):  # the first of its shape, or an unchecked one without a shape
            problem = QuadraticProgram.from_stacked(*problem)
            plan = self._plan(problem.G.shape, prices)
        (P, q, G, lower, upper), (caps, memory, size, where) = problem, plan
        record, status = _empty(size), _MISUSE
        try:
            guess = _NO_RECORD if warm_start is None else warm_start.record  # type: ignore[union-attr]
            if P.dtype is q.dtype is G.dtype is lower.dtype is upper.dtype is _FLOAT:
                status = _run(P, q, G, lower, upper, guess, memory, record)
                if not status:
                    return _new(QPSolution, (record[where], problem, caps, record, 0.0, perf_counter() - began))
        except (AttributeError, TypeError):  # not contiguous float64, or a warm start that is no solution of ours
            pass
        return _solve_again(problem, warm_start, plan, self, status, record, began)

    def prepare(self, P: ArrayLike, G: ArrayLike | None = None, prices: ArrayLike | None = None) -> "Prepared":
        """Does once what depends on P, G and prices only.

        Args:
            P: (n, n) symmetric positive definite.
            G: (m, n); none if omitted.
            prices: As for ``solve``.

        Raises:
            ProblemError: As for ``solve``.
        """
        return Prepared(self, QuadraticProgram(P, np.zeros(len(np.atleast_1d(P))), G), prices)

    def _plan(self, shape: tuple, prices: ArrayLike | None, prepared: bool = False) -> tuple[Array, Array, int, slice]:
        """Returns caps, memory, the record's length, and where x is in it, for a shape of G."""
        m, n = shape
        caps, M, limit = multiplier_caps(prices, n, m), n + m, self._limit(n + m)
        if self.time_limit is not None:
            limit = min(limit, _ITERATIONS_PER_LOOK)
        memory = new_memory(caps, n, limit, self.tolerance, prices is not None, prepared)
        size = layout.record_size(n, M, n if prepared else 0)
        plan = caps, memory, size, slice(layout.HEADER, layout.HEADER + n)
        if prices is None and not prepared:
            self._plans[m, n] = plan
        return plan

    def _limit(self, M: int) -> int:
        return self.iteration_limit or 100 + _ITERATIONS_PER_CONSTRAINT * M


class Prepared:
    """A problem whose P and G stay; made by ``DualActiveSet.prepare``. Read-only, and may serve many threads."""

    __slots__ = ("_G", "_P", "_plan", "_solver")

    def __init__(self, solver: DualActiveSet, problem: QuadraticProgram, prices: ArrayLike | None):
        self._P, self._G, self._solver = problem.P, problem.G, solver
        _, memory, size, _ = self._plan = solver._plan(problem.G.shape, prices, prepared=True)
        # factorises P and measures the rows of G; where numbers overflow, every solve is to find that out by itself
        if solve(*problem, layout.NO_RECORD, memory, np.empty(size)) == layout.SOLVED:
            prepare_memory(memory, problem.G)

    def solve(self, q: Array, lower: Array, upper: Array, warm_start: WarmStart = None) -> QPSolution:
        """Solves for one q and one set of bounds.

        Args:
            q: (n,).
            lower: (n + m,) lower bounds of x, then of the rows of G; infinite or below -1e20 where absent.
            upper: (n + m,) upper bounds likewise.
            warm_start: The last solution, or an active set; any guess is safe.

        Raises:
            ProblemError: Shapes that do not match, NaN, crossed bounds.
        """
        began = perf_counter()  # line by line as in ``DualActiveSet.solve``: a call costs a tenth of a small solve
        P, G, (caps, memory, size, where) = self._P, self._G, self._plan
        record, status = _empty(size), _MISUSE
        try:
            guess = _NO_RECORD if warm_start is None else warm_start.record  # type: ignore[union-attr]
            if q.dtype is lower.dtype is upper.dtype is _FLOAT:
                status = _run(P, q, G, lower, upper, guess, memory, record)
                if not status:
                    problem = P, q, G, lower, upper
                    return _new(QPSolution, (record[where], problem, caps, record, 0.0, perf_counter() - began))
        except (AttributeError, TypeError):
            pass
        return _solve_again((P, q, G, lower, upper), warm_start, self._plan, self._solver, status, record, began)


def _solve_again(problem: _Arrays, warm_start, plan, solver, status, record, began) -> QPSolution:
    """Continues a solve that did not end as ``SOLVED``: checks the problem, goes on, accepts the status or tries again.

    Raises:
        ProblemError: The problem breaks a rule of ``QuadraticProgram``.
    """
    caps, memory, _, where = plan
    if status == layout.MISUSE:
        problem = QuadraticProgram.from_stacked(*problem)  # raises if it is misuse indeed
    P, q, G, lower, upper = problem
    n, M = len(q), len(lower)

    def solution(record: Array) -> QPSolution:
        return QPSolution(record[where], problem, caps, record, 0.0, perf_counter() - began)

    def late() -> bool:
        return solver.time_limit is not None and perf_counter() - began > solver.time_limit

    if status == layout.MISUSE:
        status = solve(P, q, G, lower, upper, as_record(warm_start, n, M), memory, record)
        if status == layout.MISUSE:  # a proper problem: rows that overflow, P at the edge of definiteness
            record[:] = 0.0
            record[[layout.STATUS, layout.VARIABLES, layout.CONSTRAINTS]] = layout.NUMERICAL_TROUBLE, n, M
        elif status == layout.SOLVED:
            return solution(record)
    done, limit = record[layout.ITERATIONS], solver._limit(M)
    while record[layout.STATUS] == layout.ITERATION_LIMIT and solver.time_limit is not None:
        if late() or done >= limit:
            record[layout.STATUS] = layout.TIME_LIMIT if late() else layout.ITERATION_LIMIT
            break
        guess, record = record, np.empty_like(record)
        solve(P, q, G, lower, upper, guess, memory, record)
        done += record[layout.ITERATIONS]
    record[layout.ITERATIONS] = done
    stopped = record[layout.STATUS] == layout.ITERATION_LIMIT and solver.iteration_limit is not None
    if stopped or _is_certain(record, G, lower, upper):
        return solution(record)
    guess, record = record, np.empty_like(record)
    guess[layout.TAG] = 0.0  # the factor is computed anew
    if solve(P, q, G, lower, upper, guess, memory, record) == layout.MISUSE:
        record = guess
    record[layout.ITERATIONS] += done
    if not _is_certain(record, G, lower, upper):
        record = rescue(problem, caps, record, limit, late)
    return solution(record)


def _is_certain(record: Array, G: Array, lower: Array, upper: Array) -> bool:
    """Returns whether a record needs no second look; an infeasibility needs Farkas' proof."""
    if record[layout.STATUS] == layout.INFEASIBLE:
        start = layout.HEADER + G.shape[1]
        return proves_infeasibility(record[start : start + len(lower)], G, lower, upper)
    return record[layout.STATUS] in (layout.SOLVED, layout.TIME_LIMIT)
