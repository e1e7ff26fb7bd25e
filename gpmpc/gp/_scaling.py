"""Affine scalings of data columns, before training and back."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import check_tensors

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Scaling:
    """An affine map of every column, scaled = (value - offset) / factor.

    >>> import torch
    >>> scaling = Scaling(offset=torch.tensor([1.0]), factor=torch.tensor([2.0]))
    >>> scaling.scale(torch.tensor([[5.0]])).tolist()
    [[2.0]]

    See Also:
        ``standardize``, ``centre``, ``min_max`` and ``identity``, which make
        one of data.
    """

    offset: Tensor  #: (d,), in the units of the data
    factor: Tensor  #: (d,), in the units of the data; positive

    def __post_init__(self) -> None:
        check_tensors(offset=self.offset, factor=self.factor)
        if self.offset.shape != self.factor.shape or self.offset.dim() != 1:
            raise ShapeError(
                f"offset and factor must both be (d,); got {tuple(self.offset.shape)} "
                f"and {tuple(self.factor.shape)}"
            )
        if not bool((self.factor > 0).all()):
            raise SettingError(
                "factor",
                f"must be positive in every column; got {self.factor.tolist()}",
            )

    def scale(self, values: Tensor) -> Tensor:
        """Scales values (..., d) in the units of the data."""
        return (values - self.offset) / self.factor

    def restore(self, scaled: Tensor) -> Tensor:
        """Restores values (..., d) in the units of the data from scaled ones."""
        return scaled * self.factor + self.offset


def identity(columns: Tensor, names: Sequence[str] = ()) -> Scaling:
    """Leaves columns (N, d) as they are.

    >>> import torch
    >>> identity(torch.tensor([[1.0], [3.0]])).factor.tolist()
    [1.0]

    See Also:
        ``standardize``; ``centre``.
    """
    return Scaling(
        offset=torch.zeros_like(columns[0]), factor=torch.ones_like(columns[0])
    )


def centre(columns: Tensor, names: Sequence[str] = ()) -> Scaling:
    """Maps columns (N, d) to mean zero and keeps their units.

    >>> import torch
    >>> centre(torch.tensor([[1.0], [3.0]])).offset.tolist()
    [2.0]

    See Also:
        ``standardize``, which scales as well.
    """
    mean = columns[0] + (columns - columns[0]).mean(dim=0)
    return Scaling(offset=mean, factor=torch.ones_like(mean))


@explains_arguments
def standardize(
    columns: Tensor, names: Sequence[str], resolution: float = 0.0
) -> Scaling:
    """Maps columns (N, d) to mean zero and standard deviation one.

    A constant column is mapped to zero. A column whose range is at most ``resolution``,
    in the units of the data, counts as constant; the log names it.

    >>> import torch
    >>> scaling = standardize(torch.tensor([[1.0], [3.0]]), ["x"])
    >>> scaling.scale(torch.tensor([[1.0], [3.0]])).flatten().tolist()
    [-1.0, 1.0]
    """
    constant = _constant(columns, names, resolution)
    deviation = columns.std(dim=0, correction=0)
    # Squares of what moves by less than 1e-154 are zero.
    constant = constant | (deviation == 0.0)
    return Scaling(
        offset=columns.mean(dim=0), factor=torch.where(constant, 1.0, deviation)
    )


def min_max(
    columns: Tensor,
    names: Sequence[str],
    low: float = 0.1,
    high: float = 0.9,
    resolution: float = 0.0,
) -> Scaling:
    """Maps the range of each column (N, d) onto [low, high].

    A constant column, as in ``standardize``, is mapped to the middle: else a solver's
    round-off in a constant channel would be blown up to the full interval.

    Raises:
        SettingError: low is not below high.

    >>> import torch
    >>> scaling = min_max(torch.tensor([[1.0], [3.0]]), ["x"], low=0.0, high=1.0)
    >>> scaling.scale(torch.tensor([[2.0]])).tolist()
    [[0.5]]

    See Also:
        ``standardize``, which outliers move less.
    """
    if not low < high:
        raise SettingError("low, high", f"low must be below high; got {low}, {high}")
    constant = _constant(columns, names, resolution)
    smallest, largest = columns.aminmax(dim=0)
    # A constant column keeps its unit, so that what little it moves stays as little.
    factor = torch.where(constant, 1.0, (largest - smallest) / (high - low))
    middle = (smallest + largest) / 2 - (low + high) / 2
    offset = torch.where(constant, middle, smallest - low * factor)
    return Scaling(offset=offset, factor=factor)


def _constant(columns: Tensor, names: Sequence[str], resolution: float) -> Tensor:
    """Finds the columns (d,) that do not move; a note in the log names them."""
    if columns.dim() != 2 or len(names) != columns.shape[1]:
        raise ShapeError(
            f"columns (N, d) need d names; got {tuple(columns.shape)} and "
            f"{len(names)} names"
        )
    ranges = columns.amax(dim=0) - columns.amin(dim=0)
    constant = ranges <= resolution
    if bool(constant.any()):
        texts = [
            f"{names[i]} (moves by {ranges[i]:.0e})"
            for i in torch.nonzero(constant)[:, 0].tolist()
        ]
        _log.info("constant columns are centred, not scaled: %s", ", ".join(texts))
    return constant
