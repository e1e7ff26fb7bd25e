"""Predictions of GPs at certain and uncertain points, and derivatives, compiled.

``_packed``      the arrays that all loops read, and ``_window`` those of GPs whose
                 points come one at a time
``_gp_point``    mean and variance at certain points; ``_gp_moments`` the exact moments
                 at uncertain ones, with ``_pair_sums``, where their time goes
``gp_rollout``   roll-outs of the mean of GPs in an affine model; ``tape`` evaluates
                 functions that are lists of scalar operations
``_rows``        vector algebra over training points; ``linalg`` small matrices
``_simd``        eight numbers in a register: the type ``Lanes`` and its functions

``gpmpc.propagation._moments`` states the mathematics and serves torch; here the closed
forms and their derivatives are evaluated for ``Packed`` arrays, on one thread.
The moments are those of the k latent functions f of x~ = (x, u), with x ~ N(mu, S) and
u certain. ``linearize_gps`` adds the prior mean and the previous state; of all others
callers do, as they add observation noise. All but ``pack`` take H points; every array
below has H in front of the shape that is stated. Kernels trust the types of what they
are handed: the functions here make it contiguous and float64.
Nothing is kept between calls: any number of threads may call at once.
"""

from typing import NamedTuple

import numpy as np

from gpmpc._kernels._gp_moments import evaluate_moments
from gpmpc._kernels._gp_point import (
    LinearizedGPs,
    expand_points,
    kernel_rows,
    linearize_points,
)
from gpmpc._kernels._packed import Array, GPArrays, Packed, pack
from gpmpc._kernels._window import Window
from gpmpc.exceptions import SettingError, ShapeError

__all__ = [
    "Expansion",
    "GPArrays",
    "LinearizedGPs",
    "Moments",
    "Packed",
    "Window",
    "expand_gps",
    "gp_moments",
    "linearize_gps",
    "pack",
]


# of which covariances are solved for together; a multiple of sixteen
_POINTS_AT_ONCE = 256
_NO_COVARIANCES = np.zeros((0, 0, 0))  # for compiled code, where none are wanted


class Expansion(NamedTuple):
    """f at a certain point (x, u): the mean to second order, the variance to first."""

    M: Array  #: the mean without its prior (k,)
    variance: Array  #: of the latent functions, not below zero (k,)
    J: Array  #: dM/dx (k, n)
    dM_du: Array  #: (k, m)
    dvariance_dx: Array  #: (k, n)
    dvariance_du: Array  #: (k, m)
    d2M_dx2: Array  #: (k, n, n)
    d2M_dxdu: Array  #: (k, n, m)


class Moments(NamedTuple):
    """Moments of f, x ~ N(mu, S), and their derivatives.

    For symmetric dS: dV_ab = dV_dmu[a, b] . dmu + sum_cd dV_dS[a, b, c, d] dS[c, d]
    + dV_du[a, b] . du; so dM, dJ.
    """

    M: Array  #: E[f] without the prior mean (k,)
    V: Array  #: Cov[f] (k, k)
    J: Array  #: E[df/dx] = dM/dmu (k, n); Cov[x, f] = S J'
    dM_dS: Array  #: (k, n, n); dJ/dmu, the second derivatives of M in mu, is twice that
    dM_du: Array  #: (k, m)
    dV_dmu: Array  #: (k, k, n)
    dV_dS: Array  #: (k, k, n, n)
    dV_du: Array  #: (k, k, m)
    dJ_dS: Array  #: (k, n, n, n)
    dJ_du: Array  #: (k, n, m)


def linearize_gps(
    packed: Packed | Window,
    x: Array,
    u: Array,
    covariance: bool,
    offset: Array,
    adds_state: bool,
) -> LinearizedGPs:
    """Linearises k GPs at H states and inputs.

    Args:
        packed: The GPs.
        x: States (H, n).
        u: Inputs (H, m).
        covariance: Whether covariances are wanted, which take most of the time.
        offset: Prior means of the GPs (k,).
        adds_state: Whether the GPs predict differences x+ - x (k = n).

    Raises:
        ShapeError: x, u or the prior means do not fit, or the GPs of differences are
            not one a state.
        SettingError: A window has no points, or a row of its factor is missing.
    """
    x = np.ascontiguousarray(x, dtype=np.float64)
    u = np.ascontiguousarray(u, dtype=np.float64)
    offset = np.ascontiguousarray(offset, dtype=np.float64)
    H = len(x)
    k = len(packed.arrays.weights)
    n = packed.state_dim
    m = packed.input_dim
    if x.shape != (H, n) or u.shape != (H, m):
        raise ShapeError(
            f"the model takes states (H, {n}) and inputs (H, {m}); got {x.shape} and "
            f"{u.shape}"
        )
    if offset.shape != (k,) or (adds_state and k != n):
        raise ShapeError(
            f"{k} GPs have as many prior means, and states where they predict "
            f"differences; got {offset.shape} and {n} states"
        )
    if isinstance(packed, Window) and not 0 < packed.arrays.size == packed.rows:
        raise SettingError(
            "packed",
            f"has {packed.rows} of the {packed.arrays.size} rows of its factor: append "
            "points until all are there",
        )
    # a row of kernels for each would fill memory
    if covariance and H > _POINTS_AT_ONCE:
        blocks = [
            linearize_gps(
                packed,
                x=x[first : first + _POINTS_AT_ONCE],
                u=u[first : first + _POINTS_AT_ONCE],
                covariance=covariance,
                offset=offset,
                adds_state=adds_state,
            )
            for first in range(0, H, _POINTS_AT_ONCE)
        ]
        covariances = [block.covariance for block in blocks]
        return LinearizedGPs(
            mean=np.concatenate([block.mean for block in blocks]),
            A=np.concatenate([block.A for block in blocks]),
            B=np.concatenate([block.B for block in blocks]),
            covariance=np.concatenate([V for V in covariances if V is not None]),
        )
    padded = packed.arrays.points.shape[1]
    solve_rows = k * kernel_rows(H) if covariance else 0
    memory = np.empty((2 * (n + m) + 1 + solve_rows) * padded + 8)
    variances = np.zeros((H, k, k)) if covariance else _NO_COVARIANCES
    linearized = LinearizedGPs(
        mean=np.empty((H, k)),
        A=np.empty((H, k, n)),
        B=np.empty((H, k, m)),
        covariance=variances,
    )
    # else an array of the same type, which is not read
    columns = packed.columns if covariance else variances
    linearize_points.unchecked(
        gp=packed.arrays,
        columns=columns,
        prior_mean=offset,
        adds_state=adds_state,
        x=x,
        u=u,
        memory=memory,
        out=linearized,
    )
    if covariance:
        return linearized
    return LinearizedGPs(
        mean=linearized.mean, A=linearized.A, B=linearized.B, covariance=None
    )


