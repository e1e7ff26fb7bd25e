"""Fits the parameters of a model of a log by the errors of its rollouts.

A parameter that is right one step ahead on noisy, smoothed or mistimed rows may be
wrong fifty steps ahead. Here the residuals of the least squares are the errors of the
rollouts themselves, as one batch of windows, each divided by the mean error of a state
that does not move (multiple-step prediction error; Ljung, 1999, section 3.3), with a
loss that is linear for outliers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_kind,
    check_number,
)
from gpmpc.logs._log import Log
from gpmpc.logs._ranges import state_widths
from gpmpc.logs._regression import fit_affine
from gpmpc.models._kinematics import Kinematics
from gpmpc.models._log_model import LogModel
from gpmpc.models._parametric import AffineNominal
from gpmpc.models._state_space import StateSpace
from gpmpc.models._windows import Windows

STEPS = 50  # of the rollouts that models are judged by
_JUDGED = (1, 10, 50)  # steps after the starts of rollouts whose errors decide
PAST = 20  # rows before them
_WINDOWS = 300
# Of a search, at most: few need ten, and one that stops before its end is no fit.
_EVALUATIONS = 100
_COUNTED_STEPS = 8  # steps of a rollout whose errors count
_BATCH = 40_000  # states of one batch of rollouts: parameter vectors times windows
_FEWEST_BLOCKS = 8  # of consecutive windows, whose errors are correlated
_FIRST_TIME_CONSTANT = 0.03  # [s] of a first-order lag, at which the search begins,
_FIRST_STEPS = (1.0, 30.0)  # or this many time steps at least and at most
_ROUNDING = 1e-12  # of a state's range: least error of one that does not move
_EXACT_SHARE = 1e-9  # of an error at rest: what is smaller counts as exact
_DIVERGED = 1e6  # residual of a rollout that is not finite
# Of the curvature by parameters of equal effect: a smaller one is of their differences'
# rounding.
_LEAST_EIGENVALUE = 1e-9
_LEAST_UNTOLD = 1e-3  # part of a parameter in directions that nothing tells


@dataclass(frozen=True)
class NominalFit:
    """A fitted nominal model."""

    model: LogModel  #: with its parameters
    #: of the parameters (P,), robust to the correlation of neighbouring windows;
    #: infinite of those that the rows tell nothing of
    standard_errors: Array

    def to_rows(self) -> list[tuple[str, float, float]]:
        """Returns name, value and standard error of all parameters that have names."""
        names = self.model.nominal.parameter_names
        values = self.model.theta.tolist()
        errors = self.standard_errors.tolist()
        rows = zip(names, values, errors, strict=False)
        return [row for row in rows if row[0]]


def rows_before(model: LogModel) -> int:
    """Returns the rows that windows have before a start, of a model and of baselines.

    Those of ``past_rows_needed`` are enough for all structures of a search instead.
    """
    return max(model.past, PAST)


def judged_steps(steps: int, finer: Sequence[int] = ()) -> tuple[int, ...]:
    """Returns the steps whose errors decide, of rollouts of so many steps.

    Args:
        steps: Of the rollouts, which are among them.
        finer: Others that count as well, where they are no more.
    """
    return tuple(
        sorted({step for step in (*_JUDGED, *finer) if step < steps} | {steps})
    )


@explains_arguments
def fit_nominal(
    model: LogModel, theta0: Array | None, log: Log, steps: int = STEPS
) -> NominalFit:
    """Fits the parameters of a model's nominal part by the errors of its rollouts.

    Args:
        model: Structure, lag and history; its own parameters do not matter.
        theta0: Parameters at which the search begins (P,); by default the nominal
            model's ``start``.
        log: All of its runs are used.
        steps: Of the rollouts; errors at eight of them, evenly spread over the
            logarithm, count.

    Raises:
        SettingError: An argument is of another kind or out of range, theta0 lies
            outside of the parameters' bounds, or two of these are equal.
        ShapeError: theta0 has another length.
        DataError: No piece of the log is long enough, or the rollouts at theta0 are not
            finite.

    See Also:
        ``learn``, which fits and compares several.
    """
    check_kind("model", model, LogModel, "a LogModel")
    check_kind("log", log, Log, "a Log of read_log")
    check_number("steps", steps, least=1, whole=True)
    if isinstance(model.nominal, AffineNominal) and model.nominal.fitted:
        rule = "must have named parameters; learn fits the weights of an AffineNominal"
        raise SettingError("model", rule)
    theta0 = np.asarray(model.nominal.start if theta0 is None else theta0, dtype=float)
    count = len(model.nominal.parameter_names)
    if theta0.shape != (count,):
        raise ShapeError(f"theta0 must have {count} entries; got {theta0.shape}")
    windows = log.windows(steps, past=rows_before(model), most=_WINDOWS)
    lag_count = len(model.time_constants)
    # Parameters, then the time constants of first-order lags.
    first_lag = _first_lag(log.time_step)
    search_start = np.concatenate([theta0, np.full(lag_count, first_lag)])
    bounds = _bounds(model, lag_count)
    if not ((bounds[0] <= search_start) & (search_start <= bounds[1])).all():
        rule = "must lie between the parameters' bounds"
        raise SettingError("theta0", f"{rule}; got {theta0.tolist()}")
    if not len(search_start):
        return NominalFit(replace(model, theta=theta0), standard_errors=theta0)
    sizes = np.where(search_start != 0, np.abs(search_start), 1.0)
    residuals = _RolloutResiduals(model, windows, steps, bounds, sizes)
    theta = _minimize(residuals, search_start)
    if lag_count and theta[count:].min() <= 0 and first_lag > log.time_step:
        # The search jumped below zero. There lags act as none (``FirstOrderLags``), and
        # nothing pulls them back.
        from_a_step = np.concatenate([theta0, np.full(lag_count, log.time_step)])
        theta = min(theta, _minimize(residuals, from_a_step), key=residuals.loss)
    J = residuals.jacobian(theta)
    # The search moves what has no effect as well, anywhere: it is put back.
    has_effect = J.any(axis=0) | (np.arange(len(theta)) >= count)
    theta = np.where(has_effect, theta, search_start)
    time_constants = np.maximum(theta[count:], 0.0)
    standard_errors = _standard_errors(
        J=J,
        residuals=residuals.of_windows(theta[None])[0],
        block=2 * -(-steps // windows.stride),
    )
    fitted = replace(model, theta=theta[:count], time_constants=time_constants)
    return NominalFit(fitted, standard_errors[:count])


def _first_lag(time_step: float) -> float:
    """Returns the time constant of lags [s] at which the search begins.

    Lags of far less than a time step show nothing of themselves, nor do those that are
    far longer than a rollout.
    """
    fewest, most = time_step * np.array(_FIRST_STEPS)
    return float(np.clip(_FIRST_TIME_CONSTANT, fewest, most))


def _minimize(residuals: "_RolloutResiduals", theta0: Array) -> Array:
    """Finds the parameters (P,) within their bounds whose rollouts err least.

    Raises:
        DataError: The rollouts at theta0 are not finite.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        if not (np.abs(residuals(theta0)) < _DIVERGED).all():
            raise DataError(
                "the rollouts are not finite where the search of parameters begins, at "
                f"{residuals.in_words(theta0)}: begin nearer, or with fewer steps"
            )
        solution = least_squares(
            residuals,
            theta0,
            residuals.jacobian,
            bounds=residuals.bounds,
            loss="soft_l1",
            x_scale="jac",
            xtol=1e-4,
            ftol=1e-4,
            max_nfev=_EVALUATIONS,
        )
    return solution.x


