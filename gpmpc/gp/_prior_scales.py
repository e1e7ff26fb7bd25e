"""What a training supposes of columns that never move in its data.

No likelihood depends on the length-scale of a feature that never moved, nor says how
much an output varies that was never seen to. What is left is a prior, and it has to be
modest: away from the data nothing is known. By default it is one unit of the scaled
column, as the length-scales that GPyTorch begins with (0.69) and leaves untouched; where
the column lies does not count, as it does not for any other (350 K is no scale of a
temperature). One who knows the ranges says so: by the settings, or by a ``Scaling`` whose
factors they are.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc.exceptions import SettingError, check_number
from gpmpc.gp._scaling import Scaling


class PriorScales(NamedTuple):
    """Scales in the units of the data; of columns that move they are not used."""

    #: of features (d,); infinity: the feature is known to have no effect
    lengthscales: NDArray[np.float64]
    #: standard deviations of outputs (k,); None: the search decides, as of any other
    deviations: NDArray[np.float64] | None

    @classmethod
    def of(
        cls,
        trainer: Any,
        features: Scaling,
        targets: Scaling,
        deviations: NDArray[np.float64] | None,
    ) -> "PriorScales":
        """Those that a trainer's settings ask for.

        ``deviations`` (k,) are what its ``prior_deviation`` counts in; None: one unit of
        the scaled targets each.

        Raises:
            SettingError: ``prior_lengthscale`` is a list of another number of features.
        """
        d = len(features.factor)
        lengthscale = trainer.prior_lengthscale
        if lengthscale is None:
            lengthscale = 1.0
        if isinstance(lengthscale, Sequence) and len(lengthscale) != d:
            raise SettingError(
                "prior_lengthscale",
                f"must be one number, or {d}, one a feature; got {len(lengthscale)}",
            )
        unit = targets.factor.numpy() if deviations is None else deviations
        deviation = trainer.prior_deviation
        return cls(
            lengthscales=np.broadcast_to(lengthscale, d) * features.factor.numpy(),
            deviations=None if deviation is None else deviation * unit,
        )

    def of_scaled_targets(self, targets: Scaling) -> "PriorScales":
        """The same for targets that are scaled already."""
        if self.deviations is None:
            return self
        return self._replace(deviations=self.deviations / targets.factor.numpy())


def check_prior_scales(trainer: Any) -> None:
    """Raises ``SettingError`` unless a trainer's settings of columns at rest are right."""
    lengthscale = trainer.prior_lengthscale
    if lengthscale is not None:
        several = isinstance(lengthscale, Sequence)
        for value in lengthscale if several else [lengthscale]:
            if value != math.inf:
                check_number("prior_lengthscale", value, above=0)
    if trainer.prior_deviation is not None:
        check_number("prior_deviation", trainer.prior_deviation, above=0)
    check_number("resolution", trainer.resolution, least=0)
