"""What a decision starts from: its arguments, the disturbance estimate, a first plan.

A constant error of the model leaves an offset between reference and state. The form
``velocity`` has none: the error is in both of two steps, and not in their difference.
To ``trajectory`` an estimate of it may be added (Pannocchia and Rawlings, 2003), which
an observer moves by its gain L towards what the last step showed:

    d_k = (1 - L) d_{k-1} + L (mu_k - f(mu_{k-1}, u_{k-1}))
"""

from typing import Any

import numpy as np

from gpmpc._angles import full_turns, state_difference
from gpmpc._compiled import compiled
from gpmpc._dynamics import linearize
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.mpc._constraints import keep_rates
from gpmpc.mpc._controller import (
    Decision,
    Reference,
    Request,
    continued_means,
    read_parameters,
)
from gpmpc.mpc._linear_quadratic import Plan, Stages
from gpmpc.mpc._linearization import PredictionModel
from gpmpc.mpc._sqp import FAILURES

Array = np.ndarray

#: A first guess is no motion where a stage of it ends further from where the model
#: leads than this times the range of a state in the data.
MOST_RANGES = 2.0


def read_request(
    prediction: PredictionModel,
    belief: Gaussian,
    reference: Reference,
    previous: Decision | None,
    parameters: Any = None,
    plan: Any = None,
) -> Request:
    """Reads the arguments of a controller's ``control``; see ``GPMPC.control``.

    To ``Request.read`` it adds what needs more than the problem: parameters, the
    disturbance estimate, and the states that inputs handed over lead to.
    """
    horizon = prediction.horizon
    request = Request.read(
        problem=prediction.problem,
        horizon=horizon,
        initial_input=prediction.initial_input,
        belief=belief,
        reference=reference,
        previous=previous,
        plan=plan,
        signals=prediction.signals,
    )
    if parameters is not None:
        request = request._replace(parameters=read_parameters(parameters, horizon))
    if plan is not None and prediction.is_held:
        raise SettingError("plan", "is not taken by a form that linearises one point")
    covariance_mode = prediction.settings.covariance
    if request.kappas is not None and covariance_mode != "zero_order":
        rule = "are for covariances of 'zero_order'"
        raise SettingError("kappas", f"{rule}; this controller has {covariance_mode!r}")
    if prediction.settings.disturbance_gain:
        disturbance = _estimate_disturbance(prediction, request, previous)
        request = request._replace(disturbance=disturbance)
    if not request.finite:
        return request
    if plan is not None and request.guessed_states is None:
        states = _states_of_guess(prediction, request)
        request = request._replace(guessed_states=states)
        request = _turned_towards(states, request, prediction)
    return request


def _states_of_guess(prediction: PredictionModel, request: Request) -> Array:
    """Returns the states (H + 1, n) that the guessed inputs lead to.

    All of them are the first one where the model has no numbers.
    """
    try:
        return prediction.lead(
            request.state, request.guessed_inputs, request.disturbance
        )
    except FAILURES:
        return np.tile(request.state, (prediction.horizon + 1, 1))


def _turned_towards(
    states: Array, request: Request, prediction: PredictionModel
) -> Request:
    """Returns a request whose references are in the turns of states (H + 1, n)."""
    targets = request.references.states
    angles = prediction.problem.cost.angle_indices
    turned = targets + full_turns(states[1:] - targets, angles)
    return request._replace(references=request.references._replace(states=turned))


def _estimate_disturbance(
    prediction: PredictionModel, request: Request, last_decision: Decision | None
) -> Array:
    """Returns d_k (n,); zero without a last decision.

    It comes from the estimate of the last decision and from the state that its input
    led to. Where its plan is of no use, the state was not measured, or the model has no
    numbers there, the estimate stays as it was. After steps of a policy the error is
    that of all of them, and counts as its mean.
    """
    last_estimate = _last_estimate(prediction, last_decision)
    last_plan = request.last_plan
    if last_plan is None or last_plan.is_used_up or not request.finite:
        return last_estimate
    last_input = request.references.previous_input[None]
    try:
        local = linearize(
            prediction.model, last_plan.means[:1], last_input, covariance=False
        )
    except FAILURES:
        return last_estimate
    error = state_difference(request.state, local.mean[0], prediction.angles)
    if not np.isfinite(error).all():
        return last_estimate
    gain = prediction.settings.disturbance_gain / (1 + last_plan.policy_steps)
    return last_estimate + gain * (error - last_estimate)


def _last_estimate(
    prediction: PredictionModel, last_decision: Decision | None
) -> Array:
    """Returns the estimate of a decision (n,), zero where it has none of this size."""
    n = prediction.state_dim
    estimate = None if last_decision is None else last_decision.disturbance
    if estimate is None or np.shape(estimate) != (n,):
        return np.zeros(n)
    return np.array(estimate)


