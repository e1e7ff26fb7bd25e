"""Fits parameters and noise of a model of a log by the errors of its rollouts.

A parameter that is right one step ahead on noisy, smoothed or mistimed rows may be wrong fifty steps ahead; here the
residuals of the least squares are the errors of the rollouts themselves, as one batch of windows, each divided by the
mean error of a state that does not move (multiple-step prediction error; Ljung, 1999, section 3.3), with a loss that is
linear for outliers.

To first order the error of a rollout after k steps is the sum of the responses to the noise of every output at every
step and to the error of the measured start. So its variance is linear in the variances of the sources, here for each
output white noise and first-order autoregressions with a few time constants, and for each measured entry white
measurement noise. Non-negative least squares on the mean squared errors at several steps find the variances. Errors one
step ahead alone, on filtered rows, would understate them many times.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares, nnls

from gpmpc.exceptions import DataError, ShapeError, check_number
from gpmpc.logs._kinematics import Array, Kinematics
from gpmpc.logs._log import Log, Windows
from gpmpc.logs._rollouts import (
    PAST,
    STEPS,
    AffineNominal,
    LogModel,
    finite_errors,
    rollout_errors,
)

WINDOWS = 300
EVALUATIONS = 15
MEMORY_ROWS = 40_000  # states of one batch of rollouts: parameter vectors times windows
BLOCK = 4  # consecutive windows whose errors are correlated
TIME_CONSTANTS = (0.0, 0.05, 0.25, 1.0)  # [s]; zero is white
FITTED = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50)  # steps
DIFFERENCE = 1e-6
# times of the longest prediction: after which an error is forgotten, that a one weighs
FOLLOWED = 6.0
PRIOR = 1.0
# of a fold: whose errors count, and along which rollouts are linearised
NOISE_WINDOWS = 2000
LINEARIZED = 200


@dataclass(frozen=True)
class NominalFit:
    """A fitted nominal model."""

    model: LogModel  #: with its parameters
    standard_errors: Array  #: of the parameters (P,), robust to the correlation of neighbouring windows

    def to_rows(self) -> list[tuple[str, float, float]]:
        """Name, value and standard error of every parameter that has a name."""
        names = self.model.nominal.parameter_names
        return list(
            zip(
                names,
                self.model.theta.tolist(),
                self.standard_errors.tolist(),
                strict=False,
            )
        )


def fit_nominal(
    model: LogModel, theta0: Array | None, log: Log, steps: int = STEPS
) -> NominalFit:
    """Fits the parameters of a model's nominal part by the errors of its rollouts.

    Args:
        model: Structure, lag and history; its own parameters do not matter.
        theta0: Where the search begins (P,); the nominal model's ``start`` by default.
        log: All of its runs are used.
        steps: Of the rollouts; errors at eight of them, evenly spread over the logarithm, count.

    Raises:
        ShapeError: theta0 has another length.
        DataError: No piece of the log is long enough, or the rollouts at theta0 are not finite.
    """
    check_number("steps", steps, least=1, whole=True)
    theta0 = np.asarray(model.nominal.start if theta0 is None else theta0, dtype=float)
    if theta0.shape != (len(model.nominal.parameter_names),):
        raise ShapeError(
            f"theta0 must have {len(model.nominal.parameter_names)} entries; got {theta0.shape}"
        )
    cut = log.windows(steps, max(model.past, PAST), most=WINDOWS)
    if not len(theta0):
        return NominalFit(replace(model, theta=theta0), theta0)
    at = np.unique(np.geomspace(1, steps, 8).round().astype(int))
    scale = _still_error(cut, at)

    def residuals(theta: Array) -> Array:
        """Of parameter vectors (T, P): (T, W, steps, e)."""
        count = max(MEMORY_ROWS // len(cut), 1)
        batches = (theta[i : i + count] for i in range(0, len(theta), count))
        parts = [
            rollout_errors(cut, model.rollout(cut, steps, batch), at) / scale
            for batch in batches
        ]
        return np.nan_to_num(np.concatenate(parts), nan=1e6, posinf=1e6, neginf=-1e6)

    def jacobian(theta: Array) -> Array:
        h = 1e-5 * np.maximum(np.abs(theta), 1.0)
        around = residuals(np.concatenate([theta + np.diag(h), theta[None]]))
        return (
            ((around[:-1] - around[-1]) / h[:, None, None, None])
            .reshape(len(theta), -1)
            .T
        )

    def flat(theta: Array) -> Array:
        return residuals(theta[None])[0].ravel()

    with np.errstate(over="ignore", invalid="ignore"):
        if not (np.abs(flat(theta0)) < 1e6).all():
            raise DataError(
                "the rollouts at theta0 are not finite: begin nearer, or with fewer steps"
            )
        tolerances: dict[str, Any] = {
            "xtol": 1e-4,
            "ftol": 1e-4,
            "max_nfev": EVALUATIONS,
        }
        found = least_squares(
            flat, theta0, jacobian, loss="soft_l1", x_scale="jac", **tolerances
        )
    errors = _standard_errors(found.x, jacobian(found.x), residuals(found.x[None])[0])
    return NominalFit(replace(model, theta=found.x), errors)


def _still_error(windows: Windows, at: np.ndarray) -> Array:
    """Mean error (steps, e) of a state that does not move, the same for all entries of a group; never zero."""
    start = windows.states[:, windows.past : windows.past + 1]
    errors = rollout_errors(windows, np.repeat(start, windows.ahead, axis=1), at)
    mean = windows.space.distances(errors).mean(axis=0)
    counts = [group.error_dim for group in windows.space.groups]
    return np.repeat(np.maximum(mean, 1e-3 * mean.max(axis=0) + 1e-12), counts, axis=1)


def _standard_errors(theta: Array, J: Array, residuals: Array) -> Array:
    """Of a sandwich estimate whose residuals may be correlated within blocks of windows (P,)."""
    weights = 1 / np.sqrt(1 + residuals.ravel() ** 2)  # of the loss
    scores = (
        (J * (weights * residuals.ravel())[:, None])
        .reshape(len(residuals), -1, len(theta))
        .sum(axis=1)
    )
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), BLOCK))
    bread = np.linalg.pinv(J.T @ (J * weights[:, None]))
    return np.sqrt(np.maximum(np.diagonal(bread @ (blocks.T @ blocks) @ bread), 0.0))


def fit_least_squares(kinematics: Kinematics, log: Log) -> LogModel:
    """Fits outputs that are affine in the features, one step ahead on all rows."""
    cut = log.windows(1)
    x = cut.states[:, 0]
    u = cut.inputs[:, 0]
    c = cut.context[:, 0]
    z = kinematics.features(x, u, c)
    y = kinematics.outputs(x, cut.states[:, 1], log.time_step)
    solution: Any = np.linalg.lstsq(
        np.column_stack([z, np.ones(len(z))]), y, rcond=1e-8
    )[0]
    return LogModel(
        kinematics, AffineNominal(kinematics), solution.T.ravel(), (0,) * y.shape[1]
    )


@dataclass(frozen=True)
class OutputNoise:
    """Variances of the sources of a model's errors."""

    outputs: Array  #: of each of ``TIME_CONSTANTS`` and output (T, o), in squared units of the outputs
    measurement: Array  #: of each entry of a difference of states (e,), likewise


