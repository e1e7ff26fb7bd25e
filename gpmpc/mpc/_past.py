"""Keeps the past of models that have it in their state, from step to step of a loop.

A loop measures the first states of such a model. The others follow from what was
measured and applied before: a ``Command`` holds the state that its step began in, and
the next one begins in the state that the new measurement says. Where there is none, it
is the one that the model predicts.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gpmpc._arrays import is_measured
from gpmpc._dynamics import Array, linearize, to_array
from gpmpc.gaussian import Gaussian
from gpmpc.models._past import ModelWithPast, as_measured, belief_of_all, has_past
from gpmpc.mpc._controller import Decision, Reference, all_measured, model_of
from gpmpc.mpc._sqp import FAILURES
from gpmpc.signals import signals_of


@dataclass(frozen=True)
class Situation:
    """What one step's decision is made on, with the past of the controller's model."""

    belief: Gaussian  #: over the model's whole state
    reference: Reference  #: of it
    #: what the next step's past follows from (n,): mean of the belief, or what was
    #: predicted where nothing was measured; None where nothing is to follow, of models
    #: without a past, and where nothing is known yet, before the first measurement
    state: Array | None = None
    #: as many first states are measured; None where all are, as of models without a
    #: past
    measured_dim: int | None = None

    @classmethod
    def of(
        cls,
        controller: Any,
        belief: Gaussian,
        reference: Reference,
        last_state: Array | None,
        last_input: Array | None,
    ) -> "Situation":
        """Completes what was measured.

        Args:
            controller: Whose model counts.
            belief: Over what is measured, or over all of the model's state. A certain
                one becomes as uncertain as the model knows measured states.
            reference: Likewise.
            last_state: That the step before began in; None at the first.
            last_input: That was applied there.
        """
        model = model_of(controller)
        signals = signals_of(controller)
        belief = as_measured(model, belief, signals.state_names)
        if not has_past(model):
            return cls(belief, reference)
        n = model.measured_dim
        problem = getattr(controller, "problem", None)
        # A loop of all states is told all of them.
        weighed = n if problem is None else problem.state_dim
        if belief.mean.shape[-1] != n or weighed != n:
            return cls(belief, reference)
        belief = belief.in_order(signals.state_names)
        reference = reference.in_order(signals)
        measured = to_array(belief.mean)
        if last_input is None:
            last_input = np.asarray(controller.initial_input, dtype=float)
        state = _state(model, measured, last_state, last_input)
        if state is None:
            unknown = np.full(model.state_dim, np.nan)
            reference = _reference_of_all(reference, np.zeros_like(unknown), n)
            return cls(Gaussian.certain(unknown), reference, measured_dim=n)
        is_known = is_measured(measured).all()
        return cls(
            belief=belief_of_all(belief, state if is_known else np.nan * state),
            reference=_reference_of_all(reference, state, n),
            state=state,
            measured_dim=n,
        )

    def measured_part(self, decision: Decision | None) -> Decision | None:
        """Returns a decision whose plan is of the states that are measured."""
        if self.measured_dim is None:
            return decision
        return plan_of_first_states(decision, self.measured_dim)


def plan_of_first_states(decision: Decision | None, n: int) -> Decision | None:
    """Returns a decision whose plan is of the first n states."""
    if decision is None:
        return None
    return replace(
        decision,
        means=np.ascontiguousarray(decision.means[:, :n]),
        covariances=np.ascontiguousarray(decision.covariances[:, :n, :n]),
    )


def _state(
    model: ModelWithPast,
    measured: Array,
    last_state: Array | None,
    last_input: Array,
) -> Array | None:
    """Returns the state (n,) of now; None where nothing is known of it.

    Where the model has no numbers it is the last one that had some: means over the past
    would keep what is none for ever.
    """
    is_known = is_measured(measured).all()
    if last_state is None:
        return model.at_rest(measured, last_input) if is_known else None
    if is_known:
        state = model.follow(last_state, last_input, measured)
        if all_measured(state):
            return state
        return model.at_rest(measured, last_input)
    try:
        local = linearize(model, last_state[None], last_input[None], covariance=False)
    except FAILURES:
        return last_state
    state = local.mean[0]
    return state if all_measured(state) else last_state


def _reference_of_all(reference: Reference, state: Array, n: int) -> Reference:
    """Returns a reference of the whole state; nothing weighs what was added to it."""
    states = np.asarray(reference.states, dtype=float)
    if states.shape[-1] != n:
        return reference
    further = np.broadcast_to(state[n:], (len(states), len(state) - n))
    return Reference(
        states=np.hstack([states, further]),
        inputs=reference.inputs,
        kappas=reference.kappas,
    )
