"""What has changed since a model was learned: a GP of the change, which forgets.

    x[k+1] = f(x[k], u[k]) + B d(phi(x[k], u[k]), t[k])

f was learned before, d is the change: a GP over what the model's own GP sees, phi, and over the time t, so that it
forgets in its kernel (a product of kernels in space and time: Bartels, Lahr, Carron and Zeilinger, 2026),

    k_a = share^2 sf2_a exp(-1/2 sum_d (phi_d - phi'_d)^2 / l_ad^2) exp(-1/2 (t - t')^2 / memory^2).

Length-scales and signal variances are the model's: the plant may differ by a share of what was learned. Where nothing
was seen lately d is zero, and with one point it is the estimate of a constant disturbance.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from gpmpc.dynamics import Array, DynamicsModel, Linearized, linearize, to_array
from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, SlidingWindow
from gpmpc.models import Features, Wrapper


@dataclass(frozen=True)
class ChangedModel(Wrapper):
    """A model and its change.

    Attributes:
        model: f: a ``GPPosterior`` of next states, or a ``ResidualModel``.
        change: d, over (phi, t), with ``predicts="value"``; None for none.
        time: t of all predictions [steps].

    Raises:
        UnsupportedModel: Another model, or a ``ResidualModel`` whose B is a function of the state.
    """

    model: DynamicsModel
    change: GPPosterior | None = None
    time: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.gp, GPPosterior) or self.gp.device.type != "cpu" or callable(self.B):
            rule = "learning while flying needs a GPPosterior or a ResidualModel with a constant B, in host memory"
            raise UnsupportedModel(f"{rule}; got {type(self.model).__name__}")

    @cached_property
    def gp(self) -> GPPosterior:
        """The GP that the model was learned with."""
        known: Any = getattr(self.model, "residual", self.model)
        return known

    @cached_property
    def features(self) -> Features:
        """What d sees of the state and the input."""
        n, m, model = self.model.state_dim, self.model.input_dim, cast(Any, self.model)
        return Features(list(range(n)), list(range(m)), [], n, m) if self.gp is model else model.features

    @cached_property
    def B(self) -> Tensor:
        """Where d acts (n, k)."""
        model = cast(Any, self.model)
        return torch.eye(self.gp.output_dim, dtype=self.gp.dtype) if self.gp is model else model.B

    @cached_property
    def reach(self) -> Array:
        """The pseudo-inverse of B (k, n): the part of an error of f that d can explain."""
        return np.ascontiguousarray(np.linalg.pinv(to_array(self.B)), dtype=np.float64)

    def later(self, steps: float) -> "ChangedModel":
        """The model some steps later."""
        return self._replaced(time=self.time + steps)

    def _replaced(self, **changes: Any) -> "ChangedModel":
        other = replace(self, **changes)
        for name in ("gp", "features", "B", "reach"):  # these do not change with time
            other.__dict__[name] = getattr(self, name)
        return other

    def errors(self, states: Array, inputs: Array, next_states: Array) -> tuple[Array, Array, Array]:
        """Points (phi, u) (N, d) of d, what it was there (N, k), and variances of f there (N, k), of N transitions."""
        alone = linearize(self.model, states, inputs)
        variances = np.einsum("ai,nij,aj->na", self.reach, cast(Array, alone.covariance), self.reach)
        points = np.column_stack(self.features.linearize(states, inputs)[:2])
        return points, (next_states - alone.mean) @ self.reach.T, variances

    def with_points(
        self, points: Array, targets: Array, noise: Array, share: float, memory: float, window: SlidingWindow
    ) -> "ChangedModel":
        """The model with further points (phi, u) (N, d) of the change, observed now with noise of variances (k,).

        Share and memory are those of the kernel, for the first points; the window says which points go.

        Raises:
            SettingError: The kernel matrix is not positive definite.
            DataError: A number is not finite.
        """
        gp, variances = self.gp, torch.from_numpy(noise)
        features = torch.from_numpy(np.column_stack([points, np.full(len(points), self.time)]))
        if self.change is None:
            scales = torch.cat([gp.lengthscales, torch.full_like(gp.lengthscales[:, :1], memory)], dim=1)
            kernel = scales, share**2 * gp.signal_variance, variances
            one = features[:1], torch.from_numpy(targets[:1])
            first = self._replaced(change=GPPosterior.from_hyperparameters(*one, *kernel, gp.input_dim + 1, "value"))
            if len(points) == 1:
                return first
            return first.with_points(points[1:], targets[1:], noise, share, memory, window)
        before = replace(self.change, noise_variance=variances)  # of these points; the others' is in the factor
        return self._replaced(change=window.append(before, features, torch.from_numpy(targets)))

    def last_innovation(self) -> tuple[Array, Array]:
        """Error and variance (k,) of the prediction of the last point of the change by those before, with its noise.

        With L the factor and beta the weights, L_NN^2 is the variance, and beta_N L_NN^2 the error.
        """
        change: Any = self.change
        variance = to_array(change.cholesky[:, -1, -1] ** 2)
        return to_array(change.weights[:, -1]) * variance, variance

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return self.model.state_dim

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations (n, n)."""
        return self.model.noise_covariance

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution at x (*batch, n) and u (*batch, m), without the noise."""
        belief = self.model.predict(state, input)
        if self.change is None:
            return belief
        z, v = self.features(state, input)
        d = self.change.predict(z, torch.cat([v, torch.full_like(state[..., :1], self.time)], dim=-1))
        return Gaussian(belief.mean + d.mean @ self.B.mT, belief.covariance + self.B @ d.covariance @ self.B.mT)

    def linearize(self, states: Array, inputs: Array, covariance: bool = True) -> Linearized:
        """Linearises at K points (K, n), (K, m), the model and its change each by a method of their own."""
        found = linearize(self.model, states, inputs, covariance)
        if self.change is None:
            return found
        z, v, slope = self.features.linearize(states, inputs)
        d = self.change.linearize(z, np.column_stack([v, np.full(len(v), self.time)]), covariance)
        by_state, by_input = self.features.chain(d.A, d.B[..., :-1], slope)
        B, V = to_array(self.B), found.covariance
        V = None if V is None or d.covariance is None else V + B @ d.covariance @ B.T
        return Linearized(found.mean + d.mean @ B.T, found.A + B @ by_state, found.B + B @ by_input, V)
