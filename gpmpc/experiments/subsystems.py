"""The quadrotor's two subsystems as Cao, Lai and Alam (2017) learn them.

The columns of the rotational one are scaled.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from gpmpc.exceptions import SettingError
from gpmpc.gp import Scaling, identity, min_max
from gpmpc.systems import rotational, translational

SYSTEMS = {"translational": translational(), "rotational": rotational()}
# A column that moves less is at rest; the tolerance of the NMPC solver is 1e-10.
SCALINGS: dict[str, Callable[..., Scaling]] = {
    "translational": identity,
    "rotational": partial(min_max, low=0.1, high=0.9, resolution=1e-9),
}


def check_subsystems(key: str, names: Any) -> tuple[str, ...]:
    """Returns names of subsystems, one or several, as a tuple.

    Raises:
        SettingError: There is none, or an unknown one.
    """
    if isinstance(names, str):
        names = (names,)
    if not isinstance(names, Sequence) or not names:
        raise SettingError(key, "choose at least one")
    for name in names:
        if name not in SYSTEMS:
            raise SettingError(key, f"must be among {', '.join(SYSTEMS)}; got {name!r}")
    return tuple(names)