def expand_gps(packed: Packed, x: Array, u: Array) -> Expansion:
    """Returns mean and variance at states x (H, n) and inputs u (H, m), expanded.

    Raises ShapeError where x or u do not fit.
    """
    x, u = _contiguous_points(packed, x, u)
    H = len(x)
    k = packed.output_dim
    n = packed.state_dim
    m = packed.input_dim
    expansion = Expansion(
        M=np.empty((H, k)),
        variance=np.empty((H, k)),
        J=np.empty((H, k, n)),
        dM_du=np.empty((H, k, m)),
        dvariance_dx=np.empty((H, k, n)),
        dvariance_du=np.empty((H, k, m)),
        d2M_dx2=np.empty((H, k, n, n)),
        d2M_dxdu=np.empty((H, k, n, m)),
    )
    expand_points.unchecked(
        gp=packed.arrays,
        inverse_cholesky=packed.variance_factors.inverse_cholesky,
        x=x,
        u=u,
        out=expansion,
    )
    return expansion


def gp_moments(
    packed: Packed,
    mu: Array,
    S: Array,
    u: Array,
    diagonal: bool = False,
    derivatives: bool = False,
) -> Moments:
    """Returns the exact moments of f at x ~ N(mu, S) and inputs u.

    Args:
        packed: The GPs.
        mu: Mean states (H, n).
        S: Positive semidefinite covariances (H, n, n).
        u: Certain inputs (H, m).
        diagonal: Leaves the covariances between outputs at zero.
        derivatives: Whether derivatives are wanted; else their arrays are empty.

    Raises:
        ShapeError: mu, S or u do not fit.
    """
    mu, u = _contiguous_points(packed, mu, u)
    S = np.array(S, dtype=np.float64, order="C")
    H = len(mu)
    k = packed.output_dim
    n = packed.state_dim
    m = packed.input_dim
    if S.shape != (H, n, n):
        raise ShapeError(f"S must have shape {(H, n, n)}; got {S.shape}")
    differentiated_outputs = k if derivatives else 0
    evaluated = Moments(
        M=np.zeros((H, k)),
        V=np.zeros((H, k, k)),
        J=np.zeros((H, k, n)),
        dM_dS=np.zeros((H, differentiated_outputs, n, n)),
        dM_du=np.zeros((H, differentiated_outputs, m)),
        dV_dmu=np.zeros((H, differentiated_outputs, k, n)),
        dV_dS=np.zeros((H, differentiated_outputs, k, n, n)),
        dV_du=np.zeros((H, differentiated_outputs, k, m)),
        dJ_dS=np.zeros((H, differentiated_outputs, n, n, n)),
        dJ_du=np.zeros((H, differentiated_outputs, n, m)),
    )
    evaluate_moments.unchecked(
        gp=packed.arrays,
        factors=packed.variance_factors,
        mu=mu,
        S=S,
        u=u,
        diagonal=bool(diagonal),
        derivatives=bool(derivatives),
        out=evaluated,
    )
    return evaluated


def _contiguous_points(packed: Packed, x: Array, u: Array) -> tuple[Array, Array]:
    """Copies (H, n) and (H, m) to the one type that kernels are compiled for."""
    x = np.array(x, dtype=np.float64, order="C")
    u = np.array(u, dtype=np.float64, order="C")
    H = len(x)
    n = packed.state_dim
    m = packed.input_dim
    if x.shape != (H, n) or u.shape != (H, m):
        raise ShapeError(
            f"the model takes states (H, {n}) and inputs (H, {m}); got {x.shape} and "
            f"{u.shape}"
        )
    return x, u
