"""Residual models: a known nominal model and GPs that learn its error.

    x[k+1] = f0(x[k], u[k]) + B(x[k]) d(phi(x[k], u[k]))

f0 is the nominal model, d a GP, B its effect on the states, and phi what the GP sees of the state and the input:
selected columns, angles as sine and cosine (Hewing, Kabzan and Zeilinger, 2020, eq. (3), with constant B and columns).
With ``Affine.identity`` as nominal model d is the difference of two states, and the model a full one with features.
An angle counts turns in what is predicted; in what is learned from a sensor may show it within one turn, since whole
turns between x[k+1] and f0 are no error of f0.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import torch
from torch import Tensor

from gpmpc._angles import state_difference, whole_turns
from gpmpc._dynamics import (
    Array,
    Linearized,
    TensorModel,
    check_query,
    tensors_for,
    to_array,
)
from gpmpc._functions import call
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.gp import (
    GPPosterior,
    SlidingWindow,
    Trainer,
    Training,
    Transitions,
    append_points,
)
from gpmpc.gp._data_checks import (
    RESOLUTION,
    Columns,
    signal_names,
    warn_of_transitions,
)
from gpmpc.gp._posterior import AffineForm
from gpmpc.gp._transitions import check_transitions
from gpmpc.gp._wrapped import warn_of_turns
from gpmpc.models._features import Features
from gpmpc.models._nominal import Affine, CasadiFunction, linearize_function
from gpmpc.models._wrapper import check_like, move
from gpmpc.signals import UNKNOWN, Signals, check_signals

Nominal = Callable[[Tensor, Tensor], Tensor]
Effect = Tensor | Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class ResidualModel(TensorModel):
    """A nominal model and a GP on its residual.

    Raises:
        ShapeError: The parts do not belong together.
        SettingError: The residual predicts something else, an index is out of range, or the noise is missing.
    """

    #: f0, from x (*batch, n) and u (*batch, m) to (*batch, n), in torch; an ``Affine`` one allows exact moment matching
    nominal: Nominal
    residual: GPPosterior  #: d, with ``predicts="value"``
    #: where it acts (n, k), or a function of the state (*batch, n) that gives it (*batch, n, k), in torch or by
    #: ``CasadiFunction``; (*batch, n) will do where k = 1
    B: Effect
    states: Sequence[int]  #: the states that d depends on, in its order
    inputs: Sequence[int]  #: the inputs that d depends on, in its order
    input_dim: int  #: m, all of them
    #: those of ``states`` that are angles [rad]: d sees them as (sine, cosine), at their place, and their differences
    #: are taken within half a turn
    angles: Sequence[int] = ()
    #: covariance of the observations (n, n); by default that of d's, B diag(sn2) B', which needs a constant B
    noise: Tensor | None = None
    signals: Signals = UNKNOWN  #: names and time step of the data, where they are known

    _part = property(lambda self: self.residual)
    to = move

    def __post_init__(self) -> None:
        gp = self.residual
        nominal = self.nominal
        n = self.state_dim
        m = self.input_dim
        if getattr(gp, "predicts", None) != "value":
            raise SettingError(
                "residual",
                f"must be a GP with predicts='value'; got {getattr(gp, 'predicts', gp)!r}",
            )
        if not callable(nominal):
            raise SettingError(
                "nominal",
                f"must be a function of states and inputs, such as Affine; got {nominal!r}",
            )
        if callable(self.B) and self.noise is None:
            raise SettingError(
                "noise",
                "must be given (n, n) where B is a function of the state; got None",
            )
        if (self.features.dim, len(self.inputs)) != (gp.state_dim, gp.input_dim):
            got = f"{self.features.dim} and {len(self.inputs)} selected"
            raise ShapeError(
                f"the residual has {gp.state_dim} states and {gp.input_dim} inputs; got {got}"
            )
        if isinstance(nominal, CasadiFunction):
            nominal.check_sizes((n, m), (n, 1))
        if isinstance(self.B, CasadiFunction):
            self.B.check_sizes((n,), (n, gp.output_dim))
        check_signals(self.signals)
        self.signals.check_sizes(n, m)
        parts: dict[str, tuple[Any, tuple[int, ...]]] = {}
        if not callable(self.B):
            parts["B"] = self.B, (n, gp.output_dim)
        if self.noise is not None:
            parts["noise"] = self.noise, (n, n)
        if isinstance(nominal, Affine):
            shapes = {"A": (n, n), "B": (n, m), "c": (n,)}
            parts |= {
                f"nominal.{name}": (getattr(nominal, name), shape)
                for name, shape in shapes.items()
            }
        for name, (value, shape) in parts.items():
            check_tensors(**{name: value})
            if tuple(value.shape) != shape:
                raise ShapeError(
                    f"{name} must have shape {shape}; got {tuple(value.shape)}"
                )
            check_like(name, value, gp)

    @classmethod
    def train(
        cls,
        nominal: Nominal,
        transitions: Transitions,
        B: Effect | None = None,
        states: Sequence[int] | None = None,
        inputs: Sequence[int] | None = None,
        trainer: Any = None,
        seed: int = 0,
        angles: Sequence[int] = (),
    ) -> "ResidualModel":
        """Learns d from transitions: the part of x[k+1] - f0(x[k], u[k]) that B reaches (least squares).

        Where nothing is known, ``nominal`` is ``Affine.identity(n, m)``. By default B acts on every state, d depends on
        all states and inputs. The ``trainer`` is a ``Trainer`` or ``SparseTrainer``, whose ``predicts`` is not read.

        Raises:
            ShapeError: ``nominal`` or B do not fit the transitions.
            SettingError: An index is out of range, the columns of B depend on each other, or there is no trainer.
            TrainingError: An output could not be trained.
        """
        trainer = Trainer() if trainer is None else trainer
        return cast(
            Any,
            train_residual(
                trainer, transitions, angles, nominal, seed, B, states, inputs
            ).posterior,
        )

    def __len__(self) -> int:
        return len(self.residual)

    def append(
        self, transitions: Transitions, window: SlidingWindow | None = None
    ) -> "ResidualModel":
        """Appends transitions to the data of the residual GP, held to a number of points where a window is given.

        Raises:
            ShapeError: The transitions have other dimensions.
        """
        check_transitions(transitions, self)
        points = _residuals(
            self.nominal, self.B, self.features, transitions, like=self.residual.weights
        )
        add = append_points if window is None else window.append
        return replace(self, residual=add(self.residual, *points))

    @cached_property
    def features(self) -> Features:
        """What d sees of the state and the input."""
        return Features(
            self.states, self.inputs, self.angles, self.state_dim, self.input_dim
        )

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        known = self.noise if callable(self.B) else self.B
        return len(known) if isinstance(known, Tensor) and known.dim() else 0

    @property
    def output_dim(self) -> int:
        """Number of outputs, n: the next state."""
        return self.state_dim

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations (n, n)."""
        if self.noise is None and not callable(self.B):
            return self.B @ self.residual.noise_covariance @ self.B.mT
        return torch.as_tensor(self.noise)

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """The next state's distribution at a certain state and input: mean (*batch, n), covariance (*batch, n, n)."""
        input = state[..., :0] if input is None else input
        check_query(self, state, input)
        d = self.residual.predict(*self.features(state, input))
        B = _effect(self.B, state)
        known = _nominal(self.nominal, state, input, self.angles)
        mean = known + (B @ d.mean[..., None])[..., 0]
        return Gaussian(mean, B @ d.covariance @ B.mT)

    def predict_mean(self, states: Array, inputs: Array) -> Array:
        """The mean of the next states (K, n) at K points (K, n), (K, m), without derivatives."""
        x, u = tensors_for(self, states, inputs)
        with torch.no_grad():
            known = to_array(_nominal(self.nominal, x, u, self.angles))
            B = to_array(_effect(self.B, x))
        features, selected, _ = self.features.linearize(states, inputs)
        return (
            known
            + (B @ self.residual.linearize(features, selected, False).mean[..., None])[
                ..., 0
            ]
        )

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the model at K points (K, n), (K, m), by the chain rule around the GP's own ``linearize``.

        A nominal model or an effect with a method ``linearize``, such as ``Affine`` or ``CasadiFunction``, is
        linearised by it; any other by one batched call of torch autograd.
        """
        nominal = (
            self.nominal
            if hasattr(self.nominal, "linearize")
            else partial(_nominal, self.nominal, angles=self.angles)
        )
        mean, A, G = linearize_function(nominal, self, states, inputs)
        features, selected, slope = self.features.linearize(states, inputs)
        d = self.residual.linearize(features, selected, covariance)
        by_state, by_input = self.features.chain(d.A, d.B, slope)
        if callable(self.B):
            B, dB = linearize_function(self.B, self, states)
            if B.ndim == 2:  # one output
                B = B[..., None]
                dB = dB[:, :, None]
            A = A + (dB * d.mean[:, None, :, None]).sum(2)
        else:
            B = self._constant_effect
        V = None if d.covariance is None else B @ d.covariance @ B.swapaxes(-1, -2)
        mean = mean + (B @ d.mean[..., None])[..., 0]
        return Linearized(mean, A + B @ by_state, G + B @ by_input, V)

    @cached_property
    def _constant_effect(self) -> Array:
        return to_array(torch.as_tensor(self.B))

    @property
    def affine_form(self) -> AffineForm | None:
        """The parts of the model; None unless B is constant, and the nominal model ``Affine`` or a tape."""
        nominal = self.nominal
        tape = getattr(self.nominal, "tape", None)
        if callable(self.B) or not (isinstance(nominal, Affine) or tape is not None):
            return None
        A, G, c = (
            (nominal.A, nominal.B, nominal.c)
            if isinstance(nominal, Affine)
            else (None, None, None)
        )
        states = list(self.states)
        inputs = list(self.inputs)
        angles = tuple(self.angles)
        return AffineForm(self.residual, A, G, c, self.B, states, inputs, angles, tape)


def _nominal(
    nominal: Nominal, state: Tensor, input: Tensor, angles: Sequence[int]
) -> Tensor:
    """f0 (*batch, n), held against the rule that a wrong number of states would otherwise be broadcast.

    A function that wraps angles gives them within half a turn of the state's: plans count turns.
    """
    value = call("nominal", nominal, state, input)
    if not isinstance(value, Tensor):
        raise SettingError(
            "nominal", f"must give a torch tensor; got {type(value).__name__}"
        )
    if value.shape != state.shape:
        what = (
            f"nominal must give next states of the states' shape {tuple(state.shape)}"
        )
        raise ShapeError(f"{what}; got {tuple(value.shape)}")
    if len(angles) and not hasattr(nominal, "linearize"):
        places = list(angles)
        turns = torch.zeros_like(value)
        turns[..., places] = whole_turns((value - state)[..., places])
        return value - turns
    return value


def _effect(B: Effect, state: Tensor) -> Tensor:
    """B (n, k), or of a function (*batch, n, k), at states (*batch, n), checked."""
    rows = state.shape if callable(B) else state.shape[-1:]
    value: Any = call("B", B, state) if callable(B) else B
    check_tensors(B=value)
    if callable(B) and value.shape == rows:  # one output
        value = value[..., None]
    if value.shape[:-1] != rows:
        raise ShapeError(
            f"B must be ({', '.join(map(str, rows))}, k), a row a state; got {tuple(value.shape)}"
        )
    return value


def train_residual(
    trainer: Any,
    transitions: Transitions,
    angles: Sequence[int] = (),
    nominal: Nominal | None = None,
    seed: int = 0,
    B: Effect | None = None,
    states: Sequence[int] | None = None,
    inputs: Sequence[int] | None = None,
) -> Training:
    """Trains a residual model, and returns the whole training; arguments and errors are those of its ``train``.

    Without a nominal model the difference of two states is learned.
    """
    check_transitions(transitions)
    if not hasattr(trainer, "fit"):
        raise SettingError(
            "trainer", f"must be a Trainer or SparseTrainer; got {trainer!r}"
        )
    n = transitions.state_dim
    m = transitions.input_dim
    nominal = Affine.identity(n, m) if nominal is None else nominal
    B = torch.eye(n, dtype=torch.float64) if B is None else B
    states, inputs = (
        list(range(k) if some is None else some)
        for some, k in ((states, n), (inputs, m))
    )
    _check_derivatives(nominal, B, transitions)
    seen = Features(states, inputs, list(angles), n, m)
    features, targets = _residuals(nominal, B, seen, transitions)
    warn_of_transitions(transitions)
    warn_of_turns(transitions, angles)
    training = trainer.fit(
        features,
        targets,
        len(inputs),
        "value",
        seed,
        columns=_columns(transitions, B, seen),
    )
    noise = None
    if callable(
        B
    ):  # one covariance for all states: its mean over those that were observed
        effect = _effect(B, transitions.states)
        noise = (effect @ training.posterior.noise_covariance @ effect.mT).mean(0)
    model = ResidualModel(
        nominal,
        training.posterior,
        B,
        states,
        inputs,
        m,
        list(angles),
        noise,
        transitions.signals,
    )
    return replace(training, posterior=cast(Any, model))


def _columns(transitions: Transitions, B: Effect, seen: Features) -> Columns:
    """What features and targets of a residual are called, and how large they may be.

    A residual is what two states differ by, as seen through the pseudo-inverse of B,
    and round-off is that of the states. What it is where no data were seen may be as
    much as a step changes: there the nominal model is right, or it is not.
    """
    states, inputs = signal_names(transitions)
    features: list[str] = []
    for i in seen.states:
        if i in seen.angles:
            features += [f"sine of {states[i]}", f"cosine of {states[i]}"]
        else:
            features.append(states[i])
    features += [inputs[j] for j in seen.inputs]
    reach = torch.linalg.pinv(_effect(B, transitions.states))
    if not callable(B) and torch.equal(reach, torch.eye(len(reach)).to(reach)):
        outputs = [f"what is missed of {name}" for name in states]
    else:
        outputs = [f"output {a + 1} of the residual" for a in range(reach.shape[-2])]
    before = transitions.states
    after = transitions.next_states
    larger = torch.maximum(before.abs(), after.abs())
    magnitudes = (reach.abs() @ larger[..., None]).amax(dim=0)[:, 0]
    steps = (reach @ (after - before)[..., None])[..., 0]
    deviations = steps.std(dim=0, correction=0)
    deviations = torch.where(deviations > RESOLUTION, deviations, 1.0)
    return Columns(
        features=features,
        outputs=outputs,
        magnitudes=magnitudes.detach().numpy(force=True),
        deviations=deviations.detach().numpy(force=True),
    )


def _check_derivatives(nominal: Nominal, B: Effect, transitions: Transitions) -> None:
    """Raises ``SettingError`` where torch cannot follow a function.

    Training asks for no derivative: only a controller would come upon it. What is wrong
    with a function's shape is said at all rows.
    """
    x = to_array(transitions.states[:2])
    u = to_array(transitions.inputs[:2])
    with suppress(ShapeError):
        if not hasattr(nominal, "linearize"):
            linearize_function(
                partial(_nominal, nominal, angles=()), transitions.states, x, u
            )
        if callable(B) and not hasattr(B, "linearize"):
            linearize_function(partial(_effect, B), transitions.states, x)


def _residuals(
    nominal: Nominal,
    B: Effect,
    features: Features,
    transitions: Transitions,
    like: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Features (N, d) and targets (N, k) of the residual GP: the least-squares part of the error of f0."""
    like = (
        B
        if like is None and isinstance(B, Tensor)
        else transitions.states
        if like is None
        else like
    )
    to: dict[str, Any] = {"device": like.device, "dtype": like.dtype}
    x, u, after = (
        t.to(**to)
        for t in (transitions.states, transitions.inputs, transitions.next_states)
    )
    effect = _effect(B, x)
    if int(torch.linalg.matrix_rank(effect).min()) < effect.shape[-1]:
        raise SettingError(
            "B",
            "must have linearly independent columns: equal effects cannot be distinguished",
        )
    known = _nominal(nominal, x, u, features.angles)
    missed = state_difference(after, known, features.angles)
    Q, R = torch.linalg.qr(
        effect
    )  # torch.linalg.lstsq gives other last digits from call to call
    if callable(B):
        targets = torch.linalg.solve_triangular(
            R, Q.mT @ missed[..., None], upper=True
        )[..., 0]
    else:
        targets = torch.linalg.solve_triangular(R, Q.mT @ missed.mT, upper=True).mT
    return torch.cat(features(x, u), dim=1), targets
