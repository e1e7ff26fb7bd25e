"""The protocol of models x[k+1] = f(x[k], u[k]), learned or known.

Besides, their linearisation at many points at once.
"""

import logging
from collections.abc import Callable, Sequence
from functools import cache, partial
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gpmpc._arrays import read_array
from gpmpc._calls import explains_arguments
from gpmpc._functions import call
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian, check_tensors, constant_arrays

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)


class Linearized(NamedTuple):
    """First-order expansions of a model at K points, as C-contiguous float64 arrays.

    See Also:
        ``linearize``, which returns it.
    """

    mean: Array  #: next states f(x, u), or k other outputs (K, k)
    A: Array  #: derivatives of the means by the state (K, k, n)
    B: Array  #: derivatives of the means by the input (K, k, m)
    #: of the latent outputs at the points, without observation noise (K, k, k); None
    #: where it was not computed
    covariance: Array | None


class DynamicsModel(Protocol):
    """A probabilistic model of the next state.

    ``gpmpc.testing.check_model`` tests a model against this protocol.
    ``linearize_by_autograd`` is a ready-made ``linearize`` for models that torch can
    differentiate.

    See Also:
        ``gpmpc.testing.check_model``, which tells what a model of one's own
        lacks; ``linearize``.
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
        """Covariance (k, k) of what scatters the data around the prediction.

        It is not part of ``predict``: propagators add it to every step as process
        noise.
        """
        ...

    def predict(self, state: Tensor, input: Tensor) -> Gaussian:
        """Predicts the latent next state, without observation noise.

        Args:
            state: x (*batch, n).
            input: u (*batch, m).
        """
        ...

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Linearises the mean at K points.

        Args:
            states: x (K, n).
            inputs: u (K, m).
            covariance: Whether the covariances at the points are computed.
        """
        ...


class TensorModel:
    """A model whose type and device are those of a part of it.

    A subclass says which: ``_part = property(lambda self: self.residual)``.
    """

    _part: Any  #: a tensor, or a model

    @property
    def dtype(self) -> torch.dtype:
        """Type of every tensor."""
        return self._part.dtype

    @property
    def device(self) -> torch.device:
        """Device of every tensor."""
        return self._part.device


def linearization_of(model: DynamicsModel) -> Callable[..., Linearized]:
    """Returns a model's own ``linearize``, or one by autograd where it has none."""
    method = getattr(model, "linearize", None)
    return partial(linearize_by_autograd, model) if method is None else method


@explains_arguments
def linearize(
    model: DynamicsModel, states: Array, inputs: Array, covariance: bool = True
) -> Linearized:
    """Linearises a model at K points by its own ``linearize``, else by autograd.

    Args:
        model: Has a method ``linearize``, or only ``predict``.
        states: x (K, n).
        inputs: u (K, m).
        covariance: Whether the covariances at the points are computed.

    >>> import numpy as np
    >>> from gpmpc.models import KnownModel
    >>> model = KnownModel(lambda x, u: 0.9 * x + u, state_dim=1, input_dim=1)
    >>> linearize(model, np.ones((1, 1)), np.zeros((1, 1))).A.round(6).tolist()
    [[[0.9]]]

    See Also:
        ``linearize_by_autograd``; ``gpmpc.propagation.linearize`` for beliefs.
    """
    return linearization_of(model)(states, inputs, covariance)


def linearize_by_autograd(
    model: Any, states: Array, inputs: Array, covariance: bool = True
) -> Linearized:
    """Linearises a model at K points by one evaluation of them and torch autograd.

    It is slower than a closed form, which is logged once for each class.

    Args:
        model: Any that has ``predict``, ``dtype`` and ``device``.
        states: x (K, n).
        inputs: u (K, m).
        covariance: Whether the covariances at the points are computed.

    See Also:
        ``linearize``, which uses a model's own derivatives where it has them.
    """
    _log_slow(type(model).__name__)
    state, input = tensors_for(model, states, inputs)
    belief, A, B = predict_by_autograd(model, state, input)
    V = to_array(belief.covariance) if covariance else None
    return Linearized(to_array(belief.mean), to_array(A), to_array(B), V)


@cache
def _log_slow(name: str) -> None:
    """Logs once that models of a class are linearised by autograd."""
    _log.warning(
        "%s has no linearize() of its own: torch autograd linearises it, "
        "which takes longer",
        name,
    )


