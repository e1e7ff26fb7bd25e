"""Smooths the measured rows of a log, where white noise was measured along with them.

What is fitted to noisy rows is biased: noise in the states makes every effect of them
look smaller (errors in variables). So models are fitted to the most likely states,
given all rows of a piece, the noise of the measurements and that of the movement,

    x[k] measured = x[k] (+) v[k],    x[k+1] = f(x[k], u[k]) (+) w[k],

which one banded system of equations gives (the smoother of Rauch, Tung and Striebel,
1965, about a linearisation that is iterated). The model f is an affine one, then one
with GPs on top, each fitted to the rows that the one before it smoothed.

The noise of the measurements shows in the residuals e[k] of f one step ahead: v[k]
enters e[k] and, with the other sign, e[k + 1]. What f misses changes slowly, and does
not: R = cov(e[k], e[k + 2]) - cov(e[k], e[k + 1]). The noise of the movement is the
sum of the covariances over all lags, to which v contributes nothing.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solveh_banded

from gpmpc._dynamics import Array
from gpmpc.logs._fitting import fit_least_squares
from gpmpc.logs._log import Log, LogRun
from gpmpc.logs._output_gps import train_output_gp
from gpmpc.logs._ranges import difference_steps, state_widths
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._log_model import LogModel

_ROUNDING = 1e-12  # of a state's range: least noise
_SIGNIFICANT = 4.0  # standard errors by which a noise has to differ from none
_LEAST_SHARE = 0.02  # of the residuals' variance that a noise has to make up
_WINDOWS = 100_000  # whose residuals tell the noise, at most
_LAGS = 10  # over which what a model misses is correlated
_MODELS = 3  # that are fitted in turn
_LINEARIZATIONS = 2  # about the rows as they were, then about those smoothed by them
_POINTS = 100  # of the GPs
_AVERAGE = 5  # rows over which their targets are averaged
_STIFF = 1e-3  # least noise of the movement, over that of the measurements
_NONE = 1e-6  # noise of a measurement without noise, over the residuals' variance
_BLOCK = 20_000  # rows that are smoothed at once,
_OVERLAP = 1000  # with so many of each neighbour, far more than tell of a row
_OUTLIER = 6.0  # median absolute deviations


class _Noise(NamedTuple):
    """Variances of the noise of the measurements and of the movement."""

    measurement: Array  # (e,)
    movement: Array  # (e,)
    is_noisy: Array  # whether a measurement has noise (e,)


def smooth(log: Log, kinematics: Kinematics, seed: int) -> Log | None:
    """Smooths the rows of a log.

    Args:
        log: With measured rows.
        kinematics: Have the features of the models.
        seed: Of the GPs.

    Returns:
        The log with the most likely states; None where there is no white noise in any
        of its rows.
    """
    if log.longest_piece <= _LAGS + 1:
        return None  # too short to tell noise from what a model misses
    smoothed = log
    is_smoothed = False
    for number in range(_MODELS):
        model = fit_least_squares(kinematics, smoothed)
        if number > 0:
            model = _with_gps(model, smoothed, seed)
        noise = _estimate_noise(model, log)
        if not noise.is_noisy.any():
            continue
        for _ in range(_LINEARIZATIONS):
            smoothed = _smooth_all(model, log, about=smoothed, noise=noise)
        is_smoothed = True
    return smoothed if is_smoothed else None


def _smooth_all(model: LogModel, log: Log, about: Log, noise: _Noise) -> Log:
    """Returns a log with the most likely states of every run; see ``_smooth_run``."""
    runs = tuple(
        _smooth_run(model, measured, about_run, noise, log.time_step)
        for measured, about_run in zip(log.runs, about.runs, strict=True)
    )
    return replace(log, runs=runs)


def _with_gps(model: LogModel, log: Log, seed: int) -> LogModel:
    """Returns a model with GPs on all outputs."""
    gps = tuple(
        train_output_gp(model, log, outputs, _AVERAGE, _POINTS, seed)
        for outputs in model.kinematics.output_groups.values()
    )
    return replace(model, gps=gps)


def _estimate_noise(model: LogModel, log: Log) -> _Noise:
    """Estimates the noise from the residuals of a model one step ahead."""
    windows = log.windows(_LAGS + 1, most=_WINDOWS)
    states = windows.states[:, :-1]
    inputs = windows.inputs[:, :-1]
    context = np.broadcast_to(
        windows.context, (*states.shape[:-1], windows.context.shape[-1])
    )
    outputs = model.outputs(states, inputs, context)
    predicted = model.kinematics.step(states, outputs, log.time_step)
    e = windows.space.difference(predicted, windows.states[:, 1:])  # (W, lags + 1, e)
    deviation = np.median(np.abs(e), axis=(0, 1)) / 0.6745
    e = np.clip(e, -_OUTLIER * deviation, _OUTLIER * deviation)
    variance = np.square(e).mean(axis=(0, 1))
    products_by_lag = e[:, :1] * e  # (W, lags + 1, e)
    products = products_by_lag[:, 2] - products_by_lag[:, 1]
    long_run = products_by_lag.mean(axis=0)
    density = long_run[0] + 2 * long_run[1:].sum(axis=0)
    R = products.mean(axis=0)
    standard_error = products.std(axis=0) / np.sqrt(len(products))
    least = np.maximum(_SIGNIFICANT * standard_error, _LEAST_SHARE * variance)
    is_noisy = least < R
    widths = state_widths(windows.space, states.reshape(-1, states.shape[-1]))
    floor = _NONE * variance + np.square(_ROUNDING * widths)
    R = np.where(is_noisy, R, floor)
    Q = np.maximum(density, np.maximum(_STIFF * R, floor))
    return _Noise(R, Q, is_noisy)


def _smooth_run(
    model: LogModel, run: LogRun, about: LogRun, noise: _Noise, time_step: float
) -> LogRun:
    """Returns a run with its most likely states.

    Long runs are smoothed block by block, each with rows of its neighbours: the
    equations of all rows of an hour at 1 kHz are many gigabytes.

    Args:
        model: Predicts the next state.
        run: With the measured states.
        about: With the states about which the model is linearised.
        noise: Of measurements and movement.
        time_step: [s].
    """
    if len(run) < 2:  # no movement tells of a single row
        return run
    space = model.kinematics.space
    lengths = difference_steps(space.difference(about.states[:-1], space.origin))
    states = np.empty_like(run.states)
    for first in range(0, len(run), _BLOCK):
        last = min(first + _BLOCK, len(run))
        begin = max(first - _OVERLAP, 0)
        end = min(last + _OVERLAP, len(run))
        smoothed = _most_likely_states(
            model=model,
            run=run.part(begin, end, "block"),
            about=about.part(begin, end, "block"),
            noise=noise,
            time_step=time_step,
            lengths=lengths,
        )
        states[first:last] = smoothed[first - begin : last - begin]
    return replace(run, states=states)


def _most_likely_states(
    model: LogModel,
    run: LogRun,
    about: LogRun,
    noise: _Noise,
    time_step: float,
    lengths: Array,
) -> Array:
    """Computes the most likely states (K, n) of K rows; see ``_smooth_run``.

    ``lengths`` are those of the differences that linearise the model (e,).
    """
    space = model.kinematics.space
    K = len(run)
    e = space.error_dim
    A, residuals = _linearized_steps(model, about, time_step, lengths)
    couples = np.ones(K - 1)
    couples[np.array(run.begins[1:], dtype=int) - 1] = 0.0  # not over a gap
    information = couples[:, None] / noise.movement  # (K - 1, e)
    # Blocks of the normal equations on the diagonal (K, e, e) and below it.
    diagonal = np.zeros((K, e, e)) + np.diag(1 / noise.measurement)
    weighted = A.mT * information[:, None, :]  # A' Q^-1
    diagonal[:-1] += weighted @ A
    diagonal[1:] += information[:, :, None] * np.eye(e)
    below = -information[:, :, None] * A
    right = space.difference(run.states, about.states) / noise.measurement
    right[:-1] -= (weighted @ residuals[..., None])[..., 0]
    right[1:] += information * residuals
    solution = _solve_block_tridiagonal(diagonal, below, right)
    return space.displace(about.states, solution)


def _linearized_steps(
    model: LogModel, run: LogRun, time_step: float, lengths: Array
) -> tuple[Array, Array]:
    """Linearises the steps of a model along a run.

    Returns:
        Derivatives (K - 1, e, e), and predicted minus next states (K - 1, e).
    """
    space = model.kinematics.space
    states = run.states[:-1]
    inputs = run.inputs[:-1]
    context = run.context[:-1]

    def predict(x: Array) -> Array:
        outputs = model.outputs(x, inputs, context)
        return model.kinematics.step(x, outputs, time_step)

    predicted = predict(states)
    columns = []
    for h in np.diag(lengths):
        displaced = predict(space.displace(states, h))
        columns.append(space.difference(displaced, predicted) / h.sum())
    residuals = space.difference(predicted, run.states[1:])
    return np.stack(columns, axis=-1), residuals


def _solve_block_tridiagonal(diagonal: Array, below: Array, right: Array) -> Array:
    """Solves a symmetric system of blocks on and below the diagonal.

    Args:
        diagonal: (K, e, e).
        below: Block k is in row k + 1 (K - 1, e, e).
        right: (K, e).
    """
    K, e, _ = diagonal.shape
    band = np.zeros((2 * e, K * e))  # lower form: band[i - j, j] = matrix[i, j]
    for row in range(e):
        for column in range(e):
            if row >= column:
                band[row - column, column::e] = diagonal[:, row, column]
            places = slice(column, (K - 1) * e, e)
            band[e + row - column, places] = below[:, row, column]
    return solveh_banded(band, right.ravel(), lower=True).reshape(K, e)
