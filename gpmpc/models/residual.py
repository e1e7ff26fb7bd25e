"""Residual models: a known nominal model and GPs that learn its error.

    x[k+1] = f0(x[k], u[k]) + B d(x_s[k], u_s[k])

f0 is the nominal model, d a GP over a selection of the states and inputs, and B its effect on the states (Hewing,
Kabzan and Zeilinger, 2020, eq. (3)).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc.dynamics import (
    Array,
    Linearized,
    batched_jacobian,
    check_destination,
    check_query,
    tensors_for,
    to_array,
)
from gpmpc.exceptions import DataError, GpmpcError, SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.gp._archive import existing_file, new_file
from gpmpc.gp.online import SlidingWindow, append_points
from gpmpc.gp.posterior import AffineForm, GPPosterior
from gpmpc.gp.storage import posterior_of_parts, posterior_parts, read_model, write_model
from gpmpc.gp.training import Trainer
from gpmpc.gp.transitions import Transitions, check_transitions
from gpmpc.models.nominal import Affine


@dataclass(frozen=True)
class ResidualModel:
    """A nominal model and a GP on its residual.

    Attributes:
        nominal: f0, from x (*batch, n) and u (*batch, m) to (*batch, n), in torch; an ``Affine`` one allows exact
            moment matching.
        residual: d, with ``predicts="value"``.
        B: Where it acts (n, k).
        states: The states that d depends on, in its order.
        inputs: The inputs that d depends on, in its order.
        input_dim: m, all of them.

    Raises:
        ShapeError: The parts do not belong together.
        SettingError: The residual predicts something else, or an index is out of range.
    """

    nominal: Callable[[Tensor, Tensor], Tensor]
    residual: GPPosterior
    B: Tensor
    states: Sequence[int]
    inputs: Sequence[int]
    input_dim: int

    def __post_init__(self) -> None:
        gp = self.residual
        check_tensors(B=self.B)
        if getattr(gp, "predicts", None) != "value":
            raise SettingError("residual", f"must be a GP with predicts='value'; got {getattr(gp, 'predicts', gp)!r}")
        if (len(self.states), len(self.inputs)) != (gp.state_dim, gp.input_dim):
            raise ShapeError(
                f"the residual has {gp.state_dim} states and {gp.input_dim} inputs; "
                f"got {len(self.states)} and {len(self.inputs)} selected"
            )
        if self.B.dim() != 2 or self.B.shape[1] != gp.output_dim:
            raise ShapeError(f"B must be (n, {gp.output_dim}); got {tuple(self.B.shape)}")
        parts = {"B": (self.B, tuple(self.B.shape))}
        if isinstance(self.nominal, Affine):
            n, m = self.state_dim, self.input_dim
            nominal = self.nominal
            parts |= {
                "nominal.A": (nominal.A, (n, n)),
                "nominal.B": (nominal.B, (n, m)),
                "nominal.c": (nominal.c, (n,)),
            }
        for name, (value, shape) in parts.items():
            if tuple(value.shape) != shape:
                raise ShapeError(f"{name} must have shape {shape}; got {tuple(value.shape)}")
            if value.dtype != gp.dtype or value.device != gp.device:
                raise SettingError(name, f"must be {gp.dtype} on {gp.device}; got {value.dtype} on {value.device}")
        _check_chosen(self.states, self.state_dim, self.inputs, self.input_dim)

    @classmethod
    def train(
        cls,
        nominal: Callable[[Tensor, Tensor], Tensor],
        transitions: Transitions,
        B: Tensor | None = None,
        states: Sequence[int] | None = None,
        inputs: Sequence[int] | None = None,
        trainer: Any = None,
        seed: int = 0,
    ) -> "ResidualModel":
        """Learns d from transitions: the part of x[k+1] - f0(x[k], u[k]) that B reaches (least squares).

        Args:
            nominal: f0.
            transitions: What was observed.
            B: Where d acts (n, k); on every state by default.
            states: The states that d depends on; all by default.
            inputs: The inputs that d depends on; all by default.
            trainer: A ``Trainer`` or ``SparseTrainer`` that does not learn differences.
            seed: Of the random starts.

        Raises:
            ShapeError: ``nominal`` or B do not fit the transitions.
            SettingError: An index is out of range, the columns of B depend on each other, or the trainer learns
                differences.
            TrainingError: An output could not be trained.
        """
        check_transitions(transitions)
        trainer = Trainer() if trainer is None else trainer
        if getattr(trainer, "predicts", "difference") == "difference":
            rule = "must be a Trainer or SparseTrainer with predicts='value' (or the default), which a residual is"
            raise SettingError("trainer", f"{rule}; got {trainer!r}")
        n, m = transitions.state_dim, transitions.input_dim
        states = list(range(n)) if states is None else list(states)
        inputs = list(range(m)) if inputs is None else list(inputs)
        B = torch.eye(n, dtype=torch.float64) if B is None else B
        check_tensors(B=B)
        if B.dim() != 2 or len(B) != n:
            raise ShapeError(f"B must be ({n}, k), a row a state; got {tuple(B.shape)}")
        if int(torch.linalg.matrix_rank(B)) < B.shape[1]:
            raise SettingError("B", "must have linearly independent columns: equal effects cannot be distinguished")
        _check_chosen(states, n, inputs, m)
        features, targets = _residuals(nominal, B, states, inputs, transitions)
        training = trainer.fit(features, targets, len(inputs), "value", seed)
        return cls(nominal, training.posterior, B, states, inputs, m)

    def append(self, transitions: Transitions, window: SlidingWindow | None = None) -> "ResidualModel":
        """Appends transitions to the data of the residual GP, held to a number of points where a window is given.

        Raises:
            ShapeError: The transitions have other dimensions.
        """
        if (transitions.state_dim, transitions.input_dim) != (self.state_dim, self.input_dim):
            raise ShapeError(
                f"the model has {self.state_dim} states and {self.input_dim} inputs; "
                f"got transitions with {transitions.state_dim} and {transitions.input_dim}"
            )
        points = _residuals(self.nominal, self.B, self.states, self.inputs, transitions)
        add = append_points if window is None else window.append
        return replace(self, residual=add(self.residual, *points))

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return len(self.B)

    @property
    def output_dim(self) -> int:
        """Number of outputs, n: the next state."""
        return len(self.B)

    @property
    def dtype(self) -> torch.dtype:
        """Of the residual GP."""
        return self.residual.dtype

    @property
    def device(self) -> torch.device:
        """Of the residual GP."""
        return self.residual.device

    @property
    def noise_covariance(self) -> Tensor:
        """Of the observations (n, n)."""
        return self.B @ self.residual.noise_covariance @ self.B.mT

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """The next state's distribution at a certain state and input: mean (*batch, n), covariance (*batch, n, n)."""
        input = state[..., :0] if input is None else input
        check_query(self, state, input)
        d = self.residual.predict(state[..., list(self.states)], input[..., list(self.inputs)])
        return self._combined(_nominal(self.nominal, state, input), d)

    def linearize(self, states: Array, inputs: Array, covariance: bool = True) -> Linearized:
        """Linearises the model at K points (K, n), (K, m): the nominal model's expansion plus B times the GP's.

        A nominal model with a method ``linearize(states, inputs)``, such as ``Affine`` or ``CasadiNominal``, is
        linearised by it; any other by one batched call of torch autograd.
        """
        mean, A, G = self._linearize_nominal(states, inputs)
        states_seen, inputs_seen = self._columns
        d = self.residual.linearize(states[:, states_seen], inputs[:, inputs_seen], covariance)
        B = self._acts_on
        A, G = np.array(A), np.array(G)
        A[:, :, states_seen] += B @ d.A
        G[:, :, inputs_seen] += B @ d.B
        V = None if d.covariance is None else B @ d.covariance @ B.T
        return Linearized(mean + d.mean @ B.T, A, G, V)

    @cached_property
    def _linearize_nominal(self) -> Callable[[Array, Array], tuple[Array, Array, Array]]:
        return getattr(self.nominal, "linearize", self._linearize_torch)

    def _linearize_torch(self, states: Array, inputs: Array) -> tuple[Array, Array, Array]:
        arguments = tensors_for(self, states, inputs)
        (mean,), (A, G) = batched_jacobian(lambda x, u: (_nominal(self.nominal, x, u),), arguments)
        return to_array(mean), to_array(A), to_array(G)

    @cached_property
    def _columns(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        return np.array(self.states, dtype=np.intp), np.array(self.inputs, dtype=np.intp)

    @cached_property
    def _acts_on(self) -> Array:
        return to_array(self.B)

    def predict_with_jacobian(self, state: Tensor, input: Tensor | None = None) -> tuple[Gaussian, Tensor, Tensor]:
        """``predict``, and its mean's derivatives by the state (*batch, n, n) and by the input (*batch, n, m)."""
        input = state[..., :0] if input is None else input
        check_query(self, state, input)
        states, inputs = list(self.states), list(self.inputs)
        d, by_state, by_input = self.residual.predict_with_jacobian(state[..., states], input[..., inputs])
        if isinstance(self.nominal, Affine):
            nominal, A, G = self.nominal(state, input), self.nominal.A, self.nominal.B
            A, G = A.expand(*state.shape[:-1], *A.shape), G.expand(*state.shape[:-1], *G.shape)
        else:
            (nominal,), (A, G) = batched_jacobian(lambda x, u: (_nominal(self.nominal, x, u),), (state, input))
        places = [torch.tensor(chosen, dtype=torch.long, device=self.device) for chosen in (states, inputs)]
        A, G = A.index_add(-1, places[0], self.B @ by_state), G.index_add(-1, places[1], self.B @ by_input)
        return self._combined(nominal, d), A, G

    @property
    def affine_form(self) -> AffineForm | None:
        """The model as moments are composed of it; None where the nominal model is not ``Affine``."""
        nominal = self.nominal
        if not isinstance(nominal, Affine):
            return None
        return AffineForm(self.residual, nominal.A, nominal.B, nominal.c, self.B, list(self.states), list(self.inputs))

    def to(self, device: Any = None, dtype: torch.dtype | None = None) -> "ResidualModel":
        """Copies the model to another device or type; a nominal model that is not ``Affine`` is taken as it is."""
        check_destination(device, dtype)
        nominal = self.nominal
        if isinstance(nominal, Affine):
            nominal = Affine(*(part.to(device=device, dtype=dtype) for part in (nominal.A, nominal.B, nominal.c)))
        residual, B = self.residual.to(device, dtype), self.B.to(device=device, dtype=dtype)
        return ResidualModel(nominal, residual, B, self.states, self.inputs, self.input_dim)

    def _combined(self, nominal: Tensor, d: Gaussian) -> Gaussian:
        return Gaussian(nominal + d.mean @ self.B.mT, self.B @ d.covariance @ self.B.mT)


def save_residual_model(model: ResidualModel, path: str | Path, metadata: Mapping[str, Any] | None = None) -> None:
    """Writes a residual model of an ``Affine`` nominal model to one file, in one piece or not at all.

    Args:
        model: On any device; float64 or float32.
        path: The file; ``.safetensors`` by convention.
        metadata: Kept in the header, such as names and units; what JSON can hold.

    Raises:
        UnsupportedModel: The nominal model is code, which a file of numbers cannot hold.
        SettingError: A tensor is neither float64 nor float32, or the metadata are no JSON.
        DataError: The folder does not exist.
    """
    path = new_file(path)
    if not isinstance(model.nominal, Affine):
        raise UnsupportedModel(
            f"only an Affine nominal model is numbers and can be saved; got {type(model.nominal).__name__}. Save the "
            "part that was learned (save_posterior(model.residual, ...)) and give ResidualModel the nominal model again"
        )
    header: dict[str, Any] = {
        "input_dim": model.input_dim,
        "states": [int(i) for i in model.states],
        "inputs": [int(i) for i in model.inputs],
    }
    header["residual"], residual = posterior_parts(path, model.residual)
    tensors = {"B": model.B, **{f"nominal/{name}": getattr(model.nominal, name) for name in ("A", "B", "c")}}
    tensors |= {f"residual/{name}": value for name, value in residual.items()}
    write_model(path, "ResidualModel", header, tensors, metadata)


def load_residual_model(path: str | Path) -> ResidualModel:
    """Reads a file of ``save_residual_model``, into host memory.

    Raises:
        DataError: The file is missing, damaged, of another kind or of a newer format.
    """
    path = existing_file(path, "a saved ResidualModel")
    header, tensors = read_model(path, "ResidualModel")
    residual = {name.partition("/")[2]: value for name, value in tensors.items() if name.startswith("residual/")}
    gp = posterior_of_parts(path, header.get("residual"), residual)
    try:
        B, *nominal = (tensors[name] for name in ("B", "nominal/A", "nominal/B", "nominal/c"))
        if not all(bool(torch.isfinite(part).all()) for part in (B, *nominal)):
            raise DataError("B and the nominal model must be finite")
        return ResidualModel(Affine(*nominal), gp, B, header["states"], header["inputs"], header["input_dim"])
    except (GpmpcError, KeyError, TypeError) as error:
        raise DataError(f"{path}: not a consistent residual model ({error})") from error


def _check_chosen(states: Sequence[int], n: int, inputs: Sequence[int], m: int) -> None:
    for key, chosen, count in (("states", states, n), ("inputs", inputs, m)):
        whole = all(isinstance(i, int) and not isinstance(i, bool) for i in chosen)
        if not whole or any(not 0 <= i < count for i in chosen) or len(set(chosen)) != len(chosen):
            raise SettingError(key, f"must be different indices from 0 to {count - 1}; got {list(chosen)}")


def _nominal(nominal: Callable[[Tensor, Tensor], Tensor], state: Tensor, input: Tensor) -> Tensor:
    """f0 (*batch, n), held against the rule that a wrong number of states would otherwise be broadcast."""
    value = nominal(state, input)
    if not isinstance(value, Tensor):
        raise SettingError("nominal", f"must give a torch tensor; got {type(value).__name__}")
    if value.shape != state.shape:
        raise ShapeError(
            f"nominal must give next states of the states' shape {tuple(state.shape)}; got {tuple(value.shape)}"
        )
    return value


def _residuals(
    nominal: Callable[[Tensor, Tensor], Tensor],
    B: Tensor,
    states: Sequence[int],
    inputs: Sequence[int],
    transitions: Transitions,
) -> tuple[Tensor, Tensor]:
    """Features (N, d) and targets (N, k) of the residual GP: the least-squares part of the error of f0."""
    to_B = {"device": B.device, "dtype": B.dtype}
    x, u, after = (t.to(**to_B) for t in (transitions.states, transitions.inputs, transitions.next_states))
    targets = torch.linalg.lstsq(B, (after - _nominal(nominal, x, u)).mT).solution.mT
    return torch.cat([x[:, list(states)], u[:, list(inputs)]], dim=1), targets
