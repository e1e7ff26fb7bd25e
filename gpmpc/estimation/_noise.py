"""The noise of a process, estimated from a model's residuals over all its data.

A GP's noise variance comes from the evidence of its training rows, which on smooth logs
says too little: errors of one step are correlated with those of the next, and a
flexible mean explains them away. Here it is estimated from residuals of the rows in
their order of time, each predicted without itself and its neighbours,

    e_i = y_i - mu_{-i},    E[e_i^2] = latent variance_i + sigma^2

(in closed form for rows that the posterior was trained on, block by block: Rasmussen
and Williams, 2006, section 5.4.2; a row alone would be explained by its neighbours in
time, whose errors are like its own), with the correlation rho of e_i and e_{i+1}:
errors of an AR(1) process e_{i+1} = rho e_i + w, whose sum over many steps has the
variance of white noise of sigma^2 (1 + rho) / (1 - rho).

Whether the noise depends on state and input, and how, says a GP g on the logarithm of
its variance:

    e_i ~ N(0, t_i),   t_i = latent variance_i + exp g(x_i, u_i)

Hyperparameters of g are found by GP regression on log e_i^2, whose noise is that of log
chi^2_1, of mean -1.27 and variance pi^2 / 2 (Harvey, Ruiz and Shephard, 1994); g is
then the most likely one (as in Kersting, Plagemann, Pfaff and Burgard, 2007), by
regression on working responses

    z_i = g_i + r_i (e_i^2 / t_i - 1),   r_i = exp(g_i) / t_i,   of noise 2,

again and again: where g no longer changes, the gradient of its posterior is zero, and
1/2 is the Fisher information of a row without latent variance (Fisher scoring). Log
e_i^2 alone would take 2.5 times as many rows for the same accuracy. The noise of an
output varies where g of the other four fifths of the blocks of time makes the residuals
of each fifth more likely than a constant variance does, by more than two standard
errors and by a factor of 100.
"""

import math
from collections import defaultdict
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import angles_of, state_difference
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import (
    DynamicsModel,
    check_next_states,
    tensors_for,
    to_array,
)
from gpmpc.exceptions import DataError, ShapeError, UnsupportedModel, check_number
from gpmpc.gaussian import check_tensors
from gpmpc.gp import (
    GPPosterior,
    Hyperparameters,
    Trainer,
    Transitions,
    informative_points,
)
from gpmpc.gp._kernel import kernel_matrix
from gpmpc.gp._sparse import sparse_posterior
from gpmpc.gp._transitions import check_transitions, follows_previous
from gpmpc.models import NoisyModel, ResidualModel
from gpmpc.models._noisy import noise_features
from gpmpc.models._residual_data import effect_matrix
from gpmpc.models._wrapper import LinearWrapper

SEARCHED = 500  # rows of the search, at most
POINTS = 50  # inducing points of g
FOLDS = 5  # parts that are held out
# Of the working responses; from the regression on log e^2 they change g by less than
# 1e-3 then.
ITERATIONS = 15
CHI2_LOG_MEAN = -1.2703628454614782  # of log chi^2_1
CHI2_LOG_VARIANCE = math.pi**2 / 2
_FEWEST_ROWS = 10  # that a noise is estimated from
# difference of two targets at one state and input, in deviations of the noise, up to
# which they may be of one row
_SAME_TARGET = 0.1
_DIGITS = 9  # behind the point, of features that are the same
_SMALLEST_SCALE = 1e-300  # of a feature
_LARGEST_RESPONSE = 10.0  # change of a working response by one residual, at most


@dataclass(frozen=True, eq=False)
class ProcessNoise:
    """The noise of a process, an entry an output.

    See Also:
        ``estimate_process_noise``, which returns it.
    """

    variance: Tensor  #: sigma^2 of a step (k,); zero where nothing was in error
    #: rho, of the noise of a step with the next's (k,); NaN where rows are in no order
    #: of time, or nothing was in error
    correlation: Tensor

    @property
    def long_run_variance(self) -> Tensor:
        """Variance of the white noise whose sum over many steps varies as much (k,).

        sigma^2 (1 + rho) / (1 - rho), of rho between 0 and 0.99: a negative or unknown
        correlation counts as none, and a larger one as 0.99.
        """
        rho = self.correlation.nan_to_num(0.0).clamp(0.0, 0.99)
        return self.variance * (1 + rho) / (1 - rho)


