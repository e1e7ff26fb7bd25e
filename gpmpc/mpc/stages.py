"""Affine stage models of the belief's dynamics, s_{k+1} = A_k s_k + B_k u_k + c_k, of all stages of a plan in one call.

The *covariance* mode says what s holds of the belief N(mu, Sigma):

* ``full``: s = [mu; vec S] with the symmetric root S = Sigma^(1/2) (Cao, Lai and Alam, 2017, section 4.1).
* ``diagonal``: s = [mu; standard deviations]; correlations are dropped at every stage.
* ``zero_order``: s = mu; covariances are predicted beside the optimisation as if the inputs did not change them
  (Hewing, Kabzan and Zeilinger, 2020; Zanelli, Frey, Messerer and Diehl, 2021).
* ``none``: s = mu, through the model's mean at a certain state.

``full`` and ``diagonal`` are linearised at the means and covariances of the plan, whatever the propagator.
"""

from typing import Literal, NamedTuple

import numpy as np
import torch

from gpmpc.compiled import call_unchecked, compiled
from gpmpc.dynamics import DynamicsModel, linearize, tensors_for, to_array
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.kernels.linalg import dot
from gpmpc.propagation import Propagator, differentiate
from gpmpc.propagation import linearize as linearize_belief
from gpmpc.propagation.local_model import square_roots

Array = np.ndarray

Covariance = Literal["full", "diagonal", "zero_order", "none"]
COVARIANCES = ("full", "diagonal", "zero_order", "none")


class Plan(NamedTuple):
    """Where stages are linearised; it need not obey the dynamics.

    Attributes:
        states: s_0 .. s_H (H + 1, p); s_0 is the current one.
        inputs: u_0 .. u_{H-1} (H, m).
        covariances: Sigma_0 .. Sigma_H (H + 1, n, n).
    """

    states: Array
    inputs: Array
    covariances: Array


class LinearizedStages(NamedTuple):
    """K affine stage models: K = H along a plan, or K = 1 that is held over the horizon.

    Attributes:
        A: (K, p, p).
        B: (K, p, m).
        c: (K, p); the defects of the plan are part of it.
        next: Where the dynamics lead from the points themselves, F(s_k, u_k) (K, p).
        V: What a stage adds to A Sigma A' (K, n, n), in the mode ``zero_order``; zero elsewhere.
    """

    A: Array
    B: Array
    c: Array
    next: Array
    V: Array


