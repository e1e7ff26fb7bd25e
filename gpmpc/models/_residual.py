"""Residual models: a known nominal model and GPs that learn its error.

    x[k+1] = f0(x[k], u[k]) + B(x[k]) d(phi(x[k], u[k]))

f0 is the nominal model, d a GP, B its effect on the states, and phi the features of the
GP: selected columns, angles as sine and cosine (Hewing, Kabzan and Zeilinger, 2020, eq.
(3), with constant B and columns). With ``Affine.identity`` as nominal model d is the
difference of two states, and the model a full one with features. An angle counts turns
in predictions. In data a sensor may show it within one turn, since whole turns between
x[k+1] and f0 are no error of f0.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, cast

import torch
from torch import Tensor

from gpmpc._angles import full_turns
from gpmpc._dynamics import (
    Array,
    Linearized,
    TensorModel,
    check_query,
    tensors_for,
    to_array,
)
from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian, check_covariance, check_tensors
from gpmpc.gp import (
    GPPosterior,
    SlidingWindow,
    Trainer,
    Training,
    Transitions,
    append_points,
)
from gpmpc.gp._data_checks import warn_of_transitions
from gpmpc.gp._posterior import AffineForm
from gpmpc.gp._transitions import check_rows_on_host, check_transitions
from gpmpc.gp._wrapped import warn_of_turns
from gpmpc.models._casadi_function import CasadiFunction
from gpmpc.models._features import Features
from gpmpc.models._nominal import Affine, linearize_function
from gpmpc.models._residual_data import (
    Effect,
    Nominal,
    check_derivatives,
    check_no_lost_derivative,
    counts_turns,
    describe_columns,
    effect_matrix,
    nominal_next_state,
    residual_data,
    warn_of_remainder,
)
from gpmpc.models._tensors import check_like, move
from gpmpc.signals import UNKNOWN, Signals, check_signals


@dataclass(frozen=True, eq=False)
class ResidualModel(TensorModel):
    """A nominal model and a GP on its residual.

    Raises:
        ShapeError: The parts do not belong together.
        SettingError: The residual predicts something else, an index is out of range,
            the noise is missing or no covariance, or torch follows a part of a function
            alone.

    >>> from gpmpc.datasets import RandomData
    >>> from gpmpc.gp import Trainer
    >>> from gpmpc.models import Affine
    >>> from gpmpc.systems import pendulum
    >>> data = RandomData(samples=30).transitions(pendulum())
    >>> model = ResidualModel.train(
    ...     Affine.identity(2, 1), data, angles=[0], trainer=Trainer(restarts=0)
    ... )
    >>> model.features.dim, model.residual.output_dim
    (3, 2)

    See Also:
        ``train``, which takes nominal model, angles and rates from a system.
    """

    #: f0, from x (*batch, n) and u (*batch, m) to (*batch, n), in torch; an ``Affine``
    #: one allows exact moment matching
    nominal: Nominal
    residual: GPPosterior  #: d, with ``predicts="value"``
    #: effect of d (n, k), or a function of the state (*batch, n) that gives it
    #: (*batch, n, k), in torch or by ``CasadiFunction``; (*batch, n) will do for k = 1
    B: Effect
    states: Sequence[int]  #: the states that d depends on, in its order
    inputs: Sequence[int]  #: the inputs that d depends on, in its order
    input_dim: int  #: m, all of them
    #: those of ``states`` that are angles [rad]: d sees them as (sine, cosine), at
    #: their place, and their differences are taken within half a turn
    angles: Sequence[int] = ()
    #: covariance of what scatters the data around the prediction (n, n), which
    #: propagators add to every step; by default that of d's, B diag(sn2) B', which
    #: needs a constant B
    noise: Tensor | None = None
    signals: Signals = UNKNOWN  #: names and time step of the data, where they are known
    #: all noise of the observations (n, n), where ``noise`` is the process' part alone
    observation_noise: Tensor | None = None

    _part = property(lambda self: self.residual)
    to = move

    def __post_init__(self) -> None:
        self._check_kinds()
        self._check_sizes()
        if isinstance(self.nominal, CasadiFunction):
            counting = self.nominal.counting_turns(tuple(self.angles))
            object.__setattr__(self, "nominal", counting)
        check_signals(self.signals)
        self.signals.check_sizes(self.state_dim, self.input_dim)
        self._check_tensors()
        check_no_lost_derivative(self.nominal, self.B, self, self.angles)

    def _check_kinds(self) -> None:
        """Raises ``SettingError`` unless the parts are of the right kind."""
        predicts = getattr(self.residual, "predicts", None)
        if predicts != "value":
            got = self.residual if predicts is None else predicts
            rule = "must be a GP with predicts='value'"
            raise SettingError("residual", f"{rule}; got {got!r}")
        if not callable(self.nominal):
            rule = "must be a function of states and inputs, such as Affine"
            raise SettingError("nominal", f"{rule}; got {self.nominal!r}")
        if callable(self.B) and self.noise is None:
            rule = "must be given (n, n) where B is a function of the state"
            raise SettingError("noise", f"{rule}; got None")

    def _check_sizes(self) -> None:
        """Raises unless the residual and functions in CasADi have the right sizes."""
        gp = self.residual
        n = self.state_dim
        m = self.input_dim
        selected = (self.features.dim, len(self.inputs))
        if selected != (gp.state_dim, gp.input_dim):
            rule = f"the residual has {gp.state_dim} states and {gp.input_dim} inputs"
            raise ShapeError(f"{rule}; got {selected[0]} and {selected[1]} selected")
        if isinstance(self.nominal, CasadiFunction):
            self.nominal.check_sizes((n, m), (n, 1))
        if isinstance(self.B, CasadiFunction):
            self.B.check_sizes((n,), (n, gp.output_dim))

    def _check_tensors(self) -> None:
        """Raises unless all tensors have their shape, and the residual's type."""
        n = self.state_dim
        m = self.input_dim
        if not callable(self.B):
            self._check_tensor("B", self.B, (n, self.residual.output_dim))
        for key in ("noise", "observation_noise"):
            covariance = getattr(self, key)
            if covariance is not None:
                self._check_tensor(key, covariance, (n, n))
                check_covariance(key, covariance)
        if isinstance(self.nominal, Affine):
            self._check_tensor("nominal.A", self.nominal.A, (n, n))
            self._check_tensor("nominal.B", self.nominal.B, (n, m))
            self._check_tensor("nominal.c", self.nominal.c, (n,))

    def _check_tensor(self, name: str, value: Any, shape: tuple[int, ...]) -> None:
        """Raises unless a part is a tensor of a shape, of the residual's type."""
        check_tensors(**{name: value})
        got = tuple(value.shape)
        if got != shape:
            raise ShapeError(f"{name} must have shape {shape}; got {got}")
        check_like(name, value, self.residual)

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
        """Trains d on the part of x[k+1] - f0(x[k], u[k]) that B reaches.

        That part is found by least squares.

        Args:
            nominal: f0; ``Affine.identity(n, m)`` where nothing is known.
            transitions: The data.
            B: Effect of d; by default it acts on every state.
            states: The states that d depends on; by default all.
            inputs: The inputs that d depends on; by default all.
            trainer: A ``Trainer`` or ``SparseTrainer``, whose ``predicts`` is not read.
            seed: Of the training's random numbers.
            angles: Those of ``states`` that are angles [rad].

        Raises:
            ShapeError: ``nominal`` or B do not fit the transitions.
            SettingError: An index is out of range, the columns of B depend on each
                other, or there is no trainer.
            TrainingError: An output could not be trained.
        """
        training = train_residual(
            trainer=Trainer() if trainer is None else trainer,
            transitions=transitions,
            angles=angles,
            nominal=nominal,
            seed=seed,
            B=B,
            states=states,
            inputs=inputs,
        )
        return cast("ResidualModel", training.posterior)

    def __len__(self) -> int:
        return len(self.residual)

    def append(
        self, transitions: Transitions, window: SlidingWindow | None = None
    ) -> "ResidualModel":
        """Appends transitions to the data of the residual GP.

        Args:
            transitions: Of the same states and inputs.
            window: Holds the data to a number of points; by default all stay.

        Raises:
            ShapeError: The transitions have other dimensions.
            UnsupportedModel: The residual is no ``GPPosterior``.
        """
        check_transitions(transitions, self)
        if not isinstance(self.residual, GPPosterior):
            rule = "points can be appended to a residual that is a GPPosterior"
            raise UnsupportedModel(f"{rule}; got {type(self.residual).__name__}")
        data = residual_data(
            nominal=self.nominal,
            B=self.B,
            features=self.features,
            transitions=transitions,
            like=self.residual.weights,
        )
        append = append_points if window is None else window.append
        residual = append(self.residual, data.features, data.targets)
        return self._with_points(residual)

    def _with_points(self, residual: GPPosterior) -> "ResidualModel":
        """Returns the model with other points of d; nothing else is to be checked."""
        model = copy(self)
        object.__setattr__(model, "residual", residual)
        return model

    @cached_property
    def features(self) -> Features:
        """Features of the state and the input, of which d is a function."""
        return Features(
            states=self.states,
            inputs=self.inputs,
            angles=self.angles,
            state_dim=self.state_dim,
            input_dim=self.input_dim,
        )

    @property
    def state_dim(self) -> int:
        """Number of states, n: rows of B, or of the noise where B is a function.

        Zero where neither is a tensor: ``_check_tensors`` says what is wrong.
        """
        square = self.noise if callable(self.B) else self.B
        if isinstance(square, Tensor) and square.dim():
            return len(square)
        return 0

    @property
    def output_dim(self) -> int:
        """Number of outputs, n: the next state."""
        return self.state_dim

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance (n, n) of what scatters the data around the prediction.

        Propagators add it to every step as process noise.
        """
        if self.noise is None and not callable(self.B):
            return self.B @ self.residual.noise_covariance @ self.B.mT
        return torch.as_tensor(self.noise)

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """Predicts the next state: mean (*batch, n), covariance (*batch, n, n).

        Args:
            state: (*batch, n).
            input: (*batch, m); may be left out where there are no inputs.
        """
        if input is None:
            input = state[..., :0]
        check_query(self, state, input)
        features, selected_inputs = self.features(state, input)
        d = self.residual.predict(features, selected_inputs)
        effect = effect_matrix(self.B, state)
        nominal = nominal_next_state(self.nominal, state, input, self.angles)
        mean = nominal + (effect @ d.mean[..., None])[..., 0]
        return Gaussian(mean, effect @ d.covariance @ effect.mT)

    def predict_mean(self, states: Array, inputs: Array) -> Array:
        """Computes the mean of the next states (K, n) without derivatives.

        Args:
            states: (K, n).
            inputs: (K, m).
        """
        x, u = tensors_for(self, states, inputs)
        with torch.no_grad():
            nominal = to_array(nominal_next_state(self.nominal, x, u, self.angles))
            effect = to_array(effect_matrix(self.B, x))
        features, selected_inputs, _ = self.features.linearize(states, inputs)
        d = self.residual.linearize(features, selected_inputs, covariance=False)
        return nominal + (effect @ d.mean[..., None])[..., 0]

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the model at K points, by the chain rule around the GP.

        A nominal model or an effect with a method ``linearize``, such as ``Affine`` or
        ``CasadiFunction``, is linearised by it; any other by one batched call of torch
        autograd.

        Args:
            states: (K, n).
            inputs: (K, m).
            covariance: Whether the covariances at the points are computed.
        """
        f0, by_state, by_input = self._linearize_nominal(states, inputs)
        features, selected_inputs, slopes = self.features.linearize(states, inputs)
        d = self.residual.linearize(features, selected_inputs, covariance)
        d_by_state, d_by_input = self.features.chain(d.A, d.B, slopes)
        if callable(self.B):
            effect, slopes_of_effect = self._linearize_effect(states)
            by_state = by_state + (slopes_of_effect * d.mean[:, None, :, None]).sum(2)
        else:
            effect = self._constant_effect
        V = None
        if d.covariance is not None:
            V = effect @ d.covariance @ effect.swapaxes(-1, -2)
        return Linearized(
            mean=f0 + (effect @ d.mean[..., None])[..., 0],
            A=by_state + effect @ d_by_state,
            B=by_input + effect @ d_by_input,
            covariance=V,
        )

    def _linearize_nominal(self, states: Array, inputs: Array) -> tuple[Array, ...]:
        """Computes f0 (K, n), and its derivatives by state and input.

        Its angles count turns, as those of the states do.
        """
        nominal = self.nominal
        if not hasattr(nominal, "linearize"):
            nominal = partial(nominal_next_state, nominal, angles=self.angles)
            return linearize_function(nominal, self, states, inputs)
        f0, A, G = linearize_function(nominal, self, states, inputs)
        if not counts_turns(nominal):
            f0 = f0 - full_turns(f0 - states, self.angles)
        return f0, A, G

    def _linearize_effect(self, states: Array) -> tuple[Array, Array]:
        """Computes B (K, n, k) and its derivatives by the state (K, n, k, n)."""
        effect, slopes = linearize_function(cast(Any, self.B), self, states)
        if effect.ndim == 2:  # one output
            return effect[..., None], slopes[:, :, None]
        return effect, slopes

    @cached_property
    def _constant_effect(self) -> Array:
        """B (n, k) as an array."""
        return to_array(torch.as_tensor(self.B))

    @property
    def affine_form(self) -> AffineForm | None:
        """The parts of the model for compiled code and exact moments.

        None unless B is constant, the nominal model ``Affine`` or a tape, and the
        residual a ``GPPosterior``.
        """
        if callable(self.B) or not isinstance(self.residual, GPPosterior):
            return None
        form = AffineForm(
            self.residual,
            B=self.B,
            states=list(self.states),
            inputs=list(self.inputs),
            angles=tuple(self.angles),
        )
        nominal = self.nominal
        if isinstance(nominal, Affine):
            return form._replace(A=nominal.A, G=nominal.B, c=nominal.c)
        tape = getattr(nominal, "tape", None)
        if tape is None:
            return None
        return form._replace(tape=tape)