@explains_arguments
def estimate_process_noise(
    model: Any, transitions: Transitions, block: int = 20
) -> ProcessNoise:
    """Estimates the noise of a model's outputs from transitions in their order of time.

    Args:
        model: Predicts next states. Rows that GPs of it were trained on, and rows
            between them, are predicted without their block; those of
            pseudo-observations cannot be.
        transitions: All rows of one log or several; where x[k+1] of a row is not x[k]
            of the next, a new run begins.
        block: Rows that are left out together: more than errors are correlated over.

    Raises:
        ShapeError: The transitions have other dimensions.
        SettingError: The model predicts something else than next states.
        DataError: There are fewer than ten rows.

    >>> from gpmpc.datasets import RandomData
    >>> from gpmpc.gp import Trainer
    >>> from gpmpc.systems import double_integrator
    >>> pushes = RandomData(samples=60, noise=[0.01, 0.01])
    >>> data = pushes.transitions(double_integrator())
    >>> gp = Trainer(predicts="difference", restarts=0)(data[:30]).posterior
    >>> noise = estimate_process_noise(gp, data[30:])
    >>> noise.variance.sqrt().round(decimals=2).tolist()
    [0.01, 0.01]

    See Also:
        ``with_process_noise``, which gives it to GPs; ``separate_noise``.
    """
    errors, latent = residuals(model, transitions, block)
    squares = errors.square()
    variance = (squares - latent).mean(0)
    # A variance of the latent function that is too large leaves something.
    floor = 0.01 * squares.mean(0)
    successive = follows_previous(transitions, angles_of(model)).to(errors.device)
    correlation = torch.full_like(variance, torch.nan)
    if int(successive.sum()) >= _FEWEST_ROWS:
        first = errors[:-1][successive]
        second = errors[1:][successive]
        scale = (first.square().sum(0) * second.square().sum(0)).sqrt()
        correlation = (first * second).sum(0) / scale
    return ProcessNoise(
        variance=torch.maximum(variance, floor), correlation=correlation
    )


@explains_arguments
def with_process_noise(
    posterior: GPPosterior, noise: ProcessNoise | Tensor
) -> GPPosterior:
    """Replaces the noise of GPs, which are factorised anew over their points.

    Args:
        posterior: The GPs.
        noise: The noise, or its variances (k,). Where an estimated one is zero an
            output keeps what it has: its rows show no noise.

    Raises:
        UnsupportedModel: The posterior holds a sparse model's pseudo-observations.
        ShapeError: The number of outputs is another one.
        SettingError: The variances are no tensor, or one is not positive.

    See Also:
        ``estimate_process_noise``, which finds it.
    """
    variance = noise.variance if isinstance(noise, ProcessNoise) else noise
    check_tensors(noise=variance)
    if not isinstance(posterior, GPPosterior) or not posterior.has_observation_noise:
        raise UnsupportedModel(
            "the noise of a GPPosterior of observed rows can be replaced; train a "
            "sparse one again"
        )
    if variance.shape != posterior.noise_variance.shape:
        raise ShapeError(
            f"variances must be ({posterior.output_dim},); got {tuple(variance.shape)}"
        )
    variance = variance.to(posterior.weights)
    if isinstance(noise, ProcessNoise):
        variance = torch.where(variance > 0, variance, posterior.noise_variance)
    return GPPosterior.from_hyperparameters(
        posterior.features,
        posterior.targets,
        lengthscales=posterior.lengthscales,
        signal_variance=posterior.signal_variance,
        noise_variance=variance,
        input_dim=posterior.input_dim,
        predicts=posterior.predicts,
        offset=posterior.offset,
        signals=posterior.signals,
    )


class Residuals(NamedTuple):
    """Errors of a model's outputs, each predicted without its block of rows."""

    errors: Tensor  #: (N, k)
    #: variances of the latent functions without the block (N, k)
    latent: Tensor


def residuals(model: Any, transitions: Transitions, block: int) -> Residuals:
    """Computes the errors of a model's outputs at transitions.

    Args:
        model: Predicts next states. Rows that GPs of it were trained on, and rows
            between them, are predicted without their block; those of
            pseudo-observations cannot be.
        transitions: In their order of time.
        block: Rows that are left out together.

    Raises:
        ShapeError: The transitions have other dimensions.
        SettingError: The model predicts something else than next states.
        DataError: There are fewer than ten rows.
    """
    check_next_states(model)
    check_transitions(transitions, model)
    if len(transitions) < _FEWEST_ROWS:
        raise DataError(f"a noise needs ten rows or more; got {len(transitions)}")
    check_number("block", block, least=1, whole=True)
    x = transitions.states.to(dtype=model.dtype, device=model.device)
    u = transitions.inputs.to(dtype=model.dtype, device=model.device)
    after = transitions.next_states.to(dtype=model.dtype, device=model.device)
    return _residuals_of(model, x, u, after, block)


