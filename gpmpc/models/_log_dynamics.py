"""Models of outputs as models of the next state, which a controller can plan with.

    x[k+1] = kinematics.step(x[k], y(x[k], u[k]))

Where inputs act late, through lags, or past rows are remembered, the state holds that
as well, behind what is measured: a loop begins with ``at_rest`` and goes on with
``follow`` (``gpmpc.models._past``). The disturbance from the past is left to the
controller's own estimate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpmpc._angles import full_turns, wrap
from gpmpc._arrays import read_array
from gpmpc._dynamics import Array, Linearized, check_query, to_array
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.models._log_linearization import DIFFERENCE, LogLinearizer
from gpmpc.models._log_model import LogModel
from gpmpc.models._namings import NO_NAMINGS, Namings
from gpmpc.models._parametric import sees_inputs
from gpmpc.models._past import states_along
from gpmpc.signals import UNKNOWN, Signals

#: of the coloured noise of outputs [rows]; zero is white
TIME_CONSTANTS = (0.0, 5.0, 25.0, 100.0)
_NO_CONTEXT = np.empty(0)


class TubeNoise(NamedTuple):
    """Variances of the noise of a controller's tube.

    Its covariance grows by the same white noise at every step, from that of a row that
    was measured once. Both are fitted to the errors of held-out rollouts from such rows
    at many steps ahead: the noise of the sensors is in the start and not in the steps,
    and white noise stands for noise that is alike for several rows.
    """

    outputs: Array  #: of the outputs (o,), in their squared units
    start: Array  #: of each entry of a difference of states (e,), likewise


@dataclass(frozen=True, eq=False)
class OutputNoise:
    """Variances of the sources of the errors of a model of outputs."""

    #: of each time constant and output (T, o), in squared units of the outputs
    outputs: Array
    measurement: Array  #: of each entry of a difference of states (e,), likewise
    #: steps ahead at which ``scales`` stand (S,), increasing; none without
    steps: tuple[int, ...] = ()
    #: squared errors of held-out predictions over what the sources explain (S, e)
    scales: Array = field(default_factory=lambda: np.empty((0, 0)))
    #: most variances that are claimed (S, e); none without ``steps``
    largest: Array = field(default_factory=lambda: np.empty((0, 0)))
    #: of the outputs' noise [rows] (T,); zero is white
    time_constants: tuple[float, ...] = TIME_CONSTANTS
    tube: TubeNoise | None = None  #: of a controller's tube; older files have none

    def scaled(self, factors: Array) -> "OutputNoise":
        """Returns the noise with other variances of predictions, and the same tube.

        Args:
            factors: By which they change, by step and entry (S, e) or (S, 1).
        """
        largest = self.largest
        if largest.size:  # older files have none beside their scales
            largest = factors * largest
        return replace(self, scales=factors * self.scales, largest=largest)

    def scales_at(self, steps: Sequence[int]) -> Array:
        """Returns factors (steps, e) of the variances that the sources explain.

        They are interpolated over the logarithm of the step, and one without
        ``scales``.
        """
        if not self.steps:
            return np.ones((len(steps), len(self.measurement)))
        return self._between(self.scales, steps)

    def largest_at(self, steps: Sequence[int]) -> Array:
        """Returns the most variances (steps, e) that are claimed, infinite without."""
        if not self.largest.size:
            return np.full((len(steps), len(self.measurement)), np.inf)
        return self._between(self.largest, steps)

    def _between(self, values: Array, steps: Sequence[int]) -> Array:
        """Interpolates positive values (S, e) to (steps, e)."""
        logarithms = np.log(values)
        columns = [
            np.interp(np.log(steps), np.log(self.steps), column)
            for column in logarithms.T
        ]
        return np.exp(np.stack(columns, axis=-1))


@dataclass(frozen=True, eq=False)
class LogDynamics:
    """A model of a log as a ``DynamicsModel``.

    Raises:
        SettingError: It has a term of the controller that flew.

    See Also:
        ``LogModel``; ``gpmpc.logs.IdentifiedModel``, which makes one.
    """

    model: LogModel  #: without context
    input_dim: int  #: number of inputs, m
    time_step: float  #: [s]
    noise: OutputNoise | None = None  #: of its outputs; none by default
    signals: Signals = UNKNOWN  #: names and time step, where they are known
    #: smallest and largest measured states and inputs of the log (2, n + m), where they
    #: are known
    ranges: Array | None = None
    #: what a system that it flies may call its measured states and inputs
    namings: Namings = NO_NAMINGS
    dtype = torch.float64
    device = torch.device("cpu")

    def __post_init__(self) -> None:
        reason = ""
        if self.model.feedback_outputs:
            reason = "holds the feedback of the controller that flew"
        elif not self._sees_inputs:
            reason = "moves in the same way whatever the inputs are"
        if reason:
            rule = "which no controller can plan with: gpmpc learn --for-control"
            raise SettingError("model", f"{reason}, {rule}")

    @property
    def _sees_inputs(self) -> bool:
        """Whether any part of the model is a function of the inputs."""
        model = self.model
        learned = bool(model.gps) or bool(model.weights.any())
        return learned or sees_inputs(model.nominal)

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
    def past(self) -> int:
        """Number of rows after which the state forgets what it began with."""
        return self.model.past

    @property
    def state_dim(self) -> int:
        """Number of states, n: those that are measured and those beyond."""
        return self.measured_dim + self.carried_dim

    output_dim = state_dim

    def at_rest(self, measured: Array, input: Array) -> Array:
        """Returns the state (n,) of a plant that stood where it is first measured.

        Args:
            measured: (measured_dim,).
            input: That was applied all the time (m,).
        """
        return self.model.at_rest(measured, input, _NO_CONTEXT)

    def follow(self, state: Array, input: Array, measured: Array) -> Array:
        """Returns the next state (n,): what was measured, and the past a row later.

        Args:
            state: That of the step before (n,).
            input: That was applied there (m,).
            measured: What it led to (measured_dim,).
        """
        return self.model.follow(state, input, measured, _NO_CONTEXT, self.time_step)

    def augmented(self, states: Array, inputs: Array) -> Array:
        """Returns the state (n,) after measured rows.

        Before the first of them it was at rest.

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
        if not len(inputs):
            inputs = np.zeros((1, self.input_dim))
        return states_along(self, states, inputs)[-1]

    @property
    def angles(self) -> Sequence[int]:
        """Indices of the states that are angles."""
        return self.model.kinematics.space.angles

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance of the next state's noise at the state of zeros (n, n).

        The sensors' noise is no part of it (see ``start_covariance``), except in files
        without a tube's noise, as earlier releases wrote them.
        """
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
        tube = self.noise.tube
        if tube is not None:
            covariance = B * tube.outputs @ B.T
        else:
            covariance = B * self.noise.outputs.sum(axis=0) @ B.T
            measured = slice(0, space.dim)  # what is remembered has none of its own
            covariance[measured, measured] += self._covariance_of_errors(
                space.origin, self.noise.measurement
            )
        return torch.from_numpy((covariance + covariance.T) / 2)

    def start_covariance(self, measured: Array | None = None) -> Array:
        """Computes the covariances of states that were measured once.

        Predictions from rows of sensors like those of the log begin with them. They are
        zero without noise, and of older files, whose ``noise_covariance`` holds the
        sensors' noise.

        Args:
            measured: (..., measured_dim); the state of zeros by default.

        Returns:
            (..., measured_dim, measured_dim).
        """
        if measured is None:
            measured = self.model.kinematics.space.origin
        if self.noise is None or self.noise.tube is None:
            n = self.measured_dim
            return np.zeros((*measured.shape[:-1], n, n))
        return self._covariance_of_errors(measured, self.noise.tube.start)

    def _covariance_of_errors(self, measured: Array, variances: Array) -> Array:
        """Computes covariances (..., n, n) of states from variances of errors (e,).

        Args:
            measured: The states (..., n).
            variances: Of differences of states (e,).
        """
        space = self.model.kinematics.space
        h = DIFFERENCE * np.eye(space.error_dim)
        forward = space.displace(measured[..., None, :], h)
        backward = space.displace(measured[..., None, :], -h)
        differences = forward - backward
        angles = list(space.angles)
        differences[..., angles] = wrap(differences[..., angles])
        D = np.swapaxes(differences, -1, -2) / (2 * DIFFERENCE)
        return D * variances @ np.swapaxes(D, -1, -2)

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
        """Linearises at K points (K, n), (K, m), all at once."""
        states = np.asarray(states)
        inputs = np.asarray(inputs)
        local = self._linearizer(states, inputs, covariance)
        mean = local.mean + full_turns(states - local.mean, self.angles)
        return local._replace(mean=mean)

    @cached_property
    def _linearizer(self) -> LogLinearizer:
        return LogLinearizer(self.model, self.input_dim, self.time_step)

    def predict_mean(self, states: Array, inputs: Array) -> Array:
        """Computes the means of the next states (K, n); see ``linearize``."""
        return self._mean(states, inputs)

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
        if not self.model.gps:
            return np.zeros((len(z), self.state_dim, self.state_dim))
        covariance = self._linearizer(z, u, True).covariance
        assert covariance is not None
        return covariance

    def _derivatives_by_outputs(self, z: Array, u: Array) -> Array:
        """Computes the derivatives of the next states by the outputs (K, n, o)."""
        columns = []
        for h in DIFFERENCE * np.eye(len(self.model.history)):
            columns.append(self._step(z, u, h) - self._step(z, u, -h))
        return np.stack(columns, axis=-1) / (2 * DIFFERENCE)
