"""Models around another model: inputs that act late, disturbances as states, noise that varies."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from gpmpc._angles import angles_of
from gpmpc._arrays import read_array
from gpmpc._dynamics import (
    Array,
    DynamicsModel,
    Linearized,
    TensorModel,
    check_destination,
    check_next_states,
    check_query,
    linearize,
    tensors_for,
    to_array,
)
from gpmpc.exceptions import SettingError, ShapeError, check_number, check_numbers
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.gp import GPPosterior
from gpmpc.models._nominal import Affine
from gpmpc.signals import Signals, signals_of


class Wrapper(TensorModel):
    """A model with the states, the inputs, the type and the device of the model that it holds."""

    model: DynamicsModel  #: the model that is wrapped
    _part = property(lambda self: self.model)

    @property
    def state_dim(self) -> int:
        """Number of states, n; with further ones where there are some."""
        return self.model.state_dim

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return self.model.input_dim

    @property
    def output_dim(self) -> int:
        """Number of outputs: the next state."""
        return self.state_dim

    @property
    def angles(self) -> Sequence[int]:
        """Indices of the states that are angles: those of the model, whose states come first."""
        return angles_of(self.model)

    @property
    def signals(self) -> Signals:
        """Names and time step, where the model knows them; further states are named, too."""
        inner = signals_of(self.model)
        further = self._further_names
        if not further or not inner.state_names:
            return inner
        names = (*inner.state_names, *further)
        distinct = len(set(names)) == len(names)  # not so of a delay around a delay
        return replace(inner, state_names=names if distinct else ())

    @property
    def _further_names(self) -> list[str]:
        """Of the states beyond those of the model."""
        return []


def move(model: Any, device: Any = None, dtype: torch.dtype | None = None) -> Any:
    """Copies a model of tensors and models to another device or type; functions are taken as they are."""
    check_destination(device, dtype)
    parts = {field.name: getattr(model, field.name) for field in fields(model)}
    for name, part in parts.items():
        if isinstance(part, Tensor) or hasattr(part, "state_dim"):
            parts[name] = part.to(device=device, dtype=dtype)
        elif isinstance(part, Affine):
            parts[name] = move(part, device, dtype)
    return type(model)(**parts)


class LinearWrapper(Wrapper):
    """A model f whose further states are linear: z+ = [f(x, Z z + W u); 0] + L z + M u, x the first n entries of z."""

    to = move

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """Z (m, k), W (m, m), L (k, k) and M (k, m), for k states z."""
        raise NotImplementedError

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution at z (*batch, k) and u (*batch, m), without the noise."""
        check_query(self, state, input)
        n, (Z, W, L, M) = self.model.state_dim, tensors_for(self, *self.matrices)
        moved = self.model.predict(state[..., :n], state @ Z.mT + input @ W.mT)
        mean = pad(moved.mean, (0, self.state_dim - n)) + state @ L.mT + input @ M.mT
        return Gaussian(mean, self._padded(moved.covariance))

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the model at K points (K, k), (K, m), by the inner model's ``linearize``."""
        n, K, (Z, W, L, M) = self.model.state_dim, len(states), self.matrices
        inner = linearize(
            self.model,
            np.ascontiguousarray(states[:, :n]),
            states @ Z.T + inputs @ W.T,
            covariance,
        )
        mean = states @ L.T + inputs @ M.T
        A = np.tile(L, (K, 1, 1))
        B = np.tile(M, (K, 1, 1))
        mean[:, :n] += inner.mean
        A[:, :n] += inner.B @ Z
        A[:, :n, :n] += inner.A
        B[:, :n] += inner.B @ W
        more = self.state_dim - n
        V = (
            None
            if inner.covariance is None
            else np.pad(inner.covariance, ((0, 0), (0, more), (0, more)))
        )
        return Linearized(mean, A, B, V)

    def _padded(self, covariance: Tensor) -> Tensor:
        """A covariance (*batch, n, n) with zeros for the further states (*batch, k, k)."""
        more = self.state_dim - covariance.shape[-1]
        return pad(covariance, (0, more, 0, more))