def initial_guess(prediction: PredictionModel, request: Request) -> Plan:
    """Returns the plan handed over, or the last plan, shifted by a stage.

    Without one it is a line from the state to the last reference along the others, and
    its inputs are the previous one, or the reference's where R weighs deviations.
    Inputs handed over alone lead to the model's states; where these are not finite, all
    states of the plan are x_0. The form ``velocity`` holds the belief and the previous
    input.
    """
    if prediction.is_held:
        return _hold_belief(prediction, request)
    means = _guess_means(prediction, request)
    inputs = _guess_inputs(prediction, request)
    covariances = _guess_covariances(prediction, request, means, inputs)
    return prediction.plan_of(means, inputs, covariances)


def _hold_belief(prediction: PredictionModel, request: Request) -> Plan:
    """Returns the belief and the previous input over the whole horizon."""
    count = prediction.horizon + 1
    covariance = np.zeros((1, *request.covariance.shape))
    if prediction.settings.covariance != "none":
        covariance[0] = request.covariance
    state = prediction.linearizer.state(request.state[None], covariance)
    return Plan(
        states=np.repeat(state, count, axis=0),
        inputs=request.constant_guess,
        covariances=np.repeat(covariance, count, axis=0),
    )


def _guess_means(prediction: PredictionModel, request: Request) -> Array:
    """Returns the means of the first plan (H + 1, n)."""
    means = np.empty((prediction.horizon + 1, prediction.state_dim))
    means[0] = request.state
    if request.guessed_states is not None:
        means[1:] = request.guessed_states[1:]
    elif request.last_plan is not None:
        means[1:] = continued_means(request.last_plan, request.state, prediction.angles)
    else:
        targets = request.references.states
        remaining = np.linspace(1.0, 0.0, len(means))[1:, None]
        means[1:] = targets + remaining * (request.state - targets[0])
    return means


def _guess_inputs(prediction: PredictionModel, request: Request) -> Array:
    """Returns the inputs of the first plan (H, m), within bounds and rates."""
    problem = prediction.problem
    inputs = request.guessed_inputs
    if problem.cost.penalized == "deviations" and request.starts_afresh:
        bounds = problem.inputs
        inputs = request.references.inputs.clip(bounds.lower, bounds.upper)
    if problem.input_rates.finite:
        lower, upper = problem.input_rates.sides
        inputs = inputs.copy()
        keep_rates(inputs, request.references.previous_input, lower, upper)
    return inputs


def _guess_covariances(
    prediction: PredictionModel, request: Request, means: Array, inputs: Array
) -> Array:
    """Returns the covariances at which the first plan is linearised (H + 1, n, n).

    Where linearising needs none, as by default, they are zero after Sigma_0: those that
    tighten the rows are ``LocalProblem.covariances``. Else they are those of the last
    plan, unshifted, since they depend on the time since the last measurement; without a
    plan those of the stages at certain states.
    """
    n = prediction.state_dim
    covariances = np.zeros((prediction.horizon + 1, n, n))
    if prediction.settings.covariance != "none":
        covariances[0] = request.covariance
    if not prediction.linearizer.depends_on_covariance:
        return covariances
    if request.last_plan is not None:
        covariances[1:] = request.last_plan.covariances[1:]
        return covariances
    stages = prediction.point_linearizer(means[:-1], inputs, covariances[1:])
    predicted = prediction.predict_covariances(
        stages, prediction.costs.quadratic, request.covariance
    )
    covariances[1:] = predicted[1:]
    return covariances


def is_contradicted(guess: Plan, stages: Stages, ranges: Array) -> bool:
    """Returns whether a model leads far away from a guess, or nowhere, at some stage.

    Args:
        guess: A first plan.
        stages: Linearised along it.
        ranges: Of the states in the model's data (n,), infinite where they are unknown.
    """
    return _leads_away.unchecked(stages.next, stages.A, stages.B, guess.states, ranges)


@compiled
def _leads_away(after, A, B, states, ranges):
    """Returns whether states (H + 1, p) are too far from ``after``, or that no number.

    ``after`` (H, p) is where the model leads from each stage, with the derivatives
    A (H, p, p) and B (H, p, m); the ranges are of the first n states (n,).
    """
    derivatives = 0.0
    for k in range(len(after)):
        for i in range(len(ranges)):
            distance = abs(after[k, i] - states[k + 1, i])
            # One that is no number is within no range.
            if not (distance <= MOST_RANGES * ranges[i] and distance < np.inf):
                return True
        for i in range(A.shape[1]):
            for j in range(A.shape[2]):
                derivatives += 0.0 * A[k, i, j]
            for j in range(B.shape[2]):
                derivatives += 0.0 * B[k, i, j]
    return derivatives != 0.0


def open_loop_plan(prediction: PredictionModel, guess: Plan, request: Request) -> Plan:
    """Returns the plan that the inputs of a guess lead to by the model's means."""
    states = prediction.lead(request.state, guess.inputs, request.disturbance)
    return prediction.plan_of(states, guess.inputs, guess.covariances)
