"""The noise of a process, estimated from the residuals of a model over all rows of its data.

A GP's noise variance comes from the evidence of its training rows, which on smooth logs says too little: errors of one
step are correlated with those of the next, and a flexible mean explains them away. Here it is estimated from residuals
of the rows in their order of time, each predicted without itself and its neighbours,

    e_i = y_i - mu_{-i},    E[e_i^2] = latent variance_i + sigma^2

(in closed form for rows that the posterior was trained on, block by block: Rasmussen and Williams, 2006, section 5.4.2;
a row alone would be explained by its neighbours in time, whose errors are like its own), with the correlation rho of
e_i and e_{i+1}: errors of an AR(1) process e_{i+1} = rho e_i + w, whose sum over many steps has the
variance of white noise of sigma^2 (1 + rho) / (1 - rho).
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gpmpc.exceptions import DataError, ShapeError, UnsupportedModel, check_number
from gpmpc.gp import GPPosterior, Transitions
from gpmpc.gp._transitions import check_transitions


@dataclass(frozen=True)
class ProcessNoise:
    """The noise of a process, an entry an output."""

    variance: Tensor  #: sigma^2 of a step (k,)
    correlation: Tensor  #: rho, of the noise of a step with the next's (k,); NaN where rows are in no order of time
    rows: int  #: how many rows it was estimated from

    @property
    def long_run_variance(self) -> Tensor:
        """Of the white noise whose sum over many steps varies as much (k,): sigma^2 (1 + rho) / (1 - rho)."""
        rho = self.correlation.nan_to_num(0.0).clamp(0.0, 0.99)
        return self.variance * (1 + rho) / (1 - rho)


def estimate_process_noise(model: Any, transitions: Transitions, block: int = 20) -> ProcessNoise:
    """Estimates the noise of a model's outputs from transitions in their order of time.

    Args:
        model: Predicts next states. Rows that a ``GPPosterior`` was trained on are predicted without their block.
        transitions: All rows of one log or several; where x[k+1] of a row is not x[k] of the next, a new run begins.
        block: Rows that are left out together: more than errors are correlated over.

    Raises:
        ShapeError: The transitions have other dimensions.
        DataError: There are fewer than ten rows.
    """
    errors, latent = residuals(model, transitions, block)
    variance = (errors.square() - latent).mean(0)
    floor = 0.01 * errors.square().mean(0)  # a variance of the latent function that is too large leaves something
    successive = (transitions.next_states[:-1] - transitions.states[1:]).abs().amax(1) <= 1e-12 + 1e-9 * (
        transitions.states[1:].abs().amax(1)
    )
    rho = torch.full_like(variance, torch.nan)
    if int(successive.sum()) >= 10:
        first, second = errors[:-1][successive], errors[1:][successive]
        rho = (first * second).sum(0) / (first.square().sum(0) * second.square().sum(0)).sqrt()
    return ProcessNoise(torch.maximum(variance, floor), rho, len(errors))


def with_process_noise(posterior: GPPosterior, noise: ProcessNoise | Tensor) -> GPPosterior:
    """The posterior of GPs that have this noise, factorised anew over its points.

    Args:
        posterior: Its points, hyperparameters and prior means stay; with more noise its mean is smoother.
        noise: Estimated, or variances (k,), such as a ``long_run_variance``.

    Raises:
        UnsupportedModel: It stands on a sparse model's pseudo-observations.
        ShapeError: Another number of outputs.
    """
    variance = noise.variance if isinstance(noise, ProcessNoise) else noise
    if not isinstance(posterior, GPPosterior) or not posterior.has_observation_noise:
        raise UnsupportedModel("the noise of a GPPosterior of observed rows can be replaced; train a sparse one again")
    if variance.shape != posterior.noise_variance.shape:
        raise ShapeError(f"variances must be ({posterior.output_dim},); got {tuple(variance.shape)}")
    p = posterior
    kernel = p.lengthscales, p.signal_variance, variance.to(p.weights)
    return GPPosterior.from_hyperparameters(p.features, p.targets, *kernel, p.input_dim, p.predicts, p.offset)


def residuals(model: Any, transitions: Transitions, block: int) -> tuple[Tensor, Tensor]:
    """Errors of the predicted outputs (N, k), and the variances of the latent functions (N, k) at the rows, checked."""
    check_transitions(transitions, model)
    if len(transitions) < 10:
        raise DataError(f"a noise needs ten rows or more; got {len(transitions)}")
    check_number("block", block, least=1, whole=True)
    to = {"dtype": model.dtype, "device": model.device}
    x, u, after = (t.to(**to) for t in (transitions.states, transitions.inputs, transitions.next_states))
    belief = model.predict(x, u)
    errors, variance = after - belief.mean, belief.variance.clone()
    if not isinstance(model, GPPosterior) or not model.has_observation_noise:
        return errors, variance
    rows, points = _training_rows(model, torch.cat([x, u], dim=1))
    for start in range(0, len(rows), block):
        seen, at = rows[start : start + block], points[start : start + block]
        for a in range(model.output_dim):
            covariance = torch.linalg.inv(model.precision[a][at][:, at])
            errors[seen, a] = covariance @ model.weights[a, at]
            variance[seen, a] = (covariance.diagonal() - model.noise_variance[a]).clamp_min(0)
    return errors, variance


def _training_rows(model: GPPosterior, features: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (r,) that are points of a posterior, in their order, and which points these are (r,)."""
    points = {tuple(point): i for i, point in enumerate(model.features.tolist())}
    found = [(row, points[key]) for row, key in enumerate(map(tuple, features.tolist())) if key in points]
    first, second = zip(*found, strict=True) if found else ((), ())
    return torch.tensor(first, dtype=torch.long), torch.tensor(second, dtype=torch.long)
