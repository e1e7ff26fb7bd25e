"""How far a plan is from what its model knows.

Two things may be too large, each beside what the data alone would say:

* what a stage adds: the deviation of the latent function there, over that of what it was learned from. As long as GPs
  know more than the spread of their targets it is below one, and it is no more than one. The prior's own deviation is
  no measure: long length-scales go with signals ten to forty times as wide as the data, so that the ratio to it would
  stay small far beyond them;
* what has grown up to a stage: the predicted deviation of a state, over the range of that state in the data (half a
  turn for an angle). Above one the prediction says less than that the state is somewhere among the data, and that has
  no bound.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from gpmpc._compiled import compiled
from gpmpc._dynamics import Array, DynamicsModel, linearize, to_array
from gpmpc.gp import GPPosterior
from gpmpc.gp._posterior import AffineForm
from gpmpc.models import DelayedModel, DisturbedModel, ResidualModel

_ROWS = 16  # of a kernel matrix that tell observations from pseudo-observations


class DataScales(NamedTuple):
    """What a model's data say of each state (n,)."""

    added: Array  #: variance of what is learned of a step; zero where nothing is
    reached: (
        Array  #: range; infinite where a GP does not see the state, or it never moved
    )


def data_scales(model: DynamicsModel) -> DataScales | None:
    """The scales of GPs, of a residual with a constant B, and of both with delays or disturbances; else None."""
    n = model.state_dim
    if isinstance(model, DelayedModel | DisturbedModel):
        inner = data_scales(model.model)
        return None if inner is None else _with_further_states(inner, n)
    form = _learned_part(model)
    if form is None:
        return None
    B = np.eye(n) if form.B is None else to_array(form.B)
    return DataScales(B**2 @ _learned_variances(form.f), _ranges(form, n))


def _with_further_states(scales: DataScales, n: int) -> DataScales:
    """For n states, of which nothing is learned of those that are further ones."""
    further = n - len(scales.added)
    added = np.append(scales.added, np.zeros(further))
    reached = np.append(scales.reached, np.full(further, np.inf))
    return DataScales(added, reached)


def _learned_part(model: DynamicsModel) -> AffineForm | None:
    """The GPs of a model, where they act and what they see; what is known besides may be any function."""
    if not isinstance(model, ResidualModel):
        return getattr(model, "affine_form", None)
    if callable(model.B) or not isinstance(model.residual, GPPosterior):
        return None
    states = list(model.states)
    angles = tuple(model.angles)
    B = torch.as_tensor(model.B)
    return AffineForm(model.residual, B=B, states=states, angles=angles)


def _learned_variances(gp: GPPosterior) -> Array:
    """Of what each GP learned (k,): its targets' variance, or its prior's, if that is less.

    A GP that found nothing but noise is not asked to know more than to within the noise.
    """
    signal = to_array(gp.signal_variance)
    rows = gp.cholesky[:, :_ROWS, :_ROWS].square().sum(-1)
    noise = to_array(rows) - signal[:, None]
    # The noise of pseudo-observations differs from one to the next, and their spread says nothing.
    if (np.ptp(noise, axis=1) > 1e-6 * (signal + noise[:, 0])).any():
        return signal
    noise = noise[:, 0].clip(0.0)
    spread = to_array(gp.targets.var(dim=0, correction=0))
    constant = spread <= 0.0
    return np.where(constant, signal, np.maximum(np.minimum(signal, spread), noise))


def _ranges(form: AffineForm, n: int) -> Array:
    """Of the states in the data (n,)."""
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
    """The novelty of a plan whose stages add covariances (K, n, n), with the noise (n,), up to some (H + 1, n, n)."""
    return float(_novelty.unchecked(added, noise, covariances, *scales))


def measure_novelty(
    model: DynamicsModel,
    states: Array,
    inputs: Array,
    covariances: Array,
    scales: DataScales,
) -> float:
    """The same of states (H, n) and inputs (H, m) of a plan, at which the model is asked for its variances."""
    found = linearize(model, states, inputs)
    assert found.covariance is not None
    quiet = np.zeros(len(scales.added))
    added = np.ascontiguousarray(found.covariance, dtype=np.float64)
    return novelty_of(added, quiet, covariances, scales)


def later(
    model: DynamicsModel,
    means: Array,
    inputs: Array,
    covariances: Array,
    scales: DataScales,
) -> partial[float]:
    """``measure_novelty`` of a plan's means (H + 1, n), when it is called."""
    return partial(measure_novelty, model, means[:-1], inputs, covariances, scales)


@compiled
def _novelty(added, noise, covariances, learned, reached):
    largest = 0.0
    for k in range(len(added)):
        for i in range(len(learned)):
            if learned[i] > 0.0:
                ratio = (added[k, i, i] - noise[i]) / learned[i]
                largest = max(largest, min(ratio, 1.0))
    for k in range(1, len(covariances)):
        for i in range(len(reached)):
            largest = max(largest, covariances[k, i, i] / reached[i] ** 2)
    return np.sqrt(largest)
