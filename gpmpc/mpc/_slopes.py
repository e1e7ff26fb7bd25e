"""How well a learned model knows its own slopes, and so the modes of a loop that is closed around it.

The derivatives of a GP are Gaussian as well (Rasmussen and Williams, 2006, section 9.4), of covariance

    sf2 diag(l)^-2 - D' (K + sn2 I)^-1 D,   D_i = k(x~, x~_i) (x~_i - x~)' diag(l)^-2

which is near sf2 diag(l)^-2 where no data tell slopes in a direction, such as off the circle that (cosine, sine) of an
angle lie on. To first order an eigenvalue of right and left vectors v and w moves by w' dA v / w'v with its matrix.
"""

from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from gpmpc._dynamics import to_array
from gpmpc.gp import GPPosterior
from gpmpc.models import ResidualModel
from gpmpc.models._wrapper import LinearWrapper

Array = np.ndarray


def slope_covariances(model: Any, state: Array, input: Array) -> Array:
    """Covariances (n, n + m, n + m) of each next state's derivatives by state and input, by the GPs' own uncertainty.

    Zero for models without GPs, and for those whose residual acts through a function of the state.

    Args:
        model: Learned or known; delays and disturbances around it are looked through.
        state: Where (n,).
        input: Where (m,).
    """
    n = len(state)
    m = len(input)
    if isinstance(model, GPPosterior):
        return _of_gp(model, np.concatenate([state, input]))
    if isinstance(model, LinearWrapper):
        within = model.model.state_dim
        Z = model.linear_part.Z
        W = model.linear_part.W
        inner = slope_covariances(model.model, state[:within], Z @ state + W @ input)
        seen = np.vstack([np.eye(within, n + m), np.hstack([Z, W])])
        covariances = np.zeros((n, n + m, n + m))
        covariances[:within] = seen.T @ inner @ seen
        return covariances
    if isinstance(model, ResidualModel) and not callable(model.B):
        z, v, slopes = model.features.linearize(state[None], input[None])
        columns = model.features.columns
        inputs = list(model.inputs)
        by_state = np.eye(n, n + m)[columns]
        if slopes is not None:
            by_state = slopes[0][:, None] * by_state
        seen = np.vstack([by_state, np.eye(m, n + m, k=n)[inputs]])
        of_residual = _of_gp(model.residual, np.concatenate([z[0], v[0]]))
        each = seen.T @ of_residual @ seen
        return np.einsum("ik,kab->iab", to_array(model.B) ** 2, each)
    return np.zeros((n, n + m, n + m))


def _of_gp(gp: GPPosterior, at: Array) -> Array:
    """Covariances (k, d, d) of the derivatives of GPs at a point (d,)."""
    points = to_array(gp.features)
    lengthscales = to_array(gp.lengthscales)
    signal_variances = to_array(gp.signal_variance)
    factors = to_array(gp.cholesky)
    covariances = []
    for lengthscale, variance, factor in zip(
        lengthscales, signal_variances, factors, strict=True
    ):
        away = (points - at) / lengthscale
        kernel = variance * np.exp(-0.5 * np.square(away).sum(axis=1))
        slopes = kernel[:, None] * away / lengthscale
        known = solve_triangular(factor, slopes, lower=True)
        covariances.append(np.diag(variance / lengthscale**2) - known.T @ known)
    return np.array(covariances)
