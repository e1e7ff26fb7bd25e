"""Learns while flying: every step teaches a GP of the change, and a check decides whether it may steer.

A ``LearningController`` plans with the model that was learned before, or with it and its change (``ChangedModel``).
Each step of the flight becomes a point of the change, whether that is used or not; the oldest points, or those that
explain least, make room. Both predict the step before they see it, and

* the change is **used** once its predictions have won: their log densities, summed over a window of steps, exceed those
  of the model alone by a margin;
* it is **no longer used** once they have lost, or where a decision could not be applied;
* a step that neither chance nor the noise of late explains is a **surprise**: the plant is another one. What was seen
  before is forgotten, and the change is used at once: a GP with one point is an estimate of a constant disturbance.

Noise may be larger than the model believes: it is scaled by what successive errors differ by, in the median.
"""

from dataclasses import dataclass, replace
from functools import cache
from time import perf_counter
from typing import Any, Literal

import numpy as np
from scipy.stats import chi2

from gpmpc._dynamics import Array, to_array
from gpmpc.exceptions import DataError, SettingError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.gp import SlidingWindow
from gpmpc.learning._change import ChangedModel
from gpmpc.mpc import Decision, Reference
from gpmpc.mpc._controller import check_method
from gpmpc.mpc.gp_mpc import GPMPC

_FEW, _MANY = 3, 100  # differences of errors that say how large the noise is
_LARGEST = 10.0  # difference of log densities that one step counts for: no outlier decides alone


@dataclass(frozen=True)
class Learned:
    """What a flight has taught so far."""

    model: ChangedModel  #: with the change
    state: Array  #: measured at the last step (n,)
    error: Array  #: of the model alone in the last step, as far as a change reaches it (k,); NaN for unknown
    spread: Array  #: squared differences of successive errors over those expected of the model's noise (w,)
    leads: Array  #: by how much the log density with the change exceeds that without, of the last steps
    active: bool = False  #: whether the change is part of the model that plans
    version: int = 0  #: how often that model has changed

    @property
    def size(self) -> int:
        """Points of the model that plans."""
        return len(self.model.gp) + (len(self.model) if self.active else 0)


@dataclass(frozen=True)
class OnlineLearning:
    """How a change is learned while flying.

    Raises:
        SettingError: A number out of range, or an unknown rule.
    """

    points: int = 40  #: of the change, at most; where there would be more, a fifth goes
    #: which go: ``"oldest"`` or ``"least_informative"``; see ``SlidingWindow``
    remove: Literal["oldest", "least_informative"] = "oldest"
    share: float = 0.1  #: by how much the plant may differ, as a share of what was learned
    memory: float = 5000.0  #: length-scale of time in the kernel [steps]
    window: int = 20  #: steps over which predictions are compared
    margin: float = 20.0  #: lead of the summed log densities from which on the change is used
    surprise: float = 30.0  #: squared error over its expectation, from which on a plant is another one

    def __post_init__(self) -> None:
        SlidingWindow(self.points, self.remove)
        check_number("window", self.window, least=1, whole=True)
        for key in ("share", "memory", "surprise"):
            check_number(key, getattr(self, key), above=0)
        check_number("margin", self.margin, least=0)

    def learn(self, learned: Learned, input: Array, state: Array) -> Learned:
        """Learns from one step: the input that was applied (m,), and the state measured after it (n,)."""
        model, spread = learned.model, learned.spread
        point, error, latent = model.error(learned.state, np.asarray(input, dtype=float), state)
        moved = float(((error - learned.error) ** 2 / model.arrays[2]).mean()) / 2.0
        if np.isfinite(moved):
            spread = np.append(spread, moved)[-_MANY:]
        found: dict[str, Any] = {"state": state, "error": error, "spread": spread}
        if len(spread) < _FEW:
            return replace(learned, model=model.later(1.0), **found)
        noise = model.arrays[2] * noise_ratio(spread, len(error))
        larger, alone = model.with_point(point, error, noise), noise + latent
        missed, variance = larger.last_innovation()
        variance = variance + latent
        lead = log_density(missed, variance) - log_density(error, alone)
        leads = np.append(learned.leads, max(-_LARGEST, min(lead, _LARGEST)))[-self.window :]
        total = float(leads.sum())
        active = total >= 0 if learned.active else total > self.margin
        squares = missed**2 / variance if learned.active else error**2 / alone
        if float(squares.mean()) > self.surprise:
            active, leads = True, leads[:0]
            larger = replace(model).with_point(point, error, noise)
        version = learned.version + (active or learned.active)
        return replace(learned, model=larger.later(1.0), leads=leads, active=active, version=version, **found)


class LearningController:
    """Controls by a model and by what the flight teaches about its change.

    What was learned travels with the decisions (``Decision.learned``): one controller active any number of flights, and
    a flight begins where there is no decision before.

    Args:
        controller: On the model that was learned before.
        learning: How.

    Raises:
        SettingError: The controller cannot change its model.
        UnsupportedModel: No change of its model can be learned.
    """

    def __init__(self, controller: GPMPC, learning: OnlineLearning | None = None):
        check_method("controller", controller, "with_model", "GPMPC(...)")
        self.controller, self.learning = controller, OnlineLearning() if learning is None else learning
        self.problem, self.horizon = controller.problem, controller.horizon
        self.initial_input = controller.initial_input
        known, model = self.learning, controller.prediction.model
        self._model = ChangedModel(model, known.share, known.memory, known.points, known.remove)

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None, parameters: Any = None
    ) -> Decision:
        """Learns from the last step, and decides; see ``Controller.control``."""
        begin = perf_counter()
        learned = self._learned(to_array(belief.mean).copy(), previous)
        controller = self.controller.with_model(learned.model) if learned.active else self.controller
        known = {} if parameters is None else {"parameters": parameters}
        spent = perf_counter() - begin
        decision = controller.control(belief, reference, previous, **known)
        timing = replace(decision.timing, model=decision.timing.model + spent)
        return replace(decision, timing=timing, learned=learned)

    def _learned(self, state: Array, previous: Decision | None) -> Learned:
        before = None if previous is None else previous.learned
        if previous is None or before is None or not np.isfinite(state).all():
            return self._begin(state)
        if not np.array_equal(previous.means[0], before.state):  # the decision between them was not applied
            version = before.version + before.active
            return replace(before, model=before.model.later(1.0), state=state, active=False, version=version)
        try:
            return self.learning.learn(before, previous.input, state)
        except (SettingError, DataError):  # the points contradict each other beyond double precision
            return self._begin(state, before.version + 1)

    def _begin(self, state: Array, version: int = 0) -> Learned:
        unknown = np.full(len(self._model.arrays[2]), np.nan)
        return Learned(self._model, state, unknown, np.empty(0), np.empty(0), version=version)


def noise_ratio(spread: Array, outputs: int) -> float:
    """How much larger the noise is than a model of k outputs believes, 1 at least.

    ``spread`` has half the squared differences of successive errors over the model's noise, mean over the outputs (w,):
    what changes slowly has no part in them, and a jump no weight in their median.
    """
    return max(1.0, float(np.sort(spread)[len(spread) // 2]) * outputs / _median(outputs))


def log_density(error: Array, variance: Array) -> float:
    """Of independent Gaussians, but for a constant."""
    return -0.5 * float((error**2 / variance + np.log(variance)).sum())


@cache
def _median(degrees: int) -> float:
    return float(chi2.median(degrees))