def _bounds(model: LogModel, lags: int) -> tuple[Array, Array]:
    """Returns the smallest and largest parameters (P,), those of the lags last."""
    count = len(model.nominal.parameter_names)
    infinite = np.full(count, np.inf)
    low, high = getattr(model.nominal, "bounds", (-infinite, infinite))
    if not (np.asarray(low) < np.asarray(high)).all():
        rule = "must have a low below its high for every parameter"
        raise SettingError("bounds", f"{rule}; got {low} and {high}")
    # Lags have no bound at zero, where many searches would stop: negative ones act as
    # none.
    endless = np.full(lags, np.inf)
    return np.concatenate([low, -endless]), np.concatenate([high, endless])


class _RolloutResiduals:
    """Errors of a model's rollouts as a function of its parameters, without units.

    Args:
        model: Its own parameters do not matter.
        windows: W of them.
        steps: Of the rollouts.
        bounds: Smallest and largest parameters (P,), (P,).
        sizes: That parameters are supposed to have (P,).
    """

    def __init__(
        self,
        model: LogModel,
        windows: Windows,
        steps: int,
        bounds: tuple[Array, Array],
        sizes: Array,
    ):
        self.bounds = bounds
        self._sizes = sizes
        self._model = model
        self._windows = windows
        self._steps = steps
        spread = np.geomspace(1, steps, _COUNTED_STEPS)
        self._counted = np.unique(spread.round().astype(int))
        # What never moves has no error at rest, and no unit of its errors: they do not
        # count.
        moves = np.repeat(moving_groups(windows), _error_dims(windows.space))
        at_rest = errors_at_rest(windows, self._counted)
        self._scale = np.where(moves, at_rest, np.inf)

    def __call__(self, theta: Array) -> Array:
        """Computes the residuals of a parameter vector (P,), as a vector."""
        return self.of_windows(theta[None])[0].ravel()

    def of_windows(self, theta: Array) -> Array:
        """Computes the residuals (T, W, steps, e) of parameter vectors (T, P)."""
        size = max(_BATCH // len(self._windows), 1)
        batches = []
        for first in range(0, len(theta), size):
            batch = theta[first : first + size]
            predicted = self._model.rollout(self._windows, self._steps, batch)
            errors = self._windows.errors(predicted, self._counted)
            batches.append(errors / self._scale)
        residuals = np.concatenate(batches)
        return np.nan_to_num(
            residuals, nan=_DIVERGED, posinf=_DIVERGED, neginf=-_DIVERGED
        )

    def in_words(self, theta: Array) -> str:
        """Returns the named ones of a parameter vector (P,) as a text."""
        named = zip(self._model.nominal.parameter_names, theta, strict=False)
        return ", ".join(f"{name} {value:g}" for name, value in named)

    def loss(self, theta: Array) -> float:
        """Computes the loss that is minimised, of a parameter vector (P,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return float(np.sum(np.sqrt(1 + self(theta) ** 2) - 1))

    def jacobian(self, theta: Array) -> Array:
        """Computes the derivatives of the residuals by the parameters, a column each.

        By differences of one batch, forward, or backward at an upper bound: a system
        may refuse what lies beyond it.
        """
        h = 1e-5 * np.maximum(np.abs(theta), self._sizes)
        low, high = self.bounds
        above = high - theta
        below = theta - low
        h = np.minimum(h, np.maximum(above, below))
        h = np.where(h <= above, h, -h)
        displaced = theta + np.diag(h)
        residuals = self.of_windows(np.concatenate([displaced, theta[None]]))
        differences = residuals[:-1] - residuals[-1]
        slopes = differences / h[:, None, None, None]
        return slopes.reshape(len(theta), -1).T


def errors_at_rest(windows: Windows, steps: np.ndarray) -> Array:
    """Computes the mean errors (steps, e) of a state that does not move.

    They are the same for all entries of a group, and never zero.
    """
    distances = distances_at_rest(windows, steps)
    return np.repeat(distances, _error_dims(windows.space), axis=1)


def distances_at_rest(windows: Windows, steps: Sequence[int] | np.ndarray) -> Array:
    """Computes the mean errors (steps, groups) of a state that does not move.

    They are never zero.
    """
    mean, rounding = _at_rest(windows, steps)
    return np.maximum(mean, 1e-3 * mean.max(axis=0) + rounding)


def moving_groups(windows: Windows) -> np.ndarray:
    """Returns which groups of states move in windows, by more than rounding."""
    mean, rounding = _at_rest(windows, np.arange(1, windows.ahead + 1))
    return mean.max(axis=0) > rounding


def _at_rest(
    windows: Windows, steps: Sequence[int] | np.ndarray
) -> tuple[Array, Array]:
    """Computes mean errors of a state that does not move (steps, groups).

    Beside them stands what is rounding of each group (groups,).
    """
    space = windows.space
    start = windows.states[:, windows.past : windows.past + 1]
    errors = windows.errors(np.repeat(start, windows.ahead, axis=1), steps)
    mean = space.distances(errors).mean(axis=0)
    sizes = space.distances(state_widths(space, start[:, 0]))
    return mean, _ROUNDING * sizes


def _error_dims(space: StateSpace) -> list[int]:
    """Returns the number of the entries of each group's error."""
    return [group.error_dim for group in space.groups]


def mean_logarithm(errors: Array, at_rest: Array) -> Array:
    """Computes the mean logarithm (...) of rollouts' errors over those at rest.

    Args:
        errors: Mean distances (..., steps, groups).
        at_rest: From ``distances_at_rest`` (steps, groups).
    """
    return np.log(np.maximum(errors / at_rest, _EXACT_SHARE)).mean(axis=(-2, -1))


def _standard_errors(J: Array, residuals: Array, block: int) -> Array:
    """Computes standard errors of parameters (P,) by a sandwich estimate.

    Residuals may be correlated within blocks of windows. Parameters of which they say
    nothing, or nothing but a sum or a product, have infinite ones.

    Args:
        J: Derivatives of the residuals (R, P).
        residuals: Of W windows (W, ...), R in all.
        block: Windows that are correlated; fewer count where there are few blocks.
    """
    values = residuals.ravel()
    weights = 1 / np.sqrt(1 + values**2)  # of the loss
    gradients = J * (weights * values)[:, None]
    scores = gradients.reshape(len(residuals), -1, J.shape[1]).sum(axis=1)
    block = max(min(block, len(scores) // _FEWEST_BLOCKS), 1)
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), block))
    curvature = J.T @ (J * weights[:, None])
    sizes = np.sqrt(np.diagonal(curvature))
    sizes = np.where(sizes > 0, sizes, 1.0)
    eigenvalues, eigenvectors = np.linalg.eigh(curvature / np.outer(sizes, sizes))
    is_told = eigenvalues > _LEAST_EIGENVALUE
    told = eigenvectors[:, is_told]
    bread = told / eigenvalues[is_told] @ told.T / np.outer(sizes, sizes)
    covariance = bread @ (blocks.T @ blocks) @ bread
    standard_errors = np.sqrt(np.maximum(np.diagonal(covariance), 0.0))
    # How much of each parameter is in directions in which the residuals stay (P,).
    untold = np.linalg.norm(eigenvectors[:, ~is_told], axis=1)
    return np.where(untold < _LEAST_UNTOLD, standard_errors, np.inf)


def fit_least_squares(kinematics: Kinematics, log: Log) -> LogModel:
    """Fits outputs that are affine in the features, one step ahead on all rows."""
    windows = log.windows(1)
    states = windows.states[:, 0]
    next_states = windows.states[:, 1]
    features = kinematics.features(states, windows.inputs[:, 0], windows.context[:, 0])
    outputs = kinematics.outputs(states, next_states, log.time_step)
    return LogModel(
        kinematics=kinematics,
        nominal=AffineNominal(kinematics),
        theta=fit_affine(features, outputs).T.ravel(),
        history=(0,) * outputs.shape[1],
    )
