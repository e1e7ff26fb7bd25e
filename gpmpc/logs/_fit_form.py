"""Fits a form of a model to a log: nominal part, first-order lags, linear term."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._fitting import (
    PAST,
    NominalFit,
    distances_at_rest,
    fit_nominal,
    judged_steps,
    mean_logarithm,
    rows_before,
)
from gpmpc.logs._linear_terms import (
    fit_linear_term,
    refine_linear_term,
    regression_data,
)
from gpmpc.logs._log import Log
from gpmpc.logs._regression import fit_affine
from gpmpc.models._kinematics import RigidBodyKinematics
from gpmpc.models._log_model import LogModel
from gpmpc.models._memory import NO_MEMORY
from gpmpc.models._parametric import AffineNominal

_ROWS_OF_LAGS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0)  # time constants that are tried
_FACTORS_OF_LAGS = (0.0, 0.5, 0.7, 1.4, 2.0)  # by which each is tried to change
_WINDOWS = 150  # whose rollouts compare them
_ALSO_JUDGED = (3, 30)  # steps of these


def fit_from(
    start_from: LogModel,
    model: LogModel,
    log: Log,
    steps: int,
    choose_penalties: Callable[[LogModel], Array],
    starts_on_same_log: bool = False,
) -> NominalFit:
    """Fits a model but for its GPs.

    Args:
        start_from: The search begins at the parameters that this fitted model has in
            common with the other.
        model: The model, whose parameters are not known yet.
        log: The data.
        steps: Of the rollouts.
        choose_penalties: Of a linear term, by the model with its nominal part (o,).
        starts_on_same_log: Whether ``start_from`` was fitted to this log. Then a linear
            term comes upon its nominal part, where the model has the same.
    """
    if model.memory.empty:
        return _fit_nominal_part(start_from, model, log, steps)
    if starts_on_same_log and _has_equal_nominal_part(start_from, model):
        model = replace(
            model, theta=start_from.theta, time_constants=start_from.time_constants
        )
        with_term = _fit_term(model, log, steps, choose_penalties(model))
        return NominalFit(with_term, standard_errors=np.empty(0))
    without_memory = replace(
        model,
        memory=NO_MEMORY,
        weights=np.empty((0, 0)),
        gps=(),
        history=_disturbed_outputs(model),
    )
    fit = _fit_nominal_part(start_from, without_memory, log, steps)
    fitted = replace(
        model, theta=fit.model.theta, time_constants=fit.model.time_constants
    )
    with_term = _fit_term(fitted, log, steps, choose_penalties(fitted))
    return replace(fit, model=with_term)


def _fit_term(model: LogModel, log: Log, steps: int, penalties: Array) -> LogModel:
    """Fits the linear term of a model by its way of fitting."""
    fitted = fit_linear_term(model, log, penalties)
    if not model.refined:
        return fitted
    return refine_linear_term(fitted, log, steps)


def _has_equal_nominal_part(one: LogModel, other: LogModel) -> bool:
    """Returns whether two models have the same nominal part and the same lags."""
    same = one.nominal == other.nominal and one.lag == other.lag
    return same and len(one.time_constants) == len(other.time_constants)


def _disturbed_outputs(model: LogModel) -> tuple[int, ...]:
    """Returns the rows over which disturbances are averaged beside the nominal part.

    A memory sees disturbances of forces, which change slowly; parameters are fitted
    with them, and not biased by them.
    """
    outputs = len(model.history)
    if not isinstance(model.kinematics, RigidBodyKinematics):
        return (0,) * outputs
    forces = model.kinematics.output_groups["force"]
    return tuple(PAST if output in forces else 0 for output in range(outputs))


def _fit_nominal_part(
    start_from: LogModel, model: LogModel, log: Log, steps: int
) -> NominalFit:
    """Fits the nominal part and the first-order lags of a model without memory."""
    nominal = model.nominal
    if isinstance(nominal, AffineNominal):
        fitted = _fit_affine(model, log, steps)
        return NominalFit(fitted, standard_errors=np.empty(0))
    names = start_from.nominal.parameter_names
    fitted_values = dict(zip(names, start_from.theta, strict=False))
    defaults = zip(nominal.parameter_names, nominal.start, strict=True)
    theta0 = np.array([fitted_values.get(name, value) for name, value in defaults])
    return fit_nominal(model, theta0, log, steps)


def _fit_affine(model: LogModel, log: Log, steps: int) -> LogModel:
    """Fits an affine nominal part one step ahead, and first-order lags on rollouts."""
    nominal = model.nominal
    assert isinstance(nominal, AffineNominal)
    if not nominal.fitted and len(model.time_constants):
        # The lags are for the inputs of a memory's linear term, which is fitted later:
        # those with which an affine part predicts best are right for it as well.
        fitted = replace(model, nominal=replace(nominal, fitted=True))
        lags = _fit_affine(fitted, log, steps).time_constants
        return replace(model, time_constants=lags)
    if not len(model.time_constants):
        return _fit_affine_part(model, log) if nominal.fitted else model
    m = len(log.input_names)
    trials = _LagTrials(model, log, steps)
    candidates = [np.full(m, rows * log.time_step) for rows in _ROWS_OF_LAGS]
    best = min(candidates, key=trials.cost)
    for i in range(m):
        candidates = [best]
        for factor in _FACTORS_OF_LAGS:
            candidate = best.copy()
            candidate[i] *= factor
            candidates.append(candidate)
        best = min(candidates, key=trials.cost)
    return trials.fit(best)


class _LagTrials:
    """Affine models with time constants of first-order lags, and their rollouts."""

    def __init__(self, model: LogModel, log: Log, steps: int):
        self._model = model
        self._log = log
        self._windows = log.windows(steps, past=rows_before(model), most=_WINDOWS)
        self._steps = judged_steps(steps, finer=_ALSO_JUDGED)
        self._at_rest = distances_at_rest(self._windows, self._steps)

    def fit(self, time_constants: Array) -> LogModel:
        """Fits the affine part of the model with time constants (m,)."""
        model = replace(self._model, time_constants=time_constants)
        return _fit_affine_part(model, self._log)

    def cost(self, time_constants: Array) -> float:
        """Computes the mean logarithm of the groups' errors at the judged steps."""
        fitted = self.fit(time_constants)
        errors = fitted.rollout_errors(self._windows, self._steps)
        distances = self._windows.space.distances(errors).mean(axis=0)
        return float(mean_logarithm(distances, self._at_rest))


def _fit_affine_part(model: LogModel, log: Log) -> LogModel:
    """Fits an affine nominal part one step ahead on all rows."""
    has_lags = len(model.time_constants) > 0
    least_past = PAST if has_lags else 0
    windows = log.windows(1, past=max(model.past, least_past))
    still = replace(
        model,
        nominal=AffineNominal(model.kinematics, fitted=False),
        history=(0,) * len(model.history),
    )
    regressors, outputs = regression_data(still, windows)
    features = regressors[:, :-1]  # the last one is the constant
    return replace(model, theta=fit_affine(features, outputs).T.ravel())