def error_variances(
    model: LogModel, windows: Windows, noise: OutputNoise, steps: Sequence[int]
) -> Array:
    """Computes the variances (W, len(steps), e) of a model's errors at some steps after the starts of windows."""
    return _responses(model, windows, steps) @ np.concatenate(
        [noise.outputs.ravel(), noise.measurement]
    )


def follow_errors(
    windows: Windows, errors: Array, variances: Array, steps: Sequence[int]
) -> Array:
    """Scales claimed variances by how predictions of the same run ended that were over before each one began.

    A run may be calmer or rougher than those that the noise was fitted to. For each entry of the state and each step
    the scale is the mean of squared errors over claimed variances, both (W, len(steps), e), weighted by exp(-age / (6
    T)), with a one of the weight T added, and T the time of the longest prediction (adaptive conformal inference by
    variances instead of quantiles; Gibbs and Candes, 2021).
    """
    longest = max(steps) * windows.time_step
    scaled = variances.copy()
    for run in np.unique(windows.runs):
        at = np.flatnonzero(windows.runs == run)
        times = windows.times[at]
        spacing = float(times[-1] - times[0]) / max(len(at) - 1, 1)
        for k, step in enumerate(steps):
            age = times[:, None] - times - (step - 0.5) * windows.time_step
            weights = np.where(
                age > 0,
                spacing * np.exp(-np.maximum(age, 0) / (FOLLOWED * longest)),
                0.0,
            )
            ratio = errors[at, k] ** 2 / np.maximum(variances[at, k], 1e-300)
            prior = PRIOR * longest
            scaled[at, k] *= (prior + weights @ ratio) / (
                prior + weights.sum(axis=1, keepdims=True)
            )
    return scaled