@dataclass(frozen=True)
class DelayedModel(LinearWrapper):
    """A model whose input acts late, by a whole or a fractional number of steps.

    The state holds the inputs that are on their way, z = (x, u_{k-D}, .., u_{k-1}), D the delay rounded up. With a
    delay of D - 1 + w steps, 0 < w <= 1, the input that acts within step k changes from u_{k-D} to u_{k-D+1} after the
    part w of it; the model takes their mean, exact to first order in the time step (Franklin, Powell and Workman, 1998,
    section 4.3, for linear systems):

        x[k+1] = f(x[k], w u_{k-D} + (1 - w) u_{k-D+1}),    the other inputs move on by a place.

    A controller plans with it, or, with fewer states, with the undelayed model from where the inputs on their way will
    have led (``ahead``; the prediction of Smith, 1957, in state space).

    Raises:
        SettingError: The delay is no positive number, or the model does not predict next states.
    """

    model: DynamicsModel  #: without the delay, of n states and m inputs
    delay: float  #: in steps, more than zero; a fraction is allowed

    def __post_init__(self) -> None:
        check_number("delay", self.delay, above=0, unit="[steps]")
        check_next_states(self.model)

    @property
    def pending(self) -> int:
        """Number of inputs on their way, D: the delay rounded up."""
        return math.ceil(self.delay)

    @property
    def _further_names(self) -> list[str]:
        own = signals_of(self.model).input_names
        names = own or [f"u{i + 1}" for i in range(self.input_dim)]
        ages = range(self.pending, 0, -1)
        return [f"{name}[k-{age}]" for age in ages for name in names]

    @property
    def _share(self) -> float:
        """The part of a step w in which the older of two inputs acts."""
        return self.delay - (self.pending - 1)

    @property
    def state_dim(self) -> int:
        """Number of states, n + D m."""
        return self.model.state_dim + self.pending * self.model.input_dim

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations; inputs on their way have none."""
        return self._padded(self.model.noise_covariance)

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """Of the linear part: a mean of the two oldest inputs acts, and the others move on by a place."""
        (n, m), D, w = (self.model.state_dim, self.input_dim), self.pending, self._share
        every = np.eye(
            (D + 1) * m
        )  # of the inputs on their way and the one before them
        acting = w * every[:m] + (1 - w) * every[m : 2 * m]
        moved = np.vstack([np.zeros((n, len(every))), every[m:]])
        Z, L = (
            np.hstack([np.zeros((len(part), n)), part[:, : D * m]])
            for part in (acting, moved)
        )
        return Z, acting[:, D * m :], L, moved[:, D * m :]

    def augmented(self, belief: Gaussian, inputs: Any) -> Gaussian:
        """The belief over z, from one over x (*batch, n) and the inputs u_{k-D} .. u_{k-1} (D, m), the oldest first.

        Raises:
            ShapeError: Another number of inputs.
        """
        belief = belief.in_order(signals_of(self.model).state_names)
        queue = (
            self._queue(belief, inputs)
            .flatten(-2)
            .expand(*belief.mean.shape[:-1], self.pending * self.input_dim)
        )
        return Gaussian(
            torch.cat([belief.mean, queue], dim=-1), self._padded(belief.covariance)
        )

    @cached_property
    def remaining(self) -> DynamicsModel:
        """The model to plan with from where ``ahead`` leads: without a delay, or with the fraction of a step."""
        return self.model if self._share == 1 else DelayedModel(self.model, self._share)

    @property
    def lead(self) -> int:
        """By how many steps ``ahead`` looks ahead; a reference begins as much later."""
        return math.floor(self.delay)

    def ahead(self, propagator: Any, belief: Gaussian, inputs: Any) -> Gaussian:
        """The belief over the state of ``remaining`` after the inputs u_{k-D} .. u_{k-1} (D, m), the oldest first.

        The propagator moves the belief over x, which is that of now, with the process noise or without.

        Raises:
            ShapeError: Another number of inputs.
        """
        queue = self._queue(belief, inputs)
        w = self._share
        for k in range(self.lead):
            belief = propagator(
                self.model,
                belief,
                queue[k] if w == 1 else w * queue[k] + (1 - w) * queue[k + 1],
            )
        return (
            belief
            if w == 1
            else DelayedModel(self.model, w).augmented(belief, queue[-1:])
        )

    def _queue(self, belief: Gaussian, inputs: Any) -> Tensor:
        names = signals_of(self.model).input_names
        real = isinstance(inputs, Tensor) and not inputs.is_complex()
        given = inputs if real else np.array(read_array("inputs", inputs, names))
        queue = torch.as_tensor(
            given, dtype=belief.mean.dtype, device=belief.mean.device
        )
        if queue.shape != (shape := (self.pending, self.input_dim)):
            what = f"a delay of {self.delay:g} steps needs the last inputs {shape}, the oldest first"
            raise ShapeError(f"{what}; got {tuple(queue.shape)}")
        return queue


@dataclass(frozen=True)
class DisturbedModel(LinearWrapper):
    """A model with disturbances, what it does not explain, as further states (x, d) that a filter estimates.

        x[k+1] = f(x[k], u[k]) + E d[k],     d[k+1] = Phi d[k] + w[k],     w[k] ~ N(0, diag(q)^2)

    With Phi = I a disturbance is constant until something says otherwise (a random walk), as for a changed mass; with
    |Phi| < 1 it is an AR(1) process that fades, as wind does. Predicted with the state it leaves no offset from a
    reference (Pannocchia and Rawlings, 2003), and its uncertainty is part of the tube. For a rigid body, columns of E
    of the velocities are a force over the mass, those of the rates a torque.

    Raises:
        ShapeError: E has another number of rows than the model has states.
        SettingError: A standard deviation is negative, a decay not between -1 and 1, or the model does not predict next
            states.
    """

    model: DynamicsModel  #: without them, of n states
    effect: Tensor  #: E, by how much each moves the states within a step (n, q), in the model's type
    std: Sequence[
        float
    ]  #: standard deviations of w, by how much each changes from step to step (q,)
    decay: Sequence[
        float
    ] = ()  #: diagonal of Phi (q,): by default 1, a constant; less in size for an AR(1) process

    def __post_init__(self) -> None:
        n, _ = check_next_states(self.model)
        check_tensors(effect=self.effect)
        if self.effect.dim() != 2 or len(self.effect) != n:
            raise ShapeError(
                f"effect must be ({n}, q), a row a state; got {tuple(self.effect.shape)}"
            )
        check_like("effect", self.effect, self.model)
        q = self.effect.shape[1]
        check_numbers("std", self.std, q, least=0)
        object.__setattr__(self, "decay", list(self.decay) or [1.0] * q)
        check_numbers("decay", self.decay, q)
        if any(abs(phi) > 1 for phi in self.decay):
            raise SettingError("decay", f"must lie between -1 and 1; got {self.decay}")

    @property
    def state_dim(self) -> int:
        """Number of states, n + q."""
        return self.model.state_dim + self.effect.shape[1]

    @property
    def _further_names(self) -> list[str]:
        return [f"disturbance{i + 1}" for i in range(self.effect.shape[1])]

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations, and of the disturbances' changes."""
        return torch.block_diag(self.model.noise_covariance, self._diagonal(self.std))

    @cached_property
    def matrices(self) -> tuple[Array, Array, Array, Array]:
        """Of the linear part: E d is added to f(x, u), and d moves on by Phi."""
        n = self.model.state_dim
        k = self.state_dim
        m = self.input_dim
        L = np.zeros((k, k))
        L[:n, n:] = to_array(self.effect)
        L[n:, n:] = np.diag(self.decay)
        return np.zeros((m, k)), np.eye(m), L, np.zeros((k, m))

    def augmented(self, belief: Gaussian, std: Sequence[float]) -> Gaussian:
        """The belief over (x, d), from one over x (*batch, n), before anything was estimated.

        d is zero, independent, with prior standard deviations ``std`` (q,).
        """
        check_numbers("std", std, q := self.effect.shape[1], least=0)
        belief = belief.in_order(signals_of(self.model).state_names)
        own = self._diagonal([0.0] * self.model.state_dim + list(std))
        return Gaussian(pad(belief.mean, (0, q)), self._padded(belief.covariance) + own)

    def _diagonal(self, std: Sequence[float]) -> Tensor:
        return torch.diag(
            torch.as_tensor(list(std), dtype=self.dtype, device=self.device).square()
        )


