"""Problem: all controllers and propagations of the package, under the names by which a user chooses them.

What a contender is called is what is typed after ``gpmpc run``; the controller is made from these words alone, so that
a point in the figure of quality over time leads to a setting.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from gpmpc.bench.quadrotor import HOVER, OUTER, problem
from gpmpc.exceptions import SettingError, check_number
from gpmpc.gp import GPPosterior
from gpmpc.mpc.controller import Controller
from gpmpc.mpc.convex_mpc import ConvexMPC
from gpmpc.mpc.lqr import LQR
from gpmpc.mpc.nmpc import NMPC
from gpmpc.mpc.nonlinear_mpc import NonlinearGPMPC
from gpmpc.mpc.state_form import StateFormMPC
from gpmpc.propagation import Linearization, MeanEquivalence, MomentMatching, Unscented

HORIZONS = (1, 5, 10, 20)
PROPAGATIONS = {
    "mean_equivalence": MeanEquivalence(),
    "linearization": Linearization(),
    "moment_matching": MomentMatching(),
    "unscented": Unscented(),
}
CONTROLLERS = {  # by their names in conf/controller: class, propagation, and what else is set there
    "convex": (ConvexMPC, "linearization", {}),
    "paper": (ConvexMPC, "moment_matching", {"form": "increment", "covariance": "full"}),
    "state_form": (StateFormMPC, "linearization", {}),
    "nonlinear": (NonlinearGPMPC, "moment_matching", {}),
    "lqr": (LQR, None, {}),
    "nmpc": (NMPC, None, {}),
}


class Family(NamedTuple):
    """One choice of settings, at many horizons.

    Attributes:
        name: Kind of controller, for the reader.
        words: What chooses it.
        longest: The longest horizon that is worth the time.
    """

    name: str
    words: str
    longest: float = math.inf


TRUTH = Family("NMPC, true model", "controller=nmpc")
INCREMENTS, DEVIATIONS, STATES = "increments (paper)", "deviations", "state form, Clarabel"
MEAN, ZERO_ORDER = "trajectory, mean only", "trajectory, zero order"
SPREAD, CONVERGED = "trajectory, diagonal or full", "trajectory, converged"
NONLINEAR = "nonlinear GP-MPC"
CONVEX, FULL, DIAGONAL = "controller=convex", "controller.covariance=full", "controller.covariance=diagonal"
NONE, EXACT, POINTS = "controller.covariance=none", "propagation=moment_matching", "propagation=unscented"
MORE = "controller.iterations=100 controller.tolerance=1e-6"
FIRST_ORDER, SLSQP = "propagation=linearization", "controller.optimizer=slsqp"
FAMILIES = (
    TRUTH,
    Family("LQR", "controller=lqr"),
    Family(INCREMENTS, "controller=paper"),
    Family(INCREMENTS, f"controller=paper {DIAGONAL}"),
    Family(INCREMENTS, f"controller=paper {NONE}"),
    Family(DEVIATIONS, f"{CONVEX} controller.form=deviation"),
    Family(DEVIATIONS, f"{CONVEX} controller.form=deviation {FULL} {EXACT}"),
    Family(MEAN, f"{CONVEX} {NONE}"),
    Family(ZERO_ORDER, CONVEX),
    Family(ZERO_ORDER, f"{CONVEX} propagation=mean_equivalence"),
    Family(ZERO_ORDER, f"{CONVEX} {EXACT}"),
    Family(ZERO_ORDER, f"{CONVEX} {POINTS}"),
    Family(SPREAD, f"{CONVEX} {DIAGONAL}"),
    Family(SPREAD, f"{CONVEX} {DIAGONAL} {EXACT}"),
    Family(SPREAD, f"{CONVEX} {FULL}"),
    Family(SPREAD, f"{CONVEX} {FULL} {EXACT}"),
    Family(SPREAD, f"{CONVEX} {FULL} {POINTS}"),
    Family(CONVERGED, f"{CONVEX} {NONE} {MORE}"),
    Family(CONVERGED, f"{CONVEX} {MORE}"),
    Family(CONVERGED, f"{CONVEX} {FULL} {EXACT} {MORE}", longest=10),
    Family(STATES, "controller=state_form"),
    Family(NONLINEAR, f"controller=nonlinear {FIRST_ORDER}"),
    Family(NONLINEAR, "controller=nonlinear"),
    Family(NONLINEAR, f"controller=nonlinear {FIRST_ORDER} {SLSQP}", longest=10),
    Family(NONLINEAR, f"controller=nonlinear {SLSQP}", longest=10),
)


@dataclass(frozen=True)
class Contender:
    """A controller with its settings.

    Attributes:
        family: Kind of controller, for the reader.
        words: What is typed after ``gpmpc run`` to choose it, the horizon apart.
        horizon: H.
    """

    family: str
    words: str
    horizon: int

    def controller(self, model: GPPosterior) -> Controller:
        """The controller that the words mean, on a learned model, or for ``nmpc`` on the plant itself.

        Raises:
            SettingError: Words that mean none.
        """
        chosen = dict(word.split("=", 1) for word in self.words.split())
        name = chosen.pop("controller", None)
        if name not in CONTROLLERS:
            raise SettingError("controller", f"must be one of {', '.join(CONTROLLERS)}; got {name!r}")
        make, propagation, own = CONTROLLERS[name]
        propagation = chosen.pop("propagation", propagation)
        own = own | {key.removeprefix("controller."): _value(text) for key, text in chosen.items()}
        parts: list[Any] = [OUTER if make is NMPC else model]
        if propagation is not None:
            parts.append(PROPAGATIONS[propagation])
        return make(*parts, problem(), self.horizon, HOVER, **own)


def contenders(horizons: Sequence[int] = HORIZONS) -> list[Contender]:
    """Every controller and propagation of the package, at every horizon that is worth its time.

    Raises:
        SettingError: No horizon, or one that is none.
    """
    if not isinstance(horizons, list | tuple) or not horizons:
        raise SettingError("horizons", f"must be a list with something in it; got {horizons!r}")
    for horizon in horizons:
        check_number("horizons", horizon, least=1, whole=True)
    return [
        Contender(family.name, family.words, horizon)
        for family in FAMILIES
        for horizon in sorted(set(horizons))
        if horizon <= family.longest
    ]


def _value(text: str) -> str | int | float:
    """A setting's value as YAML would read it."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
