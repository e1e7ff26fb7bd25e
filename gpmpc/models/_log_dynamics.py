"""Models of outputs as models of the next state, which a controller can plan with.

    x[k+1] = kinematics.step(x[k], y(x[k], u[k]))

Where inputs act late, through lags, or past rows are remembered, the state holds that
as well, behind what is measured; ``augmented`` fills it with what was measured.
Derivatives are central differences, all points in one batch. The disturbance from the
past is left to the controller's own estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import full_turns
from gpmpc._arrays import read_array
from gpmpc._dynamics import Array, Linearized, check_query, to_array
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.models._log_model import LogModel
from gpmpc.models._windows import Windows
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
        SettingError: It has a term of the controller that flew.
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
        if getattr(self.model.nominal, "feedback", False):
            reason = "holds the feedback of the controller that flew"
        elif not (self.model.gps or getattr(self.model.nominal, "fitted", True)):
            reason = "moves in the same way whatever the inputs are"
        if reason:
            rule = "which no controller can plan with: gpmpc learn --for-control"
            raise SettingError("model", f"{reason}, {rule}")

    @property
    def measured_dim(self) -> int:
        """Number of the states that are measured; four of an attitude."""
        return self.model.kinematics.space.dim

    @cached_property
    def carried_dim(self) -> int:
        """Number of states beyond these: inputs on their way, and what is remembered.

        They are known from past rows.
        """
        return self.model.carried_dim(self.input_dim)

    @property
    def state_dim(self) -> int:
        """Number of states, n: those that are measured and those beyond."""
        return self.measured_dim + self.carried_dim

    output_dim = state_dim

    def augmented(self, states: Array, inputs: Array) -> Array:
        """Returns the state (n,) after measured rows.

        Where there are fewer rows than the model looks back, it was at rest before
        them: as in the first row.

        Args:
            states: Measured states, the last one that of now (P + 1, measured_dim).
            inputs: Those that were applied between them (P, m).

        Raises:
            ShapeError: The two do not belong together.
        """
        states = read_array("states", states)
        inputs = read_array("inputs", inputs)
        count = len(states)
        shapes = (count, self.measured_dim), (count - 1, self.input_dim)
        if not count or (states.shape, inputs.shape) != shapes:
            rule = "states (P + 1, n) and inputs (P, m) must be rows of one flight"
            raise ShapeError(f"{rule}; got {states.shape} and {inputs.shape}")
        past = self.model.past
        missing = max(past - len(inputs), 0)
        first_input = inputs[:1] if len(inputs) else np.zeros((1, self.input_dim))
        states = np.concatenate([np.repeat(states[:1], missing, axis=0), states])
        inputs = np.concatenate([np.repeat(first_input, missing, axis=0), inputs])
        states = states[-past - 1 :]
        inputs = inputs[len(inputs) - past :]
        window = Windows(
            space=self.model.kinematics.space,
            time_step=self.time_step,
            past=past,
            stride=1,
            states=states[None],
            inputs=np.concatenate([inputs, inputs[-1:]])[None],
            context=np.empty((1, past + 1, 0)),
            runs=np.zeros(1),
            times=np.zeros(1),
        )
        return self._unfiltered.recall(window)[0]

    @cached_property
    def _unfiltered(self) -> LogModel:
        """The model that begins where it is measured: a loop filters by itself."""
        return replace(self.model, start_filter=None)

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
        origin = np.zeros((1, n))
        origin[:, : space.dim] = space.origin
        B = self._derivatives_by_outputs(origin, np.zeros((1, self.input_dim)))[0]
        h = DIFFERENCE * np.eye(space.error_dim)
        forward = space.displace(space.origin[None], h)
        backward = space.displace(space.origin[None], -h)
        D = np.zeros((n, space.error_dim))  # what is remembered has no noise of its own
        D[: space.dim] = (forward - backward).T / (2 * DIFFERENCE)
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

    def _mean(self, z: Array, u: Array) -> Array:
        """Computes the mean of the next states (K, n)."""
        return self._step(z, u, 0.0)

    def _step(self, z: Array, u: Array, disturbance: Array | float) -> Array:
        """Moves states (K, n) by a step, with a disturbance of the outputs (o,)."""
        no_context = np.empty((len(z), 0))
        after = self.model.step(
            z,
            inputs=u,
            context=no_context,
            time_step=self.time_step,
            disturbance=disturbance,
        )
        # Kinematics wrap angles; a plan counts their turns.
        return after + full_turns(z - after, self.angles)

    def _covariance(self, z: Array, u: Array) -> Array:
        """Computes the covariance of the next states (K, n, n), by that of the GPs."""
        model = self.model
        K = len(z)
        if not model.gps:
            return np.zeros((K, self.state_dim, self.state_dim))
        no_context = np.empty((K, 0))
        points = model.seen_by_gps(z, u, no_context, self.time_step)
        o = len(model.history)
        V = np.zeros((K, o, o))
        for gp, seen in zip(model.gps, points, strict=True):
            block = np.ix_(range(K), gp.outputs, gp.outputs)
            prediction = gp.posterior.linearize(
                np.ascontiguousarray(seen), no_context, covariance=True
            )
            assert prediction.covariance is not None
            V[block] += prediction.covariance
        B = self._derivatives_by_outputs(z, u)
        return B @ V @ B.mT

    def _derivatives_by_outputs(self, z: Array, u: Array) -> Array:
        """Computes the derivatives of the next states by the outputs (K, n, o)."""
        columns = []
        for h in DIFFERENCE * np.eye(len(self.model.history)):
            columns.append(self._step(z, u, h) - self._step(z, u, -h))
        return np.stack(columns, axis=-1) / (2 * DIFFERENCE)
