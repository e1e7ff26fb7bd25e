"""Checks of the tensors that GPs are made of."""

from typing import Literal

import torch
from torch import Tensor

from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_choice,
    check_number,
)
from gpmpc.gaussian import check_tensors

Predicts = Literal["next_state", "difference", "value"]
PREDICTS = ("next_state", "difference", "value")

_POSITIVE = ("lengthscales", "signal_variance", "noise_variance", "observation_noise")


def check_gp_tensors(
    features: Tensor,
    targets: Tensor,
    input_dim: int,
    predicts: str,
    dtype: torch.dtype = torch.float64,
    **parameters: Tensor,
) -> None:
    """Raises unless data, and parameters of GPs if there are, belong together.

    ``GPPosterior.from_hyperparameters`` has the rules.

    Args:
        features: x~ = (x, u) (N, d).
        targets: (N, k).
        input_dim: m.
        predicts: What the targets mean.
        dtype: That all must have.
        parameters: Further fields of a ``GPPosterior``.
    """
    tensors = {"features": features, "targets": targets, **parameters}
    check_tensors(**tensors)
    two_dimensional = features.dim() == 2 and targets.dim() == 2
    if not two_dimensional or not len(features) or not targets.shape[1]:
        raise ShapeError(
            f"features (N, d) and targets (N, k) need two dimensions, a column "
            f"and a row; got {tuple(features.shape)} and {tuple(targets.shape)}"
        )
    size, d = features.shape
    k = targets.shape[1]
    shapes: dict[str, tuple[int, ...]] = {
        "features": (size, d),
        "targets": (size, k),
        "lengthscales": (k, d),
        "cholesky": (k, size, size),
        "weights": (k, size),
    }
    for name, value in tensors.items():
        shape = shapes.get(name, (k,))
        if tuple(value.shape) != shape:
            raise ShapeError(
                f"{name} must have shape {shape}; got {tuple(value.shape)}"
            )
        if value.dtype != dtype:
            type_name = str(dtype).removeprefix("torch.")
            raise SettingError(
                name,
                f"must be {type_name} (convert after: posterior.to(dtype=...)); "
                f"got {value.dtype}",
            )
        if value.device != features.device:
            raise SettingError(
                name,
                f"must be on the device of features, {features.device}; "
                f"got {value.device}",
            )
        _check_finite(name, value)
    check_columns("features", d, k, input_dim, predicts)
    for name in _POSITIVE:
        if name in tensors and not bool((tensors[name] > 0).all()):
            raise SettingError(name, f"must be positive; got {tensors[name].tolist()}")


def check_on_host(**tensors: Tensor) -> None:
    """Raises ``SettingError`` of tensors that training cannot read where they are."""
    for name, value in tensors.items():
        if value.device.type != "cpu":
            rule = f"must be in host memory for training ({name}.cpu())"
            raise SettingError(name, f"{rule}; got {value.device}")


def _check_finite(name: str, value: Tensor) -> None:
    """Raises ``DataError`` unless all entries are finite."""
    # A factor (k, N, N) is looked at output by output: no second copy is made.
    blocks = value if value.dim() == 3 else [value]
    for block in blocks:
        finite = torch.isfinite(block)
        if not bool(finite.all()):
            first = float(block[~finite][0])
            raise DataError(f"{name} must be finite; got {first}")


def check_columns(name: str, d: int, k: int, input_dim: int, predicts: str) -> None:
    """Raises unless d columns are states and controls of k GPs.

    Args:
        name: What the columns are called.
        d: Number of columns.
        k: Number of GPs.
        input_dim: Number of controls, m.
        predicts: What the GPs predict: d = k + m unless values, which may depend on
            controls alone.
    """
    check_choice("predicts", predicts, PREDICTS)
    check_number("input_dim", input_dim, least=0, whole=True)
    got = f"{input_dim} controls; got {d} columns and {k} outputs"
    if predicts != "value" and d != k + input_dim:
        rule = "must have n + m columns, one state an output and"
        raise ShapeError(f"{name} {rule} {got}")
    if not max(input_dim, 1) <= d:
        raise ShapeError(f"{name} must have n + m columns, one at least, and {got}")