def _residuals_of(
    model: Any, states: Tensor, inputs: Tensor, next_states: Tensor, block: int
) -> Residuals:
    """Computes the errors of a model, whose GPs may be inside of other models.

    Args:
        model: Predicts next states.
        states: (N, n).
        inputs: (N, m).
        next_states: (N, n).
        block: Rows that are left out together.
    """
    if isinstance(model, NoisyModel):  # its noise is what is asked for
        return _residuals_of(model.model, states, inputs, next_states, block)
    if isinstance(model, LinearWrapper):
        return _residuals_within(model, states, inputs, next_states, block)
    belief = model.predict(states, inputs)
    in_sample = Residuals(
        errors=state_difference(next_states, belief.mean, angles_of(model)),
        latent=belief.variance,
    )
    trained = _trained_gp(model, states, inputs)
    if trained is None:
        return in_sample
    return _leave_out_blocks(trained, block, in_sample)


def _residuals_within(
    model: LinearWrapper,
    states: Tensor,
    inputs: Tensor,
    next_states: Tensor,
    block: int,
) -> Residuals:
    """Computes the errors of a linear model around another; see ``_residuals_of``.

    It says z+ = [f(x, Z z + W u); 0] + L z + M u: f is to explain what the rest leaves.
    """
    n = model.model.state_dim
    Z, W, L, M = tensors_for(model, *model.linear_part)
    unexplained = next_states - states @ L.mT - inputs @ M.mT
    inner = _residuals_of(
        model.model,
        states=states[:, :n],
        inputs=states @ Z.mT + inputs @ W.mT,
        next_states=unexplained[:, :n],
        block=block,
    )
    further = unexplained[:, n:]
    return Residuals(
        errors=torch.cat([inner.errors, further], dim=1),
        latent=torch.cat([inner.latent, torch.zeros_like(further)], dim=1),
    )


def _leave_out_blocks(
    trained: "_TrainedGP", block: int, in_sample: Residuals
) -> Residuals:
    """Returns residuals as if rows that the GPs were trained on had been left out.

    Rows between them, which match no point, are predicted without the points of those
    rows, too: by their neighbours in time errors that hang together would be explained.
    Rows farther than a block from all of them keep their error by all points.

    Args:
        trained: The GPs.
        block: Rows that are left out together.
        in_sample: Residuals of all rows by the GPs with all their points.
    """
    gp = trained.gp
    errors = in_sample.errors.clone()
    latent = in_sample.latent.clone()
    pairs = _rows_and_points(trained, errors)
    block_between = _blocks_of_rows_between(
        pairs[:, 0].contiguous(), len(errors), block
    )
    for index, (rows, points) in enumerate(
        part.unbind(1) for part in pairs.split(block)
    ):
        between = (block_between == index).nonzero()[:, 0]
        change = _change_without_points(trained, between, points)
        effect = trained.effect[between]
        errors[between] += (effect @ change.errors[..., None])[..., 0]
        # Of these the variance by all points is known, of the block's own the one
        # without their points.
        latent[between] += (effect.square() @ change.latent[..., None])[..., 0]
        own_errors = trained.errors_of_points[points]
        left_out_errors = torch.zeros_like(own_errors)
        latent_variances = torch.zeros_like(own_errors)
        for a in range(gp.output_dim):
            covariance = torch.linalg.inv(gp.precision[a][points][:, points])
            left_out_errors[:, a] = covariance @ gp.weights[a, points]
            variances = covariance.diagonal() - trained.noise[a]
            latent_variances[:, a] = variances.clamp_min(0)
        # What no output of the GPs can change is left as it is.
        effect = trained.effect[rows]
        change = left_out_errors - own_errors
        errors[rows] += (effect @ change[..., None])[..., 0]
        latent[rows] = (effect.square() @ latent_variances[..., None])[..., 0]
    return Residuals(errors=errors, latent=latent)


