"""What a loop measures of a model's state, and how it completes it.

A loop measures the first states of such a model alone. What follows them is known from
the rows before: inputs on their way, what lags hold, what is remembered. It is kept
from step to step by ``at_rest``, where a flight begins, and ``follow``. A model of a
log knows as well how uncertain a state is that sensors like those of the log measured.

Two numbers tell such models apart, and each has several names:

- how many states are measured, the first ones: ``measured_dim`` of a model, all n
  without a past; ``carried_dim`` of a ``LogDynamics`` is the rest. A controller's
  problem weighs ``weighed_dim`` of them, these or all n;
- after how many rows the state is known: ``past`` of a model with one,
  ``rows_before`` of any. ``rows_back`` of a ``Memory`` is its part of it.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Protocol, TypeGuard

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gpmpc._dynamics import Array, DynamicsModel, to_array
from gpmpc.gaussian import Gaussian
from gpmpc.signals import Signals, signals_of


class ModelWithPast(DynamicsModel, Protocol):
    """A model whose state begins with what is measured, and goes on with the past."""

    @property
    def measured_dim(self) -> int:
        """Number of the states that are measured, the first ones."""
        ...

    @property
    def past(self) -> int:
        """Number of rows after which the state forgets what it began with."""
        ...

    def at_rest(self, measured: Array, input: Array) -> Array:
        """Returns the state (n,) of a plant that stood where it is first measured.

        Args:
            measured: (measured_dim,).
            input: That was applied all the time (m,).
        """
        ...

    def follow(self, state: Array, input: Array, measured: Array) -> Array:
        """Returns the next state (n,): what was measured, and the past a row later.

        Args:
            state: That of the step before (n,).
            input: That was applied there (m,).
            measured: What it led to (measured_dim,).
        """
        ...


def measured_dim(model: Any) -> int:
    """Returns the number of a model's states that are measured; all of most models."""
    return getattr(model, "measured_dim", model.state_dim)


def weighed_dim(model: DynamicsModel, problem: Any) -> int:
    """Returns the number of states that a controller's problem weighs.

    They are those that are measured where its dimension says so, and else all.
    """
    measured = measured_dim(model)
    weighs_measured = getattr(problem, "state_dim", None) == measured
    return measured if weighs_measured else model.state_dim


def weighed_signals(model: DynamicsModel, problem: Any) -> Signals:
    """Returns the signals of a model, of the states that a problem is to weigh."""
    return first_signals(signals_of(model), weighed_dim(model, problem))


def measured_signals(model: Any) -> Signals:
    """Returns the signals of a model, of the states that are measured."""
    return first_signals(signals_of(model), measured_dim(model))


def first_signals(signals: Signals, states: int) -> Signals:
    """Returns signals without the names of states beyond a number of them."""
    if len(signals.state_names) <= states:
        return signals
    return replace(signals, state_names=signals.state_names[:states])


def rows_before(model: Any) -> int:
    """Returns the number of rows after which a model's state is known."""
    return model.past if has_past(model) else 0


def has_past(model: Any) -> TypeGuard[ModelWithPast]:
    """Returns whether a model's state holds more than what is measured."""
    measured = getattr(model, "measured_dim", None)
    return measured is not None and measured < model.state_dim


def start_covariance(model: Any, measured: Array) -> Array | None:
    """Returns how uncertain states are that were measured once.

    Args:
        model: Or one around it, of the same measured states.
        measured: The states that are measured (..., n).

    Returns:
        The covariances (..., n, n); None where no model knows them.
    """
    if not knows_starts(model):
        return None
    return _model_that_knows_starts(model).start_covariance(measured)


def knows_starts(model: Any) -> bool:
    """Returns whether a model knows how uncertain states are that were measured once.

    A disturbance that a filter estimates is not measured.
    """
    knowing = _model_that_knows_starts(model)
    return knowing is not None and measured_dim(knowing) == measured_dim(model)


def _model_that_knows_starts(model: Any) -> Any:
    """Returns a model, or one that it is around, with a ``start_covariance``.

    None where there is none.
    """
    while model is not None and not hasattr(model, "start_covariance"):
        model = getattr(model, "model", None)
    return model


def variances_of_next_row(model: Any) -> Array | None:
    """Returns how far a row scatters around what is predicted of it (n,), squared.

    It is the model's noise and, where the model knows it, that of a measured start.
    None where the model has no noise.

    Raises:
        UnsupportedModel: The noise depends on the state.
    """
    noise = getattr(model, "noise_covariance", None)
    if noise is None:
        return None
    variances = to_array(noise).diagonal().copy()
    knowing = _model_that_knows_starts(model)
    if knowing is not None:
        start = knowing.start_covariance()
        variances[: len(start)] += start.diagonal()
    return variances


def as_measured(model: Any, belief: Gaussian, names: Sequence[str]) -> Gaussian:
    """Returns a belief over measured states, as uncertain as its model knows them.

    A belief that is not certain, such as a filter's, stays as it is, and so does one
    over other states.

    Args:
        model: May know it, or one that it is around.
        belief: Sorted by names where it has some.
        names: Of the states.
    """
    is_uncertain = bool(belief.covariance.any())
    if not knows_starts(model) or is_uncertain:
        return belief
    belief = belief.in_order(names)
    if belief.mean.shape[-1] != measured_dim(model):
        return belief
    covariance = start_covariance(model, to_array(belief.mean))
    if covariance is None or not np.isfinite(covariance).all():
        return belief
    return replace(belief, covariance=torch.from_numpy(covariance).to(belief.mean))


def belief_of_measured(model: DynamicsModel, states: Tensor) -> Gaussian:
    """Returns what is believed of states that were measured, with all of their past.

    They are certain where the model does not know better.

    Args:
        model: Of the states.
        states: (S, n + ...), what is measured and what a model carries on.
    """
    n = measured_dim(model)
    covariance = start_covariance(model, to_array(states[:, :n]))
    if covariance is None:
        return Gaussian.certain(states)
    further = states.shape[1] - n
    padded = pad(torch.from_numpy(covariance).to(states), (0, further, 0, further))
    return Gaussian(states, padded)


def states_along(model: ModelWithPast, measured: Array, inputs: Array) -> Array:
    """Returns the states (T, n) along the rows of a flight, from rest at the first one.

    Args:
        model: With a past.
        measured: (T, measured_dim).
        inputs: Each applied from the time of its row on (T - 1 or T, m).
    """
    state = model.at_rest(measured[0], inputs[0])
    states = [state]
    for input, after in zip(inputs, measured[1:], strict=False):
        state = model.follow(state, input, after)
        states.append(state)
    return np.array(states)


def whole_states(model: DynamicsModel, measured: Tensor, inputs: Tensor) -> Tensor:
    """Completes measured states (T, measured_dim) by what a model remembers.

    Arguments are those of ``states_along``. States of a model without a past are
    returned as they are. The result has the type and the device of what was measured.
    """
    if not has_past(model):
        return measured
    whole = states_along(model, to_array(measured), to_array(inputs))
    return torch.from_numpy(whole).to(measured)


def belief_of_all(belief: Gaussian, state: Array) -> Gaussian:
    """Returns a belief over the whole state (n,); what is not measured is certain.

    It is of the type of the belief over what is measured.
    """
    covariance = belief.covariance.new_zeros(len(state), len(state))
    n = belief.mean.shape[-1]
    covariance[:n, :n] = belief.covariance
    return Gaussian(torch.from_numpy(state).to(belief.mean), covariance)
