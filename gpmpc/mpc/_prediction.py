"""What a controller predicts with: the first guess of a plan, the stages at it, their covariances, the tightened rows.

Its *form* says where the dynamics are linearised:

* ``trajectory``: at every stage of the last plan, one step on; before the first plan, of the reference. Plans need not
  obey the dynamics (multiple shooting): what they miss, the defects, is part of the stages.
* ``velocity``: at the current belief and the last input, one linearisation held over the horizon (Cao, Lai and Alam,
  2017, section 4): ds_{k+1} = A ds_k + B du_k, which summed up is affine again, c = s_0 - A s_{-1} - B u_{-1}. Between
  two measured states S does not change, which says nothing of how it will grow: there the rows of S take the c of the
  linearisation itself.

A constant error of the model leaves an offset between reference and state. ``velocity`` has none: the error is in both
of two steps, and not in their difference. To ``trajectory`` an estimate of it may be added (Pannocchia and Rawlings,
2003), which an observer moves by its gain L towards what the last step showed:

    d_k = (1 - L) d_{k-1} + L (mu_k - f(mu_{k-1}, u_{k-1}))

Covariances of ``zero_order`` are predicted under a feedback u = u_k - K_k (x - mu_k),

    Sigma_{k+1} = (A_k - B_k K_k) Sigma_k (A_k - B_k K_k)' + V_k

because the next solves will see the next states and correct what went wrong (Hewing, Kabzan and Zeilinger, 2020). K_k
are the gains of the finite-horizon LQR of the plan's own stages: a gain that is held over the horizon would drive
deviations on where an input changes the sign of its effect along the plan, as in every swing-up. The feedback is of the
covariances only: the bounds of the inputs hold for u_k.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from gpmpc._angles import angles_of, full_turns, state_difference
from gpmpc._compiled import compiled
from gpmpc._dynamics import DynamicsModel, check_next_states, linearize
from gpmpc._kernels.gp_rollout import Feedback
from gpmpc._kernels.linalg import copy_matrix, product
from gpmpc.exceptions import SettingError, ShapeError, check_choice, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.models import RollOut
from gpmpc.mpc._controller import (
    Decision,
    Reference,
    Request,
    check_controller,
    check_method,
    read_parameters,
)
from gpmpc.mpc._linear_quadratic import (
    InputBounds,
    QuadraticCost,
    StageRows,
    Stages,
    evaluate_stages,
    finite_horizon_lqr,
)
from gpmpc.mpc._stages import (
    COVARIANCES,
    ConstraintRows,
    Covariance,
    Plan,
    StageCosts,
    StageLinearizer,
    keep_rates,
    largest_violation,
)
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Linearization, Propagator
from gpmpc.signals import signals_of

Array = np.ndarray

Form = Literal["trajectory", "velocity"]
FORMS = ("trajectory", "velocity")


class Prediction(NamedTuple):
    """A plan, the stages linearised at it, the covariances of its states, and the rows tightened by them."""

    plan: (
        Plan  # where the stages were linearised; with ``velocity`` its first stage only
    )
    stages: Stages
    covariances: Array  # Sigma_0 .. Sigma_H (H + 1, n, n)
    rows: StageRows
    cost: QuadraticCost  # with outputs linearised at the plan


@dataclass(frozen=True)
class PredictionSettings:
    """How beliefs are predicted.

    Raises:
        SettingError: An unknown form or covariance mode, a gain out of range, or one with ``"velocity"``.
    """

    #: where the dynamics are linearised: ``"trajectory"``, at every stage of the last plan; ``"velocity"``, at the
    #: current belief, held over the horizon (Cao, Lai and Alam, 2017, section 4)
    form: Form = "trajectory"
    #: what the program holds: ``"full"``, means and roots of the covariances; ``"diagonal"``, means and standard
    #: deviations; ``"zero_order"``, means, with covariances predicted beside it; ``"none"``, means alone
    covariance: Covariance = "zero_order"
    #: predicts the covariances of ``"zero_order"`` under a feedback, without which no long horizon with state
    #: constraints is feasible, and lets the iteration roll plans out under it. The covariances of ``"full"`` and
    #: ``"diagonal"`` are those without feedback
    feedback: bool = True
    disturbance_gain: float = 0.0  #: L in [0, 1], the observer gain of the constant-disturbance estimate; 0 disables it
    #: ends a decision with a roll-out under the feedback, so that its plan obeys the model's dynamics however few
    #: programs it took; for ``"trajectory"``
    rolled_out: bool = False

    def __post_init__(self) -> None:
        check_choice("form", self.form, FORMS)
        check_choice("covariance", self.covariance, COVARIANCES)
        for key in ("feedback", "rolled_out"):
            if not isinstance(getattr(self, key), bool):
                raise SettingError(
                    key, f"must be true or false; got {getattr(self, key)!r}"
                )
        if self.rolled_out and self.form == "velocity":
            raise SettingError(
                "rolled_out", "is for plans of form 'trajectory'; got form 'velocity'"
            )
        check_number("disturbance_gain", self.disturbance_gain, least=0)
        if self.disturbance_gain > (self.form != "velocity"):
            velocity = self.form == "velocity"
            rule = (
                "be 0 for form 'velocity', which needs none"
                if velocity
                else "lie between 0 and 1"
            )
            raise SettingError(
                "disturbance_gain", f"must {rule}; got {self.disturbance_gain}"
            )


class PredictionModel:
    """Predicts beliefs for one problem; checks that the settings belong to the model."""

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float] | Array,
        settings: PredictionSettings,
    ):
        self.initial_input = check_controller(
            problem,
            *check_next_states(model),
            horizon,
            initial_input,
            signals_of(model).input_names,
        )
        check_method("propagator", propagator, "propagate", "Linearization()")
        if not isinstance(settings, PredictionSettings):
            raise SettingError(
                "prediction",
                f"must be PredictionSettings(...); got {type(settings).__name__}",
            )
        self.propagator = propagator
        self.problem = problem
        self.horizon = horizon
        self.settings = settings
        self.points = horizon if settings.form == "trajectory" else 1
        self._set_model(model)
        inputs = problem.inputs.by_stage(horizon)
        rates = problem.input_rates.by_stage(horizon)
        self._limits = (*inputs, *rates)
        rated = horizon if problem.input_rates.finite else 0
        self.bounds = InputBounds(*inputs, *[side[:rated] for side in rates])
        self.constraints = ConstraintRows(problem, horizon, settings.covariance)
        self.costs = StageCosts(problem, horizon, self.linearizer)

    def with_model(self, model: DynamicsModel) -> "PredictionModel":
        """Returns the predictions by another model of as many states and inputs."""
        signals_of(model).check("the model", self.signals, "the controller", "model")
        other = copy(self)
        other._set_model(model)
        return other

    def _set_model(self, model: DynamicsModel) -> None:
        self.model, self.linearizer = (
            model,
            StageLinearizer(model, self.propagator, self.settings.covariance),
        )
        noisy = getattr(self.propagator, "process_noise", False)
        self._at_points = StageLinearizer(
            model, Linearization(noisy), "zero_order"
        )  # for the first guess of covariances
        self._roll_out = RollOut(model)
        #: what cost or model take for angles: a sensor may show them within a turn
        self.angles = sorted({*self.problem.cost.angles, *angles_of(model)})
        self.signals = signals_of(model)

    def read(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None,
        parameters: Any = None,
        plan: Any = None,
    ) -> Request:
        """The arguments of a controller's ``control``, whose dimensions are checked, with the disturbance estimate."""
        problem = self.problem
        H = self.horizon
        request = Request.read(
            problem,
            H,
            self.initial_input,
            belief,
            reference,
            previous,
            plan,
            self.signals,
        )
        if parameters is not None:
            request = request._replace(parameters=read_parameters(parameters, H))
        if reference.inputs is None and problem.cost.penalized == "deviations":
            raise ShapeError(
                f"penalized 'deviations' needs reference inputs ({H}, {problem.input_dim}); got none"
            )
        if request.kappas is not None and self.linearizer.covariance != "zero_order":
            mode = self.linearizer.covariance
            raise SettingError(
                "kappas",
                f"are for covariances of 'zero_order'; this controller has {mode!r}",
            )
        if self.settings.disturbance_gain and request.finite:
            request = request._replace(disturbance=self._disturbance(request))
        if (
            plan is not None and request.states is None and request.finite
        ):  # those that the inputs lead to
            request = request._replace(
                states=self.lead(
                    request.state, request.initial_guess, request.disturbance
                )
            )
        return request

    def lead(
        self, state: Array, inputs: Array, disturbance: Array | None = None
    ) -> Array:
        """The states (H + 1, n) that inputs (H, m) lead to; all of them the first one where these are not finite."""
        states = self._roll_out.open_loop(state[None], inputs[None], disturbance)[0]
        return states if np.isfinite(states).all() else np.tile(state, (len(states), 1))

    def initial_guess(self, request: Request) -> Plan:
        """The plan handed over, or the last plan, shifted by a stage.

        Without one it is a line from the state to the last reference along the others, and its inputs are the previous
        one, or the reference's where R weighs deviations. Inputs handed over alone lead to the model's states;
        where these are not finite, the plan's are x_0.

        Covariances are those of the last plan, unshifted: they depend on the time since the last measurement.
        """
        H = self.horizon
        n = self.problem.state_dim
        problem = self.problem
        means = np.empty((H + 1, n))
        covariances = np.zeros((H + 1, n, n))
        means[0] = request.state
        if self.linearizer.covariance != "none":
            covariances[0] = request.covariance
        if self.settings.form == "velocity":
            means[1:] = request.state
            covariances[1:] = covariances[0]
            return Plan(
                self.linearizer.state(means, covariances),
                request.constant_guess,
                covariances,
            )
        inputs = request.initial_guess
        last = request.previous
        if request.states is not None:
            means[1:] = request.states[1:]
        elif last is not None:
            means[1:H], means[H] = last.means[2:], last.means[H]
            if problem.cost.angles:  # a sensor may have taken a turn off
                means[1:] += full_turns(
                    request.state - last.means[1], problem.cost.angles
                )
        else:
            targets = request.references.states
            shares = np.linspace(1.0, 0.0, H + 1)[1:, None]
            means[1:] = targets + shares * (request.state - targets[0])
            if problem.cost.penalized == "deviations":
                inputs = request.references.inputs.clip(
                    problem.inputs.lower, problem.inputs.upper
                )
        if problem.input_rates.finite:
            inputs = inputs.copy()
            keep_rates(
                inputs, request.references.previous_input, *problem.input_rates.sides
            )
        if last is not None and not self.linearizer.at_points:
            covariances[1:] = last.covariances[1:]
        elif not self.linearizer.at_points:  # of the stages at the points
            stages = self._at_points(means[:-1], inputs, covariances[1:])
            covariances[1:] = self._covariances(
                stages, self.costs.quadratic, request.covariance
            )[1:]
        return Plan(self.linearizer.state(means, covariances), inputs, covariances)

    def linearize(self, plan: Plan, request: Request) -> Prediction:
        """The stages of a plan, linearised in one call, with covariances, rows and cost."""
        K = self.points
        stages = self.linearizer(
            plan.states[:K], plan.inputs[:K], plan.covariances[:K], request.disturbance
        )
        return self.predict(plan, stages, request)

    def linearize_many(self, requests: Sequence[Request]) -> list[Prediction]:
        """``linearize`` at the first guesses of many requests, all stages of all of them in one call."""
        if not requests:
            return []
        K = self.points
        T = len(requests)
        plans = list(map(self.initial_guess, requests))
        states, inputs, covariances = (
            np.concatenate([s[:K] for s in parts]) for parts in zip(*plans, strict=True)
        )
        disturbances = [
            np.tile(r.disturbance, (K, 1))
            for r in requests
            if r.disturbance is not None
        ]
        disturbance = np.concatenate(disturbances) if disturbances else None
        stages = self.linearizer(states, inputs, covariances, disturbance)
        parts = zip(
            *(part.reshape(T, K, *part.shape[1:]) for part in stages), strict=True
        )
        return list(map(self.predict, plans, map(Stages._make, parts), requests))

    def canonical(self, plan: Plan) -> Plan:
        """A plan whose s are those of its beliefs: with roots that are positive semidefinite."""
        means, covariances = self.linearizer.moments(plan.states, plan.covariances)
        return Plan(self.linearizer.state(means, covariances), plan.inputs, covariances)

    def predict(self, plan: Plan, stages: Stages, request: Request) -> Prediction:
        """Covariances, rows and cost for stages that were linearised at a plan; see ``linearize``."""
        covariances = plan.covariances
        mode = self.linearizer.covariance
        cost = self.costs.at(plan, request.parameters)
        if mode == "zero_order":
            covariances = self._covariances(stages, cost, request.covariance)
        elif self.settings.form == "velocity" and mode != "none":
            covariances = np.repeat(
                self.linearizer.moments(stages.next, covariances)[1],
                self.horizon + 1,
                axis=0,
            )
            covariances[0] = request.covariance
        if self.settings.form == "velocity" and request.previous is not None:
            stages = self._increments(plan, stages, request, request.previous)
        rows = self.constraints.at(
            plan, covariances, self.points, request.parameters, request.kappas
        )
        return Prediction(plan, stages, covariances, rows, cost)

    def _increments(
        self, plan: Plan, stages: Stages, request: Request, previous: Decision
    ) -> Stages:
        """A held linearisation as that of the increments since s_{-1}, the state that the last decision began at."""
        turns = full_turns(request.state - previous.means[0], self.angles)
        mean_before = previous.means[:1] + turns
        before = self.linearizer.state(mean_before, previous.covariances[:1])[0]
        c = (
            plan.states[0]
            - stages.A[0] @ before
            - stages.B[0] @ request.references.previous_input
        )
        if not request.covariance.any():
            n = self.problem.state_dim
            c[n:] = stages.c[0, n:]
        return stages._replace(c=c[None])

    def violation(self, prediction: Prediction, request: Request) -> float:
        """By how much the plan of a prediction misses a bound, at most."""
        return largest_violation.unchecked(
            prediction.rows,
            self.bounds,
            prediction.plan,
            request.references.previous_input,
        )

    def stage_costs(self, prediction: Prediction, request: Request) -> Array:
        """What each stage of the plan of a prediction costs (H,)."""
        return evaluate_stages.unchecked(
            prediction.cost,
            prediction.plan.states,
            prediction.plan.inputs,
            request.references,
            1.0,
        )

    def cost_of_inputs(self, inputs: Array, request: Request) -> float:
        """What the plan costs that inputs (H, m) lead to."""
        states = self.lead(request.state, inputs, request.disturbance)
        return self._cost_along(states, inputs, request)

    def _cost_along(self, states: Array, inputs: Array, request: Request) -> float:
        """What means (H + 1, n) and inputs cost, each stage's angles in the turn nearest to its reference."""
        n = self.problem.state_dim
        plan = Plan(
            self.linearizer.state(states, np.zeros((len(states), n, n))),
            inputs,
            np.zeros((len(states), n, n)),
        )
        references = request.references
        targets = references.states
        turns = full_turns(states[1:] - targets, self.problem.cost.angles)
        stages = evaluate_stages.unchecked(
            self.costs.at(plan, request.parameters),
            plan.states,
            inputs,
            references._replace(states=targets + turns),
            1.0,
        )
        return float(stages.sum())

    def obey(
        self,
        prediction: Prediction,
        linearized: Prediction,
        feedback: Array,
        request: Request,
    ) -> Prediction:
        """The prediction whose plan obeys the dynamics under a feedback towards its own; itself where that overflows.

        The feedback is one at the prediction that was ``linearized`` last. Stages and
        covariances stay those of it where dynamics are linearised at points.
        """
        if not self.linearizer.at_points:
            obeying = self.roll_out(prediction.plan, linearized, feedback, request)
            return obeying if np.isfinite(obeying.plan.states).all() else prediction
        plan = self._follow(prediction.plan, linearized, feedback, request)
        if not np.isfinite(plan.states).all():
            return prediction
        rows = prediction.rows
        if self.constraints.smooth:
            rows = self.constraints.at(
                plan,
                prediction.covariances,
                self.points,
                request.parameters,
                request.kappas,
            )
        cost = self.costs.at(plan, request.parameters)
        return prediction._replace(plan=plan, rows=rows, cost=cost)

    def _follow(
        self, target: Plan, prediction: Prediction, feedback: Array, request: Request
    ) -> Plan:
        """The plan that the means obey under a feedback towards another one, within its bounds."""
        law = Feedback(
            target.states[None],
            target.inputs[None],
            self._gains_towards(prediction, feedback)[None],
            *self._limits,
            request.references.previous_input,
        )
        states, inputs = self._roll_out(target.states[:1], law, request.disturbance)
        return Plan(states[0], inputs[0], target.covariances)

    def _gains_towards(self, prediction: Prediction, feedback: Array) -> Array:
        """Gains (H, m, n) of a feedback on the means: a program's, or the regulator of a prediction's stages."""
        gains = feedback
        if not len(feedback):
            stages = prediction.stages
            gains = -self.gains(stages.A, stages.B, prediction.cost)
        return np.ascontiguousarray(gains[:, :, : self.problem.state_dim])

    def roll_out(
        self, towards: Plan, prediction: Prediction, feedback: Array, request: Request
    ) -> Prediction:
        """The prediction at the plan that obeys the dynamics under a feedback towards another one, within its bounds.

        The feedback is a program's, F_k (H, m, p + m + 1), or that of the stages of ``prediction`` where that is empty.
        """
        linearizer = self.linearizer
        if linearizer.at_points:
            plan = self._follow(towards, prediction, feedback, request)
            return self.linearize(plan, request)
        n = self.problem.state_dim
        gains = self._gains_towards(prediction, feedback)
        last = request.references.previous_input
        disturbance = request.disturbance
        low, high, down, up = self._limits
        states, inputs, covariances = (part.copy() for part in towards)
        parts = []
        for k in range(
            self.horizon
        ):  # of a belief, whose means depend on its covariances
            input = towards.inputs[k] + gains[k] @ (
                states[k, :n] - towards.states[k, :n]
            )
            input = np.clip(input, last + down[k], last + up[k])
            last = inputs[k] = np.clip(input, low[k], high[k])
            stage = linearizer(
                states[k : k + 1],
                inputs[k : k + 1],
                covariances[k : k + 1],
                disturbance,
            )
            states[k + 1] = stage.next[0]
            covariances[k + 1] = linearizer.moments(
                stage.next, covariances[k + 1 : k + 2]
            )[1][0]
            parts.append(stage)
        stages = Stages(*map(np.concatenate, zip(*parts, strict=True)))
        return self.predict(Plan(states, inputs, covariances), stages, request)

    def gains(self, A: Array, B: Array, cost: QuadraticCost) -> Array:
        """K_0 .. K_{H-1} (H, m, n) of the feedback u = u_k - K_k (x - mu_k), weighed as at the first stage; or zero."""
        (m, n), Z = (self.problem.input_dim, self.problem.state_dim), cost.squares
        if not self.settings.feedback:
            return np.zeros((self.horizon, m, n))
        A = np.ascontiguousarray(A[:, :n, :n])
        B = np.ascontiguousarray(B[:, :n])
        Q = np.ascontiguousarray(cost.state[:1, 0])
        R = cost.input[:1]
        terminal = cost.terminal[0]
        if len(Z):
            Q = Q + Z[:1, :n, :n]
            R = R + Z[:1, n:-1, n:-1]
            terminal = terminal + Z[-1, :n, :n]
        return finite_horizon_lqr.unchecked(A, B, Q, R, terminal, self.horizon)[0]

    def _covariances(self, stages: Stages, cost: QuadraticCost, start: Array) -> Array:
        """Sigma_0 .. Sigma_H (H + 1, n, n) of stages under the feedback of each."""
        covariances = np.empty((self.horizon + 1, *start.shape))
        gains = self.gains(stages.A, stages.B, cost)
        _predict_covariances.unchecked(
            stages.A,
            stages.B,
            stages.V,
            start,
            gains,
            covariances,
        )
        return covariances

    def _disturbance(self, request: Request) -> Array:
        """d_k (n,), from the estimate of the last decision and the state that its input led to; at first zero."""
        previous = request.previous
        if previous is None:
            return np.zeros(self.problem.state_dim)
        before = (
            np.zeros_like(request.state)
            if previous.disturbance is None
            else previous.disturbance
        )
        applied = request.references.previous_input[None]
        predicted = linearize(
            self.model, previous.means[:1], applied, covariance=False
        ).mean[0]
        error = state_difference(request.state, predicted, self.angles)
        return before + self.settings.disturbance_gain * (error - before)


@compiled
def _predict_covariances(A, B, V, start, gains, covariances):
    """Writes Sigma_0 .. Sigma_H (H + 1, n, n) of H stages, or of one that is held.

    The gains (H, m, n) are of each stage.
    """
    n = B.shape[1]
    m = B.shape[2]
    held = len(A) - 1
    closed = np.empty((n, n))
    moved = np.empty((n, n))
    copy_matrix(start, covariances[0])
    for k in range(len(covariances) - 1):
        at = min(k, held)
        after = covariances[k + 1]
        for i in range(n):
            for j in range(n):
                closed[i, j] = A[at, i, j]
                for r in range(m):
                    closed[i, j] -= B[at, i, r] * gains[k, r, j]
        product(closed, covariances[k], moved)
        for i in range(n):
            for j in range(i + 1):
                total = (V[at, i, j] + V[at, j, i]) / 2.0
                for c in range(n):
                    total += moved[i, c] * closed[j, c]
                after[i, j] = after[j, i] = total