def _blocks_of_rows_between(matched: Tensor, count: int, block: int) -> Tensor:
    """Finds the block of matched rows beside each row that matches no point (count,).

    It is that of the nearest matched row; -1 of rows that match, and of those that are
    farther than a block from all that do.
    """
    blocks = torch.full((count,), -1, device=matched.device)
    if not len(matched):
        return blocks
    rows = torch.arange(count, device=matched.device)
    after = torch.searchsorted(matched, rows).clamp_max(len(matched) - 1)
    before = (after - 1).clamp_min(0)
    is_after_nearer = (matched[after] - rows).abs() < (matched[before] - rows).abs()
    nearest = torch.where(is_after_nearer, after, before)
    distance = (matched[nearest] - rows).abs()
    is_between = (distance > 0) & (distance <= block)
    return torch.where(is_between, nearest // block, blocks)


def _change_without_points(
    trained: "_TrainedGP", rows: Tensor, points: Tensor
) -> Residuals:
    """Returns what errors and variances of the GPs (R, k) at rows change by.

    That is where some points S are left out: with k the covariances of a row with all
    points, P the inverse of those of the targets and g = P[S] k,

        error + g' P[S, S]^-1 weights[S],   variance + g' P[S, S]^-1 g
    """
    gp = trained.gp
    covariances = kernel_matrix(
        trained.features[rows], gp.features, gp.lengthscales, gp.signal_variance
    )
    errors = []
    variances = []
    for a in range(gp.output_dim):
        gains = covariances[a] @ gp.precision[a][:, points]
        weighted = torch.linalg.solve(gp.precision[a][points][:, points], gains.mT).mT
        errors.append(weighted @ gp.weights[a, points])
        variances.append((weighted * gains).sum(-1))
    return Residuals(torch.stack(errors, dim=-1), torch.stack(variances, dim=-1))


def _rows_and_points(trained: "_TrainedGP", errors: Tensor) -> Tensor:
    """Finds the rows that the GPs were trained on, and the point that each became.

    Several rows may have equal states and inputs, as those of a plant at rest: each is
    a point of its own, the one with its target. (In units of the noise: a target that
    differs by less than ``_SAME_TARGET`` says the same.)

    Args:
        trained: The GPs.
        errors: Of the rows, by the GPs with all their points (N, n).

    Returns:
        Indices of rows and points (pairs, 2), in the order of the rows.
    """
    gp = trained.gp
    inverse = torch.linalg.pinv(trained.effect)
    deviations = trained.noise.sqrt()
    row_errors = to_array((inverse @ errors[..., None])[..., 0] / deviations)
    # B^+ B / sd (N, k, k): a row with effect B shows no more of a point's errors.
    visible = to_array(inverse @ trained.effect / deviations[:, None])
    point_errors = to_array(trained.errors_of_points)
    scale = gp.features.abs().amax(dim=0).clamp_min(_SMALLEST_SCALE)
    points_at = defaultdict(list)
    for point, features in enumerate(_rounded(gp.features / scale)):
        points_at[tuple(features)].append(point)
    pairs = []
    for row, features in enumerate(_rounded(trained.features / scale)):
        candidates = points_at[tuple(features)]
        if not candidates:
            continue
        candidate_errors = point_errors[candidates] @ visible[row].T
        distances = np.abs(candidate_errors - row_errors[row]).max(axis=1)
        nearest = int(distances.argmin())
        if distances[nearest] <= _SAME_TARGET:
            pairs.append((row, candidates.pop(nearest)))
    device = errors.device
    return torch.tensor(pairs, dtype=torch.long, device=device).reshape(-1, 2)


def _rounded(features: Tensor) -> list[list[float]]:
    """Rounds features (N, d) of about one, which round-off then leaves the same.

    A mean of two inputs, as a fractional delay has it, is not the same to the bit.
    """
    return features.round(decimals=_DIGITS).tolist()


class _TrainedGP(NamedTuple):
    """The GPs of a model that observed rows have trained, and how they act."""

    gp: GPPosterior
    noise: Tensor  #: variances of the targets (k,)
    features: Tensor  #: what they see of states and inputs (N, d)
    effect: Tensor  #: B, by which they act on the states of each row (N, n, k)

    @property
    def errors_of_points(self) -> Tensor:
        """Errors of the targets by the GPs with all their points (points, k)."""
        return (self.noise[:, None] * self.gp.weights).mT


def _trained_gp(model: Any, states: Tensor, inputs: Tensor) -> _TrainedGP | None:
    """Finds the GPs of a model.

    None where there are none, or they hold pseudo-observations.
    """
    if isinstance(model, GPPosterior):
        gp = model
        effect = torch.eye(gp.output_dim, dtype=gp.dtype, device=gp.device)
        features = torch.cat([states, inputs], dim=1)
    elif isinstance(model, ResidualModel):
        gp = model.residual
        effect = effect_matrix(model.B, states)
        features = torch.cat(model.features(states, inputs), dim=1)
    else:
        return None
    if not isinstance(gp, GPPosterior) or gp.observation_noise is None:
        return None
    effect = effect.expand(len(states), *effect.shape[-2:])
    return _TrainedGP(gp, gp.observation_noise, features, effect)


@dataclass(frozen=True, eq=False)
class VaryingNoise:
    """The outputs whose noise varies, and the model that predicts it.

    See Also:
        ``estimate_varying_noise``, which returns it.
    """

    #: a ``NoisyModel``; the model inside where no output's noise varies
    model: Any
    outputs: tuple[int, ...]  #: whose noise varies
    #: log likelihood of held-out residuals less that under a constant variance (k,)
    #: [nats]
    gain: Tensor
    error: Tensor  #: standard error of the gain, over blocks of time (k,) [nats]


@explains_arguments
def estimate_varying_noise(
    model: DynamicsModel, transitions: Transitions, block: int = 20, seed: int = 0
) -> VaryingNoise:
    """Learns how the noise of a model's outputs depends on state and input.

    It does so for the outputs whose data show that it depends on them.

    Args:
        model: As for ``estimate_process_noise``; the mean of its next states stays. The
            noise of a ``NoisyModel`` is learned anew.
        transitions: All rows, in their order of time; a few hundred at least.
        block: Rows that are left out and held out together: more than errors are
            correlated over.
        seed: Of the rows that are searched.

    Raises:
        ShapeError: The transitions have other dimensions.
        DataError: There are fewer than ten blocks.
        TrainingError: The GP of an output could not be trained.

    See Also:
        ``gpmpc.models.NoisyModel``, which it makes.
    """
    if isinstance(model, NoisyModel):
        model = model.model
    left_out = residuals(model, transitions, block)
    errors = left_out.errors.cpu().double()
    latent = left_out.latent.cpu().double()
    if len(errors) < 2 * FOLDS * block:
        raise DataError(
            f"a varying noise needs {2 * FOLDS} blocks of {block} rows or more; "
            f"got {len(errors)} rows"
        )
    squares = errors.square().clamp_min(1e-300)
    features = noise_features(model)(transitions.states, transitions.inputs)
    states, inputs = (part.cpu() for part in features)
    learner = _VarianceLearner.from_log_squares(states, inputs, squares, latent, seed)
    fold = torch.arange(len(squares)) // block % FOLDS
    gains = torch.zeros_like(errors)
    for part in range(FOLDS):
        held_out = fold == part
        gains[held_out] = learner.learn(~held_out).gain_over_constant(
            states[held_out],
            inputs[held_out],
            squares[held_out],
            latent[held_out],
        )
    block_gains = torch.stack([rows.sum(0) for rows in gains.split(block)])
    gain = block_gains.sum(0)
    error = (len(block_gains) * block_gains.var(0)).sqrt()
    varies = (gain > 2 * error) & (gain > math.log(100))
    outputs = torch.nonzero(varies)[:, 0].tolist()
    if not outputs:
        return VaryingNoise(model=model, outputs=(), gain=gain, error=error)
    g = learner.learn(torch.ones_like(fold, dtype=torch.bool)).gp
    g = replace(
        g,
        targets=g.targets[:, outputs],
        lengthscales=g.lengthscales[outputs],
        signal_variance=g.signal_variance[outputs],
        noise_variance=g.noise_variance[outputs],
        offset=g.offset[outputs],
        cholesky=g.cholesky[outputs],
        weights=g.weights[outputs],
    )
    noisy = NoisyModel(model, g.to(model.device, model.dtype), outputs)
    return VaryingNoise(model=noisy, outputs=tuple(outputs), gain=gain, error=error)


class _LogVariance(NamedTuple):
    """The logarithm of a noise variance, as GPs and as constants."""

    gp: GPPosterior  #: g
    constant: Tensor  #: (k,)

    def gain_over_constant(
        self, states: Tensor, inputs: Tensor, squares: Tensor, latent: Tensor
    ) -> Tensor:
        """Computes by how much g makes residuals more likely than the constants.

        Args:
            states: (N, n).
            inputs: (N, m).
            squares: Squared residuals (N, k).
            latent: Variances of the latent functions (N, k).

        Returns:
            Log likelihood less that of the constants (N, k).
        """
        belief = self.gp.predict(states, inputs)
        varying = (belief.mean + belief.variance / 2).exp() + latent
        constant = self.constant.exp() + latent
        fit = squares * (1 / constant - 1 / varying)
        return ((constant / varying).log() + fit) / 2


class _VarianceLearner(NamedTuple):
    """Learns g from some of the rows, with hyperparameters from all of them."""

    features: Tensor  #: (N, d)
    input_dim: int  #: m
    squares: Tensor  #: squared residuals (N, k)
    latent: Tensor  #: variances of the latent functions (N, k)
    kernel: Hyperparameters  #: of g
    inducing: Tensor  #: inducing points of g (M, d)
    #: g from the regression on log e^2, where iterations begin
    initial_gp: GPPosterior

    @classmethod
    def from_log_squares(
        cls,
        states: Tensor,
        inputs: Tensor,
        squares: Tensor,
        latent: Tensor,
        seed: int,
    ) -> "_VarianceLearner":
        """Finds hyperparameters by GP regression on log e^2.

        Args:
            states: (N, n).
            inputs: (N, m).
            squares: Squared residuals (N, k).
            latent: Variances of the latent functions (N, k).
            seed: Of the rows that are searched.
        """
        features = torch.cat([states, inputs], dim=1)
        m = inputs.shape[1]
        constant = _constant_log_variance(squares, latent)
        total = constant.exp() + latent
        responses = (squares * constant.exp() / total).log() - CHI2_LOG_MEAN
        # A residual of zero is one of 0.3 % of a standard deviation.
        responses = torch.maximum(responses, constant - 12)
        rng = np.random.default_rng(seed)
        rows = np.sort(rng.permutation(len(features))[:SEARCHED])
        training = Trainer(penalty=_prior_penalty).fit(
            features[rows], responses[rows], m, predicts="value", seed=seed
        )
        kernel = Hyperparameters.from_theta(torch.from_numpy(training.theta))
        return cls(
            features=features,
            input_dim=m,
            squares=squares,
            latent=latent,
            kernel=kernel,
            inducing=features[informative_points(features, kernel, POINTS)],
            initial_gp=training.posterior,
        )

    def learn(self, rows: Tensor) -> _LogVariance:
        """Learns g from some rows (N,) by Fisher scoring."""
        x = self.features[rows]
        squares = self.squares[rows]
        latent = self.latent[rows]
        constant = _constant_log_variance(squares, latent)
        kernel = self.kernel._replace(noise_variance=torch.full_like(constant, 2.0))
        states, inputs = x.split([x.shape[1] - self.input_dim, self.input_dim], dim=1)
        g = self.initial_gp
        for _ in range(ITERATIONS):
            current = g.predict(states, inputs).mean
            about_zero = sparse_posterior(
                self.inducing,
                x,
                _working_responses(current, squares, latent) - constant,
                kernel,
                input_dim=self.input_dim,
                predicts="value",
            )
            g = replace(
                about_zero, offset=constant, targets=about_zero.targets + constant
            )
        return _LogVariance(gp=g, constant=constant)


def _constant_log_variance(squares: Tensor, latent: Tensor) -> Tensor:
    """Finds the logarithm of the most likely constant variances (k,) of residuals."""
    g = squares.mean(0).log()
    for _ in range(10 * ITERATIONS):
        g = _working_responses(g.expand_as(squares), squares, latent).mean(0)
    return g


def _working_responses(g: Tensor, squares: Tensor, latent: Tensor) -> Tensor:
    """Computes the working responses z (N, k)."""
    total = g.exp() + latent
    change = (squares / total - 1) * g.exp() / total
    return g + change.clamp_max(_LARGEST_RESPONSE)


def _prior_penalty(theta: np.ndarray, log_std: np.ndarray) -> tuple[float, np.ndarray]:
    """Asks, with its gradient, for a plausible noise and length-scales.

    ``theta`` holds log length-scales, log signal deviation, log signal to noise.

    The noise is that of log chi^2_1 within 5 %, and no length-scale is far below the
    standard deviation of its input.
    """
    expected = math.log(CHI2_LOG_VARIANCE) / 2
    noise = (theta[-2] - theta[-1] - expected) / 0.05
    short = np.minimum(theta[:-2] - log_std, 0.0) / 0.3
    value = (noise**2 + (short**2).sum()) / 2
    return value, np.append(short / 0.3, [noise / 0.05, -noise / 0.05])
