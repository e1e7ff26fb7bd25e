"""Records a system under random inputs, from random starts.

Data of any system, without a controller.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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
from gpmpc.trajectories import Trajectory


@dataclass(frozen=True)
class RandomData:
    """Transitions under inputs drawn uniformly within the system's limits.

    Raises:
        SettingError: A number out of range, or an unknown word.
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
        for value in self.noise or ():
            check_number("data.noise", value, least=0)

    def check(self, system: System, trajectory: Trajectory | None = None) -> None:
        """Raises ``SettingError`` unless the data can be made of a system.

        It needs limits of its inputs, a region to start from, and noise of its size.
        """
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
        lower = np.array(system.input_lower)
        upper = np.array(system.input_upper)
        middle = (
            (lower + upper) / 2
            if self.around == "middle"
            else np.array(system.initial_input)
        )
        half = self.amplitude * (upper - lower) / 2
        centre = 0.0
        reach = np.finfo(float).max
        if system.region is not None:
            low, high = np.array(system.region)
            centre = (low + high) / 2
            reach = 1.5 * (high - low)
        rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        for _ in range(100 + 2 * self.samples):
            state = self._start(system, random)
            input = middle
            for k in range(min(self.episode, self.samples - len(rows))):
                if k % self.hold == 0:
                    input = np.clip(middle + random.uniform(-half, half), lower, upper)
                with np.errstate(over="ignore", invalid="ignore"):
                    after = step(system, state, input)
                after = (
                    after
                    if self.noise is None
                    else after + random.normal(0, 1, len(after)) * self.noise
                )
                if not (np.abs(after - centre) <= reach).all():
                    break
                rows.append((state, input, after))
                if getattr(system.dynamics, "ended", False):
                    break
                state = after
            if len(rows) == self.samples:
                states, inputs, after = map(np.array, zip(*rows, strict=True))
                return Transitions(states, inputs, after, system.signals)
        raise DataError(
            f"{system.name}: only {len(rows)} of {self.samples} random steps "
            "stayed near the region"
        )

    def _start(self, system: System, random: np.random.Generator) -> np.ndarray:
        if system.stateful:
            return system.dynamics.reset(int(random.integers(2**31)))
        if self.starts == "start":
            return np.array(system.goal if system.start is None else system.start)
        return random.uniform(*system.region)
