"""Covariances of a learned model's slopes, and so of the modes of a loop around it.

The derivatives of a GP are Gaussian as well (Rasmussen and Williams, 2006, section
9.4), of covariance

    sf2 diag(l)^-2 - D' (K + sn2 I)^-1 D,   D_i = k(x~, x~_i) (x~_i - x~)' diag(l)^-2

which is near sf2 diag(l)^-2 where no data tell slopes in a direction, such as off the
circle that (cosine, sine) of an angle lie on. To first order an eigenvalue of right and
left vectors v and w moves by w' dA v / w'v with its matrix.
"""

from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from gpmpc._dynamics import to_array
from gpmpc.gp import GPPosterior
from gpmpc.models import NoisyModel, ResidualModel
from gpmpc.models._wrapper import LinearWrapper

Array = np.ndarray


def slope_covariances(model: Any, state: Array, input: Array) -> Array:
    """Returns covariances (n, n + m, n + m) of each next state's derivatives.

    They are derivatives by state and input, and covariances by the GPs' own
    uncertainty, as far as it is known here. They are zero for models without a
    ``GPPosterior``, for residuals that act through a function of the state, and for
    models of logs and those that change in flight.

    Args:
        model: Learned or known; delays, disturbances and varying noise around it are
            looked through.
        state: Where the slopes are taken (n,).
        input: Where the slopes are taken (m,).
    """
    if isinstance(model, GPPosterior):
        return _gp_covariances(model, np.concatenate([state, input]))
    if isinstance(model, LinearWrapper):
        return _wrapper_covariances(model, state, input)
    if isinstance(model, NoisyModel):
        return slope_covariances(model.model, state, input)
    gp: Any = getattr(model, "residual", None)
    if isinstance(gp, GPPosterior) and not callable(model.B):
        return _residual_covariances(model, to_array(model.B), state, input)
    size = len(state) + len(input)
    return np.zeros((len(state), size, size))


def _wrapper_covariances(model: LinearWrapper, state: Array, input: Array) -> Array:
    """Returns ``slope_covariances`` of a model with linear states around another."""
    n = len(state)
    m = len(input)
    inner_dim = model.model.state_dim
    Z = model.linear_part.Z
    W = model.linear_part.W
    inner = slope_covariances(model.model, state[:inner_dim], Z @ state + W @ input)
    inner_state = np.eye(inner_dim, n + m)
    inner_input = np.hstack([Z, W])
    features = np.vstack([inner_state, inner_input])  # of the inner model (., n + m)
    covariances = np.zeros((n, n + m, n + m))
    covariances[:inner_dim] = features.T @ inner @ features
    return covariances


def _residual_covariances(
    model: ResidualModel, B: Array, state: Array, input: Array
) -> Array:
    """Returns ``slope_covariances`` of a nominal model plus B (n, k) times GPs."""
    n = len(state)
    m = len(input)
    z, v, slopes = model.features.linearize(state[None], input[None])
    by_state = np.eye(n, n + m)[model.features.columns]
    if slopes is not None:
        by_state = slopes[0][:, None] * by_state
    by_input = np.eye(m, n + m, k=n)[list(model.inputs)]
    features = np.vstack([by_state, by_input])  # of the GPs (d, n + m)
    of_gps = _gp_covariances(model.residual, np.concatenate([z[0], v[0]]))
    of_residual = features.T @ of_gps @ features
    return np.einsum("ik,kab->iab", B**2, of_residual)


def _gp_covariances(gp: GPPosterior, point: Array) -> Array:
    """Returns covariances (k, d, d) of the derivatives of GPs at a point (d,)."""
    points = to_array(gp.features)
    lengthscales = to_array(gp.lengthscales)
    signal_variances = to_array(gp.signal_variance)
    factors = to_array(gp.cholesky)
    covariances = []
    for lengthscale, variance, factor in zip(
        lengthscales, signal_variances, factors, strict=True
    ):
        differences = (points - point) / lengthscale
        kernel = variance * np.exp(-0.5 * np.square(differences).sum(axis=1))
        slopes = kernel[:, None] * differences / lengthscale
        explained = solve_triangular(factor, slopes, lower=True)
        prior = np.diag(variance / lengthscale**2)
        covariances.append(prior - explained.T @ explained)
    return np.array(covariances)
