"""Predictions of Gaussian processes at certain and uncertain points with their derivatives, by compiled loops.

``gpmpc.propagation._moments`` states the mathematics and serves torch; here the closed forms and their first
derivatives are evaluated for ``Packed`` arrays, on one thread. They belong to the k latent functions f of x~ = (x, u),
with x ~ N(mu, S) and u certain; callers add the previous state, observation noise or a nearest semidefinite covariance.
Every function but ``linearize`` takes one point, or H of them along a first dimension, which all results then have in
front. Nothing is kept between calls: any number of threads may call at once.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gpmpc._compiled import call_unchecked
from gpmpc._kernels._gp_moments import CROSS, JACOBIAN, VALUE, evaluate_moments
from gpmpc._kernels._gp_point import expand_points, linearize_points
from gpmpc._kernels._packed import Array, GPArrays, Packed, pack
from gpmpc._kernels._window import Window
from gpmpc.exceptions import ShapeError

__all__ = [
    "Expansion",
    "GPArrays",
    "Moments",
    "Packed",
    "Window",
    "linearize",
    "moments",
    "moments_with_jacobian",
    "pack",
    "point_with_jacobian",
]


class Expansion(NamedTuple):
    """f at a certain point (x, u)."""

    M: Array  #: the mean (k,)
    variance: Array  #: of the latent functions, not below zero (k,)
    J: Array  #: dM/dx (k, n)
    dM_du: Array  #: (k, m)
    dvariance_dx: Array  #: (k, n)
    dvariance_du: Array  #: (k, m)
    d2M_dx2: Array  #: (k, n, n)
    d2M_dxdu: Array  #: (k, n, m)


class Moments(NamedTuple):
    """Moments of f, x ~ N(mu, S), and their derivatives; those of J are None where they were not asked for.

    For symmetric dS: dV_ab = dV_dmu[a, b] . dmu + sum_cd dV_dS[a, b, c, d] dS[c, d] + dV_du[a, b] . du; so dM, dJ.
    """

    M: Array  #: E[f] (k,)
    V: Array  #: Cov[f] (k, k)
    J: Array  #: E[df/dx] = dM/dmu (k, n); Cov[x, f] = S J'
    dM_dS: Array  #: (k, n, n)
    dM_du: Array  #: (k, m)
    dV_dmu: Array  #: (k, k, n)
    dV_dS: Array  #: (k, k, n, n)
    dV_du: Array  #: (k, k, m)
    dJ_dS: Array | None  #: (k, n, n, n)
    dJ_du: Array | None  #: (k, n, m)

    @property
    def dJ_dmu(self) -> Array:
        """The second derivatives of M in mu (k, n, n), which are twice dM/dS."""
        return 2 * self.dM_dS


def linearize(
    packed: Packed | Window, x: Array, u: Array, covariance: bool, offset: Array, adds_state: bool
) -> tuple[Array, Array, Array, Array | None]:
    """Linearises k GPs at K points in one call.

    Args:
        packed: The GPs.
        x: States (K, n), float64 like ``u``.
        u: Inputs (K, m).
        covariance: Whether the covariances are computed; they take most of the time.
        offset: Constant prior means (k,).
        adds_state: Whether the GPs predict differences x+ - x (k = n).

    Returns:
        Means (K, k), their derivatives by x (K, k, n) and by u (K, k, m), and covariances (K, k, k) or None.

    Raises:
        ShapeError: x or u do not fit the model.
    """
    K, k, n, m = len(x), len(packed.arrays.weights), packed.state_dim, packed.input_dim
    if x.shape != (K, n) or u.shape != (K, m):
        raise ShapeError(f"the model takes states (K, {n}) and inputs (K, {m}); got {x.shape} and {u.shape}")
    x, u = np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(u, dtype=np.float64)
    M, A, B = np.empty((K, k)), np.empty((K, k, n)), np.empty((K, k, m))
    V = np.zeros((K if covariance else 0, k, k))
    kept = k * (-(-K // 4) * 4) if covariance else 0
    memory = np.empty((2 * (n + m) + 1 + kept) * packed.arrays.points.shape[1] + 8)
    columns = packed.columns if covariance else V
    offset = np.ascontiguousarray(offset, dtype=np.float64)
    call_unchecked(linearize_points, packed.arrays, columns, (offset, adds_state), x, u, memory, (M, A, B, V))
    return M, A, B, V if covariance else None


def point_with_jacobian(packed: Packed, x: ArrayLike, u: ArrayLike) -> Expansion:
    """Mean and variance at a state x (n,) or (H, n) and control u, with the derivatives that linearisation needs."""
    x, u, single = _points(packed, x, u)
    H, k, n, m = len(x), packed.output_dim, packed.state_dim, packed.input_dim
    shapes = [(k,), (k,), (k, n), (k, m), (k, n), (k, m), (k, n, n), (k, n, m)]
    out = Expansion(*[np.empty((H, *shape)) for shape in shapes])
    call_unchecked(expand_points, packed.arrays, packed.precision.inverse_cholesky, x, u, out)
    return Expansion(*_computed(out, single, 8))


def moments(
    packed: Packed, mu: ArrayLike, S: ArrayLike, u: ArrayLike, diagonal: bool = False
) -> tuple[Array, Array, Array]:
    """The exact moments of f at an uncertain point.

    Args:
        packed: The GPs.
        mu: Mean of the state (n,) or (H, n).
        S: Its covariance (n, n) or (H, n, n), symmetric and positive semidefinite.
        u: Control (m,) or (H, m).
        diagonal: Leaves the covariances between outputs at zero.

    Returns:
        M (k,), V (k, k) and J = E[df/dx] (k, n); Cov[x, f] = S J'.

    Raises:
        ShapeError: mu, S or u do not fit the model.
    """
    out, single = _moments(packed, mu, S, u, diagonal, VALUE)
    return tuple(_computed(out, single, 3)[:3])


def moments_with_jacobian(
    packed: Packed, mu: ArrayLike, S: ArrayLike, u: ArrayLike, diagonal: bool = False, cross: bool = False
) -> Moments:
    """``moments`` and their derivatives; ``cross`` adds those of J."""
    out, single = _moments(packed, mu, S, u, diagonal, CROSS if cross else JACOBIAN)
    return Moments(*_computed(out, single, 10 if cross else 8))


def _moments(
    packed: Packed, mu: ArrayLike, S: ArrayLike, u: ArrayLike, diagonal: bool, order: int
) -> tuple[Moments, bool]:
    """Moments with H in front, and whether one belief was given."""
    mu, u, single = _points(packed, mu, u)
    S = np.array(S, dtype=np.float64, order="C", ndmin=3)
    H, k, n, m = len(mu), packed.output_dim, packed.state_dim, packed.input_dim
    if S.shape != (H, n, n):
        raise ShapeError(
            f"S must have shape {(n, n) if single else (H, n, n)}; got {S.shape[1:] if single else S.shape}"
        )
    first, second = (k if order >= JACOBIAN else 0), (k if order == CROSS else 0)
    shapes = [(k,), (k, k), (k, n), (first, n, n), (first, m), (first, k, n), (first, k, n, n), (first, k, m)]
    out = Moments(*[np.zeros((H, *shape)) for shape in [*shapes, (second, n, n, n), (second, n, m)]])
    call_unchecked(evaluate_moments, order, bool(diagonal), packed.arrays, packed.precision, mu, S, u, out)
    return out, single


def _points(packed: Packed, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array, bool]:
    """Fresh contiguous (H, n) and (H, m), the one type the kernels are compiled for; whether one point was given."""
    single = np.ndim(x) == 1
    x, u = np.array(x, dtype=np.float64, order="C", ndmin=2), np.array(u, dtype=np.float64, order="C", ndmin=2)
    if x.shape[1] != packed.state_dim or u.shape != (len(x), packed.input_dim):
        got = f"{x.shape[1]} and {u.shape[1]}, for {len(x)} and {len(u)} points"
        raise ShapeError(f"the model has {packed.state_dim} states and {packed.input_dim} inputs; got {got}")
    return x, u, single


def _computed(out: tuple[Any, ...], single: bool, count: int) -> list[Any]:
    """The first ``count`` arrays, without H for one point; None for the others."""
    return [(array[0] if single else array) if i < count else None for i, array in enumerate(out)]
