"""Plans that obey the dynamics: roll-outs under a feedback towards a plan.

The feedback u = u' - K (x - x') leads towards the plan (x', u') and exists where inputs
alone would lead an unstable plant away. Its inputs keep their bounds. Gains are those
of the last program where it was condensed in feedback coordinates, else of the
regulator of the stages.
"""

from typing import NamedTuple

import numpy as np

from gpmpc._angles import full_turns
from gpmpc._kernels.gp_rollout import Feedback
from gpmpc.mpc._controller import KEPT, Request
from gpmpc.mpc._linear_quadratic import Plan, Stages
from gpmpc.mpc._linearization import LocalProblem, PredictionModel

Array = np.ndarray

MISS_RATIO = 1.02  # a plan that misses a bound by this times another misses it alike


def roll_out(
    prediction: PredictionModel,
    target: Plan,
    local: LocalProblem,
    feedback: Array,
    request: Request,
) -> LocalProblem:
    """Returns the problem at the plan that obeys the dynamics towards another plan.

    Args:
        prediction: Of the controller.
        target: The plan to follow.
        local: The problem whose stages give the gains where ``feedback`` is empty.
        feedback: Of a program, F_k (H, m, p + m + 1).
        request: Of the decision.
    """
    if not prediction.linearizer.depends_on_covariance:
        plan = _follow(prediction, target, local, feedback, request)
        return prediction.linearize(plan, request)
    return _roll_out_belief(prediction, target, local, feedback, request)


def close_defects(
    prediction: PredictionModel,
    ending: LocalProblem,
    local: LocalProblem,
    feedback: Array,
    request: Request,
) -> LocalProblem:
    """Returns a problem whose plan is rolled out towards its own, so that it obeys.

    It is the problem itself where the roll-out overflows. Where linearising needs no
    covariances, stages and covariances stay as they are.

    Args:
        prediction: Of the controller.
        ending: The problem whose plan may have defects.
        local: The problem that was linearised last, whose feedback is followed.
        feedback: Of its program; see ``roll_out``.
        request: Of the decision.
    """
    if prediction.linearizer.depends_on_covariance:
        obeying = _roll_out_belief(prediction, ending.plan, local, feedback, request)
        return obeying if np.isfinite(obeying.plan.states).all() else ending
    plan = _follow(prediction, ending.plan, local, feedback, request)
    if not np.isfinite(plan.states).all():
        return ending
    rows = ending.rows
    if prediction.constraints.smooth:
        rows = prediction.constraints.at(
            plan,
            ending.covariances,
            prediction.stage_count,
            request.parameters,
            request.kappas,
        )
    cost = prediction.costs.at(plan, request.parameters)
    return ending._replace(plan=plan, rows=rows, cost=cost)


def cost_when_followed(
    prediction: PredictionModel,
    planned: LocalProblem,
    local: LocalProblem,
    feedback: Array,
    request: Request,
) -> float:
    """Returns what it costs to roll the means out towards a plan.

    It is infinite where that overflows. Where means depend on covariances nothing is
    rolled out: it is what the plan itself costs.

    Args:
        prediction: Of the controller.
        planned: The problem whose plan is followed and whose cost counts.
        local: The problem that was linearised last, whose feedback is followed.
        feedback: Of its program; see ``roll_out``.
        request: Of the decision.
    """
    if not prediction.linearizer.depends_on_covariance:
        plan = _follow(prediction, planned.plan, local, feedback, request)
        if not np.isfinite(plan.states).all():
            return np.inf
        planned = planned._replace(plan=plan)
    return float(planned.stage_costs(request.references).sum())


class Outcome(NamedTuple):
    """What inputs lead to, and what they cost."""

    cost: float  # all are infinite where the inputs lead out of the numbers
    soft_price: float  # of violated rows with a declared or an exact price
    hard_miss: float  # the largest violation of a hard row

    def is_much_better_than(self, other: "Outcome", ratio: float) -> bool:
        """Tells whether it costs less than a ratio of another.

        Hard rows come first, and what violations cost never hides the other costs.
        """
        if self.hard_miss < ratio * other.hard_miss:
            return True
        if self.hard_miss > MISS_RATIO * other.hard_miss:
            return False
        total = self.cost + self.soft_price
        if total < ratio * (other.cost + other.soft_price):
            return True
        misses_no_more = self.soft_price <= MISS_RATIO * other.soft_price
        return misses_no_more and self.cost < ratio * other.cost


#: what inputs lead to where the model, a constraint or an output has no number
OUT_OF_NUMBERS = Outcome(cost=np.inf, soft_price=np.inf, hard_miss=np.inf)