def tensors_for(model: Any, *arrays: Array) -> list[Tensor]:
    """Converts arrays to tensors of a model's type on its device.

    Where these are the array's own, tensor and array share their memory.

    Raises:
        DataError: They are no numbers.
    """
    dtype = model.dtype
    device = model.device
    return [_as_tensor(array).to(device, dtype) for array in arrays]


def _as_tensor(values: Any) -> Tensor:
    """Returns numbers as a tensor, in half the time that ``torch.as_tensor`` takes."""
    try:
        return torch.from_numpy(values)
    except (TypeError, ValueError):  # no array, or one that is read backwards
        return torch.from_numpy(read_array("states and inputs", values).copy())


def to_array(tensor: Tensor) -> Array:
    """Converts a tensor to a C-contiguous float64 array."""
    return np.ascontiguousarray(tensor.numpy(force=True), dtype=np.float64)


def batched_jacobian(
    function: Callable[..., tuple[Tensor, ...]],
    arguments: Sequence[Tensor],
    function_in_graph: bool = False,
) -> tuple[tuple[Tensor, ...], list[Tensor]]:
    """Evaluates a function and the Jacobians of its first value.

    By one reverse pass of torch autograd over the batch.

    Args:
        function: Takes the arguments, batch element by batch element; its first value
            is (*batch, k).
        arguments: (*batch, d_i) each.
        function_in_graph: Whether the function has parameters that autograd follows.

    Returns:
        The values, and the Jacobians (*batch, k, d_i). All can be differentiated again
        where an argument or the function requires it.
    """
    in_graph = function_in_graph or any(
        argument.requires_grad for argument in arguments
    )
    differentiable = torch.is_grad_enabled() and in_graph
    with torch.inference_mode(False), torch.enable_grad():
        leaves = []
        for argument in arguments:
            if differentiable and argument.requires_grad:
                leaves.append(argument)
            else:
                leaves.append(argument.detach().clone().requires_grad_())
        values = function(*leaves)
        columns = _gradients(values[0], leaves, create_graph=differentiable)
    jacobians = [column.movedim(0, -2) for column in columns]
    if not differentiable:
        values = tuple(value.detach() for value in values)
    return values, jacobians


def _gradients(
    value: Tensor, leaves: Sequence[Tensor], create_graph: bool
) -> list[Tensor]:
    """Differentiates each entry of a value (*batch, k), summed over the batch.

    Returns:
        The gradients (k, *batch, d_i) by each leaf.
    """
    k = value.shape[-1]
    zeros = [leaf.new_zeros(k, *leaf.shape) for leaf in leaves]
    if not value.requires_grad:  # a constant
        return zeros
    eye = torch.eye(k, dtype=value.dtype, device=value.device)
    directions = eye.reshape(k, *[1] * (value.dim() - 1), k).expand(k, *value.shape)
    gradients = partial(
        torch.autograd.grad,
        value,
        leaves,
        create_graph=create_graph,
        retain_graph=True,
        allow_unused=True,
    )
    try:
        columns = gradients(directions, is_grads_batched=True)
    except RuntimeError:  # torch cannot vectorise the derivative of some operation
        rows = [gradients(direction) for direction in directions]
        columns = [
            None if column[0] is None else torch.stack(column)
            for column in zip(*rows, strict=True)
        ]
    return [
        zero if column is None else column
        for zero, column in zip(zeros, columns, strict=True)
    ]


class FirstOrderExpansion(NamedTuple):
    """A prediction, with the derivatives of its mean."""

    belief: Gaussian  # mean (*batch, k), covariance (*batch, k, k)
    A: Tensor  # by the state (*batch, k, n)
    B: Tensor  # by the input (*batch, k, m)


def predict_with_jacobian(
    model: Any, state: Tensor, input: Tensor
) -> FirstOrderExpansion:
    """Predicts, with the derivatives of the mean.

    By the model's ``linearize`` where torch follows nothing, neither the arguments nor
    the model's tensors; else by its own method of this name, which torch can
    differentiate and transform further, or by autograd.

    Args:
        model: Has ``predict``.
        state: (*batch, n).
        input: (*batch, m).
    """
    arrays = None
    if hasattr(model, "linearize") and not is_in_graph(model):
        arrays = constant_arrays(state, input)
    if arrays is not None:
        check_query(model, state, input)
        return _linearize_batch(model, arrays, state.shape[:-1])
    method = getattr(model, "predict_with_jacobian", None)
    if method is None:
        return predict_by_autograd(model, state, input)
    belief, A, B = method(state, input)
    return FirstOrderExpansion(belief, A, B)


