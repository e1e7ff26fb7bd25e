"""The protocol of learned and known models x[k+1] = f(x[k], u[k]), and their linearisation at many points at once."""

import logging
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc._functions import call
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian, check_tensors, constant_arrays

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)


class Linearized(NamedTuple):
    """A model's first-order expansions at K points, as C-contiguous float64 arrays."""

    mean: Array  #: next states f(x, u) (K, n)
    A: Array  #: derivatives of the means by the state (K, n, n)
    B: Array  #: derivatives of the means by the input (K, n, m)
    #: of the latent next states at the points, without observation noise (K, n, n); None where not wanted
    covariance: Array | None


class DynamicsModel(Protocol):
    """A probabilistic model of the next state; ``gpmpc.testing.check_model`` tests a model against this protocol.

    ``linearize_by_autograd`` is a ready-made ``linearize`` for models that torch can differentiate.
    """

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        ...

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        ...

    @property
    def output_dim(self) -> int:
        """Number of outputs, k; equal to n where the outputs are next states."""
        ...

    @property
    def dtype(self) -> torch.dtype:
        """Type of every tensor that ``predict`` takes and returns."""
        ...

    @property
    def device(self) -> torch.device:
        """Device of every tensor that ``predict`` takes and returns."""
        ...

    @property
    def noise_covariance(self) -> Tensor:
        """Covariance of the observations' noise (k, k); not contained in ``predict``."""
        ...

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """Predicts the latent next state at x (*batch, n) and u (*batch, m), without observation noise."""
        ...

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the mean at K points x (K, n), u (K, m), with the covariances there unless they are not wanted."""
        ...


class TensorModel:
    """A model whose tensors have the type and are on the device of its attribute ``_part``."""

    _part: Any

    @property
    def dtype(self) -> torch.dtype:
        """Of every tensor."""
        return self._part.dtype

    @property
    def device(self) -> torch.device:
        """Of every tensor."""
        return self._part.device


def linearize(
    model: DynamicsModel, states: Array, inputs: Array, covariance: bool = True
) -> Linearized:
    """Linearises a model at K points x (K, n), u (K, m), with the covariances there unless they are not wanted.

    By its method ``linearize``, or, where it has none but ``predict``, by autograd.
    """
    method = getattr(model, "linearize", partial(linearize_by_autograd, model))
    return method(states, inputs, covariance)


def linearize_by_autograd(
    model: Any, states: Array, inputs: Array, covariance: bool = True
) -> Linearized:
    """``linearize`` by one evaluation of all K points and torch autograd, for any model that has ``predict``.

    The model needs ``dtype`` and ``device`` besides. It is slower than a closed form, which is logged once a class.
    """
    _log_slow(type(model).__name__)
    belief, A, B = predict_by_autograd(model, *tensors_for(model, states, inputs))
    V = to_array(belief.covariance) if covariance else None
    return Linearized(to_array(belief.mean), to_array(A), to_array(B), V)


@cache
def _log_slow(name: str) -> None:
    _log.warning(
        "%s has no linearize() of its own: torch autograd linearises it, which takes longer",
        name,
    )


def tensors_for(model: Any, *arrays: Array) -> list[Tensor]:
    """Converts arrays to tensors of a model's type on its device."""
    return [
        torch.as_tensor(array, dtype=model.dtype, device=model.device)
        for array in arrays
    ]


