"""The noise of a process, estimated from the residuals of a model over all rows of its data.

A GP's noise variance comes from the evidence of its training rows, which on smooth logs says too little: errors of one
step are correlated with those of the next, and a flexible mean explains them away. Here it is estimated from residuals
of the rows in their order of time, each predicted without itself and its neighbours,

    e_i = y_i - mu_{-i},    E[e_i^2] = latent variance_i + sigma^2

(in closed form for rows that the posterior was trained on, block by block: Rasmussen and Williams, 2006, section 5.4.2;
a row alone would be explained by its neighbours in time, whose errors are like its own), with the correlation rho of
e_i and e_{i+1}: errors of an AR(1) process e_{i+1} = rho e_i + w, whose sum over many steps has the
variance of white noise of sigma^2 (1 + rho) / (1 - rho).

Whether the noise depends on state and input, and how, says a GP g on the logarithm of its variance:

    e_i ~ N(0, t_i),   t_i = latent variance_i + exp g(x_i, u_i)

Hyperparameters of g are found by GP regression on log e_i^2, whose noise is that of log chi^2_1, of mean -1.27 and
variance pi^2 / 2 (Harvey, Ruiz and Shephard, 1994); g is then the most likely one (as in Kersting, Plagemann, Pfaff and
Burgard, 2007), by regression on working responses

    z_i = g_i + r_i (e_i^2 / t_i - 1),   r_i = exp(g_i) / t_i,   of noise 2,

again and again: where g no longer changes, the gradient of its posterior is zero, and 1/2 is the Fisher information of
a row without latent variance (Fisher scoring). Log e_i^2 alone would take 2.5 times as many rows for the same accuracy.
The noise of an output varies where g of the other four fifths of the blocks of time makes the residuals of each fifth
more likely than a constant variance does, by more than two standard errors and by a factor of 100.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import angles_of, state_difference
from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import DataError, ShapeError, UnsupportedModel, check_number
from gpmpc.gp import (
    GPPosterior,
    Hyperparameters,
    Trainer,
    Transitions,
    informative_points,
)
from gpmpc.gp._sparse import sparse_posterior
from gpmpc.gp._transitions import check_transitions
from gpmpc.models import NoisyModel, ResidualModel

SEARCHED, POINTS, FOLDS = (
    500,
    50,
    5,
)  # rows of the search, at most; inducing points of g; parts that are held out
ITERATIONS = 15  # of the working responses; from the regression on log e^2 they change g by less than 1e-3 then
CHI2_LOG = (
    1.2703628454614782,
    math.pi**2 / 2,
)  # minus the mean of log chi^2_1, and its variance


@dataclass(frozen=True)
class ProcessNoise:
    """The noise of a process, an entry an output."""

    variance: Tensor  #: sigma^2 of a step (k,)
    correlation: Tensor  #: rho, of the noise of a step with the next's (k,); NaN where rows are in no order of time

    @property
    def long_run_variance(self) -> Tensor:
        """Of the white noise whose sum over many steps varies as much (k,): sigma^2 (1 + rho) / (1 - rho)."""
        rho = self.correlation.nan_to_num(0.0).clamp(0.0, 0.99)
        return self.variance * (1 + rho) / (1 - rho)


def estimate_process_noise(
    model: Any, transitions: Transitions, block: int = 20
) -> ProcessNoise:
    """Estimates the noise of a model's outputs from transitions in their order of time.

    Args:
        model: Predicts next states. Rows that a ``GPPosterior`` was trained on are predicted without their block.
        transitions: All rows of one log or several; where x[k+1] of a row is not x[k] of the next, a new run begins.
        block: Rows that are left out together: more than errors are correlated over.

    Raises:
        ShapeError: The transitions have other dimensions.
        DataError: There are fewer than ten rows.
    """
    errors, latent = _residuals(model, transitions, block)
    variance = (errors.square() - latent).mean(0)
    floor = 0.01 * errors.square().mean(
        0
    )  # a variance of the latent function that is too large leaves something
    after = transitions.next_states[:-1]
    now = transitions.states[1:]
    gap = state_difference(after, now, angles_of(model)).abs().amax(1)
    successive = gap <= 1e-12 + 1e-9 * now.abs().amax(1)
    rho = torch.full_like(variance, torch.nan)
    if int(successive.sum()) >= 10:
        first = errors[:-1][successive]
        second = errors[1:][successive]
        rho = (first * second).sum(0) / (
            first.square().sum(0) * second.square().sum(0)
        ).sqrt()
    return ProcessNoise(torch.maximum(variance, floor), rho)


def with_process_noise(
    posterior: GPPosterior, noise: ProcessNoise | Tensor
) -> GPPosterior:
    """The posterior of GPs that have this noise, or these variances (k,), factorised anew over its points.

    Raises:
        UnsupportedModel: It stands on a sparse model's pseudo-observations.
        ShapeError: Another number of outputs.
    """
    variance = noise.variance if isinstance(noise, ProcessNoise) else noise
    if not isinstance(posterior, GPPosterior) or not posterior.has_observation_noise:
        raise UnsupportedModel(
            "the noise of a GPPosterior of observed rows can be replaced; train a sparse one again"
        )
    if variance.shape != posterior.noise_variance.shape:
        raise ShapeError(
            f"variances must be ({posterior.output_dim},); got {tuple(variance.shape)}"
        )
    p = posterior
    kernel = p.lengthscales, p.signal_variance, variance.to(p.weights)
    return GPPosterior.from_hyperparameters(
        p.features, p.targets, *kernel, p.input_dim, p.predicts, p.offset, p.signals
    )


def _residuals(
    model: Any, transitions: Transitions, block: int
) -> tuple[Tensor, Tensor]:
    """Errors of the predicted outputs (N, k), and the variances of the latent functions (N, k) at the rows, checked."""
    check_transitions(transitions, model)
    if len(transitions) < 10:
        raise DataError(f"a noise needs ten rows or more; got {len(transitions)}")
    check_number("block", block, least=1, whole=True)
    to = {"dtype": model.dtype, "device": model.device}
    x, u, after = (
        t.to(**to)
        for t in (transitions.states, transitions.inputs, transitions.next_states)
    )
    belief = model.predict(x, u)
    errors = state_difference(after, belief.mean, angles_of(model))
    variance = belief.variance.clone()
    gp, seen_features, effect = _trained_gp(model, x, u)
    if gp is None or not gp.has_observation_noise:
        return errors, variance
    trained = {tuple(point): i for i, point in enumerate(gp.features.tolist())}
    features = enumerate(map(tuple, seen_features.tolist()))
    pairs = torch.tensor(
        [(row, trained[key]) for row, key in features if key in trained],
        dtype=torch.long,
    )
    for seen, at in (part.unbind(1) for part in pairs.split(block) if len(part)):
        missed = errors.new_zeros(len(seen), gp.output_dim)
        unknown = torch.zeros_like(missed)
        for a in range(gp.output_dim):
            covariance = torch.linalg.inv(gp.precision[a][at][:, at])
            missed[:, a] = covariance @ gp.weights[a, at]
            unknown[:, a] = (covariance.diagonal() - gp.noise_variance[a]).clamp_min(0)
        errors[seen] = missed @ effect.mT
        variance[seen] = unknown @ effect.square().mT
    return errors, variance


def _trained_gp(
    model: Any, states: Tensor, inputs: Tensor
) -> tuple[GPPosterior | None, Tensor, Tensor]:
    """The GPs of a model, what they see of states and inputs (N, d), and where they act (n, k)."""
    if isinstance(model, GPPosterior):
        effect = torch.eye(model.output_dim, dtype=model.dtype, device=model.device)
        return model, torch.cat([states, inputs], dim=1), effect
    if isinstance(model, ResidualModel) and not callable(model.B):
        features = torch.cat(model.features(states, inputs), dim=1)
        gp = model.residual
        return gp if isinstance(gp, GPPosterior) else None, features, model.B
    return None, states, states


@dataclass(frozen=True)
class VaryingNoise:
    """Which outputs have a noise that varies, and the model that predicts it."""

    model: Any  #: a ``NoisyModel``; the model that was given where no output's noise varies
    outputs: tuple[int, ...]  #: whose noise varies
    gain: Tensor  #: log likelihood of held-out residuals less that under a constant variance (k,) [nats]
    error: Tensor  #: standard error of the gain, over blocks of time (k,) [nats]


def estimate_varying_noise(
    model: DynamicsModel, transitions: Transitions, block: int = 20, seed: int = 0
) -> VaryingNoise:
    """Learns how the noise of a model's outputs depends on state and input, where the data show that it does.

    Args:
        model: As for ``estimate_process_noise``; the mean of its next states stays.
        transitions: All rows, in their order of time; a few hundred at least.
        block: Rows that are left out and held out together: more than errors are correlated over.
        seed: Of the rows that are searched.

    Raises:
        ShapeError: The transitions have other dimensions.
        DataError: There are fewer than ten blocks.
        TrainingError: The GP of an output could not be trained.
    """
    errors, latent = (
        part.cpu().double() for part in _residuals(model, transitions, block)
    )
    if len(errors) < 2 * FOLDS * block:
        raise DataError(
            f"a varying noise needs {2 * FOLDS} blocks of {block} rows or more; got {len(errors)} rows"
        )
    squares = errors.square().clamp_min(1e-300)
    features = transitions.features
    m = transitions.input_dim
    fold = torch.arange(len(features)) // block % FOLDS
    constant = _constant(squares, latent)
    z = (squares * constant.exp() / (constant.exp() + latent)).log() + CHI2_LOG[0]
    z = torch.maximum(
        z, constant - 12
    )  # a residual of zero is one of 0.3 % of a standard deviation
    chosen = np.sort(np.random.default_rng(seed).permutation(len(features))[:SEARCHED])
    found = Trainer(penalty=_prior).fit(features[chosen], z[chosen], m, "value", seed)
    start = found.posterior
    kernel = Hyperparameters.from_theta(torch.from_numpy(found.theta))
    Z = features[informative_points(features, kernel, POINTS)]

    def learned(rows: Tensor) -> tuple[GPPosterior, Tensor]:
        """G of some rows, and the logarithm of their constant variance."""
        x = features[rows]
        s = squares[rows]
        v = latent[rows]
        mean = _constant(squares[rows], latent[rows])
        scored = kernel._replace(noise_variance=torch.full_like(mean, 2.0))
        g = start
        for _ in range(ITERATIONS):
            at = g.predict(*x.split([x.shape[1] - m, m], dim=1)).mean
            about_zero = sparse_posterior(
                Z, x, _responses(at, s, v) - mean, scored, m, "value"
            )
            g = replace(about_zero, offset=mean, targets=about_zero.targets + mean)
        return g, mean

    gains = torch.zeros_like(errors)
    for part in range(FOLDS):
        held = fold == part
        g, mean = learned(~held)
        belief = g.predict(transitions.states[held], transitions.inputs[held])
        varying = (belief.mean + belief.variance / 2).exp() + latent[held]
        constant = mean.exp() + latent[held]
        gains[held] = (
            (constant / varying).log() + squares[held] * (1 / constant - 1 / varying)
        ) / 2
    blocks = torch.stack([part.sum(0) for part in gains.split(block)])
    gain = blocks.sum(0)
    error = (len(blocks) * blocks.var(0)).sqrt()
    outputs = tuple(
        torch.nonzero((gain > 2 * error) & (gain > math.log(100)))[:, 0].tolist()
    )
    if not outputs:
        return VaryingNoise(model, outputs, gain, error)
    g = learned(torch.ones_like(fold, dtype=torch.bool))[0]
    at = list(outputs)
    each = (
        "targets",
        "lengthscales",
        "signal_variance",
        "noise_variance",
        "offset",
        "cholesky",
        "weights",
    )
    g = replace(
        g, targets=g.targets[:, at], **{name: getattr(g, name)[at] for name in each[1:]}
    )
    return VaryingNoise(
        NoisyModel(model, g.to(model.device, model.dtype), at), outputs, gain, error
    )


def _constant(squares: Tensor, latent: Tensor) -> Tensor:
    """Logarithm of the most likely constant variances (k,) of residuals."""
    g = squares.mean(0).log()
    for _ in range(10 * ITERATIONS):
        g = _responses(g.expand_as(squares), squares, latent).mean(0)
    return g


def _responses(g: Tensor, squares: Tensor, latent: Tensor) -> Tensor:
    """The working responses z (N, k); one residual moves them by no more than 10."""
    t = g.exp() + latent
    return g + ((squares / t - 1) * g.exp() / t).clamp_max(10.0)


def _prior(theta: np.ndarray, log_std: np.ndarray) -> tuple[float, np.ndarray]:
    """Asks, with its gradient, for the noise of log chi^2_1 within 5 %, and no length-scale far below the spread."""
    noise = (theta[-2] - theta[-1] - math.log(CHI2_LOG[1]) / 2) / 0.05
    short = np.minimum(theta[:-2] - log_std, 0.0) / 0.3
    return (noise**2 + (short**2).sum()) / 2, np.append(
        short / 0.3, [noise / 0.05, -noise / 0.05]
    )
