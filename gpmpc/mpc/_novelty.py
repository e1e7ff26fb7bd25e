"""Measures how far a plan is from what its model knows.

Two things may be too large, each beside what the data alone would say:

* what a stage adds: the deviation of the latent function there, over that of what it
  was learned from. As long as GPs know more than the spread of their targets it is
  below one, and it is no more than one. The prior's own deviation is no measure: long
  length-scales go with signals ten to forty times as wide as the data, so that the
  ratio to it would stay small far beyond them;
* what has grown up to a stage: the predicted deviation of a state, over the range of
  that state in the data (half a turn for an angle). Above one the prediction says less
  than that the state is somewhere among the data, and that has no bound.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from gpmpc._compiled import compiled
from gpmpc._dynamics import Array, DynamicsModel, linearize, to_array
from gpmpc.gp import GPPosterior
from gpmpc.gp._posterior import AffineForm
from gpmpc.models import DelayedModel, DisturbedModel, LogDynamics, ResidualModel
from gpmpc.models._kinematics import Increments

_ROWS = 16  # of a kernel matrix that tell observations from pseudo-observations


class DataScales(NamedTuple):
    """What a model's data say of each state (n,)."""

    variances: Array  #: of what is learned of a step; zero where nothing is
    #: of the state in the data; infinite where no GP sees it, or it never moved
    ranges: Array


def data_scales(model: DynamicsModel) -> DataScales | None:
    """Returns the scales of a model's data; None where they are not known.

    They are for GPs, a residual with a constant B, the GPs of a log, and for all of
    them with delays or disturbances.
    """
    n = model.state_dim
    if isinstance(model, DelayedModel | DisturbedModel):
        inner = data_scales(model.model)
        return None if inner is None else _with_further_states(inner, n)
    if isinstance(model, LogDynamics):
        return _log_scales(model)
    form = _learned_part(model)
    if form is None:
        return None
    B = np.eye(n) if form.B is None else to_array(form.B)
    return DataScales(
        variances=B**2 @ _learned_variances(form.f), ranges=_ranges(form, n)
    )


def _log_scales(model: LogDynamics) -> DataScales | None:
    """Returns the scales of the data of a log's model; None where they are not known.

    They are for GPs on rates of change.
    """
    gps = model.model.gps
    if not isinstance(model.model.kinematics, Increments):
        return None
    if not gps or model.ranges is None:
        return None
    n = model.measured_dim
    if len(model.model.history) != n:  # a quaternion has one rate less than entries
        return None
    outputs = np.zeros(n)
    for gp in gps:
        outputs[list(gp.outputs)] += _learned_variances(gp.posterior)
    ranges = np.ptp(model.ranges[:, :n], axis=0)
    ranges[list(model.angles)] = np.pi
    ranges = np.where(ranges > 0.0, ranges, np.inf)
    scales = DataScales(variances=model.time_step**2 * outputs, ranges=ranges)
    return _with_further_states(scales, model.state_dim)


def _with_further_states(scales: DataScales, n: int) -> DataScales:
    """Returns scales for n states: of further ones nothing is learned."""
    further = n - len(scales.variances)
    return DataScales(
        variances=np.append(scales.variances, np.zeros(further)),
        ranges=np.append(scales.ranges, np.full(further, np.inf)),
    )


def _learned_part(model: DynamicsModel) -> AffineForm | None:
    """Returns the GPs of a model, where they act and what they see.

    What is known besides may be any function.
    """
    if not isinstance(model, ResidualModel):
        return getattr(model, "affine_form", None)
    if callable(model.B) or not isinstance(model.residual, GPPosterior):
        return None
    states = list(model.states)
    angles = tuple(model.angles)
    B = torch.as_tensor(model.B)
    return AffineForm(model.residual, B=B, states=states, angles=angles)


def _learned_variances(gp: GPPosterior) -> Array:
    """Returns the variances of what each GP learned (k,).

    That is the variance of its targets, or of its prior, if that is less. A GP that
    found nothing but noise is not asked to know more than to within the noise.
    """
    signal = to_array(gp.signal_variance)
    rows = gp.cholesky[:, :_ROWS, :_ROWS].square().sum(-1)
    noise = to_array(rows) - signal[:, None]
    # The noise of pseudo-observations differs from one to the next, and their variance
    # says nothing.
    if (np.ptp(noise, axis=1) > 1e-6 * (signal + noise[:, 0])).any():
        return signal
    noise = noise[:, 0].clip(0.0)
    targets = to_array(gp.targets.var(dim=0, correction=0))
    learned = np.maximum(np.minimum(signal, targets), noise)
    return np.where(targets <= 0.0, signal, learned)


def _ranges(form: AffineForm, n: int) -> Array:
    """Returns the ranges of the states in the data (n,)."""
    ranges = np.full(n, np.inf)
    features = to_array(form.f.features)
    widths = features.max(axis=0) - features.min(axis=0)
    states = range(n) if form.states is None else form.states
    column = 0
    for state in states:
        if state in form.angles:  # seen as sine and cosine
            ranges[state] = np.pi
            column += 2
            continue
        if widths[column] > 0.0:
            ranges[state] = widths[column]
        column += 1
    return ranges


def novelty_of(
    added: Array, noise: Array, covariances: Array, scales: DataScales
) -> float:
    """Returns the novelty of a plan.

    Args:
        added: Covariances that its stages add (K, n, n).
        noise: Variances that are part of them whatever the model knows (n,).
        covariances: Predicted up to each stage (H + 1, n, n).
        scales: Of the model's data.
    """
    return float(_novelty.unchecked(added, noise, covariances, *scales))


def measure_novelty(
    model: DynamicsModel,
    states: Array,
    inputs: Array,
    covariances: Array,
    scales: DataScales,
) -> float:
    """Returns the novelty of a plan of states (H, n) and inputs (H, m).

    The model is asked for its variances there.
    """
    local = linearize(model, states, inputs)
    assert local.covariance is not None
    no_noise = np.zeros(len(scales.variances))
    added = np.ascontiguousarray(local.covariance, dtype=np.float64)
    return novelty_of(added, no_noise, covariances, scales)


def novelty_when_read(
    model: DynamicsModel,
    means: Array,
    inputs: Array,
    covariances: Array,
    scales: DataScales,
) -> partial[float]:
    """Returns what measures the novelty of a plan's means (H + 1, n) when called."""
    return partial(measure_novelty, model, means[:-1], inputs, covariances, scales)


@compiled
def _novelty(added, noise, covariances, variances, ranges):
    largest = 0.0
    for k in range(len(added)):
        for i in range(len(variances)):
            if variances[i] > 0.0:
                ratio = (added[k, i, i] - noise[i]) / variances[i]
                if ratio != ratio:  # what is no number is not known
                    return np.inf
                largest = max(largest, min(ratio, 1.0))
    for k in range(1, len(covariances)):
        for i in range(len(ranges)):
            ratio = covariances[k, i, i] / ranges[i] ** 2
            if ratio != ratio:
                return np.inf
            largest = max(largest, ratio)
    return np.sqrt(largest)
