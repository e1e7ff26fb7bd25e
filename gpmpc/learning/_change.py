"""What has changed since a model was learned: a GP of the change, which forgets.

    x[k+1] = f(x[k], u[k]) + B d(phi(x[k], u[k]), t[k])

f was learned before, d is the change: a GP over what the model's own GP sees, phi, and over the time t, so that it
forgets in its kernel (a product of kernels in space and time: Bartels, Lahr, Carron and Zeilinger, 2026),

    k_a = share^2 sf2_a exp(-1/2 sum_d (phi_d - phi'_d)^2 / l_ad^2) exp(-1/2 (t - t')^2 / memory^2).

Length-scales and signal variances are the model's: the plant may differ by a share of what was learned. Where nothing
was seen lately d is zero, and with one point it is the estimate of a constant disturbance.
"""

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import Array, DynamicsModel, Linearized, linearize, to_array
from gpmpc._kernels import Window
from gpmpc._kernels import linearize as linearize_gps
from gpmpc.exceptions import UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.gp._online import least_informative
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
    points: int = 40  #: of d, at most; where there would be more, a fifth goes
    remove: Literal["oldest", "least_informative"] = "oldest"  #: which
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
    def change(self) -> tuple[Window, Window | None]:
        """d: GPs over (phi, u, t), at first without points; and in the making those without the points that go next."""
        gp = self.gp
        scales = np.column_stack([to_array(gp.lengthscales), np.full(gp.output_dim, self.memory)])
        signal = self.share**2 * to_array(gp.signal_variance)
        return Window.empty(scales, signal, gp.state_dim, self.points), None

    def __len__(self) -> int:
        return self.change[0].arrays.size

    def later(self, steps: float) -> "ChangedModel":
        """The model some steps later."""
        return self._replaced(time=self.time + steps)

    def _replaced(self, **changes: Any) -> "ChangedModel":
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__ | changes)
        return other

    def error(self, state: Array, input: Array, next_state: Array) -> tuple[Array, Array, Array]:
        """The point (phi, u, t) (d,) of a transition, what d was there (k,), and the variance of f there (k,)."""
        states, inputs, reach = state[None], input[None], self.arrays[1]
        alone = linearize(self.model, states, inputs)
        z, v, _ = self.features.linearize(states, inputs)
        variance = ((reach @ cast(Array, alone.covariance)[0]) * reach).sum(1)
        return np.concatenate([z[0], v[0], [self.time]]), reach @ (next_state - alone.mean[0]), variance

    def with_point(self, point: Array, target: Array, noise: Array) -> "ChangedModel":
        """The model with a further point (phi, u, t) (d,) of the change, its target (k,) and its noise's variance (k,).

        Raises SettingError where the noise is too small.
        """
        (now, coming), new, most = self.change, (point, target, noise), self.points
        gone = max(1, most // 5)
        step = len(self) - (most - gone)  # of ``gone`` in which the factor without them is made
        if step > 0 and coming is None:
            oldest = self.remove == "oldest"
            coming = now.without(range(gone) if oldest else least_informative(self.posterior, gone))
        if coming is not None and step == gone:
            now, coming = coming, None
        elif coming is not None:  # rows are as much work as their number's square: all steps have the same share
            coming = coming.append(*new, rows=int((most - gone) * (step / gone) ** (1 / 3)))
        return self._replaced(change=(now.append(*new), coming))

    def last_innovation(self) -> tuple[Array, Array]:
        """Error and variance (k,) of the prediction of the last point of the change by those before, with its noise.

        With L the factor and v = L^-1 y, L_NN^2 is the variance, and v_N L_NN the error.
        """
        last = self.change[0].columns[:, len(self) - 1]
        root = last[:, len(self) - 1]
        return last[:, -1] * root, root**2

    @property
    def posterior(self) -> GPPosterior:
        """The GPs of d as tensors."""
        gp, now, size = self.gp, self.change[0], len(self)
        arrays, (k, d) = now.arrays, now.arrays.inverse_squares.shape
        parts = arrays.points[:, :size].T, now.data[d : d + k, :size].T, arrays.inverse_squares**-0.5
        factor = now.columns[:, :size, :size].transpose(0, 2, 1)
        rest = np.exp(arrays.log_signal), self.arrays[2], np.zeros(k), factor, arrays.weights[:, :size]
        names = [field.name for field in fields(GPPosterior)]
        given: dict[str, Any] = dict(zip(names, map(torch.from_numpy, parts + rest), strict=False))
        return GPPosterior(**given, input_dim=gp.input_dim + 1, predicts="value")

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
        found, change = linearize(self.model, states, inputs, covariance), self.change[0]
        if not len(self):
            return found
        z, v, slope = self.features.linearize(states, inputs)
        at = np.empty((len(v), v.shape[1] + 1))
        at[:, :-1], at[:, -1] = v, self.time
        offset = np.zeros(self.gp.output_dim)
        mean, by_state, by_input, variance = linearize_gps(change, z, at, covariance, offset, False)
        by_state, by_input = self.features.chain(by_state, by_input[..., :-1], slope)
        B, V = self.arrays[0], found.covariance
        V = None if V is None or variance is None else V + B @ variance @ B.T
        return Linearized(found.mean + mean @ B.T, found.A + B @ by_state, found.B + B @ by_input, V)