def to_array(tensor: Tensor) -> Array:
    """Converts a tensor to a C-contiguous float64 array."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float64)


def batched_jacobian(
    function: Callable[..., tuple[Tensor, ...]], arguments: Sequence[Tensor]
) -> tuple[tuple[Tensor, ...], list[Tensor]]:
    """Evaluates a function and its first value's Jacobians, by one reverse pass of torch autograd over the batch.

    The function takes arguments (*batch, d_i), batch element by batch element, and its first value is (*batch, k); the
    Jacobians are (*batch, k, d_i), and can be differentiated again.
    """
    again = torch.is_grad_enabled() and any(
        argument.requires_grad for argument in arguments
    )
    with torch.inference_mode(False), torch.enable_grad():
        leaves = [
            a if again and a.requires_grad else a.detach().clone().requires_grad_()
            for a in arguments
        ]
        values = function(*leaves)
        outputs = values[0].shape[-1]
        eye = torch.eye(outputs, dtype=values[0].dtype, device=values[0].device)
        weights = eye.reshape(outputs, *[1] * (values[0].dim() - 1), outputs).expand(
            outputs, *values[0].shape
        )
        options = {"create_graph": again, "retain_graph": True, "allow_unused": True}
        if not values[0].requires_grad:  # a constant
            columns = [None] * len(leaves)
        else:
            try:
                columns = torch.autograd.grad(
                    values[0], leaves, weights, is_grads_batched=True, **options
                )
            except (
                RuntimeError
            ):  # an operation of which torch cannot vectorise the derivative
                rows = [
                    torch.autograd.grad(values[0], leaves, weight, **options)
                    for weight in weights
                ]
                columns = [
                    None if c[0] is None else torch.stack(c)
                    for c in zip(*rows, strict=True)
                ]
        columns = [
            a.new_zeros(outputs, *a.shape) if c is None else c
            for a, c in zip(leaves, columns, strict=True)
        ]
    jacobians = [column.movedim(0, -2) for column in columns]
    if not again:
        values = tuple(value.detach() for value in values)
    return values, jacobians


def predict_with_jacobian(
    model: Any, state: Tensor, input: Tensor
) -> tuple[Gaussian, Tensor, Tensor]:
    """Predicts, with the mean's derivatives by state (*batch, k, n) and input (*batch, k, m).

    By the model's ``linearize`` where torch follows nothing; else by its own method of this name, which torch can
    differentiate and transform further, or by autograd.
    """
    if (
        hasattr(model, "linearize")
        and (arrays := constant_arrays(state, input)) is not None
    ):
        check_query(model, state, input)
        batch = state.shape[:-1]
        count = state.shape[:-1].numel()
        flat = (
            np.ascontiguousarray(a, dtype=np.float64).reshape(count, a.shape[-1])
            for a in arrays
        )
        found = tensors_for(model, *model.linearize(*flat))
        mean, A, B, covariance = (
            part.reshape(*batch, *part.shape[1:]) for part in found
        )
        return Gaussian(mean, covariance), A, B
    method = getattr(model, "predict_with_jacobian", None)
    return (
        predict_by_autograd(model, state, input)
        if method is None
        else method(state, input)
    )


def predict_by_autograd(
    model: Any, state: Tensor, input: Tensor
) -> tuple[Gaussian, Tensor, Tensor]:
    """``predict_with_jacobian`` by torch autograd, for any model that has ``predict``."""

    def prediction(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        belief = call("model", model.predict, x, u)
        return belief.mean, belief.covariance

    (mean, covariance), (A, B) = batched_jacobian(prediction, (state, input))
    return Gaussian(mean, covariance), A, B


def check_next_states(model: Any) -> tuple[int, int]:
    """The numbers of states and inputs of a model that predicts next states; of others a ``SettingError``."""
    if not hasattr(model, "predict"):
        raise SettingError(
            "model",
            f"must be a DynamicsModel, such as GPPosterior; got {type(model).__name__}",
        )
    if model.output_dim != model.state_dim:
        got = f"{model.state_dim} states and {model.output_dim} outputs"
        raise SettingError("model", f"must predict the next state; got {got}")
    return model.state_dim, model.input_dim


def check_query(model: Any, state: Tensor, input: Tensor) -> None:
    """Raises unless a state (*batch, n) and an input (*batch, m) are tensors of a model's shape, type and device."""
    check_tensors(state=state, input=input)
    n = model.state_dim
    m = model.input_dim
    if state.shape[-1:] != (n,) or input.shape != (*state.shape[:-1], m):
        got = f"{tuple(state.shape)} and {tuple(input.shape)}"
        raise ShapeError(
            f"the model takes a state (*batch, {n}) and an input (*batch, {m}); got {got}"
        )
    for name, value in (("state", state), ("input", input)):
        if value.dtype != model.dtype or value.device != model.device:
            got = f"{value.dtype} on {value.device}"
            raise SettingError(
                name,
                f"must be {model.dtype} on {model.device} like the model; got {got}",
            )


def check_destination(device: Any, dtype: Any) -> None:
    """Raises unless torch finds the device, and the type is float32 or float64; None stays where it is."""
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError, TypeError) as error:
        reason = str(error).partition("\n")[0]
        raise SettingError(
            "device", f"must be one that torch finds here; got {device!r} ({reason})"
        ) from error
    if dtype not in (None, torch.float32, torch.float64):
        raise SettingError(
            "dtype", f"must be torch.float32 or torch.float64; got {dtype!r}"
        )
