"""The solution of a quadratic program, its residuals, and the protocol of a solver.

A solution is judged by its residuals, which it computes from the problem's own data; a
solver's flag proves nothing. With the stacked constraints C = [I; G] and multipliers y
(positive at upper, negative at lower bounds) the conditions of Karush, Kuhn and Tucker
are P x + q + C'y = 0, lower <= C x <= upper, and a zero duality gap.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpmpc.exceptions import ProblemError
from gpmpc.qp import _record as layout
from gpmpc.qp._problem import ABSENT, QuadraticProgram
from gpmpc.status import Status

Array = NDArray[np.float64]

_ROUNDING_OF_SUMS = 4e-15  # share of a sum's terms that counts as rounding


class Residuals(NamedTuple):
    """How far a point is from the conditions of optimality.

    All three are zero at the minimiser.

    Each is relative to the numbers that it is a sum of, so that neither units nor data
    of another size hide it. Where these cancel, what counts as zero is 1e-4 of the
    length of x, or 1e-12 of that of the free minimiser, in the metric of P's diagonal.
    """

    #: the largest violation of a hard constraint, or of a soft one beyond what its
    #: multiplier pays for; relative to the violated bound or the constraint's own terms
    #: |c|'|x|
    primal: float
    #: the largest entry of P x + q + G'z + z_box, multipliers of absent bounds or
    #: beyond their weights counted as wrong; relative to the entry's own terms
    dual: float
    #: |primal - dual objective|, what ``primal`` counts as violated left out; relative
    #: to x'Px, |q'x|, or the sum of |multiplier times bound|
    gap: float


class QPSolution(NamedTuple):
    """The minimiser with multipliers, status and residuals.

    Holds references to the problem's arrays, not copies.
    """

    #: (n,) the minimiser; the best iterate if the status is not ``SOLVED``. A view of
    #: the record
    x: Array
    #: P, q, G, and the bounds (M,) of the stacked constraints ``[x; Gx]``, as in
    #: ``QuadraticProgram``
    arrays: tuple[Array, Array, Array, Array, Array]
    #: largest sizes (M,) of the multipliers: the prices of soft rows, infinity
    #: elsewhere
    caps: Array
    #: the solver's whole result in one array, and a warm start for the next solve; see
    #: ``gpmpc.qp._record``
    record: Array
    build_seconds: float = (
        0.0  #: time spent on building or compiling the problem in this call [s]
    )
    solve_seconds: float = 0.0  #: time spent on solving it [s]

    @property
    def multipliers(self) -> Array:
        """The multipliers (M,) of the stacked constraints.

        They are Farkas' proof if the status is ``INFEASIBLE``.
        """
        return self.record[layout.HEADER + len(self.x) :][: len(self.caps)]

    @property
    def z(self) -> Array:
        """The multipliers (m,) of the rows of G.

        They are positive at h_upper and negative at h_lower.
        """
        return self.multipliers[len(self.x) :]

    @property
    def z_box(self) -> Array:
        """(n,) multipliers of the box: positive at ub, negative at lb."""
        return self.multipliers[: len(self.x)]

    @property
    def status(self) -> Status:
        """How the solve ended."""
        return layout.STATUSES[int(self.record[layout.STATUS])]

    @property
    def iterations(self) -> int:
        """Changes of the working set, or the iterations of the solver behind.

        Of ``DualActiveSet`` guessed constraints that enter before the first step, and
        those that leave because their multipliers are wrong, do not count, but for
        doubled digits.
        """
        return int(self.record[layout.ITERATIONS])

    @property
    def active_set(self) -> NDArray[np.int8]:
        """The working stacked constraints (M,).

        The entry is -1 for a lower bound, +1 for an upper bound, 0 for none.
        """
        active = np.zeros(len(self.caps), dtype=np.int8)
        labels = layout.working_labels(self.record, len(self.x), len(self.caps))
        active[np.abs(labels).astype(int) - 1] = np.sign(labels)
        return active

    @property
    def objective(self) -> float:
        """The objective 1/2 x'Px + q'x [the unit of the cost].

        The price of violated soft rows is part of it.
        """
        P, q, *_ = self.arrays
        x = self.x
        soft = np.isfinite(self.caps)
        price = self.caps[soft] @ self.violation()[soft]
        return float(0.5 * x @ P @ x + q @ x + price)

    def violation(self) -> Array:
        """Returns how far each stacked constraint lies outside its bounds (M,).

        In the constraint's own unit; soft rows count, too.
        """
        _, _, G, lower, upper = self.arrays
        values = np.concatenate([self.x, G @ self.x])
        above = np.where(upper < ABSENT, values - upper, 0.0)
        below = np.where(lower > -ABSENT, lower - values, 0.0)
        return np.maximum(0.0, np.maximum(above, below))

    @np.errstate(all="ignore")  # the multipliers of a failed solve may be anything
    def residuals(self, zero: float = 1e-12) -> Residuals:
        """Returns how far x and the multipliers are from the conditions of optimality.

        The residuals are NaN where that cannot be said.

        Args:
            zero: What counts as no x at all, as a share of the free minimiser.
        """
        P, q, _, _, _ = self.arrays
        units = np.sqrt(np.diagonal(P))
        length_of_q = (np.abs(q) / units).max()
        length_of_x = (units * np.abs(self.x)).max()
        zero_length = max(1e-4 * length_of_x, zero * length_of_q)
        violation = self.violation()
        return Residuals(
            primal=self._primal_residual(violation, zero_length / units),
            dual=self._dual_residual(zero_length * units),
            gap=self._gap(violation, zero_length * length_of_q),
        )

    def _primal_residual(self, violation: Array, zero_entries: Array) -> float:
        """Returns ``Residuals.primal``; an x_j below ``zero_entries`` is that."""
        _, _, G, lower, upper = self.arrays
        x = self.x
        n = len(x)
        # what is not beyond its upper bound is measured at its lower one: it is beyond
        # that, or within both and has no violation
        beyond_upper = np.concatenate([x, G @ x]) > upper
        paid_for = np.where(beyond_upper, self.multipliers, -self.multipliers)
        unpaid = np.where(paid_for >= self.caps, 0.0, violation)
        bound = np.abs(np.where(beyond_upper, upper, lower))
        entries = np.maximum(np.abs(x), zero_entries)
        terms = np.concatenate([entries, np.abs(G) @ entries])
        terms[n:][~G.any(axis=1)] = zero_row_size(G, lower, upper)
        return _largest_ratio(unpaid, np.maximum(terms, bound))

    def _dual_residual(self, zero_terms: Array) -> float:
        """Returns ``Residuals.dual``; terms below ``zero_terms`` (n,) count as that."""
        P, q, G, lower, upper = self.arrays
        x = self.x
        n = len(x)
        sizes = np.abs(self.multipliers)
        at_absent_upper = (self.multipliers > 0) & (upper >= ABSENT)
        at_absent_lower = (self.multipliers < 0) & (lower <= -ABSENT)
        beyond_cap = np.maximum(0.0, sizes - self.caps)
        wrong = np.where(at_absent_upper | at_absent_lower, sizes, beyond_cap)
        right = sizes - wrong
        stationarity = np.abs(P @ x + q + G.T @ self.z + self.z_box)
        residual = stationarity + wrong[:n] + np.abs(G).T @ wrong[n:]
        terms = np.abs(P) @ np.abs(x) + np.abs(q) + right[:n] + np.abs(G).T @ right[n:]
        return _largest_ratio(residual, np.maximum(terms, zero_terms))

    def _gap(self, violation: Array, zero_objective: float) -> float:
        """Returns ``Residuals.gap``; less than ``zero_objective`` counts as that."""
        P, q, _, lower, upper = self.arrays
        x = self.x
        multipliers = self.multipliers
        # a multiplier of an absent bound is wrong: ``dual`` says by how much
        up = (multipliers > 0) & (upper < ABSENT)
        down = (multipliers < 0) & (lower > -ABSENT)
        at_upper = multipliers[up] * upper[up]
        at_lower = multipliers[down] * lower[down]
        capped = (np.abs(multipliers) >= self.caps) & np.isfinite(self.caps)
        price = self.caps[capped] @ violation[capped]
        quadratic = x @ (P @ x)
        linear = q @ x
        gap = abs(quadratic + linear + (at_upper.sum() + at_lower.sum()) + price)
        bounds_terms = np.abs(at_upper).sum() + np.abs(at_lower).sum()
        terms = max(abs(quadratic), abs(linear), bounds_terms, zero_objective)
        return _largest_ratio(gap, terms)

    def is_optimal(self, eps: float = 1e-9) -> bool:
        """Whether the residuals, whatever the status says, are all at most ``eps``."""
        return all(residual <= eps for residual in self.residuals())  # which NaN is not


WarmStart = QPSolution | NDArray[np.number] | None
"""The solution of a similar problem, or an active set.

