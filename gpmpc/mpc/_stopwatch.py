"""The clock of a decision: the time of its parts, and its budget."""

from time import perf_counter

from gpmpc.mpc._controller import Timing


class Stopwatch:
    """Sums the wall time of the parts of a decision.

    Args:
        budget: Of all of it [s]; None for no limit.
        seconds_before: What it took before the stopwatch was started [s].
    """

    def __init__(self, budget: float | None = None, seconds_before: float = 0.0):
        self._budget = budget
        self._last = perf_counter() - seconds_before
        self._start = self._last
        self._seconds = {"model": 0.0, "build": 0.0, "solve": 0.0}

    def lap(self, part: str) -> None:
        """Adds the time since the last lap to a part."""
        now = perf_counter()
        self._seconds[part] += now - self._last
        self._last = now

    @property
    def is_late(self) -> bool:
        """Whether the budget is spent."""
        if self._budget is None:
            return False
        return perf_counter() - self._start > self._budget

    @property
    def timing(self) -> Timing:
        """The sums so far."""
        seconds = self._seconds
        return Timing(
            model=seconds["model"], build=seconds["build"], solve=seconds["solve"]
        )
