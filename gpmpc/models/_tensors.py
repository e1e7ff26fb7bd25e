"""Types and devices of models that are made of tensors and other models."""

from dataclasses import fields
from typing import Any

import torch
from torch import Tensor

from gpmpc._dynamics import check_destination
from gpmpc.exceptions import SettingError, UnsupportedModel
from gpmpc.models._nominal import Affine


def move(model: Any, device: Any = None, dtype: torch.dtype | None = None) -> Any:
    """Copies a model to another device or type; functions are taken as they are.

    Raises:
        UnsupportedModel: A part is a model that exists in float64 on the host alone.
    """
    check_destination(device, dtype)
    values = {field.name: getattr(model, field.name) for field in fields(model)}
    for name, value in values.items():
        if isinstance(value, Tensor) or hasattr(value, "state_dim"):
            if not hasattr(value, "to"):
                kind = type(value).__name__
                raise UnsupportedModel(f"{kind} has no to(): it cannot be moved")
            values[name] = value.to(device=device, dtype=dtype)
        elif isinstance(value, Affine):
            values[name] = move(value, device, dtype)
    return type(model)(**values)


def check_like(name: str, part: Any, whole: Any, owner: str = "the model") -> None:
    """Raises ``SettingError`` unless a part has the type and device of the whole.

    Args:
        name: Of the part, for the message.
        part: A tensor, or a model.
        whole: Likewise.
        owner: What the whole is, for the message.
    """
    if (part.dtype, part.device) != (whole.dtype, whole.device):
        rule = f"must be {whole.dtype} on {whole.device} like {owner}"
        raise SettingError(name, f"{rule}; got {part.dtype} on {part.device}")