def fit_noise(
    models: Sequence[LogModel], logs: Sequence[Log], most: int
) -> OutputNoise:
    """Finds the noise that explains the errors of rollouts, of ``most`` steps, on runs that a fold's model did not see.

    Where these do not tell the outputs of a group apart, as x from y while the heading turns, the outputs share as the
    squares of their residuals one step ahead do.
    """
    steps = [step for step in FITTED if step <= most]
    found: list[tuple[Array, Array, Array]] = []
    for model, log in zip(models, logs, strict=True):
        cut = log.windows(most, max(model.past, PAST), most=NOISE_WINDOWS)
        # derivatives are slow, and vary little
        few = cut[:: -(-len(cut) // LINEARIZED)]
        past = cut.past
        x = cut.states[:, past]
        after = cut.states[:, past + 1]
        y = model.outputs(
            x, cut.inputs[:, past - model.lag], cut.context[:, past]
        ) + model.disturbance(cut)
        residuals = model.kinematics.outputs(x, after, cut.time_step) - y
        found.append(
            (
                np.square(finite_errors(cut, model, steps)),
                _responses(model, few, steps),
                np.square(residuals),
            )
        )
    mean, responses, squares = (
        np.concatenate(one).mean(axis=0) for one in zip(*found, strict=True)
    )
    relative = (responses / np.maximum(mean, 1e-300)[..., None]).reshape(
        -1, responses.shape[-1]
    )
    factor = np.maximum(relative.max(axis=0), 1e-300)
    alike = _alike(models[0], factor, squares)
    targets = np.r_[np.ones(len(relative)), np.zeros(len(alike))]
    variances = nnls(np.vstack([relative / factor, alike]), targets)[0] / factor
    by_output, measured = np.split(variances, [len(TIME_CONSTANTS) * len(squares)])
    return OutputNoise(by_output.reshape(len(TIME_CONSTANTS), -1), measured)


def _alike(model: LogModel, factor: Array, squares: Array) -> Array:
    """Rows of least squares that are zero where the outputs of a group share as the residuals' squares (o,) do."""
    rows = []
    o = len(squares)
    for start in range(0, len(TIME_CONSTANTS) * o, o):
        for group in model.kinematics.output_groups.values():
            for i, j in itertools.pairwise(group):
                row = np.zeros(len(factor))
                pair = [start + i, start + j]
                scale = factor[pair] * np.maximum(squares[[i, j]], 1e-300)
                row[pair] = scale.min() / scale * [1.0, -1.0]
                rows.append(row)
    return np.array(rows).reshape(-1, len(factor))


def _responses(model: LogModel, windows: Windows, steps: Sequence[int]) -> Array:
    """Variance of every entry's error (W, s, e, sources) by a unit variance of every source."""
    A, B = _linearized(model, windows, max(steps))
    W = len(windows)
    e = A.shape[-1]
    o = B.shape[-1]
    found = np.empty((W, len(steps), e, len(TIME_CONSTANTS) * o + e))
    for s, step in enumerate(steps):
        P = np.broadcast_to(np.eye(e), (W, e, e))
        G = np.empty((step, W, e, o))
        for i in range(step - 1, -1, -1):
            G[i] = P @ B[:, i]
            P = P @ A[:, i]
        for t, constant in enumerate(TIME_CONSTANTS):
            rho = np.exp(-windows.time_step / max(constant, 1e-9))
            tail, total = np.zeros((2, *G[0].shape))
            for g in G:  # the sum over i, j of rho^|i - j| G_i G_j, in one pass
                total += g * (g + 2 * tail)
                tail = rho * (tail + g)
            found[:, s, :, t * o : (t + 1) * o] = total
        found[:, s, :, len(TIME_CONSTANTS) * o :] = np.square(P) + np.eye(e)
    return found


def _linearized(model: LogModel, windows: Windows, steps: int) -> tuple[Array, Array]:
    """Derivatives of each step by the state (W, K, e, e) and by the outputs (W, K, e, o), along the rollout."""
    space = windows.space
    kinematics = model.kinematics
    dt = windows.time_step
    predicted = model.rollout(windows, steps)
    x = np.concatenate(
        [windows.states[:, windows.past : windows.past + 1], predicted[:, :-1]], axis=1
    )
    at = windows.past - model.lag
    u = windows.inputs[:, at : at + steps]
    c = windows.context[:, windows.past][:, None]
    c = np.broadcast_to(c, (*x.shape[:-1], c.shape[-1]))
    d = model.disturbance(windows)[:, None]
    y = model.outputs(x, u, c) + d
    after = kinematics.step(x, y, dt)
    displaced = (space.displace(x, h) for h in DIFFERENCE * np.eye(space.error_dim))
    by_state = [
        kinematics.step(moved, model.outputs(moved, u, c) + d, dt)
        for moved in displaced
    ]
    by_output = [
        kinematics.step(x, y + h, dt) for h in DIFFERENCE * np.eye(y.shape[-1])
    ]
    A, B = (
        np.stack([space.difference(m, after) / DIFFERENCE for m in moved], -1)
        for moved in (by_state, by_output)
    )
    return A, B
