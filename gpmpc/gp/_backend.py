"""The choice between compiled loops and torch, in which the closed forms of a posterior both exist.

The loops of ``gpmpc._kernels`` are many times faster, on one thread, for float64 numbers in host memory. Torch
evaluates everything else: other devices and types, and whatever autograd or a function transform follows. The two give
the same numbers; ``backend`` forces one of them.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from gpmpc.exceptions import SettingError, check_choice

_Backend = Literal["auto", "compiled", "torch"]

_chosen: ContextVar[_Backend] = ContextVar("backend", default="auto")


@contextmanager
def backend(choice: _Backend) -> Iterator[None]:
    """Forces ``"compiled"`` or ``"torch"`` within a ``with`` block; ``"auto"`` leaves the choice to each call.

    Raises:
        SettingError: Another word; within the block, ``"compiled"`` where only torch can evaluate.
    """
    check_choice("backend", choice, get_args(_Backend))
    token = _chosen.set(choice)
    try:
        yield
    finally:
        _chosen.reset(token)


def host_arrays(*tensors: Tensor) -> list[np.ndarray] | None:
    """Returns the tensors as arrays for the compiled loops; None where torch has to evaluate."""
    choice = _chosen.get()
    if choice == "torch":
        return None
    reason, arrays = "", []
    try:
        for tensor in tensors:  # in microseconds: a step of control asks several times
            arrays.append(tensor.numpy())
            if forward_ad.unpack_dual(tensor).tangent is not None:
                reason = "forward-mode differentiation is under way"
            elif tensor.dtype is not torch.float64:
                reason = "a tensor is not float64"
    except (RuntimeError, TypeError):
        reason = "a tensor is on another device, part of a graph, or inside a function transform"
    if not reason:
        return arrays
    if choice == "compiled":
        raise SettingError("backend", f"the compiled loops cannot evaluate this: {reason}")
    return None
