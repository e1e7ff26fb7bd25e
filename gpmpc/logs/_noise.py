"""Noise of a model of a log, from the errors of its rollouts.

To first order the error of a rollout after k steps is the sum of the responses to the
noise of every output at every step and to the error of the measured start. So its
variance is linear in the variances of the sources, here for each output white noise and
first-order autoregressions with a few time constants, and for each measured entry white
measurement noise. Non-negative least squares on the mean squared errors at several
steps find the variances. Errors one step ahead alone, on filtered rows, would
understate them many times.

A controller's tube has no more than white noise and an uncertain start; both are fitted
to the same errors, but of rollouts that begin at a row as it was measured.
"""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear, nnls

from gpmpc._dynamics import Array
from gpmpc.logs._fitting import rows_before
from gpmpc.logs._log import Log
from gpmpc.logs._ranges import difference_steps, widths_of
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._log_dynamics import TIME_CONSTANTS, OutputNoise, TubeNoise
from gpmpc.models._log_model import DIVERGED, LogModel
from gpmpc.models._windows import Windows

_STEPS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50)  # whose errors are explained,
_FAR_STEPS = (70, 100, 150, 200, 300, 500)  # and of longer rollouts; the last step too
_WINDOWS = 2000  # of all folds, whose errors count
_COMPARED = 250  # of a log, on which models of more and of fewer rows are compared
_LINEARIZED = 400  # of all folds, along which rollouts are linearised: these are slow
_LINEARIZED_WITH_MEMORY = 120  # likewise of models with many entries to carry on
_STRIDE_WITH_MEMORY = 8  # of the windows that are linearised of these
_DIFFERENCE_OF_OUTPUTS = 1e-4  # of their ranges: in them a step is linear
_LARGEST_CLAIM = 9.0  # of the mean squared error: the variance claimed at most
_STRETCHES = 16  # of the held-out rows, one after the other,
_USUAL_STRETCHES = 8  # to each of which one may err more than any other, and counts
_RAREST_ERROR = 3.0  # times the mean squared error of the next one at most
_WINDOWS_PER_STRETCH = 4  # at least
_LEAST_FREEDOM = 4.0  # independent errors that a variance is supposed to be of
_CUTS = 8  # rounds in which what is cut off is made up for
_SMALLEST_VARIANCE = 1e-300  # that anything is divided by
_SCORING_ROUNDS = 20  # in which the noise of a tube is fitted
_LEAST_CLAIM = 0.02  # of the mean squared error: the variance claimed at least in these
_LEAST_SHARE = 0.01  # of a claimed variance that a source of a tube's noise has
#: time constant with which the weight of an earlier error decays, in multiples of the
#: time of the longest prediction
_FORGETTING = 6.0
#: weight of the claim itself, as of errors that are as large as claimed: this share of
#: the rows of a prediction,
_PRIOR = 0.5
_LEAST_PRIOR = 20  # or so many rows


def error_variances(
    model: LogModel, windows: Windows, noise: OutputNoise, steps: Sequence[int]
) -> Array:
    """Computes the variances (W, steps, e) of a model's errors.

    Args:
        model: With its parameters.
        windows: W of them, from whose starts is predicted.
        noise: Of the model.
        steps: After the starts.
    """
    variances = np.concatenate([noise.outputs.ravel(), noise.measurement])
    stride = 1 if model.memory.empty else _STRIDE_WITH_MEMORY
    # Neighbours respond alike.
    responses = _responses(model, windows[::stride], steps, noise.time_constants)
    explained = responses @ variances * noise.scales_at(steps)
    # Where a linearised rollout is not finite, it claims the most.
    explained = np.fmin(explained, noise.largest_at(steps))
    return np.repeat(explained, stride, axis=0)[: len(windows)]


def tube_variances(
    model: LogModel, windows: Windows, tube: TubeNoise, steps: Sequence[int]
) -> Array:
    """Computes the variances (W, steps, e) of a controller's tube.

    Args:
        model: With its parameters.
        windows: W of them, at whose starts it begins.
        tube: Its noise.
        steps: After the starts.
    """
    white, by_start = _of_tube(_flown_responses(model, windows, steps))
    return white @ tube.outputs + by_start @ tube.start


def as_flown(model: LogModel) -> LogModel:
    """Returns the model whose rollouts begin at a row and go on uncorrected.

    A controller plans so. Its own estimate of a disturbance takes the place of the
    model's, which stays.
    """
    if model.start_filter is None and model.correction is None:
        return model
    return replace(model, start_filter=None, correction=None)


