"""Prior scales of what is constant in the data of a training.

No likelihood depends on the length-scale of a feature that is constant, nor says how
much an output varies that was never seen to. What is left is a prior, and it has to be
modest: away from the data nothing is known. By default it is one unit of the data, as
the length-scales that GPyTorch begins with (0.69) and leaves untouched. Where a column
lies does not count, as it does not for any other (350 K is no scale of a temperature),
nor does a scaling, which has nothing to go by. Longer is not safer: on its way back to
the prior a mean has a slope that nobody has seen, over as much as a length-scale, and a
controller follows it. Who knows the ranges sets ``prior_lengthscale``.
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, TypeGuard, cast

import numpy as np
from numpy.typing import NDArray

from gpmpc.exceptions import GpmpcError, SettingError, check_number
from gpmpc.gp._scaling import Scaling

NO_EFFECT = "no_effect"  # in the place of the length-scale of a feature without any
PriorLengthscale = float | Literal["no_effect"]
#: A trainer's setting: for all features or one each; None for one unit of the data.
PriorLengthscales = PriorLengthscale | Sequence[PriorLengthscale] | None


class PriorScales(NamedTuple):
    """Scales in the units of the data; of columns that move they are not used."""

    #: of features (d,); infinity: the feature is known to have no effect
    lengthscales: NDArray[np.float64]
    #: standard deviations of outputs (k,); None: the search decides, as of any other
    deviations: NDArray[np.float64] | None

    @classmethod
    def of_settings(
        cls,
        prior_lengthscale: PriorLengthscales,
        prior_deviation: float | None,
        units: NDArray[np.float64],
        feature_count: int,
    ) -> "PriorScales":
        """Reads the settings of a trainer.

        Args:
            prior_lengthscale: The setting.
            prior_deviation: The setting.
            units: What ``prior_deviation`` counts in (k,).
            feature_count: d.

        Raises:
            SettingError: ``prior_lengthscale`` is a list of another number of features.
        """
        values = _lengthscale_list(prior_lengthscale)
        if not _is_list(prior_lengthscale):
            values = values * feature_count
        if len(values) != feature_count:
            raise SettingError(
                "prior_lengthscale",
                f"must be one number, or {feature_count}, one a feature; "
                f"got {len(values)}",
            )
        lengthscales = [math.inf if v == NO_EFFECT else float(v) for v in values]
        deviations = None if prior_deviation is None else prior_deviation * units
        return cls(lengthscales=np.array(lengthscales), deviations=deviations)

    def for_scaled_targets(self, scaling: Scaling) -> "PriorScales":
        """Returns the same for targets that are scaled already."""
        if self.deviations is None:
            return self
        return self._replace(deviations=self.deviations / scaling.factor.numpy())


def check_prior_settings(
    prior_lengthscale: PriorLengthscales,
    prior_deviation: float | None,
    resolution: float,
) -> None:
    """Raises ``SettingError`` unless the settings of constant columns are right."""
    for value in _lengthscale_list(prior_lengthscale):
        if isinstance(value, str) and value == NO_EFFECT:
            continue
        try:
            check_number("prior_lengthscale", value, above=0)
        except GpmpcError as error:
            raise SettingError(
                "prior_lengthscale",
                f"must be numbers above 0, or {NO_EFFECT!r}; got {value!r}",
            ) from error
    if prior_deviation is not None:
        check_number("prior_deviation", prior_deviation, above=0)
    check_number("resolution", resolution, least=0)


def _lengthscale_list(setting: PriorLengthscales) -> list[PriorLengthscale]:
    """The setting as a list, of one entry where it is for all features."""
    if setting is None:
        return [1.0]
    if _is_list(setting):
        return list(setting)
    return [cast(PriorLengthscale, setting)]


def _is_list(setting: PriorLengthscales) -> TypeGuard[Sequence[PriorLengthscale]]:
    return isinstance(setting, Sequence) and not isinstance(setting, str)
