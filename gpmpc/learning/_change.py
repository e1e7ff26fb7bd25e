"""What has changed since a model was learned: a GP of the change, which forgets.

    x[k+1] = f(x[k], u[k]) + B d(phi(x[k], u[k]), t[k])

f was learned before, d is the change: a GP over what the model's own GP sees, phi, and over the time t, so that it
forgets in its kernel (a product of kernels in space and time: Bartels, Lahr, Carron and Zeilinger, 2026),

    k_a = share^2 sf2_a exp(-1/2 sum_d (phi_d - phi'_d)^2 / l_ad^2) exp(-1/2 (t - t')^2 / memory^2).

Length-scales and signal variances are the model's: the plant may differ by a share of what was learned. Where nothing
was seen lately d is zero, and with one point it is the estimate of a constant disturbance.
"""

from copy import copy
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import Array, DynamicsModel, Linearized, linearize, to_array
from gpmpc._kernels import GPArrays, Packed, replace_point
from gpmpc._kernels import linearize as linearize_gps
from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import Features
from gpmpc.models._wrapper import Wrapper


@dataclass(frozen=True)
class ChangedModel(Wrapper):
    """A model and its change.

    Raises:
        UnsupportedModel: Another model, or a ``ResidualModel`` whose B is a function of the state.
    """

    model: DynamicsModel  #: f: a ``GPPosterior`` of next states, or a ``ResidualModel``
    share: float = 0.1  #: by how much the plant may differ, as a share of what was learned
    memory: float = 5000.0  #: length-scale of time in the kernel [steps]
    time: float = 0.0  #: t of all predictions [steps]

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
    def arrays(self) -> tuple[Array, Array, Array]:
        """B (n, k), its pseudo-inverse, the part of an error of f that d can explain, and the noise of the GP (k,)."""
        B = to_array(self.B)
        return B, np.asarray(np.linalg.pinv(B), dtype=np.float64), to_array(self.gp.noise_variance)

    @cached_property
    def change(self) -> tuple[Packed, Array]:
        """d: GPs over (phi, u, t) for the compiled kernels, and their targets (k, N); without points at first."""
        gp, nothing = self.gp, np.zeros((self.gp.output_dim, 0))
        scales = np.column_stack([to_array(gp.lengthscales), np.full(gp.output_dim, self.memory)])
        signal = np.log(self.share**2 * to_array(gp.signal_variance))
        arrays = GPArrays(np.zeros((scales.shape[1], 0)), scales**-2.0, signal, nothing, 0)
        return Packed(arrays, nothing[:, None, :0].repeat(0, axis=1), gp.state_dim, gp.input_dim + 1), nothing

    def __len__(self) -> int:
        return self.change[0].arrays.size

    def later(self, steps: float) -> "ChangedModel":
        """The model some steps later."""
        return self._replaced(time=self.time + steps)

    def _replaced(self, **changes: Any) -> "ChangedModel":
        other = copy(self)
        other.__dict__.update(changes)
        return other

    def error(self, state: Array, input: Array, next_state: Array) -> tuple[Array, Array, Array]:
        """The point (phi, u, t) (d,) of a transition, what d was there (k,), and the variance of f there (k,)."""
        states, inputs, reach = state[None], input[None], self.arrays[1]
        alone = linearize(self.model, states, inputs)
        z, v, _ = self.features.linearize(states, inputs)
        variance = ((reach @ cast(Array, alone.covariance)[0]) * reach).sum(1)
        return np.concatenate([z[0], v[0], [self.time]]), reach @ (next_state - alone.mean[0]), variance

    def with_point(self, point: Array, target: Array, noise: Array, drop: int = -1) -> "ChangedModel":
        """The model with a further point (phi, u, t) of the change; see ``gpmpc._kernels.replace_point``."""
        return self._replaced(change=replace_point(*self.change, point, target, noise, drop))

    def last_innovation(self) -> tuple[Array, Array]:
        """Error and variance (k,) of the prediction of the last point of the change by those before, with its noise.

        With L the factor and beta the weights, L_NN^2 is the variance, and beta_N L_NN^2 the error.
        """
        change, last = self.change[0], len(self) - 1
        variance = change.cholesky[:, last, last] ** 2
        return change.arrays.weights[:, last] * variance, variance

    @property
    def posterior(self) -> GPPosterior:
        """The GPs of d as tensors."""
        (packed, targets), gp = self.change, self.gp
        arrays, size = packed.arrays, len(self)
        parts = arrays.points[:, :size].T, targets.T, arrays.inverse_squares**-0.5, np.exp(arrays.log_signal)
        rest = self.arrays[2], np.zeros(len(targets)), packed.cholesky, arrays.weights[:, :size]
        names = [field.name for field in fields(GPPosterior)]
        given: dict[str, Any] = dict(zip(names, map(torch.from_numpy, parts + rest), strict=False))
        return GPPosterior(**given, input_dim=gp.input_dim + 1, predicts="value")

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
        if not len(self):
            return belief
        z, v = self.features(state, input)
        d = self.posterior.predict(z, torch.cat([v, torch.full_like(state[..., :1], self.time)], dim=-1))
        return Gaussian(belief.mean + d.mean @ self.B.mT, belief.covariance + self.B @ d.covariance @ self.B.mT)

    def linearize(self, states: Array, inputs: Array, covariance: bool = True) -> Linearized:
        """Linearises at K points (K, n), (K, m), the model and its change each by a method of their own."""
        found, (change, targets) = linearize(self.model, states, inputs, covariance), self.change
        if not len(self):
            return found
        z, v, slope = self.features.linearize(states, inputs)
        at = np.empty((len(v), v.shape[1] + 1))
        at[:, :-1], at[:, -1] = v, self.time
        mean, by_state, by_input, variance = linearize_gps(change, z, at, covariance, np.zeros(len(targets)), False)
        by_state, by_input = self.features.chain(by_state, by_input[..., :-1], slope)
        B, V = self.arrays[0], found.covariance
        V = None if V is None or variance is None else V + B @ variance @ B.T
        return Linearized(found.mean + mean @ B.T, found.A + B @ by_state, found.B + B @ by_input, V)
