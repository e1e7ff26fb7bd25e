"""The package's QP solver: the warm-started dual active-set method.

The method is that of Goldfarb and Idnani (1983).

In model predictive control one QP follows another and little changes in between, so the
working set of the last solution is nearly that of the next. A dual method can start
from any guess: it needs no feasible point, only multipliers of the right sign
(``gpmpc.qp._dual_iteration``). What depends on P and G only can be done beforehand:
``prepared = solver.prepare(P, G)`` once, then ``prepared.solve(q, lower, upper,
last_solution)``.

A solution that its own residuals do not support, one whose factors lost too many
digits, and an infeasibility without Farkas' proof are tried again with doubled digits
(``gpmpc.qp._dual_rescue``); what still fails is reported as
``Status.NUMERICAL_TROUBLE``.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpmpc._calls import explains_arguments
from gpmpc._compiled import compile_for, unchecked_entry_point
from gpmpc.qp import _record as layout
from gpmpc.qp._dual_kernels import SIGNATURE, solve_kernel
from gpmpc.qp._dual_rescue import rescue
from gpmpc.qp._problem import (
    QuadraticProgram,
    as_program,
    check_iteration_limit,
    check_positive,
    multiplier_caps,
    shape_of,
)
from gpmpc.qp._solution import QPSolution, WarmStart, as_record, proves_infeasibility
from gpmpc.qp._workspace import new_memory, prepare_memory, with_limit

Array = NDArray[np.float64]

# Local names save look-ups; ``tuple.__new__`` takes half the time of a named tuple's
# own constructor.
_NO_RECORD = layout.NO_RECORD
_MISUSE = layout.MISUSE
_SOLVED = layout.SOLVED
_FLOAT = np.dtype(float)
_empty = np.empty
_new = tuple.__new__
_solve_unchecked = solve_kernel  # until a solver is made, which compiles it

# What solves of one shape of G work with: the caps (M,), memory
# (``gpmpc.qp._workspace``), the length of a record (``gpmpc.qp._record``), and where x
# is in it. A plain tuple: taking a named one apart costs a fortieth of a microsecond.
Workplace = tuple[Array, Array, int, slice]

# default limit, beyond which the iteration is taken to cycle
_ITERATIONS_PER_CONSTRAINT = 10
_ITERATIONS_PER_LOOK = 25  # iterations between two looks at the clock


@explains_arguments
@dataclass(frozen=True)
class DualActiveSet:
    """The dual active-set method.

    An object holds settings, and memory for each shape of G that it has met. It may
    serve many threads all the same: a solve keeps the interpreter's lock, so that no
    two are in the same memory at once. A Python without that lock needs an object for
    each thread.

    Args:
        tolerance: Largest residual of a solution called ``SOLVED``, as a share of its
            size. One that was computed in doubled digits is held to a tolerance of its
            own (``gpmpc.qp._dual_rescue``).
        iteration_limit: Changes of the working set before ``ITERATION_LIMIT``, those of
            a second try and of doubled digits included; ample if omitted. It is looked
            at between steps, in one of which several constraints may enter or leave.
            Under a time limit it may be passed by up to 50 changes. Guessed constraints
            that enter before the first step, and those that leave because their
            multipliers are wrong, do not count, but for doubled digits.
        time_limit: Seconds before ``TIME_LIMIT``; none if omitted.

    Raises:
        ProblemError: A limit or tolerance that is not positive.
    """

    tolerance: float = 1e-9
    iteration_limit: int | None = None
    time_limit: float | None = None
    #: by shape of G: of hard rows, and of those that were priced last
    _workplaces: dict = field(
        default_factory=dict, init=False, repr=False, compare=False
    )
    _priced_workplaces: dict = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def __post_init__(self):
        check_positive(self, "tolerance")
        check_iteration_limit(self.iteration_limit)
        if self.time_limit is not None:
            check_positive(self, "time_limit")
        global _solve_unchecked
        compile_for(solve_kernel, SIGNATURE)
        _solve_unchecked = unchecked_entry_point(solve_kernel)

    def __reduce__(self) -> tuple:
        """Pickles the settings alone: another process has a memory of its own."""
        return type(self), (self.tolerance, self.iteration_limit, self.time_limit)

    def solve(
        self,
        problem: QuadraticProgram,
        warm_start: WarmStart = None,
        prices: ArrayLike | None = None,
    ) -> QPSolution:
        """Solves one problem.

        Args:
            problem: The QP. ``QuadraticProgram.unchecked`` builds it in a fraction of a
                microsecond; its arrays are checked here.
            warm_start: The solution of a similar problem, or an active set; any guess
                is safe.
            prices: Of a violation of each row of G, per unit (m,); infinite where it is
                hard, as all are by default.

        Returns:
            The minimiser with status ``SOLVED``, or ``INFEASIBLE`` (the multipliers are
            then Farkas' proof), ``ITERATION_LIMIT``, ``TIME_LIMIT`` (the best dual
            iterate) or ``NUMERICAL_TROUBLE``.

        Raises:
            ProblemError: The problem was not checked and breaks a rule of
                ``QuadraticProgram``, or the prices do.
        """
        began = perf_counter()
        try:
            shape = problem.G.shape
            if prices is None:
                workplace = self._workplaces[shape]
            else:
                workplace = self._priced_workplace(shape, prices)
        except (AttributeError, KeyError, TypeError, ValueError):
            # The first program of its shape, an unchecked one without a shape, prices
            # that are no numbers, or no program at all
            problem = as_program(problem)
            if not _has_size(problem):
                problem = QuadraticProgram.from_stacked(*problem)
            workplace = self._workplace(problem.G.shape, prices)
        P, q, G, lower, upper = problem
        caps, memory, record_size, x_slice = workplace
        record = _empty(record_size)
        # until the kernel has run. Where it has not, ``_finish`` finds out why: misuse,
        # or arguments to be converted first, as an active set for a warm start
        status = _MISUSE
        try:
            guess = _NO_RECORD
            if warm_start is not None:
                guess = warm_start.record  # type: ignore[union-attr]
            if P.dtype is q.dtype is G.dtype is lower.dtype is upper.dtype is _FLOAT:
                status = _solve_unchecked(P, q, G, lower, upper, guess, memory, record)
        except (AttributeError, TypeError):
            # not contiguous float64, or a warm start that is no solution of ours
            pass
        if status != _SOLVED:
            problem, record = self._finish(
                problem, warm_start, workplace, status, record, began
            )
        seconds = perf_counter() - began
        return _new(QPSolution, (record[x_slice], problem, caps, record, 0.0, seconds))

    def prepare(
        self, P: ArrayLike, G: ArrayLike | None = None, prices: ArrayLike | None = None
    ) -> "Prepared":
        """Does once what depends on P, G and prices only.

        Args:
            P: (n, n) symmetric positive definite.
            G: (m, n); none if omitted.
            prices: As for ``solve``.

        Raises:
            ProblemError: As for ``solve``.
        """
        q = np.zeros(shape_of("P", P)[:1])
        return Prepared(self, QuadraticProgram(P, q, G), prices)

    def _priced_workplace(self, shape: tuple, prices: ArrayLike) -> Workplace:
        """Returns what solves of this shape of G and these prices of rows share.

        The last one serves as long as prices stay, as they do from step to step.
        """
        previous_workplace = self._priced_workplaces.get(shape)
        if previous_workplace is not None:
            previous_prices = previous_workplace[0][shape[1] :]
            if np.array_equal(previous_prices, prices):
                return previous_workplace
        # Prices stand in the memory. Another thread may be between two kernel calls of
        # a solve with the previous ones: theirs is left alone.
        workplace = self._workplace(shape, prices)
        self._priced_workplaces[shape] = workplace
        return workplace

    def _workplace(
        self, shape: tuple, prices: ArrayLike | None, prepared: bool = False
    ) -> Workplace:
        """Returns what solves of this shape of G share.

        That of hard rows serves the next solves, too.
        """
        m, n = shape
        M = n + m
        caps = multiplier_caps(prices, n, m)
        limit = self._limit(M)
        if self.time_limit is not None:
            limit = min(limit, _ITERATIONS_PER_LOOK)
        soft = prices is not None
        memory = new_memory(caps, n, limit, self.tolerance, soft, prepared)
        record_size = layout.record_size(n, M, working=n if prepared else 0)
        x_slice = slice(layout.HEADER, layout.HEADER + n)
        workplace = caps, memory, record_size, x_slice
        if prices is None and not prepared:
            self._workplaces[shape] = workplace
        return workplace

    def _limit(self, M: int) -> int:
        return self.iteration_limit or 100 + _ITERATIONS_PER_CONSTRAINT * M

    def _finish(
        self,
        problem: QuadraticProgram,
        warm_start: WarmStart,
        workplace: Workplace,
        status: int,
        record: Array,
        began: float,
    ) -> tuple[QuadraticProgram, Array]:
        """Finishes a solve that did not end as ``SOLVED``.

        Checks the problem, iterates on within the limits, and accepts the result or
        tries again from its working set, then with doubled digits.

        Returns:
            The problem as it was solved, and the record.

        Raises:
            ProblemError: The problem breaks a rule of ``QuadraticProgram``.
        """
        caps, memory, _, _ = workplace
        if status == layout.MISUSE:
            problem = QuadraticProgram.from_stacked(*problem)  # raises if it is misuse
            # a proper problem whose rows overflow, or P at the edge of definiteness,
            # is refused again, and leaves the record as it is
            record[:] = 0.0
            record[layout.STATUS] = layout.NUMERICAL_TROUBLE
            guess = as_record(warm_start, len(problem.q), len(problem.lower))
            status = solve_kernel(*problem, guess, memory, record)
        else:
            problem = _for_kernel(problem)

        def late() -> bool:
            if self.time_limit is None:
                return False
            return perf_counter() - began > self.time_limit

        changes_left = self._limit(len(problem.lower))
        record = _go_on(problem, memory, status, record, changes_left, late)
        if self._is_final(record, problem, caps):
            return problem, record

        # A second try from the last working set. Its factor is computed anew, as only
        # a solved record hands its factor on. The kernel writes the new record, unless
        # it returns MISUSE: the copy then stays as it is.
        guess = record
        record = record.copy()
        iterations = int(guess[layout.ITERATIONS])
        if self.iteration_limit is not None:  # an ample limit begins anew
            changes_left = self.iteration_limit - iterations
            memory = with_limit(memory, changes_left)
        status = solve_kernel(*problem, guess, memory, record)
        record = _go_on(problem, memory, status, record, changes_left, late)
        record[layout.ITERATIONS] += iterations
        if not self._is_final(record, problem, caps):
            if self.iteration_limit is not None:
                changes_left = self.iteration_limit - int(record[layout.ITERATIONS])
            record = rescue(problem, caps, record, changes_left, late)
        return problem, record

    def _is_final(self, record: Array, problem: QuadraticProgram, caps: Array) -> bool:
        """Returns whether a record needs no second look.

        An infeasible one needs Farkas' proof, and a limit is one that was asked for.
        """
        status = record[layout.STATUS]
        if status == layout.INFEASIBLE:
            ray = record[layout.HEADER + len(problem.q) :][: len(problem.lower)]
            _, _, G, lower, upper = problem
            return proves_infeasibility(ray, G, lower, upper, caps)
        if status == layout.ITERATION_LIMIT:
            return self.iteration_limit is not None
        return status in (layout.SOLVED, layout.TIME_LIMIT)


class Prepared:
    """A problem whose P and G stay the same.

    Made by ``DualActiveSet.prepare``, with copies of P and G. Nothing of it can be set.
    Threads may share it as they may the solver.
    """

    __slots__ = ("_G", "_P", "_solver", "_workplace")

    def __init__(
        self, solver: DualActiveSet, problem: QuadraticProgram, prices: ArrayLike | None
    ):
        self._P = problem.P.copy()
        self._G = problem.G.copy()
        self._solver = solver
        self._workplace = solver._workplace(problem.G.shape, prices, prepared=True)
        _, memory, record_size, _ = self._workplace
        # factorises P and measures the rows of G; where numbers overflow, every solve
        # is to find that out by itself
        record = np.empty(record_size)
        status = solve_kernel(*problem, layout.NO_RECORD, memory, record)
        if status == layout.SOLVED:
            prepare_memory(memory, problem.G)

    def solve(
        self, q: Array, lower: Array, upper: Array, warm_start: WarmStart = None
    ) -> QPSolution:
        """Solves for one q and one set of bounds.

        Args:
            q: (n,).
            lower: (n + m,) lower bounds of x, then of the rows of G; infinite, or -1e20
                or below, where absent.
            upper: (n + m,) upper bounds likewise.
            warm_start: The last solution, or an active set; any guess is safe.

        Raises:
            ProblemError: Shapes that do not match, NaN, crossed bounds.
        """
        # line by line as in ``DualActiveSet.solve``: a call costs a tenth of a small
        # solve
        began = perf_counter()
        P = self._P
        G = self._G
        caps, memory, record_size, x_slice = self._workplace
        record = _empty(record_size)
        status = _MISUSE  # until the kernel has run; ``_finish`` finds out why not
        try:
            guess = _NO_RECORD
            if warm_start is not None:
                guess = warm_start.record  # type: ignore[union-attr]
            if q.dtype is lower.dtype is upper.dtype is _FLOAT:
                status = _solve_unchecked(P, q, G, lower, upper, guess, memory, record)
        except (AttributeError, TypeError):
            pass
        problem = P, q, G, lower, upper
        if status != _SOLVED:
            problem, record = self._solver._finish(
                QuadraticProgram.unchecked(P, q, G, lower, upper),
                warm_start,
                self._workplace,
                status,
                record,
                began,
            )
        seconds = perf_counter() - began
        return _new(QPSolution, (record[x_slice], problem, caps, record, 0.0, seconds))


def _for_kernel(problem: QuadraticProgram) -> QuadraticProgram:
    """Copies what the checked kernel refuses: arrays that are read-only or unaligned.

    The unchecked one takes them, as it writes to none of these.
    """
    P, q, G, lower, upper = (
        np.require(part, float, ["C", "A", "W"]) for part in problem
    )
    return QuadraticProgram.unchecked(P, q, G, lower, upper)


def _go_on(
    problem: QuadraticProgram,
    memory: Array,
    status: int,
    record: Array,
    changes_left: int,
    late: Callable[[], bool],
) -> Array:
    """Goes on where the kernel stopped to have the clock looked at.

    Args:
        problem: What is solved.
        memory: As for the kernel.
        status: What the kernel returned.
        record: What it wrote.
        changes_left: Changes of the working set before ``ITERATION_LIMIT``.
        late: Whether it is time for ``TIME_LIMIT``.

    Returns:
        The last record, with the changes of all.
    """
    changes = record[layout.ITERATIONS]
    while status == layout.ITERATION_LIMIT and not late() and changes < changes_left:
        guess = record
        record = np.empty_like(record)
        status = solve_kernel(*problem, guess, memory, record)
        changes += record[layout.ITERATIONS]
    record[layout.ITERATIONS] = changes
    if status == layout.ITERATION_LIMIT and late():
        record[layout.STATUS] = layout.TIME_LIMIT
    return record


def _has_size(problem: QuadraticProgram) -> bool:
    """Returns whether rows of an unchecked program have the length of its q."""
    _, q, G, _, _ = problem
    if not (isinstance(q, np.ndarray) and isinstance(G, np.ndarray)):
        return False
    return q.size > 0 and G.ndim == 2 and q.shape == G.shape[1:]
