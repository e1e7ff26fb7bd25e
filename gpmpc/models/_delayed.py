"""Models whose inputs act late."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._arrays import names_of, read_array
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array, DynamicsModel, check_next_states
from gpmpc.exceptions import ShapeError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Transitions
from gpmpc.models._past import has_past, measured_dim, rows_before
from gpmpc.models._wrapper import LinearPart, LinearWrapper
from gpmpc.signals import Signals, signals_of

_DIGITS = 9  # of a delay in steps, behind the point


@explains_arguments
@dataclass(frozen=True, eq=False)
class DelayedModel(LinearWrapper):
    """A model whose input acts late, by a whole or a fractional number of steps.

    The state holds the pending inputs, those on their way: z = (x, u_{k-D}, ..,
    u_{k-1}), D the delay rounded up. With a delay of D - 1 + w steps, 0 < w <= 1, the
    input that acts within step k changes from u_{k-D} to u_{k-D+1} after the part w of
    it; the model takes their mean, exact to first order in the time step (Franklin,
    Powell and Workman, 1998, section 4.3, for linear systems):

        x[k+1] = f(x[k], w u_{k-D} + (1 - w) u_{k-D+1}),

    and the other inputs move on by a place. The model inside is trained on the inputs
    that acted (``transitions``): one of rows as they were recorded would be late twice.
    A controller plans with it, or, with fewer states, with the undelayed model from the
    state to which the pending inputs will have led (``ahead``; the prediction of Smith,
    1957, in state space).

    Raises:
        SettingError: The delay is no positive number, or the model does not predict
            next states.

    See Also:
        ``gpmpc.estimation.estimate_delay``, which finds the delay in a log.
    """

    model: DynamicsModel  #: without the delay, of n states and m inputs
    delay: float  #: in steps, more than zero; a fraction is allowed

    def __post_init__(self) -> None:
        object.__setattr__(self, "delay", _whole_or_fraction(self.delay))
        check_next_states(self.model)

    @staticmethod
    def transitions(states: Any, inputs: Any, delay: float) -> Transitions:
        """Returns rows to train the model inside on, with the inputs that acted.

        The first D rows are left out: what acted there was applied before the log.

        Args:
            states: x_0 .. x_T of one log at equal time steps (T + 1, n).
            inputs: u_0 .. u_{T-1}, as they were applied (T, m), or one more.
            delay: In steps; see ``gpmpc.estimation.estimate_delay``.

        Raises:
            SettingError: The delay is no positive number.
            ShapeError: States and inputs are no rows of one log, longer than the delay.
        """
        delay = _whole_or_fraction(delay)
        signals = Signals(names_of(states), names_of(inputs))
        x = read_array("states", states)
        u = read_array("inputs", inputs)
        pending = math.ceil(delay)
        T = len(x) - 1
        if x.ndim != 2 or u.ndim != 2 or len(u) not in (T, T + 1) or pending >= T:
            rule = f"states (T + 1, n) and inputs (T, m) need T above {pending}"
            raise ShapeError(f"{rule}; got {x.shape} and {u.shape}")
        w = delay - (pending - 1)
        older = u[: T - pending]
        newer = u[1 : T - pending + 1]
        acting = w * older + (1 - w) * newer
        return Transitions(x[pending:-1], acting, x[pending + 1 :], signals)

    @property
    def pending(self) -> int:
        """Number of pending inputs, D: the delay rounded up."""
        return math.ceil(self.delay)

    @property
    def _older_weight(self) -> float:
        """Part w of a step in which the older of two inputs acts."""
        return self.delay - (self.pending - 1)

    @property
    def _further_names(self) -> list[str]:
        """Names of the pending inputs, the oldest first."""
        names = signals_of(self.model).input_names
        if not names:
            names = tuple(f"u{i + 1}" for i in range(self.input_dim))
        ages = range(self.pending, 0, -1)
        return [f"{name}[k-{age}]" for age in ages for name in names]

    @property
    def state_dim(self) -> int:
        """Number of states, n + D m."""
        return self.model.state_dim + self.pending * self.model.input_dim

    @property
    def measured_dim(self) -> int:
        """Number of the states that are measured: those of the model."""
        return measured_dim(self.model)

    @property
    def past(self) -> int:
        """Number of rows after which the state forgets what it began with."""
        return rows_before(self.model) + self.pending

    def at_rest(self, measured: Array, input: Array) -> Array:
        """Returns the state (n + D m,) of a plant that stood where it is measured.

        Args:
            measured: (measured_dim,).
            input: That was applied all the time (m,).
        """
        state = measured
        if has_past(self.model):
            state = self.model.at_rest(measured, input)
        return np.concatenate([state, np.tile(input, self.pending)])

    def follow(self, state: Array, input: Array, measured: Array) -> Array:
        """Returns the state (n + D m,) that a measurement says.

        Args:
            state: That of the step before (n + D m,).
            input: That was applied there (m,).
            measured: What it led to (measured_dim,).
        """
        n = self.model.state_dim
        after = measured
        if has_past(self.model):
            Z, W, _, _ = self.linear_part
            after = self.model.follow(state[:n], Z @ state + W @ input, measured)
        return np.concatenate([after, state[n + self.input_dim :], input])

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance of the model's noise; pending inputs have none."""
        return self._padded(self.model.noise_covariance)

    @cached_property
    def linear_part(self) -> LinearPart:
        """Matrices by which a mean of the two oldest inputs acts.

        The others move on by a place.
        """
        n = self.model.state_dim
        m = self.input_dim
        D = self.pending
        w = self._older_weight
        # By the queue (u_{k-D}, .., u_{k-1}, u_k), the pending inputs and the new one:
        queue = np.eye((D + 1) * m)
        acting_by_queue = w * queue[:m] + (1 - w) * queue[m : 2 * m]
        next_by_queue = np.vstack([np.zeros((n, len(queue))), queue[m:]])
        new = slice(D * m, None)
        pending = slice(0, D * m)
        return LinearPart(
            Z=np.hstack([np.zeros((m, n)), acting_by_queue[:, pending]]),
            W=acting_by_queue[:, new],
            L=np.hstack([np.zeros((n + D * m, n)), next_by_queue[:, pending]]),
            M=next_by_queue[:, new],
        )

    def augmented(self, belief: Gaussian, inputs: Any) -> Gaussian:
        """Returns the belief over z, from one over x.

        Args:
            belief: Over x (*batch, n).
            inputs: u_{k-D} .. u_{k-1} (D, m), the oldest first.

        Raises:
            ShapeError: Another number of inputs.
        """
        belief = belief.in_order(signals_of(self.model).state_names)
        pending = self._pending_inputs(belief, inputs).flatten(-2)
        batch = belief.mean.shape[:-1]
        pending = pending.expand(*batch, self.pending * self.input_dim)
        mean = torch.cat([belief.mean, pending], dim=-1)
        return Gaussian(mean, self._padded(belief.covariance))

    @cached_property
    def remaining(self) -> DynamicsModel:
        """The model to plan with from the state of ``ahead``.

        It has no delay, or one of the fraction of a step.
        """
        if self._older_weight == 1:
            return self.model
        return DelayedModel(self.model, self._older_weight)

    @property
    def lead(self) -> int:
        """Number of steps by which ``ahead`` looks ahead: a reference begins later."""
        return math.floor(self.delay)

    def ahead(self, propagator: Any, belief: Gaussian, inputs: Any) -> Gaussian:
        """Predicts the belief over the state of ``remaining`` after pending inputs.

        Args:
            propagator: Moves the belief, with the process noise or without.
            belief: Over the x of now (*batch, n).
            inputs: u_{k-D} .. u_{k-1} (D, m), the oldest first.

        Raises:
            ShapeError: Another number of inputs.
        """
        pending = self._pending_inputs(belief, inputs)
        w = self._older_weight
        for k in range(self.lead):
            acting = pending[k]
            if w != 1:
                acting = w * pending[k] + (1 - w) * pending[k + 1]
            belief = propagator.propagate(self.model, belief, acting).belief
        if w == 1:
            return belief
        return DelayedModel(self.model, w).augmented(belief, pending[-1:])

    def _pending_inputs(self, belief: Gaussian, inputs: Any) -> Tensor:
        """Reads pending inputs (D, m) as a tensor like the belief's."""
        if not isinstance(inputs, Tensor) or inputs.is_complex():
            names = signals_of(self.model).input_names
            inputs = np.array(read_array("inputs", inputs, names))
        pending = torch.as_tensor(
            inputs, dtype=belief.mean.dtype, device=belief.mean.device
        )
        shape = (self.pending, self.input_dim)
        if pending.shape != shape:
            rule = (
                f"a delay of {self.delay:g} steps needs the last inputs {shape}, "
                "the oldest first"
            )
            raise ShapeError(f"{rule}; got {tuple(pending.shape)}")
        return pending


def _whole_or_fraction(delay: float) -> float:
    """Returns a delay [steps] without round-off: 0.3 / 0.1 is less than 3.

    Raises:
        SettingError: It is no positive number.
    """
    check_number("delay", delay, unit="[steps]")
    rounded = round(delay, _DIGITS)
    check_number("delay", rounded, above=0, unit="[steps]")
    return rounded
