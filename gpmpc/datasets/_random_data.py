"""Records a system under random inputs, from random starts.

Data of any system, without a controller.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.datasets._flights import check_data
from gpmpc.exceptions import (
    DataError,
    SettingError,
    ShapeError,
    check_choice,
    check_number,
)
from gpmpc.gp import Transitions
from gpmpc.systems import System, step
from gpmpc.systems._system import check_system
from gpmpc.trajectories import Trajectory


@explains_arguments
@dataclass(frozen=True)
class RandomData:
    """Transitions under inputs drawn uniformly within the system's limits.

    Raises:
        SettingError: A number out of range, or an unknown word.

    >>> from gpmpc.systems import pendulum
    >>> RandomData(samples=20, episode=5).transitions(pendulum())
    Transitions(20 rows, n=2, m=1)

    See Also:
        ``gpmpc.gp.Transitions`` for data of your own, ``gpmpc.logs.read_log`` for a
        log.
    """

    samples: int = 200  #: how many
    episode: int = 10  #: steps from one start; the next episode starts anew
    hold: int = 1  #: steps for which an input is held
    #: where episodes start: ``"region"``, uniformly in the system's region, or
    #: ``"start"``, where its flights start
    starts: str = "region"
    amplitude: float = 1.0  #: part of the width of the input limits that is used
    #: what the inputs are drawn about: the ``"middle"`` of their limits or the system's
    #: ``"initial_input"``
    around: str = "middle"
    #: standard deviations of what is added to every next state (n,); None for none
    noise: Sequence[float] | None = None
    seed: int = 0  #: of starts, inputs and noise

    note = "Data: our own, under random inputs."

    def __post_init__(self) -> None:
        check_data(self, samples=1, episode=1, hold=1, seed=0)
        check_number("data.amplitude", self.amplitude, above=0)
        check_choice("data.starts", self.starts, ("region", "start"))
        check_choice("data.around", self.around, ("middle", "initial_input"))
        if np.ndim(cast(Any, self.noise)) == 0 and self.noise is not None:
            rule = "must be a list of standard deviations, one for every state"
            raise SettingError("data.noise", f"{rule}; got {self.noise!r}")
        for value in () if self.noise is None else self.noise:
            check_number("data.noise", value, least=0)

    def check(self, system: System, trajectory: Trajectory | None = None) -> None:
        """Raises ``SettingError`` unless the data can be made of a system.

        It needs limits of its inputs, a region to start from, and noise of its size.
        """
        check_system("system", system)
        for name, *limits in zip(
            system.input_names, system.input_lower, system.input_upper, strict=True
        ):
            if not np.isfinite(limits).all():
                raise SettingError(
                    "data",
                    f"random inputs need limits; {name} of {system.name} has none",
                )
        if system.region is None and self.starts == "region" and not system.stateful:
            raise SettingError(
                "data.starts",
                f"{system.name} has no region; take starts=start, or give it one",
            )
        if self.noise is not None and len(self.noise) != len(system.state_names):
            raise ShapeError(
                f"data.noise must have {len(system.state_names)} deviations; "
                f"got {len(self.noise)}"
            )

    def transitions(
        self, system: System, trajectory: Trajectory | None = None, name: str = ""
    ) -> Transitions:
        """Steps the system.

        An episode ends early where it is farther outside the region than the region is
        wide, and where a simulator ends it.

        Raises:
            DataError: Its episodes end at once, over and over.
        """
        self.check(system, trajectory)
        random = np.random.default_rng(self.seed)
        steps: list[_Step] = []
        for _ in range(100 + 2 * self.samples):
            length = min(self.episode, self.samples - len(steps))
            steps += self._episode(system, length, random)
            if len(steps) == self.samples:
                return Transitions(
                    np.array([step.state for step in steps]),
                    np.array([step.input for step in steps]),
                    np.array([step.next_state for step in steps]),
                    system.signals,
                )
        raise DataError(
            f"{system.name}: only {len(steps)} of {self.samples} random steps "
            "stayed near the region"
        )

    def _episode(
        self, system: System, length: int, random: np.random.Generator
    ) -> list["_Step"]:
        """Steps the system from a start, until it ends or leaves the region."""
        state = self._start(system, random)
        input = self._middle_input(system)
        steps: list[_Step] = []
        for k in range(length):
            if k % self.hold == 0:
                input = self._random_input(system, random)
            with np.errstate(over="ignore", invalid="ignore"):
                next_state = step(system, state, input)
            if self.noise is not None:
                next_state = next_state + random.normal(0, 1, len(state)) * self.noise
            if not _is_near_region(system, next_state):
                break
            steps.append(_Step(state=state, input=input, next_state=next_state))
            if getattr(system.dynamics, "ended", False):
                break
            state = next_state
        return steps

    def _start(self, system: System, random: np.random.Generator) -> np.ndarray:
        """Returns the state where an episode starts (n,)."""
        if system.stateful:
            return system.dynamics.reset(int(random.integers(2**31)))
        if self.starts == "start":
            return np.array(system.goal if system.start is None else system.start)
        low, high = system.region
        return random.uniform(low, high)

    def _middle_input(self, system: System) -> np.ndarray:
        """Returns what the inputs are drawn about (m,)."""
        if self.around == "initial_input":
            return np.array(system.initial_input)
        return (np.array(system.input_lower) + np.array(system.input_upper)) / 2

    def _random_input(self, system: System, random: np.random.Generator) -> np.ndarray:
        """Draws an input (m,)."""
        lower = np.array(system.input_lower)
        upper = np.array(system.input_upper)
        half_width = self.amplitude * (upper - lower) / 2
        offset = random.uniform(-half_width, half_width)
        return np.clip(self._middle_input(system) + offset, lower, upper)


class _Step(NamedTuple):
    """A transition, as it is recorded."""

    state: np.ndarray  # (n,)
    input: np.ndarray  # (m,)
    next_state: np.ndarray  # (n,)


def _is_near_region(system: System, state: np.ndarray) -> bool:
    """Whether a state is finite, and at most as far outside as the region is wide."""
    if system.region is None:
        return bool((np.abs(state) <= np.finfo(float).max).all())
    low, high = np.array(system.region)
    centre = (low + high) / 2
    return bool((np.abs(state - centre) <= 1.5 * (high - low)).all())
