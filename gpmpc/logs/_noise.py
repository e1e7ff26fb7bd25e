"""Noise of the outputs behind a log, white and correlated in time, estimated from the errors of rollouts.

To first order the error of a rollout after k steps is the sum of the responses to the noise of every output at every
step and to the error of the measured start. So its variance is linear in the variances of the sources, here for each
output white noise and first-order autoregressions (Wiener processes' stationary cousins) with a few time constants, and
for each measured entry white measurement noise. Non-negative least squares on the mean squared errors at several steps
find the variances. Errors one step ahead alone, on filtered rows, would understate them many times.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from gpmpc.logs._log import Log, Windows
from gpmpc.logs._rollouts import PAST, LogModel, choose_stride, finite_errors
from gpmpc.logs._state_space import Array

TIME_CONSTANTS = (0.0, 0.05, 0.25, 1.0)  # [s]; zero is white
FITTED = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50)  # steps
DIFFERENCE = 1e-6
FOLLOWED, PRIOR = 6.0, 1.0  # times of the longest prediction: after which an error is forgotten, that a one weighs
WINDOWS, LINEARIZED = 2000, 200  # of a fold: whose errors count, and along which rollouts are linearised


@dataclass(frozen=True)
class OutputNoise:
    """Variances of the sources of a model's errors."""

    outputs: Array  #: of each of ``TIME_CONSTANTS`` and output (T, o), in squared units of the outputs
    measurement: Array  #: of each entry of a difference of states (e,), likewise


def error_variances(model: LogModel, windows: Windows, noise: OutputNoise, steps: Sequence[int]) -> Array:
    """Computes the variances (W, len(steps), e) of a model's errors at some steps after the starts of windows."""
    return _responses(model, windows, steps) @ np.concatenate([noise.outputs.ravel(), noise.measurement])


def follow_errors(windows: Windows, errors: Array, variances: Array, steps: Sequence[int]) -> Array:
    """Scales claimed variances by how predictions of the same run ended that were over before each one began.

    A run may be calmer or rougher than those that the noise was fitted to. For each entry of the state and each step
    the scale is the mean of squared errors over claimed variances, weighted by exp(-age / (6 T)), with a one of the
    weight T added, and T the time of the longest prediction (adaptive conformal inference by variances instead of
    quantiles; Gibbs and Candes, 2021).

    Args:
        windows: W of them.
        errors: Of predictions of them (W, len(steps), e).
        variances: Claimed by ``error_variances`` (W, len(steps), e).
        steps: k.
    """
    longest, scaled = max(steps) * windows.time_step, variances.copy()
    for run in np.unique(windows.runs):
        at = np.flatnonzero(windows.runs == run)
        times = windows.times[at]
        spacing = float(times[-1] - times[0]) / max(len(at) - 1, 1)
        for k, step in enumerate(steps):
            age = times[:, None] - times - (step - 0.5) * windows.time_step
            weights = np.where(age > 0, spacing * np.exp(-np.maximum(age, 0) / (FOLLOWED * longest)), 0.0)
            ratio = errors[at, k] ** 2 / np.maximum(variances[at, k], 1e-300)
            prior = PRIOR * longest
            scaled[at, k] *= (prior + weights @ ratio) / (prior + weights.sum(axis=1, keepdims=True))
    return scaled


