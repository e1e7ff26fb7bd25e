"""Data of a residual GP: the error of a nominal model, as far as B reaches it."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc._angles import state_difference, whole_turns
from gpmpc._dynamics import to_array
from gpmpc._functions import call
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import check_tensors
from gpmpc.gp import Transitions
from gpmpc.gp._data_checks import (
    RESOLUTION,
    ColumnDescriptions,
    signal_names,
)
from gpmpc.models._casadi_function import CasadiFunction
from gpmpc.models._features import Features
from gpmpc.models._nominal import (
    Affine,
    check_slopes,
    lost_derivative,
    points_near_zero,
)
from gpmpc.models._tensors import check_like

Nominal = Callable[[Tensor, Tensor], Tensor]
Array = NDArray[np.float64]
_log = logging.getLogger(__name__)
Effect = Tensor | Callable[[Tensor], Tensor]


def nominal_next_state(
    nominal: Nominal, state: Tensor, input: Tensor, angles: Sequence[int]
) -> Tensor:
    """Computes f0 (*batch, n) with a check of its shape.

    A wrong number of states would otherwise be broadcast. A function that wraps angles
    gives them within half a turn of the state's: plans count turns. A
    ``CasadiFunction`` of a model counts them itself.

    Raises:
        SettingError: The value is no tensor.
        ShapeError: It has another shape than the state.
    """
    value = call("nominal", nominal, state, input)
    if not isinstance(value, Tensor):
        got = type(value).__name__
        raise SettingError("nominal", f"must give a torch tensor; got {got}")
    if value.shape != state.shape:
        rule = "nominal must give next states of the states' shape"
        got = tuple(value.shape)
        raise ShapeError(f"{rule} {tuple(state.shape)}; got {got}")
    if not len(angles) or counts_turns(nominal):
        return value
    columns = list(angles)
    turns = torch.zeros_like(value)
    turns[..., columns] = whole_turns((value - state)[..., columns])
    return value - turns


def counts_turns(nominal: Nominal) -> bool:
    """Returns whether a nominal model needs no help in counting turns of angles."""
    return isinstance(nominal, Affine | CasadiFunction)


def effect_matrix(B: Effect, state: Tensor) -> Tensor:
    """Computes B (n, k), or of a function (*batch, n, k), at states (*batch, n).

    Raises:
        ShapeError: It has another number of rows.
        SettingError: A function gives another type than the state's.
    """
    if not callable(B):
        check_tensors(B=B)
        _check_rows(B, state.shape[-1:])
        return B
    value: Any = call("B", B, state)
    check_tensors(B=value)
    check_like("B", value, state, owner="the states")
    if value.shape == state.shape:  # one output
        value = value[..., None]
    _check_rows(value, state.shape)
    return value


def _check_rows(B: Tensor, rows: torch.Size) -> None:
    """Raises ``ShapeError`` unless an effect has these dimensions besides its last."""
    if B.shape[:-1] != rows:
        expected = ", ".join(map(str, rows))
        got = tuple(B.shape)
        raise ShapeError(f"B must be ({expected}, k), a row a state; got {got}")


class ResidualData(NamedTuple):
    """What a residual GP is trained on."""

    features: Tensor  # of states and inputs (N, d)
    targets: Tensor  # the least-squares part of the error of f0 (N, k)
    remainder: Tensor  # what B does not reach of the error of f0 (N, n)


def residual_data(
    nominal: Nominal,
    B: Effect,
    features: Features,
    transitions: Transitions,
    like: Tensor,
) -> ResidualData:
    """Computes features and targets of a residual GP.

    Args:
        nominal: f0.
        B: Effect of the GP.
        features: What the GP sees.
        transitions: N of them.
        like: Has the type and the device of what is computed.

    Raises:
        SettingError: The columns of B depend on each other.
    """
    states = transitions.states.to(device=like.device, dtype=like.dtype)
    inputs = transitions.inputs.to(device=like.device, dtype=like.dtype)
    next_states = transitions.next_states.to(device=like.device, dtype=like.dtype)
    effect = effect_matrix(B, states)
    if int(torch.linalg.matrix_rank(effect).min()) < effect.shape[-1]:
        rule = "must have linearly independent columns"
        raise SettingError("B", f"{rule}: equal effects cannot be distinguished")
    predicted = nominal_next_state(nominal, states, inputs, features.angles)
    error = state_difference(next_states, predicted, features.angles)
    # torch.linalg.lstsq gives other last digits from call to call.
    Q, R = torch.linalg.qr(effect)
    if callable(B):
        solutions = torch.linalg.solve_triangular(
            R, Q.mT @ error[..., None], upper=True
        )
        targets = solutions[..., 0]
    else:
        targets = torch.linalg.solve_triangular(R, Q.mT @ error.mT, upper=True).mT
    reached = (effect @ targets[..., None])[..., 0]
    return ResidualData(
        features=torch.cat(features(states, inputs), dim=1),
        targets=targets,
        remainder=error - reached,
    )


def warn_of_remainder(
    remainder: Tensor,
    noise_covariance: Tensor,
    transitions: Transitions,
    angles: Sequence[int],
) -> None:
    """Logs states of which much more is missed than a model's noise says.

    Much is a tenth of what a step changes.

    Args:
        remainder: What B does not reach of the error of f0 (N, n).
        noise_covariance: Of the model (n, n).
        transitions: The data.
        angles: Indices of the states that are angles.
    """
    missed = remainder.square().mean(dim=0).sqrt()
    deviations = noise_covariance.diagonal().sqrt()
    change = state_difference(transitions.next_states, transitions.states, angles)
    small = 0.1 * change.square().mean(dim=0).sqrt() + RESOLUTION
    is_missed = missed > 2.0 * deviations + small
    if not bool(is_missed.any()):
        return
    states, _ = signal_names(transitions)
    indices = is_missed.nonzero().flatten().tolist()
    _log.warning(
        "training: B does not reach all that the nominal model misses: of %s %s remain "
        "(root mean square), the noise of the model has %s: predictions are too sure "
        "of them. Give B a column for them, or the model a noise",
        ", ".join(states[i] for i in indices),
        ", ".join(f"{float(missed[i]):.2g}" for i in indices),
        ", ".join(f"{float(deviations[i]):.2g}" for i in indices),
    )


def describe_columns(
    transitions: Transitions, B: Effect, features: Features
) -> ColumnDescriptions:
    """Describes features and targets of a residual: their names and magnitudes.

    A residual is the difference of two states, seen through the pseudo-inverse of B,
    and its round-off is that of the states. Where no data were seen it may be as much
    as a step changes: there the nominal model is right, or it is not.
    """
    pseudo_inverse = torch.linalg.pinv(effect_matrix(B, transitions.states))
    states = transitions.states
    next_states = transitions.next_states
    larger = torch.maximum(states.abs(), next_states.abs())
    magnitudes = (pseudo_inverse.abs() @ larger[..., None]).amax(dim=0)[:, 0]
    change = state_difference(next_states, states, features.angles)
    steps = (pseudo_inverse @ change[..., None])[..., 0]
    deviations = steps.std(dim=0, correction=0)
    deviations = torch.where(deviations > RESOLUTION, deviations, 1.0)
    return ColumnDescriptions(
        features=_feature_names(transitions, features),
        outputs=_output_names(transitions, B, pseudo_inverse),
        magnitudes=magnitudes.detach().numpy(force=True),
        deviation_units=deviations.detach().numpy(force=True),
    )


def _feature_names(transitions: Transitions, features: Features) -> list[str]:
    """Names the features, and the selected inputs."""
    states, inputs = signal_names(transitions)
    names: list[str] = []
    for i in features.states:
        if i in features.angles:
            names += [f"sine of {states[i]}", f"cosine of {states[i]}"]
        else:
            names.append(states[i])
    return names + [inputs[j] for j in features.inputs]


def _output_names(
    transitions: Transitions, B: Effect, pseudo_inverse: Tensor
) -> list[str]:
    """Names the outputs of a residual: by the states where B is the identity."""
    if not callable(B):
        identity = torch.eye(len(pseudo_inverse)).to(pseudo_inverse)
        if torch.equal(pseudo_inverse, identity):
            states, _ = signal_names(transitions)
            return [f"what is missed of {name}" for name in states]
    outputs = pseudo_inverse.shape[-2]
    return [f"output {a + 1} of the residual" for a in range(outputs)]


def check_derivatives(
    nominal: Nominal,
    B: Effect,
    transitions: Transitions,
    angles: Sequence[int],
) -> None:
    """Raises ``SettingError`` where torch cannot follow a function, or all of it.

    Training asks for no derivative: only a controller would come upon it. Errors of
    shape are left to the computation of the residuals, which names all rows.
    """
    points = [to_array(part[:2]) for part in (transitions.states, transitions.inputs)]
    with suppress(ShapeError):
        for key, function, arguments in _functions_of_torch(nominal, B, *points):
            check_slopes(key, function, transitions.states, *arguments, angles=angles)


def check_no_lost_derivative(
    nominal: Nominal, B: Effect, model: Any, angles: Sequence[int]
) -> None:
    """Raises ``SettingError`` where torch follows a part of a function alone.

    What a function raises near zero is no matter: it may be defined elsewhere.

    Args:
        nominal: f0.
        B: Effect of the GP.
        model: Has the type and the device of the functions' tensors.
        angles: Indices of the states that are angles.
    """
    points = points_near_zero(model.state_dim, model.input_dim)
    for key, function, arguments in _functions_of_torch(nominal, B, *points):
        lost = None
        with suppress(Exception):
            lost = lost_derivative(function, model, *arguments, angles=angles)
        if lost is not None:
            raise SettingError(key, lost)


def _functions_of_torch(
    nominal: Nominal, B: Effect, states: Array, inputs: Array
) -> Iterator[tuple[str, Callable[..., Tensor], tuple[Array, ...]]]:
    """Yields names, functions without derivatives of their own, and their arguments."""
    if not hasattr(nominal, "linearize"):
        without_turns = partial(nominal_next_state, nominal, angles=())
        yield "nominal", without_turns, (states, inputs)
    if callable(B) and not hasattr(B, "linearize"):
        yield "B", partial(effect_matrix, B), (states,)
