"""Problem: a posterior's closed forms exist as compiled loops and as torch expressions; which of them answers a call?

The loops of ``gpmpc.fused`` are many times faster, on one thread, for float64 numbers in host memory. Torch answers
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

from gpmpc.exceptions import SettingError
from gpmpc.gp.dynamics import check_query

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
    """Mean, (variance,) and the mean's derivatives by state and input of a ``GPPosterior``.

    Args:
        model: The posterior.
        function: Of ``gpmpc.fused``: ``"mean_with_jacobian"`` or ``"point_with_jacobian"``.
        state: (*batch, n).
        input: (*batch, m).
    """
    from gpmpc import fused  # loads numba

    check_query(model, state, input)
    batch = state.shape[:-1]
    flat = [v.reshape(batch.numel(), v.shape[-1]).numpy() for v in (state, input)]
    found = getattr(fused, function)(model.packed, *flat)
    parts = [torch.from_numpy(part.reshape(*batch, *part.shape[1:])) for part in found[: min(len(found), 4)]]
    parts[0] += model.offset
    if model.predicts == "difference":
        parts[0] += state
        parts[-2].diagonal(dim1=-2, dim2=-1).add_(1.0)
    return parts