(M,) -1 at a lower bound, +1 at an upper one, 0 elsewhere.
"""


class QPSolver(Protocol):
    """Solves strictly convex quadratic programs.

    ``gpmpc.testing.check_qp_solver`` checks whether an object does.
    """

    def solve(
        self, problem: QuadraticProgram, warm_start: WarmStart = None
    ) -> QPSolution:
        """Returns the minimiser, or the status that says why there is none.

        The result is the same from any warm start.
        """
        ...


def largest_residual(solution: QPSolution, zero: float = 1e-12) -> float:
    """Returns the largest residual, infinity where one cannot be said.

    See ``QPSolution.residuals`` for ``zero``.
    """
    largest = np.max(solution.residuals(zero))
    return np.inf if np.isnan(largest) else float(largest)


def _largest_ratio(residuals: ArrayLike, sizes: ArrayLike) -> float:
    """Returns the largest of ``residuals / sizes``, zero where both are."""
    ratios = np.zeros(np.shape(residuals))
    is_residual = np.not_equal(residuals, 0.0)
    np.divide(residuals, sizes, out=ratios, where=is_residual)
    return float(np.max(ratios))


def make_solution(
    problem: QuadraticProgram,
    status: Status,
    x: ArrayLike,
    multipliers: ArrayLike,
    *,
    active_set: ArrayLike | None = None,
    iterations: int = 0,
    build_seconds: float = 0.0,
    solve_seconds: float = 0.0,
) -> QPSolution:
    """Makes a solution from the parts that any solver has.

    See ``QPSolution``; all rows are hard.

    Args:
        problem: What was solved.
        status: How it ended.
        x: (n,).
        multipliers: (M,) box first, positive at upper and negative at lower bounds.
        active_set: (M,) -1, 0, +1; the signs of the multipliers if omitted.
        iterations: The solver's own count.
        build_seconds: Time spent on building or compiling the problem [s].
        solve_seconds: Time spent on solving it [s].

    Raises:
        ProblemError: Arrays of other shapes, or a status that no solve ends with.
    """
    if status not in layout.STATUSES:
        names = ", ".join(known.name for known in layout.STATUSES)
        raise ProblemError(f"status must be one of {names}; got {status}")
    x = np.asarray(x, dtype=float)
    multipliers = np.asarray(multipliers, dtype=float)
    n = len(problem.q)
    M = sum(problem.G.shape)
    if x.shape != (n,) or multipliers.shape != (M,):
        raise ProblemError(
            f"a solution needs x of shape {(n,)} and multipliers {(M,)}; "
            f"got {x.shape}, {multipliers.shape}"
        )
    if active_set is None:
        active_set = np.sign(multipliers)
    record = layout.warm_record(_read_active_set(active_set, M), n)
    record[[layout.STATUS, layout.ITERATIONS]] = (
        layout.STATUSES.index(status),
        iterations,
    )
    record[layout.HEADER : layout.HEADER + n + M] = np.concatenate([x, multipliers])
    x = record[layout.HEADER : layout.HEADER + n]
    return QPSolution(
        x, problem, np.full(M, np.inf), record, build_seconds, solve_seconds
    )


def as_record(warm_start: WarmStart, n: int, M: int) -> Array:
    """Returns the record of a warm start, empty if there is none.

    Raises ``ProblemError`` if it is no solution or active set of this size.
    """
    if warm_start is None:
        return layout.NO_RECORD
    if isinstance(warm_start, QPSolution):
        return np.require(warm_start.record, np.float64, ["C", "A", "W"])
    return layout.warm_record(_read_active_set(warm_start, M), n)


def _read_active_set(active_set: ArrayLike, M: int) -> Array:
    """Returns an active set (M,) as numbers; NaN counts as no bound.

    Raises:
        ProblemError: It has another shape, or holds no numbers.
    """
    try:
        active = np.asarray(active_set)
    except (
        TypeError,
        ValueError,
        RuntimeError,
    ):  # of unequal rows; torch's, of a graph
        active = np.asarray(None)
    if active.shape != (M,) or active.dtype.kind not in "iuf":
        raise ProblemError(
            f"a warm start must be a solution or an active set of shape {(M,)}, "
            f"-1, 0 or +1 by constraint; got shape {active.shape} of {active.dtype}"
        )
    return np.nan_to_num(active.astype(float))


@np.errstate(all="ignore")  # what is not finite proves nothing
def proves_infeasibility(
    ray: Array, G: Array, lower: Array, upper: Array, caps: Array | None = None
) -> bool:
    """Returns whether ``ray`` (M,) is Farkas' proof that no x satisfies the bounds.

    The bounds are ``lower <= [x; Gx] <= upper``. Those whose multiplier has a finite
    cap (M,) may be violated for a price: their weights in the ray count as zero.

    There is none if a ray y satisfies C'y = 0 and sum(y+ upper) + sum(y- lower) < 0:
    summing the constraints with these weights gives 0 < 0. In floating point C'y is not
    zero. Where a variable has a bound, what is left is moved onto it; where it has
    none, what is left must be the rounding of its own sum, for else a large x may
    satisfy the constraints.
    """
    n = G.shape[1]
    if caps is not None:
        ray = np.where(np.isfinite(caps), 0.0, ray)
    residual = ray[:n] + ray[n:] @ G
    rounding = _ROUNDING_OF_SUMS * (np.abs(ray[:n]) + np.abs(ray[n:]) @ np.abs(G))
    repaired = ray.copy()
    repaired[:n] -= np.where(np.abs(residual) > rounding, residual, 0.0)
    bounds = np.where(repaired > 0, upper, lower)
    has_weight = repaired != 0
    products = repaired[has_weight] * bounds[has_weight]
    if (np.abs(bounds[has_weight]) >= ABSENT).any() or not np.isfinite(products).all():
        return False
    sizes = np.abs(products).sum() + np.abs(ray[n:])[
        ~G.any(axis=1)
    ].sum() * zero_row_size(G, lower, upper)
    return bool(products.sum() < -_ROUNDING_OF_SUMS * sizes)


def zero_row_size(G: Array, lower: Array, upper: Array) -> float:
    """Returns the size of the numbers that cancelled in a zero row.

    It is that of the other bounds, but at most one; one where there are no others.
    """
    others = np.append(np.ones(G.shape[1], dtype=bool), G.any(axis=1))
    sizes = np.abs(np.concatenate([lower[others], upper[others]]))
    return float(min(1.0, sizes[sizes < ABSENT].max(initial=0.0) or 1.0))