def _flown_responses(model: LogModel, windows: Windows, steps: Sequence[int]) -> Array:
    """Computes the responses of a tube: to white noise and to measurements.

    A controller linearises the model without the disturbance, which it adds to the
    next states.
    """
    undisturbed = replace(as_flown(model), history=(0,) * len(model.history))
    return _responses(undisturbed, windows, steps, time_constants=(0.0,))


def _of_tube(responses: Array) -> tuple[Array, Array]:
    """Splits responses of a tube: to the outputs' noise, and to that of the start.

    What is measured where a prediction ends is no part of the second.
    """
    e = responses.shape[-2]
    return responses[..., :-e], responses[..., -e:] - np.eye(e)


def follow_errors(
    windows: Windows,
    errors: Array,
    variances: Array,
    steps: Sequence[int],
    longest: int = 0,
) -> Array:
    """Scales claimed variances by the errors of earlier predictions of the same run.

    A run may be calmer or rougher than those that the noise was fitted to. For each
    entry of the state and each step the scale is the mean of squared errors over
    claimed variances of the predictions that were over before, weighted by exp(-age /
    (6 T)), with T the time of the longest prediction, and by the claimed deviations
    (adaptive conformal inference by variances instead of quantiles; Gibbs and Candes,
    2021). Without the deviations, moments where little was claimed would decide; with
    the variances, only those where much was. A one is added with the weight of half a
    prediction's rows, 20 at least: errors k steps ahead are alike over k rows, and a
    run shows soon how large those one step ahead are.

    Args:
        windows: W of them.
        errors: Of predictions (W, steps, e).
        variances: Claimed (W, steps, e).
        steps: After the starts of the windows.
        longest: Steps of the longest prediction, where that is none of these.

    Returns:
        The scaled variances (W, steps, e).
    """
    longest_time = max(*steps, longest) * windows.time_step  # [s]
    # From one prediction to the next; pauses between pieces are no part of it.
    spacing = windows.stride * windows.time_step  # [s]
    scaled = variances.copy()
    for run in np.unique(windows.runs):
        rows = np.flatnonzero(windows.runs == run)
        times = windows.times[rows]
        for k, step in enumerate(steps):
            prior_time = max(_PRIOR * step, _LEAST_PRIOR) * windows.time_step  # [s]
            # A prediction that is just over has the age of half a step.
            age = times[:, None] - times - (step - 0.5) * windows.time_step
            decay = np.exp(-np.maximum(age, 0) / (_FORGETTING * longest_time))
            weights = np.where(age > 0, spacing * decay, 0.0)  # [s]
            deviations = np.sqrt(np.maximum(variances[rows, k], _SMALLEST_VARIANCE))
            prior = prior_time * deviations
            actual = prior + weights @ (errors[rows, k] ** 2 / deviations)
            scaled[rows, k] *= actual / (prior + weights @ deviations)
    return scaled


class _FoldErrors(NamedTuple):
    """Errors of the windows of one fold."""

    squared: Array  # of rollouts (W, steps, e)
    squared_flown: Array  # of rollouts that begin at a row, uncorrected (W, steps, e)
    responses: Array  # to the sources, of fewer windows (V, steps, e, sources)
    # To white noise and the measurements alone, of the model that a controller has.
    flown_responses: Array
    squared_residuals: Array  # of outputs one step ahead (W, o)


def noise_steps(longest: int) -> list[int]:
    """Returns the steps ahead whose errors the noise explains.

    Args:
        longest: Steps of the rollouts.
    """
    steps = [step for step in _STEPS if step <= longest]
    if longest > _STEPS[-1]:
        steps += [*(step for step in _FAR_STEPS if step < longest), longest]
    return steps


