"""The choice between compiled loops and torch for the closed forms of a posterior.

The loops of ``gpmpc._kernels`` are many times faster, on one thread, for float64
numbers in host memory. Torch evaluates everything else: other devices and types, and
whatever autograd or a function transform follows. The two give the same numbers.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Literal, get_args

import torch
from torch import Tensor

from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError, check_choice
from gpmpc.gaussian import constant_arrays

_Backend = Literal["auto", "compiled", "torch"]

_chosen: ContextVar[_Backend] = ContextVar("backend", default="auto")


@contextmanager
def backend(choice: _Backend) -> Iterator[None]:
    """Forces ``"compiled"`` or ``"torch"`` within a ``with`` block.

    ``"auto"`` leaves the choice to each call. It concerns what compiled loops are made
    for: ``linearize`` and ``rollout`` of models of GPs, ``differentiate``, and moment
    matching. Single predictions, sampling and models without such loops are torch's
    under any choice. Threads that are started in the block begin with ``"auto"``.

    Raises:
        SettingError: Another word; within the block, ``"compiled"`` where there is such
            a loop and only torch can evaluate the numbers.

    See Also:
        ``gpmpc.mpc.GPMPC``, whose decisions are compiled by default.
    """
    check_choice("backend", choice, get_args(_Backend))
    token = _chosen.set(choice)
    try:
        yield
    finally:
        _chosen.reset(token)


def host_arrays(*tensors: Tensor, gps_on_host: bool) -> list[Array] | None:
    """Returns the tensors as arrays for the compiled loops; None for torch.

    Args:
        tensors: What GPs are evaluated at.
        gps_on_host: Whether the GPs are, ``GPPosterior.on_host``.

    Raises:
        SettingError: The backend is ``"compiled"``, and only torch can evaluate.
    """
    if _chosen.get() == "torch":
        return None
    arrays = constant_arrays(*tensors)
    on_host = arrays is not None and all(
        tensor.dtype is torch.float64 for tensor in tensors
    )
    return arrays if check_and_choose_compiled(on_host and gps_on_host) else None


def check_and_choose_compiled(on_host: bool) -> bool:
    """Chooses: whether the compiled loops evaluate, and not torch.

    Args:
        on_host: Whether all numbers are float64 in host memory, and constants.

    Raises:
        SettingError: The backend is ``"compiled"``, and only torch can evaluate.
    """
    choice = _chosen.get()
    if choice == "compiled" and not on_host:
        raise SettingError(
            "backend",
            "the compiled loops take float64 in host memory that is no part of a graph "
            "or a function transform",
        )
    return on_host and choice != "torch"
