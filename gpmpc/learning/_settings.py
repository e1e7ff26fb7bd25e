"""The settings of online learning."""

from dataclasses import dataclass
from typing import Literal

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gp import SlidingWindow


@explains_arguments
@dataclass(frozen=True)
class OnlineLearning:
    """How a change of the plant is learned while flying.

    Raises:
        SettingError: A number is out of range, or a rule unknown.
    """

    #: largest number of points of the change; a fifth of them goes where there would be
    #: more
    points: int = 40
    #: which points go: ``"oldest"`` or ``"least_informative"``; see ``SlidingWindow``
    remove: Literal["oldest", "least_informative"] = "oldest"
    #: by how much the plant may differ, as a share of what was learned
    share: float = 0.1
    memory: float = 5000.0  #: length-scale of time in the kernel [steps]
    window: int = 20  #: steps over which predictions are compared
    #: lead of the summed log densities from which on the change is used
    margin: float = 20.0
    #: squared error of a sensor over its noise variance, at which it may as well be
    #: wrong as right
    surprise: float = 24.0

    def __post_init__(self) -> None:
        SlidingWindow(self.points, self.remove)  # checks both
        check_number("window", self.window, least=1, whole=True)
        for key in ("share", "memory", "surprise"):
            check_number(key, getattr(self, key), above=0)
        if self.share > 1:
            raise SettingError("share", f"must be at most 1; got {self.share}")
        check_number("margin", self.margin, least=0)