def fit_noise(
    models: Sequence[LogModel],
    logs: Sequence[Log],
    steps: Sequence[int],
    gains: Array | float = 1.0,
    flown_gains: Array | float = 1.0,
) -> OutputNoise:
    """Fits the noise that explains the errors of rollouts on held-out runs.

    Where these do not tell the outputs of a group apart, as x from y while the heading
    turns, the outputs share as the squares of their residuals one step ahead do. What
    the sources leave unexplained, or explain twice, becomes a scale of the variances of
    each group of states and step.

    Args:
        models: One for each fold.
        logs: The runs that the model of each fold was not fitted to.
        steps: Of ``noise_steps``.
        gains: By which a model of all rows errs less (steps, e): factors of squares.
        flown_gains: Likewise of rollouts as a controller makes them.
    """
    linearized = _LINEARIZED if models[0].memory.empty else _LINEARIZED_WITH_MEMORY
    folds = [
        _fold_errors(
            model=model,
            log=log,
            steps=steps,
            most=_WINDOWS // len(models),
            linearized=linearized // len(models),
        )
        for model, log in zip(models, logs, strict=True)
    ]
    squared = _usual_mean(np.concatenate([fold.squared for fold in folds]))
    by_window = np.concatenate([fold.responses for fold in folds])
    responses = by_window.mean(axis=0)
    residuals = np.concatenate([fold.squared_residuals for fold in folds]).mean(axis=0)
    # Of each error, by a unit variance of each source (steps e, sources).
    shares = responses / np.maximum(squared, _SMALLEST_VARIANCE)[..., None]
    shares = shares.reshape(-1, responses.shape[-1])
    finite = np.where(np.isfinite(shares), shares, 0.0)
    # Each source is scaled so that its largest share of an error is one.
    largest_share = np.maximum(finite.max(axis=0), _SMALLEST_VARIANCE)
    sharing = _sharing_rows(
        models[0], largest_share, residuals, time_constants=len(TIME_CONSTANTS)
    )
    regressors = np.vstack([shares / largest_share, sharing])
    targets = np.r_[np.ones(len(shares)), np.zeros(len(sharing))]
    variances = _nonnegative_solution(regressors, targets) / largest_share
    output_sources = len(TIME_CONSTANTS) * len(residuals)
    largest = np.maximum(_LARGEST_CLAIM * squared, _SMALLEST_VARIANCE)
    kinematics = models[0].kinematics
    rows = sum(len(log) for log in logs)
    student_factors = _student_factors(rows, steps)[:, None]
    squared_flown = _mean_of_finite([fold.squared_flown for fold in folds])
    flown_responses = np.concatenate([fold.flown_responses for fold in folds])
    near = sum(step <= _STEPS[-1] for step in steps)  # as far as controllers plan
    noise = OutputNoise(
        outputs=variances[:output_sources].reshape(len(TIME_CONSTANTS), -1),
        measurement=variances[output_sources:],
        steps=tuple(steps),
        scales=_scales(kinematics, squared, by_window @ variances, largest),
        largest=largest,
        tube=_fit_tube(
            model=models[0],
            squared=(flown_gains * student_factors * squared_flown)[:near],
            responses=flown_responses.mean(axis=0)[:near],
            residuals=residuals,
            steps=steps[:near],
        ),
    )
    return noise.scaled(gains * student_factors)


def _fit_tube(
    model: LogModel,
    squared: Array,
    responses: Array,
    residuals: Array,
    steps: Sequence[int],
) -> TubeNoise:
    """Fits the noise of a controller's tube to the errors of held-out rollouts.

    White noise and an uncertain start have to do for all that an ``OutputNoise`` has;
    the noise of the row where a prediction ends is in that of the start. The variances
    are those under which the errors are most likely, by Fisher's scoring: least squares
    of the squared errors, in units of the variances that were claimed before. In units
    of the squared errors themselves, to claim nothing would cost no more than to claim
    twice too much.

    Args:
        model: Has the groups.
        squared: Mean squared errors of rollouts that begin at a row (steps, e).
        responses: Those of a tube (steps, e, o + e).
        residuals: Mean squared residuals of the outputs (o,).
        steps: Ahead.
    """
    o = len(residuals)
    e = squared.shape[1]
    regressors = np.concatenate(_of_tube(responses), axis=-1).reshape(-1, o + e)
    targets = squared.ravel()
    # Roots of weights: what least squares squares.
    weights = np.repeat(_step_weights(steps) ** 0.5, e)
    usable = np.isfinite(targets) & np.isfinite(regressors).all(axis=1)
    regressors = regressors[usable]
    weights = weights[usable]
    targets = np.maximum(targets[usable], _SMALLEST_VARIANCE)
    claimed = targets
    variances = np.zeros(o + e)
    for _ in range(_SCORING_ROUNDS):
        units = weights / claimed
        shares = regressors * units[:, None]
        largest_share = np.maximum(shares.max(axis=0, initial=0.0), _SMALLEST_VARIANCE)
        sharing = _sharing_rows(model, largest_share, residuals, time_constants=1)
        scaled = _nonnegative_solution(
            np.vstack([shares / largest_share, sharing]),
            np.r_[targets * units, np.zeros(len(sharing))],
        )
        # A filter of a model without any noise would hear no sensor.
        variances = np.maximum(scaled, _LEAST_SHARE) / largest_share
        claimed = np.maximum(regressors @ variances, _LEAST_CLAIM * targets)
    return TubeNoise(outputs=variances[:o], start=variances[o:])


