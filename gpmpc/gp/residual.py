"""Problem: where part of the dynamics is known, only what it gets wrong has to be learned.

    x[k+1] = f0(x[k], u[k]) + B d(x_s[k], u_s[k])

f0 is the nominal model, d a GP over a selection of the states and inputs, and B says which states it acts on (Hewing,
Kabzan and Zeilinger, 2020, eq. (3)).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
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
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.gp.budget import Budget
from gpmpc.gp.posterior import GPPosterior
from gpmpc.gp.training import Trainer
from gpmpc.gp.transitions import Transitions, check_transitions


@dataclass(frozen=True)
class Affine:
    """A nominal model x+ = A x + B u + c, through which uncertainty goes exactly.

    Attributes:
        A: (n, n).
        B: (n, m).
        c: (n,).

    Raises:
        ShapeError: The shapes do not belong together.
        SettingError: One of the three is no tensor.
    """

    A: Tensor
    B: Tensor
    c: Tensor

    def __post_init__(self) -> None:
        check_tensors(A=self.A, B=self.B, c=self.c)
        shapes = [tuple(part.shape) for part in (self.A, self.B, self.c)]
        n = len(self.A) if self.A.dim() else 0
        if shapes[0] != (n, n) or self.B.dim() != 2 or len(self.B) != n or shapes[2] != (n,):
            raise ShapeError(f"A, B and c must be (n, n), (n, m) and (n,); got {', '.join(map(str, shapes))}")

    def __call__(self, state: Tensor, input: Tensor) -> Tensor:
        """The nominal next state (*batch, n)."""
        return state @ self.A.mT + input @ self.B.mT + self.c

    def linearize(self, states: Array, inputs: Array) -> tuple[Array, Array, Array]:
        """The nominal next states (K, n) and their constant derivatives (K, n, n) and (K, n, m)."""
        A, B, c = self._arrays
        K = len(states)
        return states @ A.T + inputs @ B.T + c, np.tile(A, (K, 1, 1)), np.tile(B, (K, 1, 1))

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array]:
        return to_array(self.A), to_array(self.B), to_array(self.c)


@dataclass(frozen=True)
class ResidualModel:
    """A nominal model and a GP on its residual.

    Attributes:
        nominal: f0, from x (*batch, n) and u (*batch, m) to (*batch, n), in torch; an ``Affine`` one allows exact
            moment matching.
        residual: d, with ``predicts="value"``.
        B: Where it acts (n, k).
        states: Which states d sees, in its order.
        inputs: Which inputs d sees, in its order.
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
                f"the residual sees {gp.state_dim} states and {gp.input_dim} inputs; "
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
        trainer: Trainer | None = None,
        seed: int = 0,
    ) -> "ResidualModel":
        """Learns d from transitions: the part of x[k+1] - f0(x[k], u[k]) that B reaches (least squares).

        Args:
            nominal: f0.
            transitions: What was observed.
            B: Where d acts (n, k); on every state by default.
            states: Which states d sees; all by default.
            inputs: Which inputs d sees; all by default.
            trainer: How the GPs are trained; what they learn is no difference, so it must not ask for one.
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
            raise SettingError("B", "must have linearly independent columns: what acts alike cannot be told apart")
        _check_chosen(states, n, inputs, m)
        features, targets = _learned(nominal, B, states, inputs, transitions)
        training = trainer.fit(features, targets, len(inputs), "value", seed)
        return cls(nominal, training.posterior, B, states, inputs, m)

    def condition_on(self, transitions: Transitions, budget: Budget | None = None) -> "ResidualModel":
        """The model whose residual GP has seen more transitions, held to a number of points if a budget is given.

        Raises:
            ShapeError: The transitions have other dimensions.
        """
        if (transitions.state_dim, transitions.input_dim) != (self.state_dim, self.input_dim):
            raise ShapeError(
                f"the model has {self.state_dim} states and {self.input_dim} inputs; "
                f"got transitions with {transitions.state_dim} and {transitions.input_dim}"
            )
        seen = _learned(self.nominal, self.B, self.states, self.inputs, transitions)
        residual = budget.condition(self.residual, *seen) if budget else self.residual.condition_on_targets(*seen)
        return replace(self, residual=residual)

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return len(self.B)

    @property
    def output_dim(self) -> int:
        """The same: it predicts the next state."""
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
        d = self.residual.predict(*self.selected(state, input))
        return self._combined(_nominal(self.nominal, state, input), d)

    def linearize(self, states: Array, inputs: Array, covariance: bool = True) -> Linearized:
        """Linearises the model at K points (K, n), (K, m): the nominal model's expansion plus B times the GP's.

        A nominal model with a method ``linearize(states, inputs)``, such as ``Affine`` or ``CasadiFunction``, is
        linearised by it; any other by one batched call of torch autograd.
        """
        mean, A, G = self._linearize_nominal(states, inputs)
        states_seen, inputs_seen = self._columns
        d = self.residual.linearize(states[:, states_seen], inputs[:, inputs_seen], covariance)
        B = self._acts_on
        mean += d.mean @ B.T
        A[:, :, states_seen] += B @ d.A
        G[:, :, inputs_seen] += B @ d.B
        V = None if d.covariance is None else B @ d.covariance @ B.T
        return Linearized(mean, A, G, V)

    @cached_property
    def _linearize_nominal(self) -> Callable[[Array, Array], tuple[Array, Array, Array]]:
        return getattr(self.nominal, "linearize", self._linearize_torch)

    def _linearize_torch(self, states: Array, inputs: Array) -> tuple[Array, Array, Array]:
        arguments = tensors_for(self, states, inputs)
        (mean,), (A, G) = batched_jacobian(lambda x, u: (_nominal(self.nominal, x, u),), arguments)
        return to_array(mean), to_array(A), to_array(G)

    @cached_property
    def _columns(self) -> tuple[Array, Array]:
        return np.array(self.states, dtype=int), np.array(self.inputs, dtype=int)

    @cached_property
    def _acts_on(self) -> Array:
        return to_array(self.B)

    def predict_with_jacobian(self, state: Tensor, input: Tensor | None = None) -> tuple[Gaussian, Tensor, Tensor]:
        """``predict``, and its mean's derivatives by the state (*batch, n, n) and by the input (*batch, n, m)."""
        input = state[..., :0] if input is None else input
        check_query(self, state, input)
        d, by_state, by_input = self.residual.predict_with_jacobian(*self.selected(state, input))
        if isinstance(self.nominal, Affine):
            nominal, A, G = self.nominal(state, input), self.nominal.A, self.nominal.B
            A, G = A.expand(*state.shape[:-1], *A.shape), G.expand(*state.shape[:-1], *G.shape)
        else:
            (nominal,), (A, G) = batched_jacobian(lambda x, u: (_nominal(self.nominal, x, u),), (state, input))
        A = A.index_add(-1, self._index(self.states), self.B @ by_state)
        G = G.index_add(-1, self._index(self.inputs), self.B @ by_input)
        return self._combined(nominal, d), A, G

    def selected(self, state: Tensor, input: Tensor) -> tuple[Tensor, Tensor]:
        """What the residual sees of x (*batch, n) and u (*batch, m)."""
        return state[..., list(self.states)], input[..., list(self.inputs)]

    def to(self, device: Any = None, dtype: torch.dtype | None = None) -> "ResidualModel":
        """The same on another device or in another type; a nominal that is no ``Affine`` is taken as it is."""
        check_destination(device, dtype)
        nominal = self.nominal
        if isinstance(nominal, Affine):
            nominal = Affine(*(part.to(device=device, dtype=dtype) for part in (nominal.A, nominal.B, nominal.c)))
        residual, B = self.residual.to(device, dtype), self.B.to(device=device, dtype=dtype)
        return ResidualModel(nominal, residual, B, self.states, self.inputs, self.input_dim)

    def save(self, path: str | Path) -> None:
        """Writes one file without pickle, in one piece or not at all; see ``gpmpc.gp.storage``.

        Raises:
            UnsupportedModel: The nominal model is no ``Affine`` one.
        """
        from gpmpc.gp.storage import save_residual_model  # which knows this class

        save_residual_model(self, path)

    @classmethod
    def load(cls, path: str | Path) -> "ResidualModel":
        """Reads what ``save`` wrote; the predictions are the same, bit by bit.

        Raises:
            DataError: The file is missing, damaged, of another kind or of a newer format.
        """
        from gpmpc.gp.storage import load_residual_model

        return load_residual_model(path)

    def _combined(self, nominal: Tensor, d: Gaussian) -> Gaussian:
        return Gaussian(nominal + d.mean @ self.B.mT, self.B @ d.covariance @ self.B.mT)

    def _index(self, chosen: Sequence[int]) -> Tensor:
        return torch.tensor(list(chosen), dtype=torch.long, device=self.device)


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


def _learned(
    nominal: Callable[[Tensor, Tensor], Tensor],
    B: Tensor,
    states: Sequence[int],
    inputs: Sequence[int],
    transitions: Transitions,
) -> tuple[Tensor, Tensor]:
    """What d sees and is to be, of N transitions: the features, and the least-squares part of what f0 missed (N, k)."""
    to_B = {"device": B.device, "dtype": B.dtype}
    x, u, after = (t.to(**to_B) for t in (transitions.states, transitions.inputs, transitions.next_states))
    targets = torch.linalg.lstsq(B, (after - _nominal(nominal, x, u)).mT).solution.mT
    return torch.cat([x[:, list(states)], u[:, list(inputs)]], dim=1), targets
