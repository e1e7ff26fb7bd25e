"""Problem: what the rest of the package asks of a learned model of x[k+1] = f(x[k], u[k]), whoever wrote it."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian, check_tensors


class DynamicsModel(Protocol):
    """A probabilistic model of the next state; every method takes leading batch dimensions.

    ``gpmpc.testing.check_model`` holds a model against this.
    """

    state_dim: int
    input_dim: int
    output_dim: int
    dtype: torch.dtype
    device: torch.device
    noise_covariance: Tensor  # of the observations, (k, k); no part of ``predict``

    def predict(self, state: Tensor, input: Tensor | None = None) -> Gaussian:
        """N(mean (*batch, k), covariance (*batch, k, k)) of the latent next state at a certain x and u."""

    def predict_with_jacobian(self, state: Tensor, input: Tensor | None = None) -> tuple[Gaussian, Tensor, Tensor]:
        """The same, and the mean's derivatives by the state (*batch, k, n) and by the input (*batch, k, m)."""


def batched_jacobian(
    function: Callable[..., tuple[Tensor, ...]], arguments: Sequence[Tensor]
) -> tuple[tuple[Tensor, ...], list[Tensor]]:
    """Values of a function and its first value's Jacobians, by one reverse pass of torch autograd an entry.

    It needs no function transforms, so it works for GPyTorch kernels too, and it can be differentiated again.

    Args:
        function: Of the arguments, batch element by batch element; the first value is (*batch, k).
        arguments: Each (*batch, d_i).

    Returns:
        The values, and d value / d argument (*batch, k, d_i) for each argument.
    """
    again = torch.is_grad_enabled() and any(argument.requires_grad for argument in arguments)
    with torch.inference_mode(False), torch.enable_grad():
        leaves = [a if again and a.requires_grad else a.detach().clone().requires_grad_() for a in arguments]
        values = function(*leaves)
        rows = [
            torch.autograd.grad(
                values[0][..., a].sum(), leaves, create_graph=again, retain_graph=True, materialize_grads=True
            )
            for a in range(values[0].shape[-1])
        ]
    jacobians = [torch.stack(column, dim=-2) for column in zip(*rows, strict=True)]
    if not again:
        values = tuple(value.detach() for value in values)
    return values, jacobians


def check_query(model: Any, state: Tensor, input: Tensor) -> None:
    """Raises unless a state (*batch, n) and an input (*batch, m) fit a model in shape, type and device.

    Raises:
        ShapeError: Another number of states or inputs.
        SettingError: No tensor, or another dtype or device.
    """
    check_tensors(state=state, input=input)
    if state.shape[-1:] != (model.state_dim,) or input.shape[-1:] != (model.input_dim,):
        got = [tensor.shape[-1] if tensor.dim() else "a scalar" for tensor in (state, input)]
        raise ShapeError(
            f"the model has {model.state_dim} states and {model.input_dim} inputs; got {got[0]} and {got[1]}"
        )
    if state.shape[:-1] != input.shape[:-1]:
        raise ShapeError(
            "state (*batch, n) and input (*batch, m) must have the same batch; "
            f"got {tuple(state.shape[:-1])} and {tuple(input.shape[:-1])}"
        )
    for name, value in (("state", state), ("input", input)):
        if value.dtype != model.dtype or value.device != model.device:
            raise SettingError(
                name, f"must be {model.dtype} on {model.device} like the model; got {value.dtype} on {value.device}"
            )


def check_destination(device: Any, dtype: Any) -> None:
    """Raises unless a model can go to a device and a type; None stays where it is.

    Raises:
        SettingError: torch finds no such device here, or the type is neither float32 nor float64.
    """
    if device is not None:
        try:
            torch.empty(0, device=device)
        except (AssertionError, RuntimeError, TypeError) as error:
            reason = str(error).partition("\n")[0]
            raise SettingError("device", f"must be one that torch finds here; got {device!r} ({reason})") from error
    if dtype not in (None, torch.float32, torch.float64):
        raise SettingError("dtype", f"must be torch.float32 or torch.float64; got {dtype!r}")