def fit_noise(models: Sequence[LogModel], logs: Sequence[Log], most: int) -> OutputNoise:
    """Finds the noise that explains the errors of rollouts on held-out runs.

    Where these do not tell the outputs of a group apart, as x from y while the heading turns, the outputs share as the
    squares of their residuals one step ahead do.

    Args:
        models: One a fold.
        logs: Runs that the fold's model was not fitted to.
        most: Steps of the longest rollouts.
    """
    steps = [step for step in FITTED if step <= most]
    found: list[tuple[Array, Array, Array]] = []
    for model, log in zip(models, logs, strict=True):
        past = max(model.past, PAST)
        cut = log.windows(most, past, choose_stride(log, most + past, WINDOWS))
        few = cut[:: -(-len(cut) // LINEARIZED)]  # derivatives are slow, and vary little
        x, after = cut.states[:, past], cut.states[:, past + 1]
        y = model.outputs(x, cut.inputs[:, past - model.lag], cut.context[:, past]) + model.disturbance(cut)
        residuals = model.kinematics.outputs(x, after, cut.time_step) - y
        found.append((np.square(finite_errors(cut, model, steps)), _responses(model, few, steps), np.square(residuals)))
    mean, responses, squares = (np.concatenate(one).mean(axis=0) for one in zip(*found, strict=True))
    relative = (responses / np.maximum(mean, 1e-300)[..., None]).reshape(-1, responses.shape[-1])
    factor = np.maximum(relative.max(axis=0), 1e-300)
    alike = _alike(models[0], factor, squares)
    targets = np.r_[np.ones(len(relative)), np.zeros(len(alike))]
    variances = nnls(np.vstack([relative / factor, alike]), targets)[0] / factor
    by_output, measured = np.split(variances, [len(TIME_CONSTANTS) * len(squares)])
    return OutputNoise(by_output.reshape(len(TIME_CONSTANTS), -1), measured)


def _alike(model: LogModel, factor: Array, squares: Array) -> Array:
    """Rows of least squares that are zero where the outputs of a group share as the residuals' squares (o,) do."""
    rows, o = [], len(squares)
    for start in range(0, len(TIME_CONSTANTS) * o, o):
        for group in model.kinematics.output_groups.values():
            for i, j in itertools.pairwise(group):
                row, pair = np.zeros(len(factor)), [start + i, start + j]
                scale = factor[pair] * np.maximum(squares[[i, j]], 1e-300)
                row[pair] = scale.min() / scale * [1.0, -1.0]
                rows.append(row)
    return np.array(rows).reshape(-1, len(factor))


def _responses(model: LogModel, windows: Windows, steps: Sequence[int]) -> Array:
    """Variance of every entry's error (W, s, e, sources) by a unit variance of every source."""
    A, B = _linearized(model, windows, max(steps))
    W, e, o = len(windows), A.shape[-1], B.shape[-1]
    found = np.empty((W, len(steps), e, len(TIME_CONSTANTS) * o + e))
    for s, step in enumerate(steps):
        P = np.broadcast_to(np.eye(e), (W, e, e))
        G = np.empty((step, W, e, o))
        for i in range(step - 1, -1, -1):
            G[i] = P @ B[:, i]
            P = P @ A[:, i]
        for t, constant in enumerate(TIME_CONSTANTS):
            if constant == 0:
                total = np.square(G).sum(axis=0)
            else:  # sum over i, j of rho^|i - j| G_i G_j, in one pass
                rho, tail, total = np.exp(-windows.time_step / constant), np.zeros_like(G[0]), np.zeros_like(G[0])
                for g in G:
                    total += g * (g + 2 * tail)
                    tail = rho * (tail + g)
            found[:, s, :, t * o : (t + 1) * o] = total
        found[:, s, :, len(TIME_CONSTANTS) * o :] = np.square(P) + np.eye(e)
    return found


def _linearized(model: LogModel, windows: Windows, steps: int) -> tuple[Array, Array]:
    """Derivatives of each step by the state (W, K, e, e) and by the outputs (W, K, e, o), along the rollout."""
    space, kinematics, dt = windows.space, model.kinematics, windows.time_step
    predicted = model.rollout(windows, steps)
    x = np.concatenate([windows.states[:, windows.past : windows.past + 1], predicted[:, :-1]], axis=1)
    at = windows.past - model.lag
    u, c = windows.inputs[:, at : at + steps], windows.context[:, windows.past][:, None]
    c = np.broadcast_to(c, (*x.shape[:-1], c.shape[-1]))
    d = model.disturbance(windows)[:, None]
    y = model.outputs(x, u, c) + d
    after = kinematics.step(x, y, dt)
    A, B = [], []
    for direction in np.eye(space.error_dim):
        moved = space.displace(x, DIFFERENCE * direction)
        A.append(space.difference(kinematics.step(moved, model.outputs(moved, u, c) + d, dt), after) / DIFFERENCE)
    for direction in np.eye(y.shape[-1]):
        B.append(space.difference(kinematics.step(x, y + DIFFERENCE * direction, dt), after) / DIFFERENCE)
    return np.stack(A, axis=-1), np.stack(B, axis=-1)
