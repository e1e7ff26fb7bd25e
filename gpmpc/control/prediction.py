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

Torch ends here: what comes out is NumPy float64.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import torch

from gpmpc.control.ancillary_feedback import lqr_gain, own_spread, spread
from gpmpc.control.compiled_rollout import CompiledRollout
from gpmpc.control.condensing import respond
from gpmpc.control.controller import Decision
from gpmpc.control.request import Request
from gpmpc.control.tracking import TrackingProblem
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.gp.dynamics import DynamicsModel
from gpmpc.gp.evaluation import host_arrays, point_arrays
from gpmpc.gp.posterior import GPPosterior
from gpmpc.propagation import Linearization, Propagator, differentiate, linearize

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
        states = np.empty((len(inputs) + 1, len(self.start)))
        respond(self.A, self.B, self.c, self.start, np.ascontiguousarray(inputs), states)
        return states


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
            ``gpmpc.control.ancillary_feedback``.

    Raises:
        SettingError: An unknown form or covariance mode.
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
    ):
        for key, value, possible in (("form", form, FORMS), ("covariance", covariance, COVARIANCES)):
            if value not in possible:
                raise SettingError(key, f"must be one of {', '.join(map(repr, possible))}; got {value!r}")
        if not isinstance(feedback, bool):
            raise SettingError("feedback", f"must be true or false; got {feedback!r}")
        self.model, self.propagator, self.problem, self.horizon = model, propagator, problem, horizon
        self.form, self.covariance, self.feedback = form, covariance, feedback
        self._linearise = getattr(self, f"_{covariance}")
        exact = isinstance(model, GPPosterior) and model.predicts in ("next_state", "difference")
        self._first_order = exact and type(propagator) is Linearization and not propagator.hessian
        self._compiles = exact and (covariance == "none" or (covariance == "zero_order" and self._first_order))

    @cached_property
    def _rollout(self) -> CompiledRollout:
        uncertain = self.covariance == "zero_order"
        noisy = uncertain and self.propagator.observation_noise
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
        """The vector s (p,) of a belief."""
        if self.covariance == "full":
            eigenvalues, vectors = np.linalg.eigh(covariance)
            root = (vectors * np.sqrt(eigenvalues.clip(0))) @ vectors.T
            return np.concatenate((mean, root.ravel()))
        if self.covariance == "diagonal":
            return np.concatenate([mean, np.sqrt(np.clip(np.diag(covariance), 0, None))])
        return mean

    def beliefs(self, prediction: Prediction, inputs: Array) -> tuple[Array, Array]:
        """Predicted means (H + 1, n) and covariances (H + 1, n, n) under inputs (H, m), by the stage models."""
        n, states = self.problem.state_dim, prediction.states(inputs)
        if self.covariance == "full":
            roots = states[:, n:].reshape(-1, n, n)
            return states[:, :n], roots @ roots.mT
        if self.covariance == "diagonal":
            return states[:, :n], states[:, n:, None] ** 2 * np.eye(n)
        return states, prediction.covariances

    def predict(self, request: Request, previous: Decision | None) -> Prediction:
        """The stage models of a step: about its request, and for ``increment`` about the step before."""
        if self.form == "trajectory":
            return self.along(request, request.shifted, self._followed(request, previous))
        if self.form == "deviation":
            return self.held(request, request.wanted[0])
        prediction = self.held(request, request.last)
        if previous is None or not previous.status.solved:
            return prediction  # no step before: the increment that the local model itself predicts
        before = self.state(previous.means[0], previous.covariances[0])
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
                its bounds: u_k + K (mu_k - follow_k) for k = 1 .. H-1.
        """
        if self._compiles and host_arrays(self.model.weights) is not None:
            found = self._rollout(request.state, request.covariance, inputs, follow)
            return Prediction(found.A, found.B, found.c, request.state, found.covariances, found.inputs)
        belief, gain, stages, plan = self._belief(request.state, request.covariance), None, [], np.array(inputs)
        covariances, n = [_array(belief.covariance)], self.problem.state_dim
        for k, input in enumerate(plan):
            if follow is not None and k:
                moved = input + gain @ (_array(belief.mean) - follow[k])
                input[:] = np.clip(moved, self.problem.input_lower, self.problem.input_upper)
            A, B, c, belief, V = self._linearise(belief, self._tensor(input))
            if self.feedback and gain is None and (follow is not None or V is not None):
                gain = self._gain(np.ascontiguousarray(A[:n, :n]), np.ascontiguousarray(B[:n]))
            if self.feedback and V is not None:
                belief = Gaussian(belief.mean, self._tensor(spread(A + B @ gain, V, covariances[-1], 1)[1]))
            covariances.append(_array(belief.covariance))
            stages.append((A, B, c))
        A, B, c = (np.array(part) for part in zip(*stages, strict=True))
        return Prediction(A, B, c, self.state(request.state, covariances[0]), np.array(covariances), plan)

    def held(self, request: Request, input: Array) -> Prediction:
        """The local model about the belief and an input (m,), for all stages."""
        belief, H = self._belief(request.state, request.covariance), self.horizon
        A, B, c, after, V = self._linearise(belief, self._tensor(input))
        now, after = _array(belief.covariance), _array(after.covariance)
        if V is None:
            covariances = np.empty((H + 1, *now.shape))
            covariances[0], covariances[1:] = now, after
        else:
            covariances = spread(A + B @ self._gain(A, B) if self.feedback else A, V, now, H)
        start = self.state(request.state, now)
        return Prediction(A[None], B[None], c[None], start, covariances, np.tile(input, (H, 1)))

    def _followed(self, request: Request, previous: Decision | None) -> Array | None:
        """What the rollout of a shifted plan has to follow: its own means, or without one the reference.

        Open-loop, over a long horizon, the smallest error leads the rollout out of the data and the bounds.
        """
        if not self.feedback:
            return None
        if previous is not None and previous.status.solved and len(previous.means) == self.horizon + 1:
            return previous.means[1:]
        return np.concatenate([request.state[None], request.targets[:-1]])

    # One stage, by covariance mode: A, B, c, the next belief, and, where feedback can act on it, what the covariance
    # gains in the stage, V = Sigma+ - A Sigma A'.

    def _full(self, belief: Gaussian, input: torch.Tensor) -> tuple[Array, Array, Array, Gaussian, None]:
        local = linearize(self.propagator, self.model, belief, input)
        return _array(local.A), _array(local.B), _array(local.c), local.next, None

    def _diagonal(self, belief: Gaussian, input: torch.Tensor) -> tuple[Array, Array, Array, Gaussian, None]:
        belief = Gaussian(belief.mean, torch.diag_embed(belief.variance))
        moved, d = differentiate(self.propagator, self.model, belief, input)
        deviations = np.sqrt(_array(belief.variance))
        after = np.sqrt(_array(moved.belief.variance))
        # d Sigma_cc = 2 sd_c d sd_c, and the same backwards; where the next deviation is zero it has no derivative.
        backwards = np.divide(0.5, after, out=np.zeros_like(after), where=after > 0)[:, None]
        mean_by_deviation = 2 * _array(d.mean_by_covariance.diagonal(dim1=-2, dim2=-1)) * deviations
        variance_by_mean = _array(d.covariance_by_mean.diagonal(dim1=0, dim2=1)).T
        variance_by_variance = d.covariance_by_covariance.diagonal(dim1=-2, dim2=-1).diagonal(dim1=0, dim2=1)
        variance_by_deviation = 2 * _array(variance_by_variance).T * deviations
        variance_by_input = _array(d.covariance_by_input.diagonal(dim1=0, dim2=1)).T
        A = np.block(
            [
                [_array(d.mean_by_mean), mean_by_deviation],
                [backwards * variance_by_mean, backwards * variance_by_deviation],
            ]
        )
        B = np.concatenate([_array(d.mean_by_input), backwards * variance_by_input])
        s = np.concatenate([_array(belief.mean), deviations])
        c = np.concatenate([_array(moved.belief.mean), after]) - A @ s - B @ _array(input)
        return A, B, c, Gaussian(moved.belief.mean, torch.diag_embed(moved.belief.variance)), None

    def _zero_order(self, belief: Gaussian, input: torch.Tensor) -> tuple[Array, Array, Array, Gaussian, Array]:
        x, u, S = _array(belief.mean), _array(input), _array(belief.covariance)
        if self._first_order and host_arrays(self.model.weights) is not None:
            mean, variance, A, B = point_arrays(self.model, "point_with_jacobian", x, u)
            V = np.diag(variance)
            if self.propagator.observation_noise:
                V += _array(self.model.noise_covariance)
            after = Gaussian(torch.from_numpy(mean), torch.from_numpy(A @ S @ A.T + V))
            return A, np.ascontiguousarray(B), mean - A @ x - B @ u, after, V
        moved, d = differentiate(self.propagator, self.model, belief, input)
        A, B = _array(d.mean_by_mean), _array(d.mean_by_input)
        c = _array(moved.belief.mean) - A @ x - B @ u
        V = own_spread(A, _array(moved.cross_covariance), _array(moved.belief.covariance))
        return A, B, c, moved.belief, V

    def _none(self, belief: Gaussian, input: torch.Tensor) -> tuple[Array, Array, Array, Gaussian, None]:
        x, u = _array(belief.mean), _array(input)
        if isinstance(self.model, GPPosterior) and host_arrays(self.model.weights) is not None:
            mean, A, B = point_arrays(self.model, "mean_with_jacobian", x, u)
        else:
            moved, A, B = self.model.predict_with_jacobian(belief.mean, input)
            mean, A, B = _array(moved.mean), _array(A), _array(B)
        c = mean - A @ x - B @ u
        return (
            np.ascontiguousarray(A),
            np.ascontiguousarray(B),
            c,
            Gaussian(self._tensor(mean), belief.covariance),
            None,
        )

    def _gain(self, A: Array, B: Array) -> Array:
        problem = self.problem
        return lqr_gain(A, B, problem.Q, problem.R, problem.terminal, self.horizon)

    def _belief(self, mean: Array, covariance: Array) -> Gaussian:
        known = np.zeros_like(covariance) if self.covariance == "none" else covariance
        return Gaussian(self._tensor(mean), self._tensor(known))

    def _tensor(self, array: Array) -> torch.Tensor:
        return torch.as_tensor(array, dtype=self.model.dtype, device=self.model.device)


def _array(tensor: Any) -> Array:
    """A tensor as a contiguous float64 array in host memory."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float64)