class StageLinearizer:
    """Linearises the dynamics of the belief at K points in one call, in one covariance mode.

    Args:
        model: Its mean, and where covariances count its variance.
        propagator: How the belief moves; ``none`` needs the model's mean only.
        covariance: See the module's text.

    Raises:
        SettingError: An unknown mode.
    """

    def __init__(self, model: DynamicsModel, propagator: Propagator, covariance: Covariance):
        if covariance not in COVARIANCES:
            possible = ", ".join(map(repr, COVARIANCES))
            raise SettingError("covariance", f"must be one of {possible}; got {covariance!r}")
        self.model, self.propagator, self.covariance, self._n = model, propagator, covariance, model.state_dim
        first_order = getattr(propagator, "first_order", False)
        self.at_points = covariance == "none" or (covariance == "zero_order" and first_order)
        noisy = covariance == "zero_order" and getattr(propagator, "process_noise", False)
        self._noise = to_array(model.noise_covariance) if noisy else None
        moments = {"full": self._full, "diagonal": self._diagonal, "zero_order": self._zero_order}
        self._linearize = self._points if self.at_points else moments[covariance]

    def weight(self, Q: Array) -> Array:
        """The weight of s that belongs to a weight of x (n, n): the blocks on its diagonal (p / n, n, n)."""
        if self.covariance == "full":  # tr(Q Sigma) = |vec S|^2 in I_n kron Q
            return np.tile(Q, (self._n + 1, 1, 1))
        return np.stack([Q, np.diag(np.diag(Q))]) if self.covariance == "diagonal" else Q[None]

    def state(self, means: Array, covariances: Array) -> Array:
        """The vectors s (K, p) of beliefs (K, n), (K, n, n)."""
        if self.covariance == "full":
            return np.concatenate((means, square_roots(covariances)[0].reshape(len(means), -1)), axis=1)
        if self.covariance == "diagonal":
            variances = np.diagonal(covariances, axis1=1, axis2=2)
            return np.concatenate([means, np.sqrt(np.clip(variances, 0, None))], axis=1)
        return means

    def moments(self, states: Array, covariances: Array) -> tuple[Array, Array]:
        """Means and covariances of the states s (K, p); ``covariances`` where s does not hold them."""
        n = self._n
        if self.covariance == "full":
            S = states[:, n:].reshape(-1, n, n)
            return states[:, :n], S @ S.mT
        if self.covariance == "diagonal":
            return states[:, :n], states[:, n:, None] ** 2 * np.eye(n)
        return states, covariances

    def __call__(
        self, states: Array, inputs: Array, covariances: Array, disturbance: Array | None = None
    ) -> LinearizedStages:
        """The stage models at K points.

        Args:
            states: s (K, p), contiguous.
            inputs: (K, m), contiguous.
            covariances: Of the states (K, n, n).
            disturbance: Added to the next means (n,) or (K, n); None for none.
        """
        after, A, B, V = self._linearize(states, inputs, covariances)
        if disturbance is not None:
            after = after.copy()
            after[:, : self._n] += disturbance
        return LinearizedStages(A, B, call_unchecked(_constants, A, B, after, states, inputs), after, V)

    def _points(self, states: Array, inputs: Array, _: Array) -> tuple[Array, ...]:
        found = linearize(self.model, states, inputs, self.covariance == "zero_order")
        V = np.zeros((len(states), self._n, self._n)) if found.covariance is None else found.covariance
        V = V if self._noise is None else V + self._noise
        parts = found.mean, found.A, found.B, V  # a model may give views, which the kernels do not notice
        return tuple([np.ascontiguousarray(part, dtype=np.float64) for part in parts])

    def _zero_order(self, states: Array, inputs: Array, covariances: Array) -> tuple[Array, ...]:
        moved, d = differentiate(self.propagator, self.model, *self._tensors(states, covariances, inputs))
        A, S = d.mean_by_mean, moved.belief.covariance
        passed = A @ moved.cross_covariance  # mean equivalence passes nothing on
        eigenvalues, vectors = torch.linalg.eigh(S - (passed + passed.mT) / 2)
        V = (vectors * eigenvalues.clamp_min(0)[..., None, :]) @ vectors.mT
        return tuple(map(to_array, (moved.belief.mean, A, d.mean_by_input, V)))

    def _full(self, states: Array, inputs: Array, covariances: Array) -> tuple[Array, ...]:
        belief, input = self._tensors(states[:, : self._n], covariances, inputs)
        local = linearize_belief(self.propagator, self.model, belief, input)
        after = self.state(to_array(local.next.mean), to_array(local.next.covariance))
        return after, to_array(local.A), to_array(local.B), np.zeros_like(covariances)

    def _diagonal(self, states: Array, inputs: Array, covariances: Array) -> tuple[Array, ...]:
        n = self._n
        covariances = covariances * np.eye(n)
        belief, input = self._tensors(states[:, :n], covariances, inputs)
        moved, d = differentiate(self.propagator, self.model, belief, input)
        sd, sd_next = belief.variance.sqrt(), moved.belief.variance.clamp_min(0).sqrt()
        # d Sigma_cc = 2 sd_c d sd_c, and backwards; where the next deviation is zero it has no derivative.
        backwards = torch.where(sd_next > 0, 0.5 / torch.where(sd_next > 0, sd_next, 1.0), 0.0)[..., None]
        twice = 2 * sd[..., None, :]
        mean_by_sd = d.mean_by_covariance.diagonal(dim1=-2, dim2=-1) * twice
        by_mean, by_input = (
            part.diagonal(dim1=-3, dim2=-2).mT for part in (d.covariance_by_mean, d.covariance_by_input)
        )
        by_variance = d.covariance_by_covariance.diagonal(dim1=-2, dim2=-1).diagonal(dim1=-3, dim2=-2).mT
        upper = torch.cat([d.mean_by_mean, mean_by_sd], dim=-1)
        lower = torch.cat([backwards * by_mean, backwards * by_variance * twice], dim=-1)
        A, B = torch.cat([upper, lower], dim=-2), torch.cat([d.mean_by_input, backwards * by_input], dim=-2)
        return *map(to_array, (torch.cat([moved.belief.mean, sd_next], dim=-1), A, B)), np.zeros_like(covariances)

    def _tensors(self, means: Array, covariances: Array, inputs: Array) -> tuple[Gaussian, torch.Tensor]:
        mean, covariance, input = tensors_for(self.model, means, covariances, inputs)
        return Gaussian(mean, covariance), input


@compiled
def _constants(A, B, after, states, inputs):
    """C (K, p) of s+ = A s + B u + c through the points."""
    c = after.copy()
    for k in range(len(c)):
        for i in range(c.shape[1]):
            c[k, i] -= dot(A[k, i], states[k], A.shape[2]) + dot(B[k, i], inputs[k], B.shape[2])
    return c
