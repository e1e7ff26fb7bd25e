"""The dual active-set method with doubled digits.

For the programs that float64 alone cannot decide.

Rows that are parallel up to 1e-12, or a Hessian at the edge of definiteness, leave few
of sixteen digits. Here the iteration of ``gpmpc.qp._dual_iteration`` is written for
accuracy: variables and rows are scaled by powers of two, the working set has a QR
factor computed anew at each change, and x and the multipliers are sums of two floats
that Newton's method corrects by residuals without rounding error (iterative refinement:
Higham, Accuracy and Stability of Numerical Algorithms, 2002, chapter 12):

    a = -A_W dmu - L^-1 r1,   A_W' a = -r2,   L' dx = a

for the residuals r1 of stationarity and r2 of the working set. Here P = L L', other
than in the kernels (P = L'L), and A_W = L^-1 C_W' holds the columns of the working set
W.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr, solve_triangular

from gpmpc.qp import _record as layout
from gpmpc.qp._problem import ABSENT
from gpmpc.qp._solution import (
    QPSolution,
    largest_residual,
    proves_infeasibility,
    zero_row_size,
)
from gpmpc.status import Status

Array = NDArray[np.float64]

# violation, as a share of the terms that it is a sum of, that doubled digits cannot
# tell from none
NEGLIGIBLE = 1e-26
# share of these terms by which a row may contradict others that it depends on: the
# data's rounding
_ROUNDING_OF_DATA = 1e-14
# Distances from the span of the others, as a share of the row, within which a row
# depends on them. Where rows that differ by rounding only are taken for independent
# ones, x does not converge: then the next one is tried.
_DEPENDENT_DISTANCES = (1e-14, 1e-13, 1e-12, 1e-10)
# A guessed constraint is this many times as far from the others: if it is nearer and
# does matter, it is found violated and enters later.
_GUESS_MARGIN = 1e6
# Residuals up to this are rounding: then the point of doubled digits is the better one.
_ROUNDED = 1e-13
# A solution that takes more changes was none: they cost a factorisation each.
_CHANGES_OF_POLISH = 20
_CONVERGED = 1e-12  # last correction of x, as a share of its size
_CORRECTIONS = 12


@np.errstate(all="ignore")  # what is not finite does not convince
def rescue(
    problem: tuple,
    caps: Array,
    record: Array,
    limit: int = _CHANGES_OF_POLISH,
    late: Callable[[], bool] = lambda: False,
) -> Array:
    """Returns the record of a solve that starts from the working set of another.

    Args:
        problem: P, q, G, lower and upper; bounds of 1e20 or more are absent.
        caps: (M,), see ``gpmpc.qp._problem.multiplier_caps``.
        record: What the kernel wrote.
        limit: Changes of the working set before ``ITERATION_LIMIT``, those for all
            dependent distances together.
        late: Whether it is time for ``TIME_LIMIT``.
    """
    P, q, G, lower, upper = problem
    result = record.copy()
    status = layout.NUMERICAL_TROUBLE
    iterations = 0
    try:
        lower = np.where(lower <= -ABSENT, -np.inf, lower)
        upper = np.where(upper >= ABSENT, np.inf, upper)
        labels = layout.working_labels(record, len(q), len(lower))
        for dependent_distance in _DEPENDENT_DISTANCES:
            solver = _AccurateSolver(
                (P, q, G, lower, upper), caps, dependent_distance, late
            )
            status = solver.run(labels, limit - iterations)
            iterations += solver.iterations
            if status != layout.NUMERICAL_TROUBLE:  # else the kernel's x is as good
                solver.write(result)
                break
    except TimeoutError:
        status = layout.TIME_LIMIT
    except (ArithmeticError, ValueError, np.linalg.LinAlgError):
        # not finite, or not positive definite once scaled
        status = layout.NUMERICAL_TROUBLE
    result[layout.STATUS] = status
    result[layout.ITERATIONS] += iterations
    return result


def polish(solution: QPSolution, tolerance: float) -> QPSolution:
    """Returns the better of a solution and what doubled digits make of it, judged.

    They change the last digits only of a solution whose working set is right. From a
    wrong one they may end elsewhere, and at a worse point.

    Args:
        solution: Of any solver.
        tolerance: Largest residual of what is called ``SOLVED``.
    """
    record = rescue(solution.arrays, solution.caps, solution.record)
    x = record[layout.HEADER :][: len(solution.x)]
    polished = solution._replace(x=x, record=record)
    if polished.status is Status.INFEASIBLE:  # which is proven
        return polished
    before = largest_residual(solution)
    after = largest_residual(polished)
    better = polished if after <= max(before, _ROUNDED) else solution
    is_solved = min(before, after) <= tolerance
    status = layout.SOLVED if is_solved else layout.NUMERICAL_TROUBLE
    better.record[layout.STATUS] = status
    return better


class _Violated(NamedTuple):
    """A violated constraint."""

    p: int
    side: int  # +1 if the upper bound is violated, -1 if it is the lower one
    sense: int  # the direction in which the multiplier moves
    amount: float


class _Blocking(NamedTuple):
    """The working constraint whose multiplier ends a step; p = -1 if none does."""

    p: int
    step: float
    multiplier: float  # the end of its range


class _AccurateSolver:
    """A scaled program and the state of the iteration.

    The state is the working set (+1 at an upper bound), x and the multipliers.
    """

    def __init__(
        self, problem: tuple, caps: Array, dependent_distance: float, late: Callable
    ):
        P, q, G, lower, upper = problem
        n = len(q)
        M = len(lower)
        D = inverse_power_of_two(np.sqrt(np.diagonal(P)))
        E = np.concatenate(
            [1.0 / D, inverse_power_of_two(np.abs(G * D).max(axis=1, initial=0.0))]
        )
        self.D = D
        self.E = E
        self.n = n
        self.P = P * np.outer(D, D)
        self.q = q * D
        self.C = np.vstack([np.eye(n), G * D * E[n:, None]])
        self.lower = lower * E
        self.upper = upper * E
        self.caps = caps / E
        for scaled, given in (
            (self.lower, lower),
            (self.upper, upper),
            (self.caps, caps),
        ):
            # an infinite bound or price would count as none
            if (np.isinf(scaled) & np.isfinite(given)).any():
                raise OverflowError
        self.unscaled_G = G
        self.unscaled_bounds = (lower, upper)
        self.late = late
        self.L = np.linalg.cholesky(self.P)
        self.columns = solve_triangular(self.L, self.C.T, lower=True)  # L^-1 C'
        self.norms = np.sqrt((self.columns**2).sum(axis=0))
        # L^-1 magnifies the rounding of a column by up to 1 / min L_ii
        self.dependent_distance = dependent_distance / np.diagonal(self.L).min()
        self.working: dict[int, int] = {}
        self.Q = np.zeros((n, 0))  # A_W = Q R
        self.R = np.zeros((0, 0))
        self.x = np.zeros((2, n))
        self.mu = np.zeros((2, M))
        self.iterations = 0
        self.ray: Array | None = None  # Farkas' proof, not scaled

    def run(self, labels: Array, limit: int) -> int:
        """Changes the working set until no constraint is violated; returns the status.

        Args:
            labels: Signed numbers of the constraints to start with.
            limit: Changes before ``ITERATION_LIMIT``.
        """
        self._guess(labels)
        passed_over: set[int] = set()
        while True:
            if not self._correct_multipliers():
                return layout.NUMERICAL_TROUBLE
            violated = self._most_violated(passed_over)
            if violated is None:
                return layout.SOLVED
            if self.iterations >= limit:
                return layout.ITERATION_LIMIT
            rounding = _ROUNDING_OF_DATA * self._terms_of(violated.p, violated.side)
            combination = self._satisfy_constraint(violated, rounding)
            if combination is None:
                continue
            if self._prove(violated, combination):
                return layout.INFEASIBLE
            working_terms = [self._terms_of(*w) for w in self.working.items()]
            rounding = rounding + (
                _ROUNDING_OF_DATA * np.abs(combination) @ working_terms
            )
            if violated.amount > rounding:
                return layout.NUMERICAL_TROUBLE
            passed_over.add(violated.p)

    def write(self, record: Array) -> None:
        """Writes x, multipliers (or Farkas' ray) and working set to a record."""
        n = self.n
        M = len(self.E)
        k = len(self.working)
        multipliers = self.mu.sum(axis=0) * self.E if self.ray is None else self.ray
        x = self.x.sum(axis=0) * self.D
        if not (np.isfinite(x).all() and np.isfinite(multipliers).all()):
            raise OverflowError
        record[layout.HEADER : layout.HEADER + n + M] = np.concatenate([x, multipliers])
        record[layout.HEADER + n + M :][:k] = [
            side * (p + 1) for p, side in self.working.items()
        ]
        record[[layout.WORKING, layout.VARIABLES, layout.CONSTRAINTS]] = k, n, M

    def _bound(self, p: int, side: int) -> float:
        return self.upper[p] if side > 0 else self.lower[p]

    def _range(self, p: int, side: int) -> tuple[float, float]:
        """Returns the range of a multiplier at the upper (+1) or lower (-1) bound."""
        equality = self.lower[p] == self.upper[p]
        cap = self.caps[p]
        least = -cap if equality or side < 0 else 0.0
        most = cap if equality or side > 0 else 0.0
        return least, most

    def _guess(self, labels: Array) -> None:
        """Starts with the labelled bounds, except those that depend on others."""
        guess = {int(abs(label)) - 1: int(np.sign(label)) for label in labels}
        present = [
            p
            for p, side in guess.items()
            if np.isfinite(self._bound(p, side)) and self.norms[p] > 0.0
        ]
        if not present:
            return
        unit_columns = self.columns[:, present] / self.norms[present]
        R, order = qr(unit_columns, mode="r", pivoting=True)
        distances = np.abs(np.diagonal(R))
        independent = distances > _GUESS_MARGIN * self.dependent_distance
        for i in order[: len(independent)][independent]:
            self.working[present[i]] = guess[present[i]]

    def _factorise(self) -> None:
        if self.late():
            raise TimeoutError
        self.Q, self.R = qr(self.columns[:, list(self.working)], mode="economic")

    def _correct_multipliers(self) -> bool:
        """Finds x and the multipliers of the working set.

        Drops the most wrong one until all are in range.
        """
        while True:
            self._factorise()
            if not self._refine():
                return False
            worst = 0.0
            wrong = -1
            multiplier = 0.0
            for p, side in self.working.items():
                least, most = self._range(p, side)
                outside = (
                    max(self.mu[0, p] - most, least - self.mu[0, p]) * self.norms[p]
                )
                if outside > worst:
                    worst = outside
                    wrong = p
                    multiplier = most if self.mu[0, p] > most else least
            if wrong < 0:
                return True
            self._drop(wrong, multiplier if np.isfinite(multiplier) else 0.0)

    def _drop(self, p: int, multiplier: float) -> None:
        self.mu[:, p] = multiplier, 0.0
        del self.working[p]
        self.iterations += 1

    def _refine(self) -> bool:
        """Refines x and the multipliers on the working set by Newton's method.

        Residuals are free of rounding. Returns False if it does not converge.
        """
        W = np.array(list(self.working), dtype=int)
        x = self.x
        mu = self.mu
        C = self.C[W]
        b = np.array([self._bound(*w) for w in self.working.items()])
        others = np.setdiff1d(np.flatnonzero(mu[0]), W)  # soft rows at their caps
        for _ in range(_CORRECTIONS):
            r1 = _sum_products(
                [
                    (self.P, x[0]),
                    (self.P, x[1]),
                    (C.T, mu[0, W]),
                    (C.T, mu[1, W]),
                    (self.C[others].T, mu[0, others]),
                ],
                self.q,
            )
            r2 = _sum_products([(C, x[0]), (C, x[1])], -b)
            scaled_r1 = solve_triangular(self.L, r1, lower=True)
            along = solve_triangular(self.R, r2, trans="T")
            part = self.Q.T @ scaled_r1
            a = self.Q @ (part - along) - scaled_r1
            dx = solve_triangular(self.L, a, trans="T", lower=True)
            _add(x, slice(None), dx)
            _add(mu, W, solve_triangular(self.R, along - part))
            size = max(np.abs(x[0]).max(), NEGLIGIBLE * np.abs(self.q).max())
            if not np.isfinite(size):
                return False
            if np.abs(dx).max() <= _CONVERGED * size:
                box = self.n > W  # bounds of variables hold exactly
                x[0, W[box]] = b[box]
                x[1, W[box]] = 0.0
                return True
        return False

    def _most_violated(self, passed_over: set[int]) -> _Violated | None:
        """Returns the most violated constraint, None if there is none."""
        zero = np.zeros(len(self.C))
        y = _sum_products([(self.C, self.x[0]), (self.C, self.x[1])], zero)
        mu = self.mu[0]
        above = np.where(np.isfinite(self.upper), y - self.upper, -np.inf)
        above = above - NEGLIGIBLE * np.abs(self.upper)
        below = np.where(np.isfinite(self.lower), self.lower - y, -np.inf)
        below = below - NEGLIGIBLE * np.abs(self.lower)
        # One at a cap must stay outside its bound: it is violated where it is not. The
        # rounding that ``above`` lost then counts the other way, and is less than what
        # is taken off below
        excess = np.maximum(above, below)
        excess = np.where(mu < 0.0, -below, excess)
        excess = np.where(mu > 0.0, -above, excess)
        sizes = np.abs(self.C) @ np.abs(self.x[0])
        excess -= NEGLIGIBLE * np.maximum(sizes, np.abs(self.q).max())
        excess[[*self.working, *passed_over]] = -np.inf
        p = int(np.argmax(np.where(self.norms > 0.0, excess / self.norms, excess)))
        if not excess[p] > 0.0:
            return None
        if mu[p] != 0.0:
            side = int(np.sign(mu[p]))
            sense = -side
        else:
            side = 1 if above[p] > below[p] else -1
            sense = side
        return _Violated(p, side, sense, float(excess[p]))

    def _terms_of(self, p: int, side: int) -> float:
        """Returns the size of the numbers whose rounding a violation may be.

        A zero row has those of the other rows only.
        """
        if self.C[p].any():
            return max(abs(self._bound(p, side)), np.abs(self.C[p]) @ np.abs(self.x[0]))
        return zero_row_size(self.unscaled_G, *self.unscaled_bounds)

    def _satisfy_constraint(self, violated: _Violated, rounding: float) -> Array | None:
        """Moves multipliers until a constraint is satisfied.

        Returns:
            None, or the combination of working constraints that a constraint is that
            cannot be satisfied: it contradicts them, or is violated by no more than
            ``rounding``. ``_prove`` tells which.
        """
        p = violated.p
        sense = violated.sense
        violation = violated.amount
        mu = self.mu.sum(axis=0)
        multiplier_before = mu[p]
        while True:
            # step direction
            self._factorise()
            r, square = self._project(p)
            is_far = np.sqrt(square) > self.dependent_distance * self.norms[p]
            independent = is_far and len(self.working) < self.n

            # step length
            step = violation / square if independent else np.inf
            least, most = self._range(p, violated.side)
            range_end = most if sense > 0 else least
            room = (range_end - mu[p]) * sense
            reaches_range_end = room < step
            blocking = self._first_blocking(mu, sense * r, min(step, room))
            step = blocking.step
            if step == np.inf or (not independent and violation <= rounding):
                self.mu[:, p] = multiplier_before, 0.0
                return r

            # take the step
            mu[list(self.working)] -= sense * step * r
            mu[p] += sense * step
            violation -= step * square
            if blocking.p < 0:
                self.iterations += 1
                if reaches_range_end:  # not mu[p], which rounding has put beside it
                    self.mu[:, p] = range_end, 0.0
                else:
                    self.mu[:, p] = mu[p], 0.0
                    self.working[p] = violated.side
                return None
            mu[blocking.p] = blocking.multiplier
            self._drop(blocking.p, blocking.multiplier)

    def _project(self, p: int) -> tuple[Array, float]:
        """Returns the combination r of working columns nearest to p's.

        The second value is the square of the distance that is left.
        """
        distance = self.columns[:, p]
        r = np.zeros(len(self.working))
        for _ in range(2):  # twice is enough
            part = self.Q.T @ distance
            distance = distance - self.Q @ part
            r = r + solve_triangular(self.R, part)
        return r, distance @ distance

    def _first_blocking(self, mu: Array, rates: Array, step: float) -> _Blocking:
        """Returns the longest step up to ``step``, and the constraint that ends it.

        ``rates`` are those at which the working multipliers decrease.
        """
        noise = 1e-14 * np.abs(rates * self.norms[list(self.working)]).max(initial=0.0)
        blocking = _Blocking(-1, step, 0.0)
        for (w, side), rate in zip(self.working.items(), rates, strict=True):
            if abs(rate) * self.norms[w] > noise:
                least, most = self._range(w, side)
                range_end = least if rate > 0.0 else most
                room = max(0.0, (mu[w] - range_end) / rate)
                if room < blocking.step:
                    blocking = _Blocking(w, room, range_end)
        return blocking

    def _prove(self, violated: _Violated, combination: Array) -> bool:
        """Returns whether a contradiction has Farkas' proof, which becomes the ray.

        ``combination`` is that of working constraints which the violated one is. What
        may be violated for a price has no weight in a proof.
        """
        p = violated.p
        sense = violated.sense
        W = np.array(list(self.working), dtype=int)
        sides = np.array(list(self.working.values()), dtype=int)
        weights = np.abs(combination) * self.norms[W]
        has_weight = weights > self.dependent_distance * self.norms[p]
        W = W[has_weight]
        sides = sides[has_weight]
        r = combination[has_weight]
        Q, R = qr(self.columns[:, W], mode="economic")
        for _ in range(3):
            residual = _sum_products([(self.C[W].T, -r)], self.C[p])
            r = r + solve_triangular(
                R, Q.T @ solve_triangular(self.L, residual, lower=True)
            )
        # where a bound cannot pull that way it is rounding
        wrong = (-sense * r * sides < 0.0) & (self.lower[W] < self.upper[W])
        ray = np.zeros(len(self.E))
        ray[W] = np.where(wrong, 0.0, -sense * r)
        ray[p] = sense
        ray = ray * self.E
        proven = proves_infeasibility(
            ray, self.unscaled_G, *self.unscaled_bounds, self.caps
        )
        self.ray = ray if proven else None
        return proven


def inverse_power_of_two(sizes: Array) -> Array:
    """Returns the powers of two nearest to the reciprocals; one for zero."""
    return np.exp2(-np.round(np.log2(np.where(sizes > 0.0, sizes, 1.0))))


def _add(parts: Array, where, change: Array) -> None:
    """Adds to a sum of two floats.

    The second holds what the first rounds off.
    """
    high = parts[0, where]  # may be a view, which the last two lines write to
    low = parts[1, where] + change
    total = high + low
    remainder = low - (total - high)
    parts[0, where] = total
    parts[1, where] = remainder


def _sum_products(products: list[tuple[Array, Array]], constant: Array) -> Array:
    """Returns ``constant + sum A @ v`` as if in doubled precision.

    The method is that of Ogita, Rump and Oishi (2005).
    """
    terms = [constant[:, None]]
    for A, v in products:
        product = A * v
        A_high = _leading_half(A)
        v_high = _leading_half(v)
        A_low = A - A_high
        v_low = v - v_high
        terms += [
            product,
            ((A_high * v_high - product) + A_high * v_low + A_low * v_high)
            + A_low * v_low,
        ]
    total = np.concatenate(terms, axis=1)
    rounding = np.zeros(len(constant))
    while total.shape[1] > 1:
        if total.shape[1] % 2:
            total = np.column_stack([total, np.zeros(len(constant))])
        a = total[:, ::2]
        b = total[:, 1::2]
        total = a + b
        part = total - a
        rounding += ((a - (total - part)) + (b - part)).sum(axis=1)
    return total[:, 0] + rounding


def _leading_half(a: Array) -> Array:
    """Returns the leading 26 bits of each number."""
    shifted = 134217729.0 * a
    return shifted - (shifted - a)
