"""Models of outputs as models of the next state, which a controller can plan with.

    x[k+1] = kinematics.step(x[k], y(x[k], u[k]))

Derivatives are central differences, all points in one batch. The disturbance from the
past is left to the controller's own estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import full_turns
from gpmpc._dynamics import Array, Linearized, check_query, to_array
from gpmpc.exceptions import SettingError
from gpmpc.gaussian import Gaussian
from gpmpc.models._log_model import LogModel
from gpmpc.signals import UNKNOWN, Signals

#: of the coloured noise of outputs [s]; zero is white
TIME_CONSTANTS = (0.0, 0.05, 0.25, 1.0)
DIFFERENCE = 1e-5  # of central differences, relative to entries above one


@dataclass(frozen=True)
class OutputNoise:
    """Variances of the sources of the errors of a model of outputs."""

    #: of each of ``TIME_CONSTANTS`` and output (T, o), in squared units of the outputs
    outputs: Array
    measurement: Array  #: of each entry of a difference of states (e,), likewise


@dataclass(frozen=True)
class LogDynamics:
    """A model of a log as a ``DynamicsModel``.

    Raises:
        SettingError: Its inputs act late, or it has a term of the controller that flew.
    """

    model: LogModel  #: without context
    input_dim: int  #: number of inputs, m
    time_step: float  #: [s]
    noise: OutputNoise | None = None  #: of its outputs; none by default
    signals: Signals = UNKNOWN  #: names and time step, where they are known
    dtype = torch.float64
    device = torch.device("cpu")

    def __post_init__(self) -> None:
        reason = ""
        if self.model.lag or len(self.model.time_constants):
            reason = "has inputs that act late"
        elif not self.model.memory.empty:
            reason = "remembers past rows"
        elif getattr(self.model.nominal, "feedback", False):
            reason = "holds the feedback of the controller that flew"
        if reason:
            rule = "which no controller can plan with: gpmpc learn --for-control"
            raise SettingError("model", f"{reason}, {rule}")

    @property
    def state_dim(self) -> int:
        """Number of states, n; four of an attitude."""
        return self.model.kinematics.space.dim

    output_dim = state_dim

    @property
    def angles(self) -> Sequence[int]:
        """Indices of the states that are angles."""
        return self.model.kinematics.space.angles

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance of the next state's noise at the state of zeros (n, n)."""
        return self._noise_at_origin

    @cached_property
    def _noise_at_origin(self) -> Tensor:
        n = self.state_dim
        if self.noise is None:
            return torch.zeros(n, n, dtype=torch.float64)
        space = self.model.kinematics.space
        origin = space.origin[None]
        no_outputs = np.zeros((1, self.noise.outputs.shape[1]))
        B = self._derivatives_by_outputs(origin, no_outputs)[0]
        h = DIFFERENCE * np.eye(space.error_dim)
        forward = space.displace(origin, h)
        backward = space.displace(origin, -h)
        D = (forward - backward).T / (2 * DIFFERENCE)
        by_outputs = B * self.noise.outputs.sum(axis=0) @ B.T
        covariance = by_outputs + D * self.noise.measurement @ D.T
        return torch.from_numpy((covariance + covariance.T) / 2)

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """Predicts the next state: mean (*batch, n), covariance (*batch, n, n)."""
        check_query(self, state, input)
        n = self.state_dim
        batch = state.shape[:-1]
        x = to_array(state).reshape(-1, n)
        u = to_array(input).reshape(-1, self.input_dim)
        mean = torch.from_numpy(self._mean(x, u))
        covariance = torch.from_numpy(self._covariance(x, u))
        return Gaussian(mean.reshape(*batch, n), covariance.reshape(*batch, n, n))

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises at K points (K, n), (K, m) by central differences, all at once."""
        n = self.state_dim
        K = len(states)
        z = np.concatenate([states, inputs], axis=1)
        d = z.shape[1]
        h = DIFFERENCE * np.maximum(np.abs(z), 1.0)  # (K, d)
        directions = np.concatenate([np.eye(d), -np.eye(d)])[:, None]
        displaced = (z + directions * h).reshape(-1, d)
        values = self._mean(displaced[:, :n], displaced[:, n:]).reshape(2, d, K, n)
        slopes = (values[0] - values[1]) / (2 * h.T[..., None])
        J = np.moveaxis(slopes, 0, -1)  # (K, n, d)
        V = None
        if covariance:
            V = self._covariance(states, inputs)
        return Linearized(
            mean=self._mean(states, inputs),
            A=np.ascontiguousarray(J[..., :n]),
            B=np.ascontiguousarray(J[..., n:]),
            covariance=V,
        )

    def _mean(self, x: Array, u: Array) -> Array:
        """Computes the mean of the next states (K, n)."""
        model = self.model
        no_context = np.empty((len(x), 0))
        y = model.outputs(x, u, no_context)
        after = model.kinematics.step(x, y, self.time_step)
        # Kinematics wrap angles; a plan counts their turns.
        return after + full_turns(x - after, self.angles)

    def _covariance(self, x: Array, u: Array) -> Array:
        """Computes the covariance of the next states (K, n, n), by that of the GPs."""
        model = self.model
        K = len(x)
        if not model.gps:
            return np.zeros((K, self.state_dim, self.state_dim))
        no_context = np.empty((K, 0))
        features = model.kinematics.features(x, u, no_context)
        features = np.ascontiguousarray(features)
        y = model.outputs(x, u, no_context)
        V = np.zeros((K, y.shape[1], y.shape[1]))
        for gp in model.gps:
            block = np.ix_(range(K), gp.outputs, gp.outputs)
            prediction = gp.posterior.linearize(features, no_context, covariance=True)
            assert prediction.covariance is not None
            V[block] += prediction.covariance
        B = self._derivatives_by_outputs(x, y)
        return B @ V @ B.mT

    def _derivatives_by_outputs(self, x: Array, y: Array) -> Array:
        """Computes the derivatives of the next states by the outputs (K, n, o)."""
        step = self.model.kinematics.step
        dt = self.time_step
        columns = []
        for h in DIFFERENCE * np.eye(y.shape[1]):
            columns.append(step(x, y + h, dt) - step(x, y - h, dt))
        return np.stack(columns, axis=-1) / (2 * DIFFERENCE)