def outcome_of_inputs(
    prediction: PredictionModel,
    local: LocalProblem,
    inputs: Array,
    covariances: Array,
    request: Request,
) -> Outcome:
    """Returns what inputs (H, m) cost in the model, and what the plan misses there.

    Each stage's angles count in the turn nearest to its reference. Rows of the states,
    tightened by covariances (H + 1, n, n), count from where they are no longer kept;
    elastic ones do not, whose price is not known before they are missed.

    Args:
        prediction: Of the controller.
        local: A problem of the request, whose stages do not count.
        inputs: To be judged.
        covariances: Of the states.
        request: Of the decision.
    """
    batch = prediction.roll_out_means.open_loop(
        request.state[None], inputs[None], request.disturbance
    )
    states = batch[0]
    if not np.isfinite(states).all():
        return OUT_OF_NUMBERS
    n = prediction.state_dim
    plan = prediction.plan_of(states, inputs, np.zeros((len(states), n, n)))
    references = request.references
    targets = references.states
    turns = full_turns(states[1:] - targets, prediction.problem.cost.angle_indices)
    led = local._replace(
        plan=plan,
        rows=prediction.constraints.at(
            plan,
            np.ascontiguousarray(covariances),
            prediction.stage_count,
            request.parameters,
            request.kappas,
        ),
        cost=prediction.costs.at(plan, request.parameters),
    )
    stage_costs = led.stage_costs(references._replace(states=targets + turns))
    prices = prediction.constraints.prices
    hard = np.isinf(prices)
    soft = ~hard & ~prediction.constraints.elastic
    misses = (led.row_violations() - KEPT).clip(0.0)
    return Outcome(
        cost=float(stage_costs.sum()),
        soft_price=float((misses[:, soft] @ prices[soft]).sum()),
        hard_miss=float(misses[:, hard].max(initial=0.0)),
    )


def _follow(
    prediction: PredictionModel,
    target: Plan,
    local: LocalProblem,
    feedback: Array,
    request: Request,
) -> Plan:
    """Returns the plan that the means obey under a feedback towards another one."""
    limits = prediction.roll_out_bounds
    law = Feedback(
        states=target.states[None],
        inputs=target.inputs[None],
        gains=_feedback_on_means(prediction, local, feedback)[None],
        lower=limits.lower,
        upper=limits.upper,
        rate_lower=limits.rate_lower,
        rate_upper=limits.rate_upper,
        previous_input=request.references.previous_input,
    )
    states, inputs = prediction.roll_out_means(
        target.states[:1], law, request.disturbance
    )
    return Plan(states[0], inputs[0], target.covariances)


def _roll_out_belief(
    prediction: PredictionModel,
    target: Plan,
    local: LocalProblem,
    feedback: Array,
    request: Request,
) -> LocalProblem:
    """Returns ``roll_out`` of a belief whose means depend on its covariances."""
    linearizer = prediction.linearizer
    n = prediction.state_dim
    F = _feedback_on_means(prediction, local, feedback)
    limits = prediction.roll_out_bounds
    last_input = request.references.previous_input
    states = target.states.copy()
    inputs = target.inputs.copy()
    covariances = target.covariances.copy()
    linearizations = []
    for k in range(prediction.horizon):
        off = states[k, :n] - target.states[k, :n]
        input = target.inputs[k] + F[k] @ off
        lowest = last_input + limits.rate_lower[k]
        highest = last_input + limits.rate_upper[k]
        input = np.clip(input, lowest, highest)
        inputs[k] = np.clip(input, limits.lower[k], limits.upper[k])
        last_input = inputs[k]
        stage = linearizer(
            states[k : k + 1],
            inputs[k : k + 1],
            covariances[k : k + 1],
            request.disturbance,
        )
        states[k + 1] = stage.next[0]
        _, after = linearizer.moments(stage.next, covariances[k + 1 : k + 2])
        covariances[k + 1] = after[0]
        linearizations.append(stage)
    stages = Stages._make(map(np.concatenate, zip(*linearizations, strict=True)))
    return prediction.assemble(Plan(states, inputs, covariances), stages, request)


def _feedback_on_means(
    prediction: PredictionModel, local: LocalProblem, feedback: Array
) -> Array:
    """Returns F (H, m, n) of a feedback on the means, u = u' + F (x - x').

    It is a program's, or F = -K with the gains K of the regulator of a problem's
    stages.
    """
    F = feedback
    if not len(feedback):
        stages = local.stages
        F = -prediction.gains(stages.A, stages.B, local.cost)
    return np.ascontiguousarray(F[:, :, : prediction.state_dim])
