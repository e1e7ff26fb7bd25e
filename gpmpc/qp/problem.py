"""What a convex quadratic program is, and which ones are accepted.

    minimise    1/2 x'P x + q'x
    subject to  h_lower <= G x <= h_upper,   lb <= x <= ub

with P symmetric and positive definite, so that the minimiser is unique whenever the constraints can be met. The rows
of G may depend on each other, repeat, or be zero. A bound of size 1e20 or more is none, equal bounds make an
equality.

Solvers see the constraints *stacked*, box first: ``lower <= C x <= upper`` with C = [I; G], M = n + m rows.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpmpc.exceptions import ProblemError

Array = NDArray[np.float64]

ABSENT = 1e20  # a bound of this size or more is none
SYMMETRY = 1e-10  # largest |P - P'| accepted, as a share of the largest diagonal entry


def as_float_array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """``value`` as a contiguous, writeable float64 array of that shape; itself if it is one.

    Raises:
        ProblemError: It is not; the message begins with ``name``.
    """
    try:
        array = np.require(value, np.float64, ["C", "A", "W"])
    except (TypeError, ValueError) as error:
        raise ProblemError(f"{name} must be an array of real numbers; got {value!r}") from error
    if array.size and array.strides != np.empty(array.shape).strides:  # an axis of length 1 may have any, for NumPy
        array = array.copy()
    if array.shape != shape:
        raise ProblemError(f"{name} must have shape {shape}; got {array.shape}")
    if np.isnan(array).any():
        raise ProblemError(f"{name} must not contain NaN; it does at index {_first(np.isnan(array))}")
    return array


def _first(mask: NDArray[np.bool_]) -> str:
    """The first true index, printed as the user would write it."""
    return ", ".join(str(i) for i in np.argwhere(mask)[0])


def check_hessian(P: Array) -> None:
    """Raises ``ProblemError`` unless P is finite, symmetric and positive definite."""
    if not np.isfinite(P).all():
        raise ProblemError(f"P must be finite; it is not at index {_first(~np.isfinite(P))}")
    skew = np.abs(P - P.T)
    if skew.max() > SYMMETRY * np.abs(np.diagonal(P)).max():
        i, j = np.unravel_index(np.argmax(skew), P.shape)
        raise ProblemError(f"P must be symmetric; got P[{i}, {j}] = {P[i, j]:.6g} and P[{j}, {i}] = {P[j, i]:.6g}")
    try:
        pivots = np.diagonal(np.linalg.cholesky(P)) ** 2
        definite = bool((pivots > len(P) * np.finfo(float).eps * np.diagonal(P)).all())
    except np.linalg.LinAlgError:
        definite = False
    if not definite:
        eigenvalues = np.linalg.eigvalsh(P)
        raise ProblemError(
            f"P must be positive definite; its smallest eigenvalue (number 0 of {len(P)}, in ascending order) is "
            f"{eigenvalues[0]:.6g}, the largest {eigenvalues[-1]:.6g}"
        )


def _check_bounds(kind: str, low: Array, high: Array, names: tuple[str, str]) -> None:
    crossed = low > high
    if crossed.any():
        i = int(np.argmax(crossed))
        raise ProblemError(f"{kind} {i}: {names[0]} must not exceed {names[1]}; got {low[i]:.6g} > {high[i]:.6g}")
    for name, impossible, array in ((names[0], low >= ABSENT, low), (names[1], high <= -ABSENT, high)):
        if impossible.any():
            i = int(np.argmax(impossible))
            raise ProblemError(f"{kind} {i}: no number satisfies {name} = {array[i]:.6g}")


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """``min 1/2 x'Px + q'x`` subject to ``h_lower <= Gx <= h_upper`` and ``lb <= x <= ub``, checked at construction.

    Args:
        P: (n, n) symmetric positive definite.
        q: (n,).
        G: (m, n) rows; none if omitted.
        h_lower: (m,) lower bounds of the rows; absent if omitted.
        h_upper: (m,) upper bounds of the rows; absent if omitted.
        lb: (n,) lower bounds of x; absent if omitted.
        ub: (n,) upper bounds of x; absent if omitted.

    Raises:
        ProblemError: Shapes that do not match, NaN, P not symmetric (which entries) or not positive definite (which
            eigenvalue), crossed bounds (which index).
    """

    P: Array
    q: Array
    G: Array | None = None
    h_lower: Array | None = None
    h_upper: Array | None = None
    lb: Array | None = None
    ub: Array | None = None

    def __post_init__(self):
        shape = np.shape(self.P)
        if len(shape) != 2 or shape[0] != shape[1] or shape[0] == 0:
            raise ProblemError(f"P must be a square matrix with at least one row; got shape {shape}")
        n = shape[0]
        rows = np.shape(self.G) if self.G is not None else (0, n)
        if len(rows) != 2:
            raise ProblemError(f"G must be a matrix of {n} columns; got shape {rows}")
        m = rows[0]
        if self.G is None and (self.h_lower is not None or self.h_upper is not None):
            raise ProblemError("h_lower and h_upper bound the rows of G; got bounds without G")
        given = {
            "P": (self.P, (n, n), None),
            "q": (self.q, (n,), None),
            "G": (self.G, (m, n), 0.0),
            "h_lower": (self.h_lower, (m,), -np.inf),
            "h_upper": (self.h_upper, (m,), np.inf),
            "lb": (self.lb, (n,), -np.inf),
            "ub": (self.ub, (n,), np.inf),
        }
        for name, (value, expected, default) in given.items():
            array = np.full(expected, default) if value is None and default is not None else value
            object.__setattr__(self, name, as_float_array(name, array, expected))
        for name in ("q", "G"):
            if not np.isfinite(getattr(self, name)).all():
                raise ProblemError(
                    f"{name} must be finite; it is not at index {_first(~np.isfinite(getattr(self, name)))}"
                )
        check_hessian(self.P)
        _check_bounds("row", self.h_lower, self.h_upper, ("h_lower", "h_upper"))
        _check_bounds("variable", self.lb, self.ub, ("lb", "ub"))

    @classmethod
    def from_stacked(cls, P: ArrayLike, q: ArrayLike, G: ArrayLike, lower: ArrayLike, upper: ArrayLike):
        """The same problem from bounds (M,) on the stacked constraints ``[x; Gx]``."""
        n, m = len(P), len(G)
        lower, upper = as_float_array("lower", lower, (n + m,)), as_float_array("upper", upper, (n + m,))
        return cls(P, q, G, lower[n:], upper[n:], lower[:n], upper[:n])

    @classmethod
    def unchecked(cls, P: Array, q: Array, G: Array, lower: Array, upper: Array) -> "QuadraticProgram":
        """``from_stacked`` without a look at the arrays, for a builder whose formulas keep the rules by themselves."""
        program, n = object.__new__(cls), len(q)
        parts = {"P": P, "q": q, "G": G, "h_lower": lower[n:], "h_upper": upper[n:], "lb": lower[:n], "ub": upper[:n]}
        program.__dict__.update(parts)
        return program

    @property
    def lower(self) -> Array:
        """(M,) lower bounds of the stacked constraints ``[x; Gx]``."""
        return np.concatenate([self.lb, self.h_lower])

    @property
    def upper(self) -> Array:
        """(M,) upper bounds of the stacked constraints ``[x; Gx]``."""
        return np.concatenate([self.ub, self.h_upper])
