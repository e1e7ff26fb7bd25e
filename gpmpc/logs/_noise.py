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
from scipy.optimize import minimize, nnls

from gpmpc.logs._log import Windows
from gpmpc.logs._rollouts import LogModel
from gpmpc.logs._state_space import Array

TIME_CONSTANTS = (0.0, 0.05, 0.25, 1.0)  # [s]; zero is white
FITTED = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50)  # steps
DIFFERENCE = 1e-6
FOLLOWED, PRIOR = 6.0, 1.0  # times of the longest prediction: after which an error is forgotten, that a one weighs
ALIKE = 0.05  # weight of differences within a group of outputs


@dataclass(frozen=True)
class OutputNoise:
    """Variances of the sources of a model's errors.

    The level of a prediction, exp(level . (1, z)), multiplies all of them; z are the logarithms of the mean squared
    one-step residuals of each group of outputs over the rows before the start: a rough flight stays rough for a while.
    """

    outputs: Array  #: of each time constant and output (T, o), in squared units of the outputs, at level one
    measurement: Array  #: of each entry of a difference of states (e,), likewise
    level: Array  #: coefficients (1 + groups of outputs,)
    time_constants: tuple[float, ...] = TIME_CONSTANTS  #: [s]; zero is white


def error_variances(model: LogModel, windows: Windows, noise: OutputNoise, steps: Sequence[int]) -> Array:
    """Computes the variances (W, len(steps), e) of a model's errors at some steps after the starts of windows."""
    weights = np.concatenate([noise.outputs.ravel(), noise.measurement])
    level = np.exp(_regressors(model, windows) @ noise.level)
    return level[:, None, None] * (_responses(model, windows, steps, noise.time_constants) @ weights)


def follow_errors(windows: Windows, errors: Array, variances: Array, steps: Sequence[int]) -> Array:
    """Scales claimed variances by how predictions of the same run ended that were over before each one began.

    A run may be calmer or rougher than those that the noise was fitted to. For each group of states and each step the
    scale is the mean of squared errors over claimed variances, weighted by exp(-age / (6 T)), with a one of the weight
    T added, and T the time of the longest prediction (adaptive conformal inference by variances instead of
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
            for columns in windows.space.error_columns:
                ratio = (errors[at, k, columns] ** 2 / np.maximum(variances[at, k, columns], 1e-300)).mean(axis=1)
                scale = (PRIOR * longest + weights @ ratio) / (PRIOR * longest + weights.sum(axis=1))
                scaled[at, k, columns] *= scale[:, None]
    return scaled


def _regressors(model: LogModel, windows: Windows) -> Array:
    """One, and the logarithm of the mean squared residual of each group of outputs in the past (W, 1 + groups)."""
    first = model.lag
    x, u = windows.states[:, first : windows.past + 1], windows.inputs[:, : windows.past - model.lag]
    y = model.kinematics.outputs(x[:, :-1], x[:, 1:], windows.time_step)
    squares = np.square(y - model.outputs(x[:, :-1], u, windows.context[:, first : windows.past])).mean(axis=1)
    columns = [
        np.log(squares[:, list(group)].mean(axis=1) + 1e-12) for group in model.kinematics.output_groups.values()
    ]
    return np.column_stack([np.ones(len(windows)), *columns])


def fit_noise(models: Sequence[LogModel], folds: Sequence[Windows], errors: Sequence[Array]) -> OutputNoise:
    """Finds the noise that explains the errors of rollouts on held-out windows.

    Args:
        models: One a fold.
        folds: Windows that the fold's model was not fitted to.
        errors: Of its rollouts there (W, steps, e).
    """
    steps, outputs = fitted_steps(errors[0].shape[1]), len(models[0].kinematics.output_names)
    pairs = list(zip(models, folds, strict=True))
    responses = np.concatenate([_responses(model, cut, steps, TIME_CONSTANTS) for model, cut in pairs])
    squares = np.concatenate([np.square(e[:, np.array(steps) - 1]) for e in errors])
    mean = np.maximum(squares.mean(axis=0), 1e-300)
    relative = (responses.mean(axis=0) / mean[..., None]).reshape(-1, responses.shape[-1])
    factor = np.maximum(relative.max(axis=0), 1e-300)
    count = len(TIME_CONSTANTS) * outputs
    alike = _alike(models[0], factor)
    found = nnls(np.vstack([relative / factor, alike]), np.r_[np.ones(len(relative)), np.zeros(len(alike))])[0] / factor
    ratio = (squares / np.maximum(responses @ found, 1e-300)).mean(axis=(1, 2))
    level = _fit_level(np.concatenate([_regressors(model, cut) for model, cut in pairs]), ratio)
    return OutputNoise(found[:count].reshape(-1, outputs), found[count:], level)


def _alike(model: LogModel, factor: Array) -> Array:
    """Rows that draw neighbouring outputs of a group together where the errors do not tell them apart, as x and y."""
    rows, o = [], len(model.kinematics.output_names)
    for start in range(0, len(TIME_CONSTANTS) * o, o):
        for group in model.kinematics.output_groups.values():
            for i, j in itertools.pairwise(group):
                row, pair = np.zeros(len(factor)), [start + i, start + j]
                row[pair] = ALIKE * factor[pair].mean() / factor[pair] * [1.0, -1.0]
                rows.append(row)
    return np.array(rows).reshape(-1, len(factor))


def _fit_level(z: Array, ratio: Array) -> Array:
    """Fits E ratio = exp(z b) by maximum likelihood of exponential distributions (gamma regression, log link)."""
    centre = z[:, 1:].mean(axis=0)
    z = np.column_stack([z[:, :1], z[:, 1:] - centre])

    def objective(b: Array) -> tuple[float, Array]:
        eta = np.clip(z @ b, -20, 20)
        scaled = ratio * np.exp(-eta)
        penalty = np.r_[0.0, b[1:]] / len(z)
        return float((scaled + eta).mean() + penalty @ b / 2), z.T @ (1 - scaled) / len(z) + penalty

    b = minimize(objective, np.zeros(z.shape[1]), jac=True, method="BFGS").x
    return np.r_[b[0] - centre @ b[1:], b[1:]]


def fitted_steps(most: int) -> list[int]:
    """The steps at which squared errors are compared."""
    return [step for step in FITTED if step <= most]


def _responses(model: LogModel, windows: Windows, steps: Sequence[int], time_constants: Sequence[float]) -> Array:
    """Variance of every entry's error (W, s, e, sources) by a unit variance of every source."""
    A, B = _linearized(model, windows, max(steps))
    W, e, o = len(windows), A.shape[-1], B.shape[-1]
    found = np.empty((W, len(steps), e, len(time_constants) * o + e))
    for s, step in enumerate(steps):
        P = np.broadcast_to(np.eye(e), (W, e, e))
        G = np.empty((step, W, e, o))
        for i in range(step - 1, -1, -1):
            G[i] = P @ B[:, i]
            P = P @ A[:, i]
        for t, constant in enumerate(time_constants):
            if constant == 0:
                total = np.square(G).sum(axis=0)
            else:  # sum over i, j of rho^|i - j| G_i G_j, in one pass
                rho, tail, total = np.exp(-windows.time_step / constant), np.zeros_like(G[0]), np.zeros_like(G[0])
                for g in G:
                    total += g * (g + 2 * tail)
                    tail = rho * (tail + g)
            found[:, s, :, t * o : (t + 1) * o] = total
        found[:, s, :, len(time_constants) * o :] = np.square(P) + np.eye(e)
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
