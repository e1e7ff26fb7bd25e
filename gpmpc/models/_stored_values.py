"""Values in the files of models."""

from collections.abc import Mapping
from typing import Any

from torch import Tensor

from gpmpc.exceptions import DataError


def texts(key: str, values: Any) -> tuple[str, ...]:
    """Returns a list of texts.

    Raises:
        DataError: It is anything else.
    """
    is_list = isinstance(values, list)
    if not is_list or not all(isinstance(value, str) for value in values):
        raise DataError(f"{key} must be a list of texts; got {values!r:.80}")
    return tuple(values)


def tensors_below(name: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Returns the tensors of a part, ``name/key`` by their key."""
    prefix = f"{name}/"
    return {
        key.removeprefix(prefix): tensor
        for key, tensor in tensors.items()
        if key.startswith(prefix)
    }
