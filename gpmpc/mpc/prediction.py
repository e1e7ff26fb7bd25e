"""Problem: a convex controller sees the belief's future as affine stage models; which ones is its *form*.

    s_{k+1} = A_k s_k + B_k u_k + c_k

* ``increment``: ds_{k+1} = A ds_k + B du_k with A and B from the current belief and the last input, held (Cao, Lai and
  Alam, 2017, section 4). Summed up that is an affine model again, c = s_0 - A s_{-1} - B u_{-1}. Between two measured
  states S does not change, which says nothing of how it will grow: there the rows of S take the local model's c.
* ``deviation``: the local model about the current belief and the reference input u*_0, held.
* ``trajectory``: the belief is rolled out along the last plan, shifted, and linearised at every stage (linear
  time-varying). The rollout follows what the plan predicted by an ancillary feedback; the first one, the reference.

What s holds of the belief is its *covariance* mode. ``full``: s = [mu; vec S], S = Sigma^(1/2), as in the paper.
``diagonal``: s = [mu; standard deviations], correlations are dropped at every stage. ``zero_order``: s = mu, and the
covariances are predicted beside the optimisation as if the inputs did not change them (Hewing, Kabzan and Zeilinger,
2020; Zanelli, Frey, Messerer and Diehl, 2021). ``none``: s = mu, through the model's mean at a certain state.

A constant error of the model leaves an offset between reference and state. ``increment`` has none: the error is in
both of two steps, and not in their difference. The other forms may add an estimate of it to every mean, a
*disturbance* (Pannocchia and Rawlings, 2003), which moves by a gain L towards what the last step showed:

    d_k = (1 - L) d_{k-1} + L (mu_k - f(mu_{k-1}, u_{k-1}))

Torch ends here: what comes out is NumPy float64.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch

from gpmpc.dynamics import DynamicsModel
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp.backend import chosen_backend, host_arrays
from gpmpc.gp.posterior import GPPosterior
from gpmpc.kernels.extended_state import square_roots
from gpmpc.mpc.ancillary_feedback import spread
from gpmpc.mpc.compiled_rollout import CompiledRollout
from gpmpc.mpc.controller import Decision
from gpmpc.mpc.linear_quadratic import Stages, expand, finite_horizon_lqr
from gpmpc.mpc.request import Request, check_method
from gpmpc.mpc.stage_models import disturbed, is_first_order, stage_model
from gpmpc.mpc.tracking import TrackingProblem
from gpmpc.propagation import Propagator

Array = np.ndarray

Form = Literal["increment", "deviation", "trajectory"]
Covariance = Literal["full", "diagonal", "zero_order", "none"]
FORMS = ("increment", "deviation", "trajectory")
COVARIANCES = ("full", "diagonal", "zero_order", "none")


@dataclass(frozen=True)
class Prediction:
    """Affine stage models from a current state on, K = H of them or K = 1 that is held.

    Attributes:
        A: (K, p, p).
        B: (K, p, m).
        c: (K, p).
        start: s_0 (p,).
        covariances: Sigma_0 .. Sigma_H that the models were made at (H + 1, n, n); a held model has one of its own for
            the stages 1 to H.
        inputs: The inputs that they were made at (H, m).
    """

    A: Array
    B: Array
    c: Array
    start: Array
    covariances: Array
    inputs: Array

    def states(self, inputs: Array) -> Array:
        """s_0 .. s_H (H + 1, p) under inputs (H, m), as the stage models have it."""
        (_, p, m), stages = self.B.shape, Stages(self.A, self.B, self.c)
        return expand(stages, self.start, np.empty((0, m, p + m + 1)), np.zeros(m), inputs.ravel())[1]


class Predictor:
    """Makes the stage models of one form and covariance mode.

    Args:
        model: What was learned.
        propagator: How the belief moves.
        problem: Its weights give the ancillary feedback.
        horizon: H.
        form: See the module's text.
        covariance: See the module's text.
        feedback: Rolls out, and predicts the covariances of ``zero_order``, under an ancillary feedback; see
            ``gpmpc.mpc.ancillary_feedback``.
        disturbance_gain: L, from 0 (no disturbance is estimated) to 1 (it is what the last step showed).

    Raises:
        SettingError: An unknown form or covariance mode, no propagator, a gain out of range, or one with ``increment``.
    """

    def __init__(
        self,
        model: DynamicsModel,
        propagator: Propagator,
        problem: TrackingProblem,
        horizon: int,
        form: Form,
        covariance: Covariance,
        feedback: bool,
        disturbance_gain: float = 0.0,
    ):
        for key, value, possible in (("form", form, FORMS), ("covariance", covariance, COVARIANCES)):
            if value not in possible:
                raise SettingError(key, f"must be one of {', '.join(map(repr, possible))}; got {value!r}")
        if not isinstance(feedback, bool):
            raise SettingError("feedback", f"must be true or false; got {feedback!r}")
        self.model, self.propagator, self.problem, self.horizon = model, propagator, problem, horizon
        check_method("propagator", propagator, "propagate", "Linearization()")
        check_number("disturbance_gain", disturbance_gain, least=0)
        if disturbance_gain > (form != "increment"):
            rule = "be 0 for form 'increment', which needs none" if form == "increment" else "lie between 0 and 1"
            raise SettingError("disturbance_gain", f"must {rule}; got {disturbance_gain}")
        self.form, self.covariance, self.feedback = form, covariance, feedback
        self.disturbance_gain = disturbance_gain
        at_points = covariance == "none" or (covariance == "zero_order" and is_first_order(propagator))
        exact = isinstance(model, GPPosterior) and model.predicts in ("next_state", "difference")
        self._compiles = exact and at_points

    @property
    def compiled(self) -> bool:
        """Whether compiled loops answer: a rollout takes microseconds, and many of them go one by one."""
        if chosen_backend() == "auto":
            return self._compiles and self._in_host_memory
        return self._compiles and host_arrays(self.model.weights) is not None

    @cached_property
    def _in_host_memory(self) -> bool:
        return host_arrays(self.model.weights) is not None

    @cached_property
    def rollout(self) -> CompiledRollout:
        """The compiled loop, where ``compiled`` says that there is one."""
        uncertain = self.covariance == "zero_order"
        noisy = uncertain and self.propagator.process_noise
        return CompiledRollout(self.model, self.problem, self.feedback, uncertain, noisy)

    def extended(self, weight: Array) -> Array:
        """The weight of s that belongs to a weight of x (n, n): the blocks on its diagonal (p / n, n, n)."""
        n = self.problem.state_dim
        if self.covariance == "full":  # tr(Q Sigma) = |vec S|^2 in I_n kron Q
            return np.tile(weight, (n + 1, 1, 1))
        if self.covariance == "diagonal":
            return np.stack([weight, np.diag(np.diag(weight))])
        return weight[None]

    def state(self, mean: Array, covariance: Array) -> Array:
        """The vectors s (*batch, p) of beliefs."""
        if self.covariance == "full":
            S = np.empty(covariance.shape)
            square_roots(np.ascontiguousarray(covariance).reshape(-1, *S.shape[-2:]), S.reshape(-1, *S.shape[-2:]))
            return np.concatenate((mean, S.reshape(*mean.shape[:-1], -1)), axis=-1)
        if self.covariance == "diagonal":
            variance = np.diagonal(covariance, axis1=-2, axis2=-1)
            return np.concatenate([mean, np.sqrt(np.clip(variance, 0, None))], axis=-1)
        return mean

    def beliefs(self, prediction: Prediction, inputs: Array) -> tuple[Array, Array]:
        """Predicted means (H + 1, n) and covariances (H + 1, n, n) under inputs (H, m), by the stage models."""
        return self.moments(prediction.states(inputs), prediction.covariances)

    def moments(self, states: Array, covariances: Array) -> tuple[Array, Array]:
        """Means and covariances of the states s (K, p); ``covariances`` where s does not hold them."""
        n = self.problem.state_dim
        if self.covariance == "full":
            roots = states[:, n:].reshape(-1, n, n)
            return states[:, :n], roots @ roots.mT
        if self.covariance == "diagonal":
            return states[:, :n], states[:, n:, None] ** 2 * np.eye(n)
        return states, covariances

    def predict(self, request: Request, previous: Decision | None) -> Prediction:
        """The stage models of a step: about its request, and for ``increment`` about the step before."""
        if self.form == "trajectory":
            return self.along(request, request.shifted, self.followed(request, previous))
        prediction = self.held(request, self.about(request))
        if self.form == "deviation" or previous is None or not previous.applicable:
            return prediction  # no step before: the increment that the local model itself predicts
        return self.incremented(request, prediction, self.state(previous.means[0], previous.covariances[0]))

    def about(self, request: Request) -> Array:
        """The input (m,) that a held model is made at."""
        return request.wanted[0] if self.form == "deviation" else request.last

    def incremented(self, request: Request, prediction: Prediction, before: Array) -> Prediction:
        """A held model as that of the increments since s_{-1}, ``before`` (p,)."""
        c = prediction.start - prediction.A[0] @ before - prediction.B[0] @ request.last
        if not request.covariance.any():
            n = self.problem.state_dim
            c[n:] = prediction.c[0, n:]
        return replace(prediction, c=c[None])

    def along(self, request: Request, inputs: Array, follow: Array | None = None) -> Prediction:
        """The stage models along the rollout of a plan.

        Args:
            request: Where it starts.
            inputs: The plan (H, m).
            follow: Means (H, n) that the rollout is to follow by the ancillary feedback, which changes the plan within
                box and rates: u_k + K (mu_k - follow_k) for k = 1 .. H-1.
        """
        if self.compiled:
            found = self.rollout(request.state, request.covariance, request.disturbance, inputs, follow)
            return Prediction(found.A, found.B, found.c, request.state, found.covariances, found.inputs)
        belief, gain, stages, plan = self._belief(request.state, request.covariance), None, [], np.array(inputs)
        covariances, n = [_array(belief.covariance)], self.problem.state_dim
        for k, input in enumerate(plan):
            if follow is not None and k:
                moved, problem = input + gain @ (_array(belief.mean) - follow[k]), self.problem
                moved = np.clip(moved, plan[k - 1] + problem.rate_lower, plan[k - 1] + problem.rate_upper)
                input[:] = np.clip(moved, problem.input_lower, problem.input_upper)
            A, B, c, belief, V = self._linearise(belief, self._tensor(input), request.disturbance)
            if self.feedback and gain is None and (follow is not None or V is not None):
                gain = self.gain(np.ascontiguousarray(A[:n, :n]), np.ascontiguousarray(B[:n]))
            if self.feedback and V is not None:
                belief = Gaussian(belief.mean, self._tensor(spread(A + B @ gain, V, covariances[-1], 1)[1]))
            covariances.append(_array(belief.covariance))
            stages.append((A, B, c))
        A, B, c = (np.array(part) for part in zip(*stages, strict=True))
        return Prediction(A, B, c, self.state(request.state, covariances[0]), np.array(covariances), plan)

    def held(self, request: Request, input: Array) -> Prediction:
        """The local model about the belief and an input (m,), for all stages."""
        belief = self._belief(request.state, request.covariance)
        A, B, c, after, V = self._linearise(belief, self._tensor(input), request.disturbance)
        now = _array(belief.covariance)
        return self.hold(self.state(request.state, now), input, A, B, c, now, _array(after.covariance), V)

    def hold(
        self, start: Array, input: Array, A: Array, B: Array, c: Array, now: Array, after: Array, V: Array | None
    ) -> Prediction:
        """One stage, made at s_0 = ``start``, Sigma_0 = ``now`` and an input, for all of them."""
        H = self.horizon
        if V is None:
            covariances = np.empty((H + 1, *now.shape))
            covariances[0], covariances[1:] = now, after
        else:
            covariances = spread(A + B @ self.gain(A, B) if self.feedback else A, V, now, H)
        return Prediction(A[None], B[None], c[None], start, covariances, np.tile(input, (H, 1)))

    def followed(self, request: Request, previous: Decision | None) -> Array | None:
        """What the rollout of a shifted plan has to follow: its own means, or without one the reference.

        Open-loop, over a long horizon, the smallest error leads the rollout out of the data and the bounds.
        """
        if not self.feedback:
            return None
        if previous is not None and previous.applicable and len(previous.means) == self.horizon + 1:
            return previous.means[1:]
        return np.concatenate([request.state[None], request.targets[:-1]])

    def disturbance(self, request: Request, previous: Decision | None) -> Array:
        """d_k (n,), from the estimate of the last decision and what came of its input; zero before the first step."""
        if previous is None or not previous.applicable:
            return np.zeros(self.problem.state_dim)
        before = np.zeros_like(request.state) if previous.disturbance is None else previous.disturbance
        x, u = self._tensor(previous.means[0]), self._tensor(request.last)
        if isinstance(self.model, GPPosterior):
            predicted = _array(self.model.mean_with_jacobian(x, u)[0])
        else:
            predicted = _array(self.model.predict(x, u).mean)
        return before + self.disturbance_gain * (request.state - predicted - before)

    def _linearise(
        self, belief: Gaussian, input: torch.Tensor, disturbance: Array
    ) -> tuple[Array, Array, Array, Gaussian, Array | None]:
        """One ``StageModel``; compiled where a point is all that it needs."""
        if not self.compiled:
            stage = stage_model(self.covariance, self.propagator, self.model, belief, input)
            stage = disturbed(stage, self._tensor(disturbance)) if len(disturbance) else stage
            A, B, c = (_array(part) for part in stage[:3])
            return A, B, c, stage.next, None if stage.V is None else _array(stage.V)
        x, u = _array(belief.mean), _array(input)
        if self.covariance == "none":
            mean, A, B = (part[0] for part in self.model.linearize(x[None], u[None], covariance=False)[:3])
            V = None
            S = belief.covariance
        else:
            mean, A, B, V = (part[0] for part in self.model.linearize(x[None], u[None]))
            if self.propagator.process_noise:
                V += _array(self.model.noise_covariance)
            S = self._tensor(A @ _array(belief.covariance) @ A.T + V)
        A, B = np.ascontiguousarray(A), np.ascontiguousarray(B)
        if len(disturbance):
            mean += disturbance
        return A, B, mean - A @ x - B @ u, Gaussian(self._tensor(mean), S), V

    def gain(self, A: Array, B: Array) -> Array:
        """K (m, n) of the ancillary feedback, from dmu+/dmu (n, n) and dmu+/du (n, m)."""
        problem = self.problem
        return -finite_horizon_lqr(A[None], B[None], problem.Q, problem.R, problem.terminal, self.horizon)[0][0]

    def _belief(self, mean: Array, covariance: Array) -> Gaussian:
        known = np.zeros_like(covariance) if self.covariance == "none" else covariance
        return Gaussian(self._tensor(mean), self._tensor(known))

    def _tensor(self, array: Array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=self.model.dtype, device=self.model.device)


def _array(tensor: Any) -> Array:
    """A tensor as a contiguous float64 array in host memory."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float64)
