"""Problem: a posterior's closed forms exist as compiled loops and as torch expressions; which of them answers a call?

The loops of ``gpmpc.kernels`` are many times faster, on one thread, for float64 numbers in host memory. Torch answers
everything else: other devices and types, and whatever autograd or a function transform follows. The two give the same
numbers; ``evaluation`` forces one of them.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.util import find_spec
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from gpmpc.dynamics import check_query
from gpmpc.exceptions import SettingError

Evaluation = Literal["auto", "compiled", "torch"]

_chosen: ContextVar[Evaluation] = ContextVar("evaluation", default="auto")
_compilable = find_spec("numba") is not None


@contextmanager
def evaluation(choice: Evaluation) -> Iterator[None]:
    """Forces ``"compiled"`` or ``"torch"`` within a ``with`` block; ``"auto"`` leaves the choice to each call.

    Raises:
        SettingError: Another word; within the block, ``"compiled"`` where only torch can answer.
    """
    if choice not in ("auto", "compiled", "torch"):
        raise SettingError("evaluation", f"must be 'auto', 'compiled' or 'torch'; got {choice!r}")
    token = _chosen.set(choice)
    try:
        yield
    finally:
        _chosen.reset(token)


def chosen_evaluation() -> Evaluation:
    """What ``evaluation`` says here."""
    return _chosen.get()


def host_arrays(*tensors: Tensor) -> list[np.ndarray] | None:
    """The tensors as arrays that the compiled loops may answer for; None where torch has to."""
    choice = _chosen.get()
    if choice == "torch":
        return None
    reason = ""
    try:
        arrays = [tensor.numpy() for tensor in tensors]
    except (RuntimeError, TypeError):
        reason = "a tensor is on another device, part of a graph, or inside a function transform"
    else:
        if not _compilable:
            reason = "numba is not installed"
        elif forward_ad._current_level >= 0:
            reason = "forward-mode differentiation is under way"
        elif any(array.dtype != np.float64 for array in arrays):
            reason = "a tensor is not float64"
    if not reason:
        return arrays
    if choice == "compiled":
        raise SettingError("evaluation", f"the compiled loops cannot answer: {reason}")
    return None


def compiled_point(model: Any, function: str, state: Tensor, input: Tensor) -> list[Tensor]:
    """``point_arrays`` of tensors: state (*batch, n), input (*batch, m)."""
    check_query(model, state, input)
    x, u, batch = state.numpy(), input.numpy(), state.shape[:-1]
    if len(batch) > 1:
        x, u = x.reshape(batch.numel(), x.shape[-1]), u.reshape(batch.numel(), u.shape[-1])
    parts = [torch.from_numpy(part) for part in point_arrays(model, function, x, u)]
    return [part.unflatten(0, batch) for part in parts] if len(batch) > 1 else parts


def point_arrays(model: Any, function: str, x: np.ndarray, u: np.ndarray) -> list[np.ndarray]:
    """Mean, (variance,) and the mean's derivatives by state and input of a ``GPPosterior``, in NumPy.

    Args:
        model: The posterior; float64, in host memory.
        function: Of ``gpmpc.kernels``: ``"mean_with_jacobian"`` or ``"point_with_jacobian"``.
        x: State (n,) or (H, n).
        u: Input (m,) or (H, m).
    """
    from gpmpc import kernels  # loads numba

    found = getattr(kernels, function)(model.packed, x, u)
    mean, *others = found[:3] if len(found) == 3 else found[:4]
    mean += model.offset.numpy()
    if model.predicts == "difference":
        mean += x
        diagonal = range(x.shape[-1])
        others[-2][..., diagonal, diagonal] += 1.0
    return [mean, *others]
