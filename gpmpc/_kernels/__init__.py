"""Predictions of Gaussian processes at certain and uncertain points with their derivatives, by compiled loops.

``gpmpc.propagation._moments`` states the mathematics and serves torch; here the closed forms and their first
derivatives are evaluated for ``Packed`` arrays, on one thread. They belong to the k latent functions f of x~ = (x, u),
with x ~ N(mu, S) and u certain; callers add the previous state, observation noise or a nearest semidefinite covariance.
Every function takes H points along a first dimension, which all results have in front. Nothing is kept between calls:
any number of threads may call at once.
"""

from typing import NamedTuple

import numpy as np

from gpmpc._kernels._gp_moments import evaluate_moments
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
    """Moments of f, x ~ N(mu, S), and their derivatives.

    For symmetric dS: dV_ab = dV_dmu[a, b] . dmu + sum_cd dV_dS[a, b, c, d] dS[c, d] + dV_du[a, b] . du; so dM, dJ.
    """

    M: Array  #: E[f] (k,)
    V: Array  #: Cov[f] (k, k)
    J: Array  #: E[df/dx] = dM/dmu (k, n); Cov[x, f] = S J'
    dM_dS: Array  #: (k, n, n); dJ/dmu, the second derivatives of M in mu, is twice that
    dM_du: Array  #: (k, m)
    dV_dmu: Array  #: (k, k, n)
    dV_dS: Array  #: (k, k, n, n)
    dV_du: Array  #: (k, k, m)
    dJ_dS: Array  #: (k, n, n, n)
    dJ_du: Array  #: (k, n, m)


def linearize(
    packed: Packed | Window,
    x: Array,
    u: Array,
    covariance: bool,
    offset: Array,
    adds_state: bool,
) -> tuple[Array, Array, Array, Array | None]:
    """Linearises k GPs with prior means ``offset`` (k,) at K states x (K, n) and inputs u (K, m).

    ``adds_state`` says that they predict differences x+ - x (k = n). Returns means (K, k), their derivatives by x
    (K, k, n) and by u (K, k, m), and covariances (K, k, k), which take most of the time, or None. Raises ShapeError
    where x or u do not fit.
    """
    K = len(x)
    k = len(packed.arrays.weights)
    n = packed.state_dim
    m = packed.input_dim
    if x.shape != (K, n) or u.shape != (K, m):
        raise ShapeError(
            f"the model takes states (K, {n}) and inputs (K, {m}); got {x.shape} and {u.shape}"
        )
    x = np.ascontiguousarray(x, dtype=np.float64)
    u = np.ascontiguousarray(u, dtype=np.float64)
    M = np.empty((K, k))
    A = np.empty((K, k, n))
    B = np.empty((K, k, m))
    V = np.zeros((K if covariance else 0, k, k))
    kept = k * (-(-K // 4) * 4) if covariance else 0
    memory = np.empty((2 * (n + m) + 1 + kept) * packed.arrays.points.shape[1] + 8)
    columns = packed.columns if covariance else V
    offset = np.ascontiguousarray(offset, dtype=np.float64)
    linearize_points.unchecked(
        packed.arrays,
        columns,
        (offset, adds_state),
        x,
        u,
        memory,
        (M, A, B, V),
    )
    return M, A, B, V if covariance else None


def point_with_jacobian(packed: Packed, x: Array, u: Array) -> Expansion:
    """Mean and variance at states x (H, n) and inputs u (H, m), with the derivatives that linearisation needs."""
    x, u = _points(packed, x, u)
    k = packed.output_dim
    n = packed.state_dim
    m = packed.input_dim
    shapes = [(k,), (k,), (k, n), (k, m), (k, n), (k, m), (k, n, n), (k, n, m)]
    out = Expansion(*[np.empty((len(x), *shape)) for shape in shapes])
    expand_points.unchecked(packed.arrays, packed.precision.inverse_cholesky, x, u, out)
    return out


def moments(
    packed: Packed,
    mu: Array,
    S: Array,
    u: Array,
    diagonal: bool = False,
    derivatives: bool = False,
) -> Moments:
    """The exact moments of f, x ~ N(mu, S) with mu (H, n) and positive semidefinite S (H, n, n), at inputs u (H, m).

    ``diagonal`` leaves the covariances between outputs at zero; without ``derivatives`` their arrays are empty. Raises
    ShapeError where mu, S or u do not fit.
    """
    mu, u = _points(packed, mu, u)
    S = np.array(S, dtype=np.float64, order="C")
    H = len(mu)
    k = packed.output_dim
    n = packed.state_dim
    m = packed.input_dim
    if S.shape != (H, n, n):
        raise ShapeError(f"S must have shape {(H, n, n)}; got {S.shape}")
    d = k if derivatives else 0
    shapes = [
        (k,),
        (k, k),
        (k, n),
        (d, n, n),
        (d, m),
        (d, k, n),
        (d, k, n, n),
        (d, k, m),
        (d, n, n, n),
        (d, n, m),
    ]
    out = Moments(*[np.zeros((H, *shape)) for shape in shapes])
    evaluate_moments.unchecked(
        derivatives,
        bool(diagonal),
        packed.arrays,
        packed.precision,
        mu,
        S,
        u,
        out,
    )
    return out


def _points(packed: Packed, x: Array, u: Array) -> tuple[Array, Array]:
    """Fresh contiguous (H, n) and (H, m), the one type the kernels are compiled for."""
    x = np.array(x, dtype=np.float64, order="C")
    u = np.array(u, dtype=np.float64, order="C")
    H = len(x)
    n = packed.state_dim
    m = packed.input_dim
    if x.shape != (H, n) or u.shape != (H, m):
        raise ShapeError(
            f"the model takes states (H, {n}) and inputs (H, {m}); got {x.shape} and {u.shape}"
        )
    return x, u
