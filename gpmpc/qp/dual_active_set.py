"""The package's QP solver: which bounds of a strictly convex QP hold with equality, given a good guess?

In model predictive control one QP follows another and little changes in between, so the working set of the last
solution is nearly that of the next. A dual method can start from any guess: it needs no feasible point, only
multipliers of the right sign. ``DualActiveSet`` is the method of Goldfarb and Idnani (1983), warm-started
(``gpmpc.qp.dual_iteration``), in two modes that the caller chooses by what stays the same:

* P and G stay: ``prepared = solver.prepare(P, G)`` once, then ``prepared.solve(q, lower, upper, last_solution)``.
* P and G change: ``solver.solve(problem, last_solution)``, or ``solver.solve_stacked(...)`` without building a problem.

An answer that its own residuals do not bear out, one whose factors lost too many digits to say, and an infeasibility
without Farkas' proof are tried again with a new factor, then with doubled digits (``gpmpc.qp.dual_rescue``); what still
fails is reported as ``Status.NUMERICAL_TROUBLE``.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpmpc.compiled import compile_for, direct
from gpmpc.exceptions import ProblemError
from gpmpc.qp import record as layout
from gpmpc.qp.dual_kernels import GRAM_SIGNATURE, LAZY_SIGNATURE, solve_gram, solve_lazy
from gpmpc.qp.dual_rescue import rescue
from gpmpc.qp.farkas import proves_infeasibility
from gpmpc.qp.gram_system import gram_system
from gpmpc.qp.problem import QuadraticProgram
from gpmpc.qp.soft_rows import SoftRows, stack_softness
from gpmpc.qp.solution import QPSolution, Terms
from gpmpc.qp.solver import WarmStart
from gpmpc.qp.workspace import SHARE, gram_workspace, lazy_workspace

Array = NDArray[np.float64]

FLOAT = np.dtype(np.float64)
empty = np.empty  # a local name saves a look-up
new = tuple.__new__  # half the time of a named tuple's own constructor

run_gram, run_lazy = solve_gram, solve_lazy  # until they are compiled
_tags = count(1)  # next() of a count is atomic
ITERATIONS_PER_CONSTRAINT = 10  # default limit, beyond which the iteration is taken to cycle
ITERATIONS_PER_LOOK = 25  # iterations between two looks at the clock


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
        global run_lazy
        compile_for(solve_lazy, LAZY_SIGNATURE)
        run_lazy = direct(solve_lazy)

    def solve(
        self, problem: QuadraticProgram, warm_start: WarmStart = None, soft: SoftRows | None = None
    ) -> QPSolution:
        """Solves one problem.

        Args:
            problem: The QP.
            warm_start: The solution of a similar problem, or an active set; any guess is safe.
            soft: Weights of the rows that may be violated.

        Returns:
            The minimiser with status ``SOLVED``, or ``INFEASIBLE`` (the multipliers are then Farkas' proof),
            ``ITERATION_LIMIT``, ``TIME_LIMIT`` (the best dual iterate) or ``NUMERICAL_TROUBLE``.
        """
        return self.solve_stacked(problem.P, problem.q, problem.G, problem.lower, problem.upper, warm_start, soft)

    def solve_stacked(
        self,
        P: Array,
        q: Array,
        G: Array,
        lower: Array,
        upper: Array,
        warm_start: WarmStart = None,
        soft: SoftRows | None = None,
    ) -> QPSolution:
        """Solves ``min 1/2 x'Px + q'x``, ``lower <= [x; Gx] <= upper``, the fast way when P and G change.

        Args:
            P: (n, n) symmetric positive definite.
            q: (n,).
            G: (m, n).
            lower: (n + m,) bounds of x, then of the rows.
            upper: (n + m,).
            warm_start: As for ``solve``.
            soft: As for ``solve``.

        Raises:
            ProblemError: As for ``QuadraticProgram``.
        """
        began = perf_counter()
        try:
            plan = self._plans.get(G.shape) if soft is None else None
            softness, work, size, where = plan or self._plan(*G.shape, soft)
            record = empty(size)
            warm = layout.NO_RECORD if warm_start is None else warm_start.record
            if P.dtype is q.dtype is G.dtype is lower.dtype is upper.dtype is FLOAT:
                status = run_lazy(P, q, G, lower, upper, warm, work, record)
            else:  # may still be float64: a dtype that was pickled is another object
                status = solve_lazy(P, q, G, lower, upper, warm, work, record)
        except (AttributeError, TypeError):  # not contiguous float64, or a warm start that is no solution of ours
            status = layout.MISUSE
        if status == layout.MISUSE:
            problem = QuadraticProgram.from_stacked(P, q, G, lower, upper)  # raises if it is misuse indeed
            P, q, G, lower, upper = problem.P, problem.q, problem.G, problem.lower, problem.upper
            n, m = len(P), len(G)
            softness, work, size, where = self._plan(m, n, soft)
            record, warm = np.empty(size), _as_record(warm_start, n, n + m)
            status = solve_lazy(P, q, G, lower, upper, warm, work, record)
            if status == layout.MISUSE:
                _write_trouble(record, n, n + m)
        terms = new(Terms, (P, G, softness))
        if status != layout.SOLVED:

            def again(guess: Array, record: Array) -> int:
                return solve_lazy(P, q, G, lower, upper, guess, work, record)

            record = self._settle(again, terms, q, lower, upper, record, began)
        return new(QPSolution, (record[where], terms, q, lower, upper, record, 0.0, perf_counter() - began))

    def prepare(self, P: ArrayLike, G: ArrayLike | None = None, soft: SoftRows | None = None) -> "Prepared":
        """Does once what depends on P, G and soft weights only.

        Args:
            P: (n, n) symmetric positive definite.
            G: (m, n); none if omitted.
            soft: Weights of the rows that may be violated.

        Raises:
            ProblemError: As for ``QuadraticProgram``.
        """
        problem = QuadraticProgram(P, np.zeros(len(np.atleast_1d(P))), G)
        n, m = len(problem.P), len(problem.G)
        terms = Terms(problem.P, problem.G, stack_softness(soft, n, m))
        return Prepared(self, terms, self._settings(n, n + m, soft is not None, float(next(_tags))))

    def workspace(self, rows: int, variables: int, soft: SoftRows | None = None) -> tuple[Array, Array]:
        """Softness and the memory that ``solve_lazy`` takes in kernels that call it themselves, holding the lock."""
        return self._plan(rows, variables, soft)[:2]

    def _plan(self, m: int, n: int, soft: SoftRows | None) -> tuple[Array, Array, int, slice]:
        """For a shape of G, softness, workspace, the record's length, and where x is in it."""
        softness, settings = stack_softness(soft, n, m), self._settings(n, n + m, soft is not None)
        work, where = lazy_workspace(settings, softness), slice(layout.HEADER, layout.HEADER + n)
        plan = softness, work, layout.record_size(n, n + m), where
        if soft is None:
            self._plans[m, n] = plan
        return plan

    def _limit(self, M: int) -> int:
        return self.iteration_limit or 100 + ITERATIONS_PER_CONSTRAINT * M

    def _settings(self, n: int, M: int, soft: bool, tag: float = layout.NO_TAG) -> Array:
        limit = self._limit(M) if self.time_limit is None else min(self._limit(M), ITERATIONS_PER_LOOK)
        return np.array([limit, self.tolerance, soft, n, M, tag, 1.0])

    def _settle(self, again: Callable, terms: Terms, q: Array, lower: Array, upper: Array, record: Array, began: float):
        """Decides on a solve that did not end as ``SOLVED``: go on, believe it, or try again; returns the record."""
        done, limit = record[layout.ITERATIONS], self._limit(len(lower))

        def late() -> bool:
            return self.time_limit is not None and perf_counter() - began > self.time_limit

        while record[layout.STATUS] == layout.ITERATION_LIMIT and self.time_limit is not None:
            if late() or done >= limit:
                record[layout.STATUS] = layout.TIME_LIMIT if late() else layout.ITERATION_LIMIT
                break
            guess, record = record, np.empty_like(record)
            again(guess, record)
            done += record[layout.ITERATIONS]
        record[layout.ITERATIONS] = done
        stopped = record[layout.STATUS] == layout.ITERATION_LIMIT and self.iteration_limit is not None
        if stopped or _is_certain(record, terms.G, lower, upper):
            return record
        guess, record = record, np.empty_like(record)
        guess[layout.TAG] = layout.NO_TAG  # the factor is made anew
        if again(guess, record) == layout.MISUSE:
            record = guess
        record[layout.ITERATIONS] += done
        if _is_certain(record, terms.G, lower, upper):
            return record
        return rescue(terms, q, lower, upper, record, limit, late)


class Prepared:
    """A problem whose P and G stay; made by ``DualActiveSet.prepare``. Read-only, and may serve many threads.

    Attributes:
        terms: P, G and softness of the rows.
        build_seconds: Time that the preparation took [s].
    """

    __slots__ = ("_settings", "_size", "_solver", "_system", "_traits", "_work", "_x", "build_seconds", "terms")

    def __init__(self, solver: DualActiveSet, terms: Terms, settings: Array):
        global run_gram
        compile_for(solve_gram, GRAM_SIGNATURE)
        run_gram = direct(solve_gram)
        began = perf_counter()
        self.terms, self._solver, self._settings = terms, solver, settings
        self._system, self._traits, settings[SHARE] = gram_system(terms)
        self._work = gram_workspace(settings, self._traits)
        n, M = len(terms.P), sum(terms.G.shape)
        self._size = layout.record_size(n, M) + layout.factor_size(n, M)
        self._x = slice(layout.HEADER, layout.HEADER + n)
        self.build_seconds = perf_counter() - began

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
        began = perf_counter()
        record = empty(self._size)
        try:
            warm = layout.NO_RECORD if warm_start is None else warm_start.record
            if q.dtype is lower.dtype is upper.dtype is FLOAT:
                status = run_gram(q, lower, upper, warm, self._system, self._work, record)
            else:  # may still be float64: a dtype that was pickled is another object
                status = solve_gram(q, lower, upper, warm, self._system, self._work, record)
        except (AttributeError, TypeError):  # not contiguous float64, or a warm start that is no solution of ours
            status = layout.MISUSE
        if status:
            return self._solve_carefully(q, lower, upper, warm_start, record, status, began)
        return new(QPSolution, (record[self._x], self.terms, q, lower, upper, record, 0.0, perf_counter() - began))

    def _solve_carefully(self, q, lower, upper, warm_start, record, status, began) -> QPSolution:
        """The rest of ``solve`` for whatever is not plain sailing."""
        P, G, _ = self.terms
        if status == layout.MISUSE:
            problem = QuadraticProgram.from_stacked(P, q, G, lower, upper)  # raises if it is misuse indeed
            q, lower, upper = problem.q, problem.lower, problem.upper

        def again(guess: Array, record: Array) -> int:
            return solve_gram(q, lower, upper, guess, self._system, self._work, record)

        if status == layout.MISUSE:
            status = again(_as_record(warm_start, len(q), len(lower)), record)
            if status == layout.MISUSE:
                _write_trouble(record, len(q), len(lower))
        if status != layout.SOLVED:
            record = self._solver._settle(again, self.terms, q, lower, upper, record, began)
        return QPSolution(record[self._x], self.terms, q, lower, upper, record, 0.0, perf_counter() - began)


def _is_certain(record: Array, G: Array, lower: Array, upper: Array) -> bool:
    """Whether a record needs no second look; an infeasibility needs Farkas' proof."""
    if record[layout.STATUS] == layout.INFEASIBLE:
        start = layout.HEADER + G.shape[1]
        return proves_infeasibility(record[start : start + len(lower)], G, lower, upper)
    return record[layout.STATUS] in (layout.SOLVED, layout.TIME_LIMIT)


def _write_trouble(record: Array, n: int, M: int) -> None:
    """Fills the record of a kernel that refused a proper problem: rows that overflow, P at the edge of definiteness."""
    record[:] = 0.0
    record[layout.STATUS], record[layout.VARIABLES], record[layout.CONSTRAINTS] = layout.NUMERICAL_TROUBLE, n, M


def _as_record(warm_start: WarmStart, n: int, M: int) -> Array:
    """Whatever can be used of a warm start; nothing if it belongs to a problem of another size."""
    if warm_start is None:
        return layout.NO_RECORD
    if isinstance(warm_start, QPSolution):
        return np.ascontiguousarray(warm_start.record, dtype=np.float64)
    active = np.asarray(warm_start)
    if active.shape != (M,) or active.dtype.kind not in "biuf":
        raise ProblemError(
            f"a warm start must be a solution or an active set of shape {(M,)}; got shape {active.shape}"
        )
    return layout.warm_record(np.nan_to_num(active), n)
