"""Convex quadratic programs, and rows that may be violated at a price.

    minimise    1/2 x'P x + q'x
    subject to  h_lower <= G x <= h_upper,   lb <= x <= ub

with P symmetric and positive definite, so that the minimiser is unique whenever the
constraints can be met. The rows of G may depend on each other, repeat, or be zero. A
bound of size 1e20 or more is none, equal bounds make an equality. A row with a price w
may be violated by v for w v: its multiplier then reaches w, and no more. So the penalty
is exact: a row whose multiplier stays below its price is kept (Fletcher, 1987, section
14.3).

Solvers see the constraints *stacked*, box first: ``lower <= C x <= upper`` with C = [I;
G], M = n + m rows. Kernels and exported C factorise P = L'L, where rows that end early
stay short; doubled digits and ``CvxpySolver`` take P = L L'.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpmpc.exceptions import ProblemError

Array = NDArray[np.float64]

_new = tuple.__new__
ABSENT = 1e20  # a bound of this size or more is none
# largest |P_ij - P_ji| accepted, as a share of sqrt(P_ii P_jj), which no entry of a
# positive definite P exceeds, whatever the units of the variables
_SYMMETRY = 1e-10


def _as_float_array(
    name: str, value: ArrayLike, shape: tuple[int, ...], finite: bool = False
) -> Array:
    """Returns a contiguous, writeable float64 array of that shape without NaN.

    It is ``value`` itself if that is one.
    """
    array = None
    try:
        # of a complex array NumPy would drop the imaginary part, of a masked one the
        # mask; texts it would read
        is_real = np.asarray(value).dtype.kind not in "cSU"
        if is_real and not np.ma.is_masked(value):
            # a matrix is multiplied as no array is: "E"
            array = np.require(value, np.float64, ["C", "A", "W", "E"])
    except (
        TypeError,
        ValueError,
        RuntimeError,
    ):  # torch's, of a graph or another device
        pass
    if array is None:
        raise ProblemError(f"{name} must be an array of real numbers; got {value!r}")
    # for NumPy an axis of length 1 may have any stride
    if array.size and array.strides != np.empty(array.shape).strides:
        array = array.copy()
    if array.shape != shape:
        raise ProblemError(f"{name} must have shape {shape}; got {array.shape}")
    wrong = np.argwhere(~np.isfinite(array) if finite else np.isnan(array))
    if len(wrong):
        rule = (
            "not contain NaN; it does"
            if np.isnan(array).any()
            else "be finite; it is not"
        )
        raise ProblemError(
            f"{name} must {rule} at index {', '.join(map(str, wrong[0]))}"
        )
    return array


def _symmetric_part(P: Array) -> Array:
    """Returns (P + P')/2, which is P itself if that is symmetric.

    Raises ``ProblemError`` where the two differ by more than rounding.
    """
    roots = np.sqrt(np.abs(np.diagonal(P)))
    excess = np.abs(P - P.T) - _SYMMETRY * np.outer(roots, roots)
    if excess.max() > 0.0:
        i, j = np.unravel_index(np.argmax(excess), P.shape)
        raise ProblemError(
            f"P must be symmetric; got P[{i}, {j}] = {P[i, j]:.6g} "
            f"and P[{j}, {i}] = {P[j, i]:.6g}"
        )
    return P if (P == P.T).all() else 0.5 * P + 0.5 * P.T


def _check_definite(P: Array) -> None:
    """Raises ``ProblemError`` unless a symmetric P is positive definite."""
    try:
        pivots = np.diagonal(np.linalg.cholesky(P)) ** 2
        definite = bool((pivots > len(P) * np.finfo(float).eps * np.diagonal(P)).all())
    except np.linalg.LinAlgError:
        definite = False
    if not definite:
        eigenvalues = np.linalg.eigvalsh(P)
        raise ProblemError(
            f"P must be positive definite; its smallest eigenvalue (number 0 of "
            f"{len(P)}, in ascending order) is {eigenvalues[0]:.6g}, "
            f"the largest {eigenvalues[-1]:.6g}"
        )


def _check_bounds(
    n: int, lower: Array, upper: Array, names: tuple[str, str, str, str]
) -> None:
    """Raises ``ProblemError`` where stacked bounds are crossed or cannot be met.

    ``names`` are those of the box's bounds, then those of the rows'.
    """
    for i in np.flatnonzero((lower > upper) | (lower >= ABSENT) | (upper <= -ABSENT)):
        low, high = names[:2] if i < n else names[2:]
        place = f"variable {i}" if i < n else f"row {i - n}"
        if lower[i] > upper[i]:
            raise ProblemError(
                f"{place}: {low} must not exceed {high}; "
                f"got {lower[i]:.6g} > {upper[i]:.6g}"
            )
        name, value = (low, lower[i]) if lower[i] >= ABSENT else (high, upper[i])
        raise ProblemError(f"{place}: no number satisfies {name} = {value:.6g}")


class _Arrays(NamedTuple):
    """The arrays of a program, as compiled code takes them.

    A program is exactly these five: solvers, solutions and recordings take it apart.
    """

    P: Array
    q: Array
    G: Array
    lower: Array
    upper: Array


class QuadraticProgram(_Arrays):
    """A convex quadratic program, checked at construction.

    ``min 1/2 x'Px + q'x`` subject to ``h_lower <= Gx <= h_upper``, ``lb <= x <= ub``.

    Args:
        P: (n, n) symmetric positive definite.
        q: (n,).
        G: (m, n) rows; none if omitted.
        h_lower: (m,) lower bounds of the rows; absent if omitted.
        h_upper: (m,) upper bounds of the rows; absent if omitted.
        lb: (n,) lower bounds of x; absent if omitted.
        ub: (n,) upper bounds of x; absent if omitted.

    Attributes:
        lower: (M,) lower bounds of the stacked constraints ``[x; Gx]``.
        upper: (M,) upper bounds likewise.

    Raises:
        ProblemError: Shapes that do not match, NaN, P not symmetric (which entries) or
            not positive definite (which eigenvalue), crossed bounds (which index).

    >>> from gpmpc.qp import DualActiveSet
    >>> problem = QuadraticProgram(P=[[2, 0], [0, 2]], q=[-2, -4], ub=[0.5, 1])
    >>> solution = DualActiveSet().solve(problem)
    >>> solution.status.name, solution.x.tolist()
    ('SOLVED', [0.5, 1.0])
    """

    __slots__ = ()

    def __new__(
        cls,
        P: ArrayLike,
        q: ArrayLike,
        G: ArrayLike | None = None,
        h_lower: ArrayLike | None = None,
        h_upper: ArrayLike | None = None,
        lb: ArrayLike | None = None,
        ub: ArrayLike | None = None,
    ):
        if G is None and (h_lower is not None or h_upper is not None):
            raise ProblemError(
                "h_lower and h_upper bound the rows of G; got bounds without G"
            )
        (n, m), P, q, G = _check_matrices(P, q, G)

        def bound(
            name: str, value: ArrayLike | None, size: int, absent: float
        ) -> Array:
            return _as_float_array(
                name, np.full(size, absent) if value is None else value, (size,)
            )

        lower = np.concatenate(
            [bound("lb", lb, n, -np.inf), bound("h_lower", h_lower, m, -np.inf)]
        )
        upper = np.concatenate(
            [bound("ub", ub, n, np.inf), bound("h_upper", h_upper, m, np.inf)]
        )
        _check_bounds(n, lower, upper, ("lb", "ub", "h_lower", "h_upper"))
        return cls.unchecked(P, q, G, lower, upper)

    @classmethod
    def from_stacked(
        cls,
        P: ArrayLike,
        q: ArrayLike,
        G: ArrayLike,
        lower: ArrayLike,
        upper: ArrayLike,
    ) -> "QuadraticProgram":
        """Checks a program with bounds (M,) on the stacked constraints ``[x; Gx]``."""
        (n, m), P, q, G = _check_matrices(P, q, G)
        lower = _as_float_array("lower", lower, (n + m,))
        upper = _as_float_array("upper", upper, (n + m,))
        _check_bounds(n, lower, upper, ("lower", "upper", "lower", "upper"))
        return cls.unchecked(P, q, G, lower, upper)

    @staticmethod
    def unchecked(
        P: Array, q: Array, G: Array, lower: Array, upper: Array
    ) -> "QuadraticProgram":
        """Takes the arrays as they are, in 0.2 us.

        ``DualActiveSet.solve`` checks them in compiled code.
        """
        return _new(QuadraticProgram, (P, q, G, lower, upper))

    def __reduce__(self):
        return QuadraticProgram.unchecked, tuple(self)

    h_lower = property(
        lambda self: self.lower[len(self.q) :], doc="(m,) lower bounds of the rows."
    )
    h_upper = property(
        lambda self: self.upper[len(self.q) :], doc="(m,) upper bounds of the rows."
    )
    lb = property(lambda self: self.lower[: len(self.q)], doc="(n,) lower bounds of x.")
    ub = property(lambda self: self.upper[: len(self.q)], doc="(n,) upper bounds of x.")


def _check_matrices(
    P: ArrayLike, q: ArrayLike, G: ArrayLike | None
) -> tuple[tuple[int, int], Array, Array, Array]:
    """Returns (n, m), P, q and G as arrays."""
    shape = shape_of("P", P)
    if len(shape) != 2 or shape[0] != shape[1] or shape[0] == 0:
        raise ProblemError(
            f"P must be a square matrix with at least one row; got shape {shape}"
        )
    n = shape[0]
    rows = shape_of("G", G) if G is not None else (0, n)
    if len(rows) != 2:
        raise ProblemError(f"G must be a matrix of {n} columns; got shape {rows}")
    P = _as_float_array("P", P, (n, n), finite=True)
    q = _as_float_array("q", q, (n,), finite=True)
    G = (
        np.zeros((0, n))
        if G is None
        else _as_float_array("G", G, (rows[0], n), finite=True)
    )
    P = _symmetric_part(P)
    _check_definite(P)
    return (n, rows[0]), P, q, G


def shape_of(name: str, matrix: ArrayLike) -> tuple[int, ...]:
    """Returns the shape of what may be nested lists of one length."""
    try:
        return np.shape(matrix)
    except ValueError as error:
        raise ProblemError(
            f"{name} must be a matrix, of rows of one length; got {matrix!r}"
        ) from error


def as_program(problem: object) -> QuadraticProgram:
    """Returns what a solver was asked to solve: a program, or a tuple of its arrays.

    The latter is checked. Anything else raises ``ProblemError``.
    """
    if isinstance(problem, QuadraticProgram):
        return problem
    if isinstance(problem, tuple) and len(problem) == len(_Arrays._fields):
        return QuadraticProgram.from_stacked(*problem)
    got = type(problem).__name__
    raise ProblemError(f"problem must be QuadraticProgram(...); got {got}")


def multiplier_caps(prices: ArrayLike | None, variables: int, rows: int) -> Array:
    """Returns the largest sizes (M,) of the stacked constraints' multipliers.

    They are the prices of rows, and infinity elsewhere.

    Raises:
        ProblemError: Another number of prices than of rows, NaN, or a price that is not
            positive.
    """
    caps = np.full(variables + rows, np.inf)
    if prices is not None:
        caps[variables:] = _as_float_array("prices of rows", prices, (rows,))
    for i in np.flatnonzero(caps <= 0.0):
        raise ProblemError(
            f"price of row {i - variables} must be positive; got {caps[i]:.6g}"
        )
    return caps


def check_positive(settings: object, *names: str) -> None:
    """Raises ``ProblemError`` unless settings of a solver are positive numbers."""
    for name in names:
        value = getattr(settings, name)
        is_number = isinstance(value, int | float | np.number)
        if not (is_number and value > 0) or isinstance(value, bool):
            raise ProblemError(f"{name} must be positive; got {value}")


def check_iteration_limit(limit: int | None) -> None:
    """Raises ``ProblemError`` unless a limit is a positive whole number or None."""
    if limit is None:
        return
    is_whole = isinstance(limit, int | np.integer) and not isinstance(limit, bool)
    if not is_whole or limit < 1:
        rule = "iteration_limit must be positive, a whole number"
        raise ProblemError(f"{rule}; got {limit}")
