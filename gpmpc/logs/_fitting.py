"""Parameters of a nominal model by least squares over rollouts of many steps, as one batch of windows.

A parameter that is right one step ahead on noisy, smoothed or mistimed rows may be wrong fifty steps ahead; here the
residuals are the errors of the rollouts themselves, each divided by the mean error of a state that does not move
(multiple-step prediction error; Ljung, 1999, section 3.3), with a loss that is linear for outliers.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from gpmpc.exceptions import DataError, ShapeError, check_number
from gpmpc.logs._kinematics import Kinematics
from gpmpc.logs._log import Log, Windows
from gpmpc.logs._nominal import AffineNominal
from gpmpc.logs._rollouts import PAST, STEPS, LogModel, choose_stride, rollout_errors
from gpmpc.logs._state_space import Array

WINDOWS = 300
EVALUATIONS = 15
MEMORY_ROWS = 40_000  # states of one batch of rollouts: parameter vectors times windows
BLOCK = 4  # consecutive windows whose errors are correlated


@dataclass(frozen=True)
class NominalFit:
    """A fitted nominal model."""

    model: LogModel  #: with its parameters
    standard_errors: Array  #: of the parameters (P,), robust to the correlation of neighbouring windows
    cost: float  #: of the loss, per residual
    start_cost: float  #: at the start
    evaluations: int  #: of the rollouts

    def to_rows(self) -> list[tuple[str, float, float]]:
        """Name, value and standard error of every parameter."""
        names = self.model.nominal.parameter_names
        return list(zip(names, self.model.theta.tolist(), self.standard_errors.tolist(), strict=True))


def fit_nominal(model: LogModel, theta0: Array | None, log: Log, steps: int = STEPS) -> NominalFit:
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
    theta0 = model.nominal.start if theta0 is None else np.asarray(theta0, dtype=float)
    if theta0.shape != (len(model.nominal.parameter_names),):
        raise ShapeError(f"theta0 must have {len(model.nominal.parameter_names)} entries; got {theta0.shape}")
    past = max(model.past, PAST)
    cut = log.windows(steps, past, choose_stride(log, steps + past, WINDOWS))
    if not len(theta0):
        return NominalFit(replace(model, theta=theta0), theta0, 0.0, 0.0, 0)
    at = np.unique(np.geomspace(1, steps, 8).round().astype(int))
    scale = _still_error(cut, at)

    def residuals(theta: Array) -> Array:
        """Of parameter vectors (T, P): (T, W, steps, e)."""
        count = max(MEMORY_ROWS // len(cut), 1)
        parts = [
            rollout_errors(cut, model.rollout(cut, steps, theta[i : i + count]), at) / scale
            for i in range(0, len(theta), count)
        ]
        return np.nan_to_num(np.concatenate(parts), nan=1e6, posinf=1e6, neginf=-1e6)

    def jacobian(theta: Array) -> Array:
        h = 1e-5 * np.maximum(np.abs(theta), 1.0)
        around = residuals(np.concatenate([theta + np.diag(h), theta[None]]))
        return ((around[:-1] - around[-1]) / h[:, None, None, None]).reshape(len(theta), -1).T

    with np.errstate(over="ignore", invalid="ignore"):
        first = residuals(theta0[None])[0]
        if not (np.abs(first) < 1e6).all():
            raise DataError("the rollouts at theta0 are not finite: begin nearer, or with fewer steps")
        found = least_squares(
            lambda theta: residuals(theta[None])[0].ravel(),
            theta0,
            jacobian,
            loss="soft_l1",
            x_scale="jac",
            max_nfev=EVALUATIONS,
            xtol=1e-4,
            ftol=1e-4,
        )
    start_cost = float((np.sqrt(1 + first**2) - 1).sum() / first.size)
    errors = _standard_errors(found.x, jacobian(found.x), residuals(found.x[None])[0])
    return NominalFit(
        replace(model, theta=found.x), errors, float(found.cost / first.size), start_cost, found.nfev + found.njev
    )


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
    scores = (J * (weights * residuals.ravel())[:, None]).reshape(len(residuals), -1, len(theta)).sum(axis=1)
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), BLOCK))
    bread = np.linalg.pinv(J.T @ (J * weights[:, None]))
    return np.sqrt(np.maximum(np.diagonal(bread @ (blocks.T @ blocks) @ bread), 0.0))


def fit_least_squares(kinematics: Kinematics, log: Log) -> LogModel:
    """Fits outputs that are affine in the features, one step ahead on all rows."""
    cut = log.windows(1)
    x, u, c = cut.states[:, 0], cut.inputs[:, 0], cut.context[:, 0]
    z = kinematics.features(x, u, c)
    y = kinematics.outputs(x, cut.states[:, 1], log.time_step)
    solution: Any = np.linalg.lstsq(np.column_stack([z, np.ones(len(z))]), y, rcond=1e-8)[0]
    nominal = AffineNominal(kinematics, y.shape[1], z.shape[1])
    return LogModel(kinematics, nominal, solution.T.ravel(), (0,) * y.shape[1])
