"""Separates the noise that a model has learned into the process' and the sensors'.

Both scatter the targets of one step alike. Several steps on they differ: noise of the
process adds up, noise of the sensors does not. In the order of time they can be told
apart: with y_k = x_k + v_k, v ~ N(0, R), the error of one step

    e_{k+1} = y_{k+1} - f(y_k) = w_k + v_{k+1} - A_k v_k,    E[e_{k+1} e_k'] = -A_k R,

is correlated with the one before, which shared v_k, and noise of the process is not. R
is estimated by weighted least squares from all products of successive errors, an entry
a state; what is within two standard errors of zero is zero. Noise of the process is
what is left of the noise that was learned, Q = N - R - A R A'.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import angles_of
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array, DynamicsModel, linearize, to_array
from gpmpc.estimation._noise import residuals
from gpmpc.exceptions import DataError, UnsupportedModel
from gpmpc.gp import GPPosterior, Transitions
from gpmpc.gp._transitions import follows_previous
from gpmpc.models import ResidualModel

_PAIRS = 20  # successive errors, at least
_FLOOR = 0.01  # of the learned variance: what is always left to the process


@dataclass(frozen=True, eq=False)
class SeparatedNoise:
    """The two parts of a model's noise.

    See Also:
        ``separate_noise``, which returns it.
    """

    #: the same predictions, with the noise of the process alone; ``observation_noise``
    #: of its GPs, or of a ``ResidualModel`` with its own noise, is still all of it
    model: DynamicsModel
    #: variances of what moves the state in a step (n,). ``noise_covariance`` of a
    #: ``ResidualModel`` may be larger: each of its outputs keeps as much of its noise
    #: as the state with the most left that it acts on
    process: Tensor
    #: variances of the sensors (n,); zero where none can be told from zero
    measurement: Tensor


@explains_arguments
def separate_noise(
    model: GPPosterior | ResidualModel, transitions: Transitions, block: int = 20
) -> SeparatedNoise:
    """Separates the noise of a model that was learned from measured states.

    Args:
        model: GPs of next states or differences, or a ``ResidualModel`` with a constant
            B.
        transitions: Those of the training, in their order of time; a few hundred. Where
            x[k+1] of a row is not x[k] of the next, a new run begins.
        block: Rows that are left out together when one of them is predicted.

    Raises:
        UnsupportedModel: Another model, or one that was learned from
            pseudo-observations.
        SettingError: The GPs predict something else than next states, as those inside a
            ``ResidualModel`` do.
        ShapeError: The transitions have other dimensions.
        DataError: Fewer than twenty rows follow one another.

    See Also:
        ``SeparatedNoise``, its result; ``gpmpc.calibration.calibrate``, which
        says whether intervals hold.
    """
    gp = getattr(model, "residual", model)
    constant = not callable(getattr(model, "B", None))
    if not isinstance(gp, GPPosterior) or not constant:
        raise UnsupportedModel(
            "the noise of GPs, or of a ResidualModel with a constant B, can be "
            f"separated; got {type(model).__name__}"
        )
    if gp.observation_noise is None:
        raise UnsupportedModel(
            "the noise of GPs of observed rows can be separated, not of sparse ones"
        )
    model = _with_all_noise(model)
    errors = to_array(residuals(model, transitions, block).errors)
    successive = follows_previous(transitions, angles_of(model))
    later = 1 + np.flatnonzero(successive.cpu().numpy())
    if len(later) < _PAIRS:
        raise DataError(
            f"separate_noise needs {_PAIRS} rows that follow one another; "
            f"got {len(later)}"
        )
    states = to_array(transitions.states)
    A = linearize(model, states, to_array(transitions.inputs), covariance=False).A
    learned = np.diagonal(to_array(model.noise_covariance))
    correlated = _shared_errors(errors[later - 1], errors[later], A[later])
    scatter = (errors**2).mean(axis=0)
    # Scaled to the learned noise: left-out errors need not scatter as much as it says.
    measurement_fraction = np.divide(
        correlated, scatter, out=np.zeros_like(scatter), where=scatter > 0
    )
    measurement = measurement_fraction.clip(0.0, 1.0) * learned
    sensor_noise_through_A = (A[later] ** 2).mean(axis=0) @ measurement
    process = np.maximum(
        learned - measurement - sensor_noise_through_A, _FLOOR * learned
    )
    process_variance = torch.from_numpy(process)
    return SeparatedNoise(
        model=_with_noise(model, process_variance),
        process=process_variance,
        measurement=torch.from_numpy(measurement),
    )


def _with_all_noise(model: GPPosterior | ResidualModel) -> Any:
    """Returns a model with all that was learned, also where it was separated before."""
    if isinstance(model, GPPosterior):
        noise = model.observation_noise
        return model if noise is None else replace(model, noise_variance=noise)
    residual = _with_all_noise(model.residual)
    if model.observation_noise is None:
        return replace(model, residual=residual)
    return replace(
        model,
        residual=residual,
        noise=model.observation_noise,
        observation_noise=None,
    )


def _shared_errors(before: Array, after: Array, A: Array) -> Array:
    """Estimates the variances R (n,) of what successive errors share.

    E[after before'] = -A R; the errors are (K, n), A is (K, n, n). Zero where the
    estimate is within two standard errors of it.
    """
    scatter = (after**2).mean(axis=0)
    weights = np.divide(1.0, scatter, out=np.zeros_like(scatter), where=scatter > 0)
    products = np.einsum("kij,ki,kj,i->j", A, after, before, weights)
    information = np.einsum("kij,i->j", A**2, weights)
    observed = information > 0
    zero = np.zeros_like(products)
    shared = np.divide(-products, information, out=zero.copy(), where=observed)
    variance = np.divide(scatter, information, out=zero.copy(), where=observed)
    deviation = np.sqrt(variance)
    return np.where(shared > 2.0 * deviation, shared, 0.0)


def _with_noise(model: GPPosterior | ResidualModel, process: Tensor) -> Any:
    """Replaces the noise (n,) of a model; its means and latent variances stay.

    Args:
        model: With all the noise that was learned.
        process: Variances of what moves the states (n,).
    """
    if isinstance(model, GPPosterior):
        return replace(model, noise_variance=process.to(model.noise_variance))
    gp: Any = model.residual
    smallest = torch.finfo(gp.dtype).tiny
    if model.noise is not None:
        learned = model.noise.diagonal().clamp_min(smallest)
        root = (process.to(learned) / learned).sqrt()
        noise = root[:, None] * model.noise * root
        return replace(model, noise=noise, observation_noise=model.noise)
    B = torch.as_tensor(model.B).to(gp.noise_variance)
    learned = (B.square() @ gp.noise_variance).clamp_min(smallest)
    # Of each output the largest part that a state it acts on has left; all of one that
    # acts on none.
    fraction = process.to(learned) / learned
    largest_fraction = torch.where(B != 0, fraction[:, None], 0.0).amax(dim=0)
    fraction_of_output = torch.where((B != 0).any(dim=0), largest_fraction, 1.0)
    quieter = replace(gp, noise_variance=fraction_of_output * gp.noise_variance)
    return replace(model, residual=quieter)