@dataclass(frozen=True)
class NoisyModel(Wrapper):
    """A model whose predictions contain its noise, a GP on its logarithm (Goldberg, Williams and Bishop, 1998).

        x[k+1] = f(x[k], u[k]) + e[k],   e_i ~ N(0, sigma_i^2(x, u)),   log sigma_i^2 = g_i ~ N(m_i, v_i) a posteriori

    The variance that is used is the mean of sigma_i^2 given the data, exp(m_i + v_i / 2). Everything that predicts
    counts the noise once: the covariances of ``predict`` and ``linearize`` contain all of it and ``noise_covariance``
    is zero, so that a propagator gives the same with ``process_noise`` and without. Linearisations hold the covariance
    at their points. ``MomentMatching``, which has no closed form for it, raises ``UnsupportedModel``.

    Raises:
        SettingError: ``outputs`` are no distinct outputs of the model, which predicts next states, or type or device
            of the GPs are others.
        ShapeError: The GPs have other states, inputs or outputs.
    """

    model: DynamicsModel  #: f, of n states and m inputs
    log_noise: GPPosterior  #: g, over (x, u), with ``predicts="value"``: an output each
    outputs: Sequence[
        int
    ]  #: the states whose noise g describes, in its order; the others keep that of the model

    to = move

    def __post_init__(self) -> None:
        (n, m), g, outputs = check_next_states(self.model), self.log_noise, self.outputs
        if getattr(g, "predicts", None) != "value":
            got = repr(g.predicts) if isinstance(g, GPPosterior) else type(g).__name__
            raise SettingError(
                "log_noise",
                f"must be a GPPosterior, and must predict 'value'; got {got}",
            )
        check_like("log_noise", g, self)
        if (
            not hasattr(outputs, "__len__")
            or not outputs
            or not all(type(i) is int for i in outputs)
        ):
            raise SettingError(
                "outputs", f"must be a list of whole numbers; got {outputs!r}"
            )
        if len(set(outputs)) < len(outputs) or not set(outputs) <= set(range(n)):
            raise SettingError(
                "outputs", f"must be distinct, of 0 .. {n - 1}; got {list(outputs)}"
            )
        if (found := (g.state_dim, g.input_dim, g.output_dim)) != (n, m, len(outputs)):
            raise ShapeError(
                f"log_noise must have {n} states, {m} inputs and {len(outputs)} outputs; got {found}"
            )

    @property
    def noise_covariance(self) -> Tensor:
        """Zero (n, n): ``predict`` contains the noise."""
        return torch.zeros_like(self.model.noise_covariance)

    def noise(self, state: Tensor, input: Tensor) -> Tensor:
        """Covariance of the noise at x (*batch, n) and u (*batch, m), (*batch, n, n)."""
        g = self.log_noise.predict(state, input)
        return self._constant + torch.diag_embed(
            (g.mean + g.variance / 2).exp() @ self._places
        )

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """The next state's distribution at x (*batch, n) and u (*batch, m), with the noise."""
        belief = self.model.predict(state, input)
        return Gaussian(belief.mean, belief.covariance + self.noise(state, input))

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises f at K points (K, n), (K, m); with the noise in the covariance."""
        found = linearize(self.model, states, inputs, covariance)
        if found.covariance is None:
            return found
        g = self.log_noise.linearize(states, inputs)
        at = list(self.outputs)
        V = found.covariance + to_array(self._constant)
        V[:, at, at] += np.exp(
            g.mean + np.einsum("kii->ki", cast(Array, g.covariance)) / 2
        )
        return found._replace(covariance=V)

    @cached_property
    def _places(self) -> Tensor:
        """Rows of the identity (k, n)."""
        return torch.eye(self.state_dim, dtype=self.dtype, device=self.device)[
            list(self.outputs)
        ]

    @cached_property
    def _constant(self) -> Tensor:
        """The model's noise covariance without those outputs (n, n)."""
        kept = 1 - self._places.sum(0)
        return kept[:, None] * self.model.noise_covariance * kept


def check_like(name: str, part: Any, model: Any) -> None:
    """Raises ``SettingError`` unless a part of a model has its type and is on its device."""
    if (part.dtype, part.device) != (model.dtype, model.device):
        got = f"{part.dtype} on {part.device}"
        raise SettingError(
            name, f"must be {model.dtype} on {model.device} like the model; got {got}"
        )
