"""Affine scalings of data columns of very different ranges, before training and back."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import check_tensors

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Scaling:
    """One affine map a column, scaled = (value - offset) / factor."""

    offset: Tensor  #: (d,), in the units of the data
    factor: Tensor  #: (d,), in the units of the data; positive

    def __post_init__(self) -> None:
        check_tensors(offset=self.offset, factor=self.factor)
        if self.offset.shape != self.factor.shape or self.offset.dim() != 1:
            raise ShapeError(
                f"offset and factor must both be (d,); got {tuple(self.offset.shape)} and {tuple(self.factor.shape)}"
            )
        if not bool((self.factor > 0).all()):
            raise SettingError(
                "factor",
                f"must be positive in every column; got {self.factor.tolist()}",
            )

    def scale(self, values: Tensor) -> Tensor:
        """Scaled values (..., d) from values in the units of the data."""
        return (values - self.offset) / self.factor

    def restore(self, scaled: Tensor) -> Tensor:
        """Values (..., d) in the units of the data from scaled values."""
        return scaled * self.factor + self.offset


def identity(columns: Tensor, names: Sequence[str] = ()) -> Scaling:
    """Leaves columns (N, d) as they are."""
    return Scaling(torch.zeros_like(columns[0]), torch.ones_like(columns[0]))


def centre(columns: Tensor, names: Sequence[str] = ()) -> Scaling:
    """Maps columns (N, d) to mean zero and keeps their units."""
    return Scaling(
        columns[0] + (columns - columns[0]).mean(dim=0), torch.ones_like(columns[0])
    )


def standardize(
    columns: Tensor, names: Sequence[str], resolution: float = 0.0
) -> Scaling:
    """Maps columns (N, d) to mean zero and standard deviation one; a constant column to zero.

    A column whose range is at most ``resolution``, in the units of the data, counts as constant; the log names it.
    """
    constant = _constant(columns, names, resolution)
    return Scaling(
        columns.mean(dim=0),
        torch.where(constant, 1.0, columns.std(dim=0, correction=0)),
    )


def min_max(
    columns: Tensor,
    names: Sequence[str],
    low: float = 0.1,
    high: float = 0.9,
    resolution: float = 0.0,
) -> Scaling:
    """Maps the range of each column (N, d) onto [low, high]; a constant column, as in ``standardize``, to the middle.

    Else a solver's round-off in a channel at rest would be blown up to the full interval.

    Raises:
        SettingError: low is not below high.
    """
    if not low < high:
        raise SettingError("low, high", f"low must be below high; got {low}, {high}")
    constant = _constant(columns, names, resolution)
    smallest, largest = columns.aminmax(dim=0)
    # A constant column keeps its unit, so that what little it moves stays as little.
    factor = torch.where(constant, 1.0, (largest - smallest) / (high - low))
    middle = (smallest + largest) / 2 - (low + high) / 2
    return Scaling(torch.where(constant, middle, smallest - low * factor), factor)


def _constant(columns: Tensor, names: Sequence[str], resolution: float) -> Tensor:
    """Which columns (d,) do not move; a note in the log names them."""
    if columns.dim() != 2 or len(names) != columns.shape[1]:
        raise ShapeError(
            f"columns (N, d) need d names; got {tuple(columns.shape)} and {len(names)} names"
        )
    moved = columns.amax(dim=0) - columns.amin(dim=0)
    if bool((moved <= resolution).any()):
        which = ", ".join(
            f"{n} (moves by {m:.0e})"
            for n, m in zip(names, moved, strict=True)
            if m <= resolution
        )
        _log.info("constant columns are centred, not scaled: %s", which)
    return moved <= resolution