def is_in_graph(model: Any) -> bool:
    """Whether autograd or a function transform follows tensors of a model.

    They are those of GPs, of an affine nominal model and of an effect B, its own or
    those of the model that it is made around. What functions hold is not seen.
    """
    of_gps = getattr(model, "prediction_tensors", None)
    if of_gps is not None:
        return constant_arrays(*of_gps) is None
    nominal = getattr(model, "nominal", None)
    parts = [getattr(model, "B", None)]
    parts += [getattr(nominal, name, None) for name in ("A", "B", "c")]
    tensors = [part for part in parts if isinstance(part, Tensor)]
    inner = getattr(model, "_part", None)
    return constant_arrays(*tensors) is None or (
        isinstance(inner, TensorModel) and is_in_graph(inner)
    )


def _linearize_batch(
    model: Any, arrays: Sequence[np.ndarray], batch: torch.Size
) -> FirstOrderExpansion:
    """Linearises a model at states and inputs of any batch."""
    count = batch.numel()
    points = [
        np.ascontiguousarray(array, dtype=np.float64).reshape(count, array.shape[-1])
        for array in arrays
    ]
    mean, A, B, covariance = [
        tensor.reshape(*batch, *tensor.shape[1:])
        for tensor in tensors_for(model, *model.linearize(*points))
    ]
    return FirstOrderExpansion(Gaussian(mean, covariance), A, B)


def predict_by_autograd(
    model: Any, state: Tensor, input: Tensor
) -> FirstOrderExpansion:
    """Predicts, with the derivatives of the mean, by torch autograd.

    Args:
        model: Any that has ``predict``.
        state: (*batch, n).
        input: (*batch, m).
    """

    def prediction(x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        belief = call("model", model.predict, x, u)
        return belief.mean, belief.covariance

    (mean, covariance), (A, B) = batched_jacobian(
        prediction, (state, input), function_in_graph=is_in_graph(model)
    )
    return FirstOrderExpansion(Gaussian(mean, covariance), A, B)


def check_next_states(model: Any) -> tuple[int, int]:
    """Returns the numbers of states and inputs of a model of next states.

    Raises:
        SettingError: It predicts something else, or is no model.
    """
    if isinstance(model, type) or not hasattr(model, "predict"):
        got = type(model).__name__
        if isinstance(model, type):
            got = f"the class {model.__name__}"
        rule = "must be a DynamicsModel, such as GPPosterior"
        raise SettingError("model", f"{rule}; got {got}")
    if model.output_dim != model.state_dim:
        got = f"{model.state_dim} states and {model.output_dim} outputs"
        raise SettingError("model", f"must predict the next state; got {got}")
    if getattr(model, "predicts", None) == "value":
        rule = "must predict the next state"
        raise SettingError("model", f"{rule}; got GPs with predicts='value'")
    return model.state_dim, model.input_dim


def check_query(model: Any, state: Tensor, input: Tensor) -> None:
    """Checks that a model can predict at a state and an input.

    Raises:
        ShapeError: They are not (*batch, n) and (*batch, m).
        SettingError: They are no tensors, or of another type or device.
    """
    check_tensors(state=state, input=input)
    n = model.state_dim
    m = model.input_dim
    if state.shape[-1:] != (n,) or input.shape != (*state.shape[:-1], m):
        rule = f"the model takes a state (*batch, {n}) and an input (*batch, {m})"
        got = f"{tuple(state.shape)} and {tuple(input.shape)}"
        raise ShapeError(f"{rule}; got {got}")
    for name, value in (("state", state), ("input", input)):
        if value.dtype != model.dtype or value.device != model.device:
            rule = f"must be {model.dtype} on {model.device} like the model"
            got = f"{value.dtype} on {value.device}"
            raise SettingError(name, f"{rule}; got {got}")


def check_destination(device: Any, dtype: Any) -> None:
    """Checks that a model can move to a device and a type; None stays as it is.

    Raises:
        SettingError: torch does not find the device, or the type is neither float32 nor
            float64.
    """
    try:
        torch.empty(0, device=device)
    except (AssertionError, RuntimeError, TypeError) as error:
        reason = str(error).partition("\n")[0]
        rule = "must be one that torch finds here"
        raise SettingError("device", f"{rule}; got {device!r} ({reason})") from error
    if dtype not in (None, torch.float32, torch.float64):
        rule = "must be torch.float32 or torch.float64"
        raise SettingError("dtype", f"{rule}; got {dtype!r}")
