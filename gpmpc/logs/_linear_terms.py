"""Fits linear terms of past rows: a ridge regression whose penalty rollouts choose.

One step ahead the smallest penalty looks best, since noisy, smoothed and mistimed rows
explain each other. Many steps ahead it may be useless. So each group of outputs gets
the penalty with which the rollouts of rows that were left out are best: two halves of
the log, each of which is rolled out by what the other one taught. They are chosen on
all rows, once for a structure: chosen by each fold, on fewer rows, they would be others
than those of the model that is written.

Of noisy rows even the best such fit is biased (errors in variables). ``refine`` goes on
from it to the weights whose own rollouts are best, by Gauss-Newton steps (the output
error of Ljung, 1999, section 3.3).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._fitting import (
    distances_at_rest,
    errors_at_rest,
    judged_steps,
    mean_logarithm,
)
from gpmpc.logs._log import Log, LogRun
from gpmpc.logs._regression import Standardization
from gpmpc.models._log_model import LogModel
from gpmpc.models._windows import Windows

PENALTIES = (1e-9, 1e-5, 1e-3, 1e-2, 0.1, 0.3, 1.0)  # of standardised columns, per row
_FIRST_PENALTY = 1e-2
_ROWS = 10_000  # to which a term is fitted
_WINDOWS = 100  # of a half, whose rollouts choose
_BLOCKS = 8  # of a log of few runs, half of which are left out
_FEW_RUNS = 4
_MOST_REFINED = 250  # weights of a term that is refined
_FEW_WEIGHTS = 40  # those of a term for which long rollouts cost little
_STRETCH = 3  # times as long, at most
_ROWS_A_STEP = 20  # of a log, for each step of these
_ROLLED_ROWS = 250_000  # of one Jacobian: weights times windows times steps
_REFINED_WINDOWS = 150
_COUNTED_STEPS = 12  # of a rollout, whose errors count
_PRIOR = 0.1  # weight of the ridge regression, in the mean squared error
_EVALUATIONS = 10
_DIFFERENCE = 1e-5
_LARGEST_ERROR = 1e3


class Moments(NamedTuple):
    """Second moments of standardised regressors z and targets y, per row."""

    mean: Array  # of the regressors (r,); the constant has 0
    deviation: Array  # likewise; the constant has 1
    zz: Array  # (r, r)
    zy: Array  # (r, o)

    def weights(self, penalties: Array) -> Array:
        """Solves the ridge regressions of the outputs.

        Args:
            penalties: Of each output (o,).

        Returns:
            Weights of the regressors as they are (o, r).
        """
        r, o = self.zy.shape
        weights = np.empty((o, r))
        is_penalized = np.r_[np.ones(r - 1), 0.0]
        for penalty in np.unique(penalties):
            outputs = penalties == penalty
            damped = self.zz + np.diag(penalty * is_penalized + 1e-12)
            weights[outputs] = np.linalg.solve(damped, self.zy[:, outputs]).T
        weights /= self.deviation
        weights[:, -1] -= weights[:, :-1] @ self.mean[:-1]
        return weights


def fit_linear_term(model: LogModel, log: Log, penalties: Array) -> LogModel:
    """Fits the linear term of a model on what its nominal part leaves.

    Args:
        model: With its memory, and the parameters of its nominal part.
        log: The data.
        penalties: Of each output (o,).

    Raises:
        DataError: No piece of the log is long enough.
    """
    return replace(model, weights=_moments(model, log).weights(penalties))


def refine_linear_term(model: LogModel, log: Log, steps: int) -> LogModel:
    """Moves the weights of a fitted linear term to where rollouts are best.

    Args:
        model: With its weights.
        log: The data.
        steps: Of the rollouts; those of few weights are longer where the log allows.
    """
    if model.weights.size > _MOST_REFINED:
        return model
    errors = _RolloutErrors.of(model, log, steps)
    with np.errstate(over="ignore", invalid="ignore"):
        solution = least_squares(
            errors,
            np.zeros(model.weights.size),
            errors.jacobian,
            loss="soft_l1",
            xtol=1e-4,
            ftol=1e-4,
            max_nfev=_EVALUATIONS,
        )
    return errors.model_at(solution.x)


@dataclass(frozen=True)
class _RolloutErrors:
    """Errors of rollouts as a function of changes of the weights, without units."""

    model: LogModel
    windows: Windows
    steps: np.ndarray  # whose errors count
    scale: Array  # of the errors (steps, e)
    unit: Array  # of the changes (o, r): each moves the outputs by as much
    mean: Array  # of the regressors, about which they change (r,); the constant has 0

    @classmethod
    def of(cls, model: LogModel, log: Log, steps: int) -> "_RolloutErrors":
        """Chooses windows, as many and as long as the weights allow."""
        longest = max(b - a for run in log for a, b in run.pieces) - model.past - 1
        steps = min(steps, longest)
        if model.weights.size <= _FEW_WEIGHTS:
            # Half of a piece, which has as many starts then as a rollout has steps.
            affordable = min(len(log) // _ROWS_A_STEP, longest // 2)
            steps = int(np.clip(affordable, steps, _STRETCH * steps))
        count = _ROLLED_ROWS // (model.weights.size * steps)
        windows = log.windows(
            steps, past=model.past, most=int(np.clip(count, 40, _REFINED_WINDOWS))
        )
        counted = np.geomspace(1, steps, _COUNTED_STEPS).round().astype(int)
        counted = np.unique(counted)
        moments = _moments(model, log)
        deviation = moments.deviation
        # A regressor that never changes has an infinite deviation: its unit is zero, so
        # that its weight is not moved.
        effects = np.where(np.isfinite(deviation), model.weights * deviation, 0.0)
        # About the means the constant is that of the outputs, wherever a unit begins.
        effects[:, -1] += model.weights @ moments.mean
        size = np.linalg.norm(effects, axis=1, keepdims=True)
        return cls(
            model=model,
            windows=windows,
            steps=counted,
            scale=errors_at_rest(windows, counted),
            unit=size / deviation,
            mean=moments.mean,
        )

    def model_at(self, change: Array) -> LogModel:
        """Returns the model with changed weights (o r,), or many of them (T, o r)."""
        shape = (*change.shape[:-1], *self.unit.shape)
        changes = change.reshape(shape) * self.unit
        changes[..., -1] -= changes @ self.mean
        return replace(self.model, weights=self.model.weights + changes)

    def __call__(self, change: Array) -> Array:
        """Computes the residuals of a change (o r,), as a vector."""
        return self._of_changes(change[None])[0]

    def _of_changes(self, changes: Array) -> Array:
        """Computes the residuals (T, R) of changes (T, P), each with its prior."""
        model = self.model_at(changes)
        errors = model.rollout_errors(self.windows, self.steps) / self.scale
        errors = np.clip(errors, -_LARGEST_ERROR, _LARGEST_ERROR)
        errors = errors.reshape(len(changes), -1)
        weight = np.sqrt(_PRIOR * errors.shape[1] / changes.shape[1])
        return np.concatenate([errors, weight * changes], axis=1)

    def jacobian(self, change: Array) -> Array:
        """Computes the derivatives of the residuals (R, P) by forward differences."""
        displaced = change + _DIFFERENCE * np.eye(len(change))
        residuals = self._of_changes(np.concatenate([displaced, change[None]]))
        return ((residuals[:-1] - residuals[-1]) / _DIFFERENCE).T


def choose_penalties(model: LogModel, log: Log, steps: int) -> Array:
    """Chooses the penalty of each output (o,) by rollouts: of all, then by group.

    Args:
        model: With its memory, and the parameters of its nominal part.
        log: The data.
        steps: Of the rollouts.
    """
    o = len(model.history)
    try:
        trials = [
            _Trial.of(model, *pair, steps) for pair in _left_out_halves(log, model.past)
        ]
    except DataError:  # too short to be divided
        return np.full(o, _FIRST_PENALTY)
    penalties = _best(trials, [np.full(o, penalty) for penalty in PENALTIES])
    groups = model.kinematics.output_groups.values()
    if len(groups) == 1:
        return penalties
    for outputs in groups:
        candidates = [penalties]
        for penalty in PENALTIES:
            candidate = penalties.copy()
            candidate[list(outputs)] = penalty
            candidates.append(candidate)
        penalties = _best(trials, candidates)
    return penalties


def _best(trials: Sequence["_Trial"], candidates: Sequence[Array]) -> Array:
    """Returns the penalties (o,) whose rollouts are best on the whole."""
    costs = np.sum([trial.costs(candidates) for trial in trials], axis=0)
    return candidates[int(np.argmin(costs))]


@dataclass(frozen=True)
class _Trial:
    """A fit to one half of a log, judged by rollouts of the other one."""

    model: LogModel
    moments: Moments  # of the one half
    windows: Windows  # of the other one
    steps: tuple[int, ...]
    at_rest: Array  # errors of a constant state (steps, groups)

    @classmethod
    def of(cls, model: LogModel, log: Log, held_out: Log, steps: int) -> "_Trial":
        """Prepares the trial; raises ``DataError`` where a half is too short.

        Pieces that are too short for so many steps are rolled out to their ends.
        """
        steps = max(min(steps, held_out.longest_piece - model.past - 1), 1)
        windows = held_out.windows(steps, past=model.past, most=_WINDOWS)
        judged = judged_steps(steps)
        at_rest = distances_at_rest(windows, judged)
        return cls(model, _moments(model, log), windows, judged, at_rest)

    def costs(self, candidates: Sequence[Array]) -> Array:
        """Computes the mean logarithm of errors, for penalties beside each other (C,).

        The errors are those of the groups at the judged steps.
        """
        weights = np.stack([self.moments.weights(one) for one in candidates])
        model = replace(self.model, weights=weights)
        errors = model.rollout_errors(self.windows, self.steps)
        distances = self.windows.space.distances(errors).mean(axis=1)
        return mean_logarithm(distances, self.at_rest)


def _moments(model: LogModel, log: Log) -> Moments:
    """Computes the moments of the regressors and the targets of a linear term."""
    stride = max(-(-len(log) // _ROWS), 1)
    rows = [
        _piece_data(model, _as_window(log, run, a, b), stride)
        for run in log
        for a, b in run.pieces
        if b - a > model.past + 1
    ]
    if not rows:
        raise DataError(f"no piece of the log has more than {model.past + 1} rows")
    regressors = np.concatenate([one for one, _ in rows])
    residuals = np.concatenate([other for _, other in rows])
    # What never changes has no effect that could be known.
    others = Standardization.of(regressors[:, :-1])
    with_constant = Standardization(
        mean=np.r_[others.mean, 0.0], deviation=np.r_[others.deviation, 1.0]
    )
    z = with_constant(regressors)
    count = len(z)
    return Moments(*with_constant, z.T @ z / count, z.T @ residuals / count)


def _as_window(log: Log, run: LogRun, begin: int, end: int) -> Windows:
    """Returns a piece of a run as one window, whose start is its last row but one.

    Of all rows up to the start it is known what they led to: each has a target.
    """
    rows = slice(begin, end)
    return Windows(
        space=log.space,
        time_step=log.time_step,
        past=end - begin - 2,
        stride=1,
        states=run.states[None, rows],
        inputs=run.inputs[None, rows],
        context=run.context[None, begin : end - 1],
        runs=np.zeros(1),
        times=run.time[None, end - 2],
    )


def _piece_data(model: LogModel, piece: Windows, stride: int) -> tuple[Array, Array]:
    """Returns the regressors (N, r) and targets (N, o) of every so many rows."""
    rows = slice(model.lag, piece.past + 1)
    features, residuals = model.nominal_residuals(piece, rows)
    rows_back = model.past - model.lag  # of what acts; the delay is in ``features``
    starts = np.arange(rows_back, len(features[0]), stride)
    earlier = starts[:, None] + np.arange(-rows_back, 0)
    remembered = model.memory.begin(features[0][earlier], residuals[0][earlier])
    regressors = model.memory.regressors(features[0][starts], remembered)
    return regressors, residuals[0][starts]


def regression_data(model: LogModel, windows: Windows) -> tuple[Array, Array]:
    """Returns the regressors (W, r) at the starts of windows, and the targets (W, o).

    The targets are what the nominal part leaves of the outputs one step ahead.
    """
    start = windows.past
    states = windows.states[:, start]
    context = windows.context[:, start]
    acting, _ = model.acting_inputs(windows, slice(start, start + 1))
    inputs = acting[:, 0]
    m = windows.inputs.shape[-1]
    remembered = model.parts(model.recall(windows), m).memory
    features = model.features(states, inputs, context)
    next_states = windows.states[:, start + 1]
    measured = model.kinematics.outputs(states, next_states, windows.time_step)
    residuals = measured - model.nominal_outputs(states, inputs, context)
    return model.memory.regressors(features, remembered), residuals


def _left_out_halves(log: Log, past_rows: int) -> list[tuple[Log, Log]]:
    """Splits a log in two halves, each of which is left out once.

    By run where there are enough runs, else by blocks of time that alternate. What a
    block begins with, the past, is the end of the block before.
    """
    runs: Sequence[LogRun] = sorted(log.runs, key=len)
    if len(runs) < _FEW_RUNS:
        runs = [block for run in log.runs for block in _blocks(run, past_rows)]
    halves = [replace(log, runs=tuple(runs[i::2])) for i in range(2)]
    return [(halves[0], halves[1]), (halves[1], halves[0])]


def _blocks(run: LogRun, past_rows: int) -> list[LogRun]:
    """Cuts a run into blocks of time of equal lengths, with the rows before them."""
    ends = np.linspace(0, len(run), _BLOCKS + 1).astype(int).tolist()
    return [run.part(max(a - past_rows, 0), b, f"block {a}") for a, b in pairwise(ends)]
