"""From a plan to the linear-quadratic problem at it: stages, covariances, rows, cost.

The *form* says where the dynamics are linearised:

* ``trajectory``: at every stage of the last plan, one step on; before the first plan,
  of the reference. Plans need not obey the dynamics (multiple shooting): what they
  miss, the defects, is part of the stages.
* ``velocity``: at the current belief and the last input, one linearisation held over
  the horizon (Cao, Lai and Alam, 2017, section 4): ds_{k+1} = A ds_k + B du_k, which
  summed up is affine again, c = s_0 - A s_{-1} - B u_{-1}. Between two measured states
  S does not change, which says nothing of how it will grow: there the rows of S take
  the c of the linearisation itself.

Covariances of ``zero_order`` are predicted under a feedback u = u_k - K_k (x - mu_k),

    Sigma_{k+1} = (A_k - B_k K_k) Sigma_k (A_k - B_k K_k)' + V_k

because the next solves will see the next states and correct what went wrong (Hewing,
Kabzan and Zeilinger, 2020). K_k are the gains of the finite-horizon LQR of the plan's
own stages: a gain that is held over the horizon would drive deviations on where an
input changes the sign of its effect along the plan, as in every swing-up. The feedback
is of the covariances only: the bounds of the inputs hold for u_k. ``full`` and
``diagonal`` are linearised at the means and covariances of the plan, whatever the
propagator.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch

from gpmpc._angles import angles_of, full_turns
from gpmpc._calls import explains_arguments
from gpmpc._compiled import compiled
from gpmpc._dynamics import (
    DynamicsModel,
    check_next_states,
    linearization_of,
    tensors_for,
    to_array,
)
from gpmpc._kernels.linalg import copy_matrix, dot, product
from gpmpc.exceptions import (
    SettingError,
    check_choice,
    check_flag,
    check_method,
    check_number,
)
from gpmpc.gaussian import Gaussian, nearest_positive_semidefinite
from gpmpc.models import RollOut
from gpmpc.models._past import weighed_dim, weighed_signals
from gpmpc.mpc._constraints import ConstraintRows, largest_violation
from gpmpc.mpc._controller import KEPT, Decision, Request, check_controller
from gpmpc.mpc._cost import PENALIZED, by_stage
from gpmpc.mpc._linear_quadratic import (
    COVARIANCES,
    CondensedProgram,
    Covariance,
    InputBounds,
    Plan,
    QuadraticCost,
    References,
    StageRows,
    Stages,
    evaluate_stages,
    expand,
)
from gpmpc.mpc._riccati import finite_horizon_lqr
from gpmpc.mpc.problem import Problem
from gpmpc.propagation import Linearization, Propagator, differentiate
from gpmpc.propagation._local_model import expand_belief, square_roots
from gpmpc.signals import signals_of
from gpmpc.status import Status

Array = np.ndarray

Form = Literal["trajectory", "velocity"]
FORMS = ("trajectory", "velocity")

#: from states, inputs and covariances at K points to next s, A, B and V
_Linearize = Callable[[Array, Array, Array], tuple[Array, Array, Array, Array]]


@explains_arguments
@dataclass(frozen=True)
class PredictionSettings:
    """How beliefs are predicted.

    Raises:
        SettingError: An unknown form or covariance mode, a gain out of range, or one
            with ``"velocity"``.

    >>> PredictionSettings(disturbance_gain=0.3).covariance
    'zero_order'
    """

    #: where the dynamics are linearised: ``"trajectory"``, at every stage of the last
    #: plan; ``"velocity"``, at the current belief, held over the horizon (Cao, Lai and
    #: Alam, 2017, section 4)
    form: Form = "trajectory"
    #: what the program holds: ``"full"``, means and roots of the covariances;
    #: ``"diagonal"``, means and standard deviations; ``"zero_order"``, means, with
    #: covariances predicted beside it; ``"none"``, means alone
    covariance: Covariance = "zero_order"
    #: predicts the covariances of ``"zero_order"`` under a feedback, without which no
    #: long horizon with state constraints is feasible, and lets the iteration roll
    #: plans out under it. The covariances of ``"full"`` and ``"diagonal"`` are those
    #: without feedback
    feedback: bool = True
    #: L in [0, 1], the observer gain of the constant-disturbance estimate; 0 disables
    #: it
    disturbance_gain: float = 0.0
    #: ends a decision with a roll-out under the feedback, so that its plan obeys the
    #: model's dynamics however few programs it took; for ``"trajectory"``
    rolled_out: bool = False

    def __post_init__(self) -> None:
        check_choice("form", self.form, FORMS)
        check_choice("covariance", self.covariance, COVARIANCES)
        for key in ("feedback", "rolled_out"):
            check_flag(key, getattr(self, key))
        if self.rolled_out and self.is_held:
            rule = "is for plans of form 'trajectory'"
            raise SettingError("rolled_out", f"{rule}; got form 'velocity'")
        gain = self.disturbance_gain
        check_number("disturbance_gain", gain, least=0)
        if self.is_held and gain > 0:
            rule = "must be 0 for form 'velocity', which needs none"
            raise SettingError("disturbance_gain", f"{rule}; got {gain}")
        if gain > 1:
            rule = "must lie between 0 and 1"
            raise SettingError("disturbance_gain", f"{rule}; got {gain}")

    @property
    def is_held(self) -> bool:
        """Whether one linearisation, at the belief, is held over the horizon.

        Its stages hold for increments, in which a constant error cancels.
        """
        return self.form == "velocity"

    @property
    def may_iterate(self) -> bool:
        """Whether a step may take more than one program: new plans give new stages."""
        return self.form == "trajectory"


class LocalProblem(NamedTuple):
    """The linear-quadratic problem at a plan.

    ``linearize`` makes all parts at one plan. A step, or a roll-out that is not worth a
    linearisation, then replaces the plan alone: stages, covariances and rows stay those
    of the plan before, whose program led to it.
    """

    plan: Plan
    stages: Stages  # with ``velocity`` at the first stage only
    # Sigma_0 .. Sigma_H (H + 1, n, n) as predicted, for tightening; those of the plan
    # are the ones that the stages were linearised at
    covariances: Array
    rows: StageRows  # tightened by the covariances
    cost: QuadraticCost  # with outputs linearised at a plan

    def with_solution(
        self, program: CondensedProgram, unknowns: Array, request: Request
    ) -> "LocalProblem":
        """Returns the problem with the plan that a program's solution means.

        Stages and rows stay where they were linearised.

        Args:
            program: Condensed from this problem.
            unknowns: That solve it (H m,).
            request: Of the decision.
        """
        inputs, states = expand.unchecked(
            self.stages,
            self.plan.states[0],
            program.feedback,
            request.references.previous_input,
            np.ascontiguousarray(unknowns, dtype=np.float64),
        )
        # Where moments are matched, they are linearised at the plan's covariances next.
        return self._replace(plan=Plan(states, inputs, self.covariances))

    def stage_costs(self, references: References) -> Array:
        """Returns what each stage of the plan costs (H,)."""
        return evaluate_stages.unchecked(
            self.cost, self.plan.states, self.plan.inputs, references, 1.0
        )

    def violation(self, bounds: InputBounds, previous_input: Array) -> float:
        """Returns by how much the plan misses a bound, at most."""
        return largest_violation.unchecked(self.rows, bounds, self.plan, previous_input)

    def row_violations(self) -> Array:
        """Returns by how much the plan misses each row (H, r), zero inside."""
        E, D, lower, upper = self.rows
        states = self.plan.states[1:]
        gradients = np.broadcast_to(E, (len(states), *E.shape[1:]))
        values = np.einsum("kri,ki->kr", gradients, states)
        if len(D):
            values = values + np.einsum("krj,kj->kr", D, self.plan.inputs)
        outside = np.maximum(values - upper, lower - values)
        return np.maximum(0.0, outside)

    def row_lengths(self) -> Array:
        """Returns what each row rises per unit of distance (H, r).

        The distance is one of means and inputs together. A row that depends on neither
        counts as one of length 1.
        """
        n = self.covariances.shape[-1]
        squares = (self.rows.E[:, :, :n] ** 2).sum(axis=2)
        if len(self.rows.D):
            squares = squares + (self.rows.D**2).sum(axis=2)
        lengths = np.where(squares > 0.0, np.sqrt(squares), 1.0)
        return np.broadcast_to(lengths, self.rows.lower.shape)


class PredictionModel:
    """Linearises plans of one controller; checks that its settings fit the model."""

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: Problem,
        horizon: int,
        initial_input: Sequence[float] | Array,
        settings: PredictionSettings,
    ):
        states, inputs = check_next_states(model)
        weighed = weighed_dim(model, problem)
        names = signals_of(model).input_names
        self.initial_input = check_controller(
            problem, weighed, inputs, horizon, initial_input, names
        )
        check_method("propagator", propagator, "propagate", "Linearization()")
        if not isinstance(settings, PredictionSettings):
            rule = "must be PredictionSettings(...)"
            raise SettingError("prediction", f"{rule}; got {type(settings).__name__}")
        self.propagator = propagator
        #: as it was handed over: of all states, or of those that are measured
        self.stated_problem = problem.with_angles(angles_of(model))
        problem = self.stated_problem.over(states)
        self.problem = problem
        self.state_dim = problem.state_dim
        self.input_dim = problem.input_dim
        self.horizon = horizon
        self.settings = settings
        self.is_held = settings.is_held
        #: K, the number of stage models: H, or the one that is held
        self.stage_count = 1 if self.is_held else horizon
        self._set_model(model)
        lower, upper = problem.inputs.by_stage(horizon)
        rate_lower, rate_upper = problem.input_rates.by_stage(horizon)
        #: bounds of every stage, infinite where there are none: roll-outs read them
        self.roll_out_bounds = InputBounds(lower, upper, rate_lower, rate_upper)
        #: the same for programs and violations; rates are (0, m) where none is bounded,
        #: so that they take no rows
        count = horizon if problem.input_rates.finite else 0
        self.program_bounds = InputBounds(
            lower, upper, rate_lower[:count], rate_upper[:count]
        )
        self.constraints = ConstraintRows(problem, horizon, settings.covariance)
        #: whether every last plan of a decision is rolled out: curved constraints are
        #: judged where it leads
        self.rolls_out = settings.rolled_out or self.constraints.smooth
        self.costs = StageCosts(problem, horizon, self.linearizer)

    def with_model(self, model: DynamicsModel) -> "PredictionModel":
        """Returns the predictions by another model of as many states and inputs."""
        signals_of(model).check("the model", self.signals, "the controller", "model")
        other = copy(self)
        other._set_model(model)
        return other

    def _set_model(self, model: DynamicsModel) -> None:
        covariance = self.settings.covariance
        noisy = getattr(self.propagator, "process_noise", False)
        self.model = model
        self.linearizer = StageLinearizer(model, self.propagator, covariance)
        #: for the first guess of covariances
        self.point_linearizer = StageLinearizer(
            model, Linearization(noisy), "zero_order"
        )
        self.roll_out_means = RollOut(model)
        #: what cost or model take for angles: a sensor may show them within a turn
        self.angles = sorted({*self.problem.cost.angle_indices, *angles_of(model)})
        self.signals = signals_of(model)
        #: of the states that ``stated_problem`` weighs
        self.stated_signals = weighed_signals(model, self.stated_problem)

    def plan_of(self, means: Array, inputs: Array, covariances: Array) -> Plan:
        """Returns a plan from means (H + 1, n), inputs, and covariances."""
        return Plan(self.linearizer.state(means, covariances), inputs, covariances)

    def canonical(self, plan: Plan) -> Plan:
        """Returns a plan whose s are those of its beliefs.

        Their roots are then positive semidefinite.
        """
        means, covariances = self.linearizer.moments(plan.states, plan.covariances)
        return self.plan_of(means, plan.inputs, covariances)

    def linearize(self, plan: Plan, request: Request) -> LocalProblem:
        """Returns the problem at a plan, whose stages are linearised in one call."""
        K = self.stage_count
        stages = self.linearizer(
            plan.states[:K], plan.inputs[:K], plan.covariances[:K], request.disturbance
        )
        return self.assemble(plan, stages, request)

    def misses_hard_rows(self, local: LocalProblem, limit: float) -> bool:
        """Returns whether a plan misses a hard row of the states by more than that."""
        hard = np.isinf(self.constraints.prices)
        missed = local.row_violations()[:, hard]
        return not missed.max(initial=0.0) <= limit

    def linearize_many(
        self, plans: Sequence[Plan], requests: Sequence[Request]
    ) -> list[LocalProblem]:
        """Returns the problems at many plans, with all stages in one call."""
        if not requests:
            return []
        K = self.stage_count
        T = len(requests)
        states = np.concatenate([plan.states[:K] for plan in plans])
        inputs = np.concatenate([plan.inputs[:K] for plan in plans])
        covariances = np.concatenate([plan.covariances[:K] for plan in plans])
        disturbances = [
            np.tile(request.disturbance, (K, 1))
            for request in requests
            if request.disturbance is not None
        ]
        disturbance = np.concatenate(disturbances) if disturbances else None
        all_stages = self.linearizer(states, inputs, covariances, disturbance)
        by_plan = [part.reshape(T, K, *part.shape[1:]) for part in all_stages]
        stages = [Stages._make(parts) for parts in zip(*by_plan, strict=True)]
        return list(map(self.assemble, plans, stages, requests))

    def assemble(self, plan: Plan, stages: Stages, request: Request) -> LocalProblem:
        """Returns the problem at a plan from its stages: covariances, rows, cost."""
        cost = self.costs.at(plan, request.parameters)
        covariances = self._covariances_of(plan, stages, cost, request)
        last_plan = request.last_plan
        if self.is_held and last_plan is not None and not last_plan.is_used_up:
            stages = self._in_increments(plan, stages, request, last_plan)
        rows = self.constraints.at(
            plan, covariances, self.stage_count, request.parameters, request.kappas
        )
        return LocalProblem(plan, stages, covariances, rows, cost)

    def end_of_solved(self, local: LocalProblem, violation: float) -> Status:
        """Returns how a decision of a solved program ends: by the rows it misses.

        Args:
            local: With the plan.
            violation: By how much the plan misses a bound, at most.
        """
        if violation <= KEPT or not self.constraints.per_stage:
            return Status.SOLVED
        if self.misses_hard_rows(local, KEPT):
            return Status.HARD_BOUND_MISSED
        if not local.row_violations().max() <= KEPT:
            return Status.SOFT_BOUND_MISSED
        return Status.SOLVED  # what is missed is a bound of inputs, by rounding

    def _covariances_of(
        self, plan: Plan, stages: Stages, cost: QuadraticCost, request: Request
    ) -> Array:
        """Returns the covariances that tighten the rows (H + 1, n, n)."""
        mode = self.linearizer.covariance
        if mode == "zero_order":
            return self.predict_covariances(stages, cost, request.covariance)
        if self.is_held and mode != "none":
            _, after = self.linearizer.moments(stages.next, plan.covariances)
            covariances = np.repeat(after, self.horizon + 1, axis=0)
            covariances[0] = request.covariance
            return covariances
        return plan.covariances

    def predict_covariances(
        self, stages: Stages, cost: QuadraticCost, start: Array
    ) -> Array:
        """Returns Sigma_0 .. Sigma_H (H + 1, n, n) of stages under their feedback."""
        covariances = np.empty((self.horizon + 1, *start.shape))
        gains = self.gains(stages.A, stages.B, cost)
        _predict_covariances.unchecked(
            stages.A, stages.B, stages.V, start, gains, covariances
        )
        return covariances

    def gains(self, A: Array, B: Array, cost: QuadraticCost) -> Array:
        """Returns K_0 .. K_{H-1} (H, m, n) of the feedback u = u_k - K_k (x - mu_k).

        They are weighed by Q and R of the first stage and by the weight of the last
        one, and zero without feedback.
        """
        n = self.state_dim
        if not self.settings.feedback:
            return np.zeros((self.horizon, self.input_dim, n))
        A = np.ascontiguousarray(A[:, :n, :n])
        B = np.ascontiguousarray(B[:, :n])
        Q = np.ascontiguousarray(cost.state[:1, 0])
        R = cost.input[:1]
        terminal = cost.terminal[0]
        Z = cost.squares
        if len(Z):
            Q = Q + Z[:1, :n, :n]
            R = R + Z[:1, n:-1, n:-1]
            terminal = terminal + Z[-1, :n, :n]
        gains, _ = finite_horizon_lqr.unchecked(A, B, Q, R, terminal, self.horizon)
        return gains

    def _in_increments(
        self, plan: Plan, stages: Stages, request: Request, previous: Decision
    ) -> Stages:
        """Returns a held linearisation as that of the increments since s_{-1}.

        s_{-1} is the state that the last decision began at. Where a policy has moved
        its plan on, what the plan did not foresee is due to all steps since then, and
        counts as its mean.
        """
        last_means = previous.means[:3]
        if self.angles:
            turns = full_turns(request.state - last_means[0], self.angles)
            last_means = last_means + turns
        last_states = self.linearizer.state(last_means, previous.covariances[:3])
        last_input = request.references.previous_input
        c = plan.states[0] - stages.A[0] @ last_states[0] - stages.B[0] @ last_input
        if previous.policy_steps:
            foreseen = last_states[2] - stages.A[0] @ last_states[1]
            foreseen -= stages.B[0] @ previous.inputs[1]
            c = foreseen + (c - foreseen) / (1 + previous.policy_steps)
        if not request.covariance.any():
            n = self.state_dim
            c[n:] = stages.c[0, n:]
        return stages._replace(c=c[None])

    def lead(
        self, state: Array, inputs: Array, disturbance: Array | None = None
    ) -> Array:
        """Returns the states (H + 1, n) that inputs (H, m) lead to.

        All of them are the first one where these are not finite.
        """
        batch = self.roll_out_means.open_loop(state[None], inputs[None], disturbance)
        states = batch[0]
        return states if np.isfinite(states).all() else np.tile(state, (len(states), 1))


class StageLinearizer:
    """Linearises the dynamics of the belief at K points in one call, in one mode.

    See ``gpmpc.mpc._linear_quadratic`` for the covariance modes.

    Attributes:
        depends_on_covariance: Whether the stages depend on covariances, which have to
            be predicted first then, and not on means and inputs alone.
        noise: Variances (n,) of the noise that V holds.
    """

    def __init__(
        self, model: DynamicsModel, propagator: Propagator, covariance: Covariance
    ):
        self.model = model
        self.propagator = propagator
        self.covariance = covariance
        self._n = model.state_dim
        self._linearize_model = linearization_of(model)
        first_order = getattr(propagator, "first_order", False)
        zero_order = covariance == "zero_order"
        at_means = zero_order and first_order
        self.depends_on_covariance = covariance != "none" and not at_means
        noisy = zero_order and getattr(propagator, "process_noise", False)
        self.noise_covariance = to_array(model.noise_covariance) if noisy else None
        self.noise = np.zeros(self._n)
        if self.noise_covariance is not None:
            self.noise = np.ascontiguousarray(np.diagonal(self.noise_covariance))
        by_mode: dict[str, _Linearize] = {
            "full": self._linearize_roots,
            "diagonal": self._linearize_deviations,
            "zero_order": self._linearize_moments,
        }
        self._linearize: _Linearize = self._linearize_means
        if self.depends_on_covariance:
            self._linearize = by_mode[covariance]

    def __call__(
        self,
        states: Array,
        inputs: Array,
        covariances: Array,
        disturbance: Array | None = None,
    ) -> Stages:
        """Returns the stage models at K points.

        Args:
            states: s (K, p).
            inputs: u (K, m).
            covariances: Of the states (K, n, n).
            disturbance: Added to the means (n,), or (K, n) by point.
        """
        after, A, B, V = self._linearize(states, inputs, covariances)
        if disturbance is not None:
            after = after.copy()
            after[:, : self._n] += disturbance
        c = _constants.unchecked(A, B, after, states, inputs)
        return Stages(A, B, c, after, V)

    def weight(self, Q: Array) -> Array:
        """Returns weights of s from weights of x (K, n, n).

        They are the blocks on the diagonals (K, p / n, n, n).
        """
        if self.covariance == "full":  # tr(Q Sigma) = |vec S|^2 in I_n kron Q
            return np.repeat(Q[:, None], self._n + 1, axis=1)
        if self.covariance == "diagonal":
            return np.stack([Q, Q * np.eye(self._n)], axis=1)
        return Q[:, None]

    def state(self, means: Array, covariances: Array) -> Array:
        """Returns the vectors s (K, p) of beliefs (K, n), (K, n, n)."""
        if self.covariance == "full":
            roots = square_roots(covariances).root
            return np.concatenate((means, roots.reshape(len(means), -1)), axis=1)
        if self.covariance == "diagonal":
            variances = np.diagonal(covariances, axis1=1, axis2=2)
            return np.concatenate([means, np.sqrt(np.clip(variances, 0, None))], axis=1)
        return means

    def moments(self, states: Array, covariances: Array) -> tuple[Array, Array]:
        """Returns means and covariances of states s (K, p).

        The covariances are those handed over where s does not hold them.
        """
        n = self._n
        if self.covariance == "full":
            S = states[:, n:].reshape(-1, n, n)
            return states[:, :n], S @ S.mT
        if self.covariance == "diagonal":
            return states[:, :n], states[:, n:, None] ** 2 * np.eye(n)
        return states, covariances

    def _linearize_means(
        self, states: Array, inputs: Array, _: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Returns next means, A, B and V of the model at certain states."""
        has_covariance = self.covariance == "zero_order"
        local = self._linearize_model(states, inputs, covariance=has_covariance)
        V = local.covariance
        if V is None:
            V = np.zeros((len(states), self._n, self._n))
        if self.noise_covariance is not None:
            V = V + self.noise_covariance
        # a model may give views, which the kernels do not notice
        return (
            np.ascontiguousarray(local.mean, dtype=np.float64),
            np.ascontiguousarray(local.A, dtype=np.float64),
            np.ascontiguousarray(local.B, dtype=np.float64),
            np.ascontiguousarray(V, dtype=np.float64),
        )

    def _linearize_moments(
        self, states: Array, inputs: Array, covariances: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Returns next means, A, B and V, with moments matched at the covariances."""
        belief, input = self._tensors(states, covariances, inputs)
        step, slopes = differentiate(self.propagator, self.model, belief, input)
        A = slopes.mean_by_mean
        # mean equivalence passes nothing on
        through_mean = A @ step.cross_covariance
        added = step.belief.covariance - (through_mean + through_mean.mT) / 2
        V, _ = nearest_positive_semidefinite(added)
        B = slopes.mean_by_input
        return to_array(step.belief.mean), to_array(A), to_array(B), to_array(V)

    def _linearize_roots(
        self, states: Array, inputs: Array, covariances: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Returns next [mu; vec S], its A and B, and no V."""
        means = states[:, : self._n]
        belief, input = self._tensors(means, covariances, inputs)
        local = expand_belief(self.propagator, self.model, belief, input)
        return local.next_state, local.A, local.B, np.zeros_like(covariances)

    def _linearize_deviations(
        self, states: Array, inputs: Array, covariances: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Returns next [mu; standard deviations], its A and B, and no V."""
        n = self._n
        covariances = covariances * np.eye(n)
        belief, input = self._tensors(states[:, :n], covariances, inputs)
        step, slopes = differentiate(self.propagator, self.model, belief, input)
        sd = belief.variance.sqrt()
        next_sd = step.belief.variance.clamp_min(0).sqrt()
        # d Sigma_cc = 2 sd_c d sd_c, and backwards; where the next deviation is zero it
        # has no derivative.
        sd_by_variance = torch.where(
            next_sd > 0, 0.5 / torch.where(next_sd > 0, next_sd, 1.0), 0.0
        )[..., None]
        variance_by_sd = 2 * sd[..., None, :]
        mean_by_variance = slopes.mean_by_covariance.diagonal(dim1=-2, dim2=-1)
        variance_by_mean = slopes.covariance_by_mean.diagonal(dim1=-3, dim2=-2).mT
        variance_by_input = slopes.covariance_by_input.diagonal(dim1=-3, dim2=-2).mT
        variance_by_variance = (
            slopes.covariance_by_covariance.diagonal(dim1=-2, dim2=-1)
            .diagonal(dim1=-3, dim2=-2)
            .mT
        )
        upper = torch.cat(
            [slopes.mean_by_mean, mean_by_variance * variance_by_sd], dim=-1
        )
        sd_by_mean = sd_by_variance * variance_by_mean
        sd_by_sd = sd_by_variance * variance_by_variance * variance_by_sd
        lower = torch.cat([sd_by_mean, sd_by_sd], dim=-1)
        A = torch.cat([upper, lower], dim=-2)
        B = torch.cat(
            [slopes.mean_by_input, sd_by_variance * variance_by_input], dim=-2
        )
        after = torch.cat([step.belief.mean, next_sd], dim=-1)
        return to_array(after), to_array(A), to_array(B), np.zeros_like(covariances)

    def _tensors(
        self, means: Array, covariances: Array, inputs: Array
    ) -> tuple[Gaussian, torch.Tensor]:
        mean, covariance, input = tensors_for(self.model, means, covariances, inputs)
        return Gaussian(mean, covariance), input


class StageCosts:
    """The cost of a problem's stages along plans.

    Attributes:
        quadratic: The cost of the weights alone.
        outputs: ``LeastSquares`` whose squares are added along a plan.
    """

    def __init__(self, problem: Problem, horizon: int, linearizer: StageLinearizer):
        n = problem.state_dim
        m = problem.input_dim
        cost = problem.cost
        self._linearizer = linearizer
        self.outputs = problem.outputs
        for output in self.outputs:
            by_stage("weight", output.weight, horizon, 2)
            by_stage("reference", output.reference, horizon, 1)
        # weights of x_1 .. x_H, the last one the terminal one
        self._Q, _ = cost.by_stage(horizon)
        Q = cost.Q if cost.Q.ndim > 2 else cost.Q[None]
        R = cost.R if cost.R.ndim > 2 else cost.R[None]
        self.quadratic = QuadraticCost(
            state=np.ascontiguousarray(linearizer.weight(Q)),
            terminal=np.ascontiguousarray(linearizer.weight(self._Q[-1:])[0]),
            input=np.ascontiguousarray(R),
            penalized=PENALIZED.index(cost.penalized),
            squares=np.empty((0, n + m + 1, n + m + 1)),
        )

    def at(self, plan: Plan, parameters: Array | None = None) -> QuadraticCost:
        """Returns the cost with its outputs linearised along a plan.

        Raises what ``expand_function`` does.
        """
        if not self.outputs:
            return self.quadratic
        n = self._Q.shape[1]
        means = np.ascontiguousarray(plan.states[1:, :n])
        squares = np.sum(
            [output.squares(means, plan.inputs, parameters) for output in self.outputs],
            axis=0,
        )
        weights = self._linearizer.weight(self._Q + squares[:, :n, :n])
        # Z weighs the mean already, in the kernels: its xx block adds the cost of
        # spread.
        weights[:, 0] = self._Q
        return self.quadratic._replace(
            state=weights, terminal=weights[-1], squares=squares
        )


@compiled
def _constants(A, B, after, states, inputs):
    """Returns c (K, p) of s+ = A s + B u + c through the points."""
    c = after.copy()
    for k in range(len(c)):
        for i in range(c.shape[1]):
            c[k, i] -= dot(A[k, i], states[k], A.shape[2]) + dot(
                B[k, i], inputs[k], B.shape[2]
            )
    return c


@compiled
def _predict_covariances(A, B, V, start, gains, covariances):
    """Writes Sigma_0 .. Sigma_H (H + 1, n, n) of H stages, or of one that is held.

    The gains (H, m, n) are of each stage.
    """
    n = B.shape[1]
    m = B.shape[2]
    last = len(A) - 1
    closed = np.empty((n, n))
    spread = np.empty((n, n))
    copy_matrix(start, covariances[0])
    for k in range(len(covariances) - 1):
        stage = min(k, last)
        after = covariances[k + 1]
        for i in range(n):
            for j in range(n):
                closed[i, j] = A[stage, i, j]
                for r in range(m):
                    closed[i, j] -= B[stage, i, r] * gains[k, r, j]
        product(closed, covariances[k], spread)
        for i in range(n):
            for j in range(i + 1):
                total = (V[stage, i, j] + V[stage, j, i]) / 2.0
                for c in range(n):
                    total += spread[i, c] * closed[j, c]
                after[i, j] = after[j, i] = total
