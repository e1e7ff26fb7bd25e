"""Problem: GP predictions at certain and uncertain points, with derivatives, inside a controller's millisecond.

``gpmpc.propagation.moment_matching`` states the mathematics and serves torch; here the same closed forms and all their
first derivatives are evaluated by compiled loops over ``Packed`` arrays, on one thread. Only the k latent functions f
of x~ = (x, u), x ~ N(mu, S) and u certain: what is made of them (next states, differences, observation noise, a nearest
semidefinite covariance) is the caller's. Every function takes one point, or H of them along a first dimension, which
all results then have in front. Nothing is kept between calls: any number of threads may call at once.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gpmpc.exceptions import ShapeError
from gpmpc.kernels.moments import CROSS, JACOBIAN, VALUE, moments_along
from gpmpc.kernels.packed import Array, Packed, pack
from gpmpc.kernels.point import HESSIAN, linearize_along, means_along, means_memory, points_along

__all__ = [
    "Expansion",
    "Moments",
    "Packed",
    "linearize",
    "mean_with_jacobian",
    "moments",
    "moments_with_jacobian",
    "pack",
    "point_with_jacobian",
]


class Expansion(NamedTuple):
    """f at a certain point (x, u); third derivatives are None where they were not asked for.

    Attributes:
        M: The mean (k,).
        variance: Of the latent functions, not below zero (k,).
        J: dM/dx (k, n).
        dM_du: (k, m).
        dvariance_dx: (k, n).
        dvariance_du: (k, m).
        d2M_dx2: (k, n, n).
        d2M_dxdu: (k, n, m).
        d3M_dx3: (k, n, n, n).
        d3M_dx2du: (k, n, n, m).
    """

    M: Array
    variance: Array
    J: Array
    dM_du: Array
    dvariance_dx: Array
    dvariance_du: Array
    d2M_dx2: Array
    d2M_dxdu: Array
    d3M_dx3: Array | None
    d3M_dx2du: Array | None


class Moments(NamedTuple):
    """Moments of f, x ~ N(mu, S), and their derivatives; those of J are None where they were not asked for.

    For symmetric dS: dV_ab = dV_dmu[a, b] . dmu + sum_cd dV_dS[a, b, c, d] dS[c, d] + dV_du[a, b] . du; so dM, dJ.

    Attributes:
        M: E[f] (k,).
        V: Cov[f] (k, k).
        J: E[df/dx] = dM/dmu (k, n); Cov[x, f] = S J'.
        dM_dS: (k, n, n).
        dM_du: (k, m).
        dV_dmu: (k, k, n).
        dV_dS: (k, k, n, n).
        dV_du: (k, k, m).
        dJ_dS: (k, n, n, n).
        dJ_du: (k, n, m).
    """

    M: Array
    V: Array
    J: Array
    dM_dS: Array
    dM_du: Array
    dV_dmu: Array
    dV_dS: Array
    dV_du: Array
    dJ_dS: Array | None
    dJ_du: Array | None

    @property
    def dJ_dmu(self) -> Array:
        """The second derivatives of M in mu (k, n, n), which are twice dM/dS."""
        return 2 * self.dM_dS


def linearize(
    packed: Packed, x: Array, u: Array, covariance: bool, offset: Array, adds_state: bool
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
    K, k, n, m = len(x), packed.output_dim, packed.state_dim, packed.input_dim
    if x.shape != (K, n) or u.shape != (K, m):
        raise ShapeError(f"the model takes states (K, {n}) and inputs (K, {m}); got {x.shape} and {u.shape}")
    x, u = np.ascontiguousarray(x, dtype=np.float64), np.ascontiguousarray(u, dtype=np.float64)
    M, J, J_u = np.empty((K, k)), np.empty((K, k, n)), np.empty((K, k, m))
    V = np.zeros((K if covariance else 0, k, k))
    gp = packed.points, packed.inverse_squares, packed.log_signal, packed.weights
    columns = packed.columns if covariance else V
    linearize_along(gp, columns, offset, adds_state, x, u, M, J, J_u, V)
    return M, J, J_u, V if covariance else None


def mean_with_jacobian(packed: Packed, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array, Array]:
    """The posterior mean at a certain point.

    Args:
        packed: The GPs.
        x: State (n,) or (H, n).
        u: Control (m,) or (H, m).

    Returns:
        M (k,), dM/dx (k, n) and dM/du (k, m).

    Raises:
        ShapeError: x or u do not fit the model.
    """
    n, m = packed.state_dim, packed.input_dim
    if type(x) is np.ndarray and type(u) is np.ndarray and x.shape == (n,) and u.shape == (m,):
        queries, single = np.concatenate((x, u), dtype=np.float64)[None], True  # the usual case, quickly
    else:
        x, u, single = _points(packed, x, u)
        queries = np.concatenate((x, u), axis=1)
    points, out = packed.points, np.empty((len(queries), packed.output_dim, 1 + n + m))
    memory = np.empty(means_memory(*points.shape))
    means_along(points, packed.inverse_squares, packed.log_signal, packed.weights, queries, n, memory, out)
    if single:
        return out[0, :, 0], out[0, :, 1 : 1 + n], out[0, :, 1 + n :]
    return out[..., 0], out[..., 1 : 1 + n], out[..., 1 + n :]


def point_with_jacobian(packed: Packed, x: ArrayLike, u: ArrayLike, hessian: bool = False) -> Expansion:
    """Mean and variance at a certain point, with the derivatives that linearised propagation needs.

    Args:
        packed: The GPs.
        x: State (n,) or (H, n).
        u: Control (m,) or (H, m).
        hessian: Also gives third derivatives, for propagation to second order.

    Raises:
        ShapeError: x or u do not fit the model.
    """
    x, u, single = _points(packed, x, u)
    H, k, n, m = len(x), packed.output_dim, packed.state_dim, packed.input_dim
    third = k if hessian else 0
    shapes = [(k,), (k,), (k, n), (k, m), (k, n), (k, m), (k, n, n), (k, n, m), (third, n, n, n), (third, n, n, m)]
    out = tuple([np.empty((H, *shape)) for shape in shapes])
    points_along(
        HESSIAN if hessian else JACOBIAN,
        packed.points,
        packed.inverse_squares,
        packed.log_signal,
        packed.weights,
        packed.inverse_cholesky,
        x,
        u,
        out,
    )
    return Expansion(*_given(out, single, 10 if hessian else 8))


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
    return tuple(_given(out, single, 3)[:3])


def moments_with_jacobian(
    packed: Packed, mu: ArrayLike, S: ArrayLike, u: ArrayLike, diagonal: bool = False, cross: bool = False
) -> Moments:
    """``moments`` and their derivatives; ``cross`` adds those of J."""
    out, single = _moments(packed, mu, S, u, diagonal, CROSS if cross else JACOBIAN)
    return Moments(*_given(out, single, 10 if cross else 8))


def _moments(packed: Packed, mu, S, u, diagonal: bool, order: int) -> tuple[tuple[Array, ...], bool]:
    """The ten arrays of ``Moments``, H in front; whether one belief was asked for."""
    mu, u, single = _points(packed, mu, u)
    S = np.array(S, dtype=np.float64, order="C", ndmin=3)
    H, k, n, m = len(mu), packed.output_dim, packed.state_dim, packed.input_dim
    if S.shape != (H, n, n):
        raise ShapeError(
            f"S must have shape {(n, n) if single else (H, n, n)}; got {S.shape[1:] if single else S.shape}"
        )
    first, second = (k if order >= JACOBIAN else 0), (k if order == CROSS else 0)
    shapes = [(k,), (k, k), (k, n), (first, n, n), (first, m), (first, k, n), (first, k, n, n), (first, k, m)]
    out = tuple([np.empty((H, *shape)) for shape in [*shapes, (second, n, n, n), (second, n, m)]])
    moments_along(
        order,
        bool(diagonal),
        packed.points,
        packed.inverse_squares,
        packed.signal_variance,
        packed.weights,
        packed.inverse_cholesky,
        packed.centred,
        mu,
        S,
        u,
        out,
    )
    return out, single


def _points(packed: Packed, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array, bool]:
    """Fresh contiguous (H, n) and (H, m), the one type the kernels are compiled for; whether one point was given."""
    single = np.ndim(x) == 1
    x, u = np.array(x, dtype=np.float64, order="C", ndmin=2), np.array(u, dtype=np.float64, order="C", ndmin=2)
    if x.shape[1] != packed.state_dim or u.shape != (len(x), packed.input_dim):
        got = f"{x.shape[1]} and {u.shape[1]}, for {len(x)} and {len(u)} points"
        raise ShapeError(f"the model has {packed.state_dim} states and {packed.input_dim} inputs; got {got}")
    return x, u, single


def _given(out: tuple[Array, ...], single: bool, count: int) -> list[Array | None]:
    """Those that were computed, without H for one point; None for the others."""
    return [(array[0] if single else array) if i < count else None for i, array in enumerate(out)]