def _step_weights(steps: Sequence[int]) -> Array:
    """Returns how much each step ahead counts in a likelihood (steps,).

    It is the root of the number of steps that it stands for. Were each of these to
    count alike, tubes of coloured noise would be many times too wide one step ahead;
    were each doubling, too narrow at the last one.
    """
    if len(steps) < 2:
        return np.ones(len(steps))
    weights = np.sqrt(np.gradient(steps))
    return weights / weights.max()


def _mean_of_finite(squared: Sequence[Array]) -> Array:
    """Averages squared errors (W, steps, e) over all rollouts that did not diverge.

    Infinite where all of them did.
    """
    errors = np.concatenate(squared)
    return _usual_mean(np.where(errors < DIVERGED**2, errors, np.nan))


def _usual_mean(squared: Array) -> Array:
    """Averages squared errors (W, steps, e) so that a rare wild stretch counts little.

    A vehicle whose heading comes from its movement has none before it starts. An
    interval as wide as such an error would be too wide ever after. Where there are
    fewer than eight stretches, all count.

    Args:
        squared: Of windows, those of a run one after the other. NaN does not count;
            the mean is infinite where there is nothing else.
    """
    stretches = max(min(_STRETCHES, len(squared) // _WINDOWS_PER_STRETCH), 1)
    parts = np.array_split(squared, stretches)
    counts = np.array([np.sum(~np.isnan(part), axis=0) for part in parts])
    sums = np.array([np.nansum(part, axis=0) for part in parts])
    means = sums / np.maximum(counts, 1)
    rare_stretches = stretches // _USUAL_STRETCHES
    if rare_stretches:
        largest_usual = np.sort(means, axis=0)[-1 - rare_stretches]
        capped = np.minimum(means, _RAREST_ERROR * largest_usual)
        means = np.where(largest_usual > 0, capped, means)
    count = counts.sum(axis=0)
    total = (counts * means).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.inf)


def _nonnegative_solution(regressors: Array, targets: Array) -> Array:
    """Solves a least squares (R, v) of numbers that are not negative (v,).

    Rows of rollouts whose linearisation is not finite do not count.
    """
    is_finite = np.isfinite(regressors).all(axis=1)
    regressors = regressors[is_finite]
    targets = targets[is_finite]
    try:
        return nnls(regressors, targets)[0]
    except RuntimeError:  # too many iterations
        return np.maximum(lsq_linear(regressors, targets, (0, np.inf)).x, 0.0)


def _student_factors(rows: int, steps: Sequence[int]) -> Array:
    """Returns factors (steps,) of variances that few independent errors estimate.

    They are those of Student's t distribution, whose degrees of freedom are the
    predictions that do not overlap.
    """
    freedom = np.maximum(rows / np.asarray(steps), _LEAST_FREEDOM)
    return freedom / (freedom - 2)


def learning_gains(
    fewer: Sequence[LogModel],
    models: Sequence[LogModel],
    logs: Sequence[Log],
    steps: Sequence[int],
    exponent: float,
) -> Array:
    """Estimates by what factor squared errors (steps, e) fall with the rows to come.

    A model of all rows errs less than those that held some out. How much less, the
    errors of models of fewer rows say, upon a power law of the number of rows
    (Cortes et al., 1993, Learning curves). With g the mean logarithm over the held-out
    logs and s its standard error, as much as g^2 / (g^2 + s^2) of it is taken.

    Args:
        fewer: Models of fewer rows, one for each log.
        models: Models of more rows, likewise.
        logs: The runs that neither was fitted to.
        steps: After the starts.
        exponent: Logarithm of the rows to come over that of the rows that the one model
            has more than the other.
    """
    ratios = []
    for few, model, log in zip(fewer, models, logs, strict=True):
        windows = log.windows(
            max(steps), past=max(map(rows_before, (few, model))), most=_COMPARED
        )
        squared = [
            np.square(one.rollout_errors(windows, steps)).mean(axis=0)
            for one in (few, model)
        ]
        ratios.append(np.log(_group_ratios(model.kinematics, squared[1], squared[0])))
    gain = np.minimum(np.mean(ratios, axis=0), 0.0)
    variance = np.var(ratios, axis=0, ddof=1) / len(ratios)
    agreement = gain**2 / np.maximum(gain**2 + variance, _SMALLEST_VARIANCE)
    return np.exp(exponent * agreement * gain)


def _scales(
    kinematics: Kinematics, squared: Array, explained: Array, largest: Array
) -> Array:
    """Computes factors (steps, e) with which variances explain squared errors.

    Along a rollout that is barely stable, the linearisation may explain a thousand
    times what it does elsewhere: variances are cut off, and the others make up for it.

    Args:
        kinematics: Have the groups, each of which has one factor.
        squared: Mean squared errors (steps, e).
        explained: Variances by window (V, steps, e).
        largest: Variances at which they are cut off (steps, e).
    """
    scales = _group_ratios(kinematics, squared, explained.mean(axis=0))
    for _ in range(_CUTS):
        claimed = np.fmin(scales * explained, largest).mean(axis=0)
        scales = scales * _group_ratios(kinematics, squared, claimed)
    return scales


def _group_ratios(kinematics: Kinematics, squared: Array, claimed: Array) -> Array:
    """Computes squared errors over claimed variances (steps, e), by group."""
    ratios = np.ones_like(squared)
    for columns in kinematics.space.error_columns:
        actual = squared[:, columns].sum(axis=1, keepdims=True)
        total = claimed[:, columns].sum(axis=1, keepdims=True)
        ratios[:, columns] = np.where(
            (np.minimum(actual, total) > 0) & np.isfinite(total),
            actual / np.maximum(total, _SMALLEST_VARIANCE),
            1.0,
        )
    return ratios


def _fold_errors(
    model: LogModel, log: Log, steps: Sequence[int], most: int, linearized: int
) -> _FoldErrors:
    """Computes the errors of a fold, and its responses to the sources of noise.

    Args:
        model: That was not fitted to the log.
        log: Held-out runs.
        steps: After the starts.
        most: Number of windows, about.
        linearized: Number of windows along which rollouts are linearised, about.
    """
    windows = log.windows(max(steps), past=rows_before(model), most=most)
    stride = -(-len(windows) // linearized)
    measured, modelled = model.first_outputs(windows)
    squared = np.square(model.rollout_errors(windows, steps))
    flown = as_flown(model)
    squared_flown = squared
    if flown is not model:
        squared_flown = np.square(flown.rollout_errors(windows, steps))
    responses = _responses(model, windows[::stride], steps, TIME_CONSTANTS)
    outputs = measured.shape[1]
    others = slice(outputs, len(TIME_CONSTANTS) * outputs)
    flown_responses = np.delete(responses, others, axis=-1)
    if any(model.history):
        flown_responses = _flown_responses(model, windows[::stride], steps)
    return _FoldErrors(
        squared=squared,
        squared_flown=squared_flown,
        responses=responses,
        flown_responses=flown_responses,
        squared_residuals=np.square(measured - modelled),
    )


def _sharing_rows(
    model: LogModel, scales: Array, residuals: Array, time_constants: int
) -> Array:
    """Returns rows of least squares by which the outputs of a group share.

    They are zero where the variances of two outputs share as the residuals do.

    Args:
        model: Has the groups.
        scales: Of each source's variance in the least squares (sources,).
        residuals: Mean squared residuals of the outputs (o,).
        time_constants: Number of those, for each of which outputs are sources.
    """
    rows = []
    o = len(residuals)
    for first_source in range(0, time_constants * o, o):
        for group in model.kinematics.output_groups.values():
            for i, j in itertools.pairwise(group):
                pair = [first_source + i, first_source + j]
                floored = np.maximum(residuals[[i, j]], _SMALLEST_VARIANCE)
                scale = scales[pair] * floored
                row = np.zeros(len(scales))
                row[pair] = scale.min() / scale * [1.0, -1.0]
                rows.append(row)
    return np.array(rows).reshape(-1, len(scales))


def _responses(
    model: LogModel,
    windows: Windows,
    steps: Sequence[int],
    time_constants: Sequence[float],
) -> Array:
    """Computes the variances of errors by a unit variance of every source.

    One pass from the last step to the first carries the derivatives of the state at
    each of the steps by what the model carries on, and sums what each source adds.

    Args:
        model: Whose rollouts are linearised.
        windows: W of them, along which they are.
        steps: After the starts.
        time_constants: Of the noise of every output [rows].

    Returns:
        (W, steps, e, sources), the sources those of the outputs by time constant, then
        the measurements.
    """
    W = len(windows)
    e = windows.space.error_dim
    o = len(model.kinematics.output_names)
    disturbance = model.disturbance(windows)
    carried = model.rollout_carried(windows, max(steps))
    E = carried.shape[-1] - windows.space.dim + e
    difference_lengths = _difference_steps(model, windows, carried[:, 0])
    by_start = np.zeros((W, len(steps), e, E))
    # tails[t] = sum over j > k of rho^(j - k) G_j
    tails = np.zeros((len(time_constants), W, len(steps), e, o))
    sums = np.zeros_like(tails)
    rhos = [np.exp(-1 / max(constant, 1e-9)) for constant in time_constants]
    for k in range(max(steps) - 1, -1, -1):
        A, B = _linearized_step(
            model, windows, k, carried[:, k], disturbance, difference_lengths
        )
        for s, step in enumerate(steps):
            if step == k + 1:
                by_start[:, s] = np.eye(e, E)
        flat = by_start.reshape(W, -1, E)
        G = (flat @ B).reshape(W, len(steps), e, o)
        by_start = (flat @ A).reshape(by_start.shape)
        for t, rho in enumerate(rhos):  # the sum over i, j of rho^|i - j| G_i G_j
            sums[t] += G * (G + 2 * tails[t])
            tails[t] = rho * (tails[t] + G)
    output_sources = len(time_constants) * o
    responses = np.empty((W, len(steps), e, output_sources + e))
    for t, total in enumerate(sums):
        responses[..., t * o : (t + 1) * o] = total
    responses[..., output_sources:] = np.square(by_start[..., :e]) + np.eye(e)
    return responses


class _DifferenceSteps(NamedTuple):
    """By how much a step is displaced to differentiate it."""

    carried: Array  # errors of states, and what is carried on (E,)
    outputs: Array  # (o,)


def _difference_steps(
    model: LogModel, windows: Windows, carried: Array
) -> _DifferenceSteps:
    """Returns small shares of the ranges that windows have.

    Args:
        model: Whose steps are linearised.
        windows: W of them.
        carried: States at their starts with all that is carried on (W, n + ...).
    """
    space = windows.space
    n = space.dim
    start = windows.past
    states = windows.states
    errors = space.difference(carried[:, :n], space.origin)
    outputs = model.kinematics.outputs(
        states[:, start], states[:, start + 1], windows.time_step
    )
    return _DifferenceSteps(
        carried=difference_steps(np.hstack([errors, carried[:, n:]])),
        outputs=_DIFFERENCE_OF_OUTPUTS * widths_of(outputs),
    )


def _linearized_step(
    model: LogModel,
    windows: Windows,
    k: int,
    carried: Array,
    disturbance: Array,
    steps: _DifferenceSteps,
) -> tuple[Array, Array]:
    """Linearises a step of rollouts by forward differences.

    Args:
        model: Whose step it is.
        windows: W of them, which have the inputs and the context.
        k: Number of the step.
        carried: States with all that is carried on, before it (W, n + ...).
        disturbance: Of the outputs (W, o).
        steps: Of the differences.

    Returns:
        Derivatives by the state and what is carried on (W, E, E), and by the outputs
        (W, E, o).
    """
    space = windows.space
    n = space.dim
    e = space.error_dim
    E = carried.shape[-1] - n + e
    o = disturbance.shape[-1]
    by_state = np.zeros((E + o, 1, E))
    by_state[:E, 0] = np.diag(steps.carried)
    by_output = np.zeros((E + o, 1, o))
    by_output[E:, 0] = np.diag(steps.outputs)
    displaced = np.concatenate(
        [
            space.displace(carried[:, :n], by_state[..., :e]),
            carried[:, n:] + by_state[..., e:],
        ],
        axis=-1,
    )

    def step(carried: Array, disturbance: Array) -> Array:
        return model.step(
            carried,
            inputs=windows.inputs[:, windows.past + k],
            context=windows.context[:, windows.past],
            time_step=windows.time_step,
            disturbance=disturbance,
        )

    after = step(carried, disturbance)
    displaced_after = step(displaced, disturbance + by_output)
    changes = np.concatenate(
        [
            space.difference(displaced_after[..., :n], after[:, :n]),
            displaced_after[..., n:] - after[:, n:],
        ],
        axis=-1,
    )
    lengths = np.concatenate([steps.carried, steps.outputs])
    J = np.moveaxis(changes / lengths[:, None, None], 0, -1)
    return J[..., :E], J[..., E:]
