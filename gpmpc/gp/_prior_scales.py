"""What a training supposes of columns that never move in its data.

No likelihood depends on the length-scale of a feature that never moved, nor says how
much an output varies that was never seen to. What is left is a prior, and it has to be
modest: away from the data nothing is known. By default it is one unit of the data, as
the length-scales that GPyTorch begins with (0.69) and leaves untouched. Where a column
lies does not count, as it does not for any other (350 K is no scale of a temperature),
nor does a scaling, which has nothing to go by. Longer is not safer: on its way back to
the prior a mean has a slope that nobody has seen, over as much as a length-scale, and a
controller follows it. One who knows the ranges says so.
"""

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.gp._scaling import Scaling

NO_EFFECT = "no_effect"  # in the place of the length-scale of a feature without any
PriorLengthscale = float | Literal["no_effect"]


class PriorScales(NamedTuple):
    """Scales in the units of the data; of columns that move they are not used."""

    #: of features (d,); infinity: the feature is known to have no effect
    lengthscales: NDArray[np.float64]
    #: standard deviations of outputs (k,); None: the search decides, as of any other
    deviations: NDArray[np.float64] | None

    @classmethod
    def of(cls, trainer: Any, d: int, units: NDArray[np.float64]) -> "PriorScales":
        """Those that a trainer's settings ask for, of d features and k outputs.

        ``units`` (k,) are what its ``prior_deviation`` counts in.

        Raises:
            SettingError: ``prior_lengthscale`` is a list of another number of features.
        """
        setting = trainer.prior_lengthscale
        if not _is_list(setting):
            setting = [1.0 if setting is None else setting] * d
        if len(setting) != d:
            raise SettingError(
                "prior_lengthscale",
                f"must be one number, or {d}, one a feature; got {len(setting)}",
            )
        deviation = trainer.prior_deviation
        return cls(
            lengthscales=np.array([math.inf if s == NO_EFFECT else s for s in setting]),
            deviations=None if deviation is None else deviation * units,
        )

    def of_scaled_targets(self, targets: Scaling) -> "PriorScales":
        """The same for targets that are scaled already."""
        if self.deviations is None:
            return self
        return self._replace(deviations=self.deviations / targets.factor.numpy())


def check_prior_scales(trainer: Any) -> None:
    """Raises ``SettingError`` unless settings of columns at rest are right."""
    setting = trainer.prior_lengthscale
    for value in (
        setting if _is_list(setting) else [1.0 if setting is None else setting]
    ):
        if value != NO_EFFECT:
            try:
                check_number("prior_lengthscale", value, above=0)
            except GpmpcError as error:
                raise SettingError(
                    "prior_lengthscale",
                    f"must be numbers above 0, or {NO_EFFECT!r}; got {value!r}",
                ) from error
    if trainer.prior_deviation is not None:
        check_number("prior_deviation", trainer.prior_deviation, above=0)
    check_number("resolution", trainer.resolution, least=0)


def _is_list(setting: Any) -> bool:
    return isinstance(setting, Sequence) and not isinstance(setting, str)