def train_residual(
    trainer: Any,
    transitions: Transitions,
    angles: Sequence[int] = (),
    nominal: Nominal | None = None,
    seed: int = 0,
    B: Effect | None = None,
    states: Sequence[int] | None = None,
    inputs: Sequence[int] | None = None,
    further_noise: Tensor | None = None,
) -> Training:
    """Trains a residual model, and returns the whole training: it is its ``posterior``.

    Arguments and errors are those of ``ResidualModel.train``. Without a nominal model
    the difference of two states is learned. ``further_noise`` holds variances (n,) of
    what no output learns, which are added to the noise of those that do.
    """
    check_rows_on_host(transitions)
    if not hasattr(trainer, "fit"):
        rule = "must be a Trainer or SparseTrainer"
        raise SettingError("trainer", f"{rule}; got {trainer!r}")
    n = transitions.state_dim
    m = transitions.input_dim
    if nominal is None:
        nominal = Affine.identity(n, m)
    if B is None:
        B = torch.eye(n, dtype=torch.float64)
    _check_types(nominal, B, transitions)
    features = Features(
        states=list(range(n) if states is None else states),
        inputs=list(range(m) if inputs is None else inputs),
        angles=list(angles),
        state_dim=n,
        input_dim=m,
    )
    check_derivatives(nominal, B, transitions, features.angles)
    data = residual_data(
        nominal=nominal,
        B=B,
        features=features,
        transitions=transitions,
        like=transitions.states,
    )
    warn_of_transitions(transitions)
    warn_of_turns(transitions, angles)
    training = trainer.fit(
        features=data.features,
        targets=data.targets,
        input_dim=len(features.inputs),
        predicts="value",
        seed=seed,
        columns=describe_columns(transitions, B, features),
    )
    model = ResidualModel(
        nominal=nominal,
        residual=training.posterior,
        B=B,
        states=features.states,
        inputs=features.inputs,
        input_dim=m,
        angles=features.angles,
        noise=_mean_noise(training.posterior, B, transitions) if callable(B) else None,
        signals=transitions.signals,
    )
    if further_noise is not None and bool(further_noise.any()):
        noise = model.noise_covariance + torch.diag(further_noise)
        model = replace(model, noise=noise)
    warn_of_remainder(
        data.remainder, model.noise_covariance, transitions, features.angles
    )
    return replace(training, posterior=cast(Any, model))


def _check_types(nominal: Nominal, B: Effect, transitions: Transitions) -> None:
    """Raises ``SettingError`` of tensors of another type or device than the data's."""
    parts = {}
    if isinstance(B, Tensor):
        parts["B"] = B
    if isinstance(nominal, Affine):
        parts |= {
            "nominal.A": nominal.A,
            "nominal.B": nominal.B,
            "nominal.c": nominal.c,
        }
    for name, part in parts.items():
        check_like(name, part, transitions.states, owner="the transitions")


def _mean_noise(residual: GPPosterior, B: Effect, transitions: Transitions) -> Tensor:
    """Averages the covariance of the noise (n, n) over the observed states."""
    effect = effect_matrix(B, transitions.states)
    return (effect @ residual.noise_covariance @ effect.mT).mean(0)
