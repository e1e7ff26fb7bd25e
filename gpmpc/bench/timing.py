"""Problem: how long calls take beside one another, on a machine that others use too.

Contenders take turns, so that a slow minute of the machine slows all of them. What is taken is the processor time of
the calling thread, not the clock on the wall; what it costs to ask for it is subtracted. A call is one sample: the
distribution is that of single calls, as a control loop meets them. Every library has to be told to use one thread
(``gpmpc.bench.machine.one_thread``): what other threads do is not counted.

``hot`` calls find their data in the caches, as in a benchmark's loop; ``flushed`` ones find them evicted by a walk
through a large buffer, as after other work between two control steps.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc.exceptions import check_number

EVICTING = 64 * 2**20  # bytes walked through before a flushed call: more than any core's own caches
WARM_UP = 2  # calls that are not counted: what is compiled, loaded or allocated once


@dataclass(frozen=True)
class Times:
    """Processor times of single calls.

    Attributes:
        seconds: In the order of the calls (S,) [s].
    """

    seconds: np.ndarray

    @property
    def median(self) -> float:
        """[s]."""
        return float(np.median(self.seconds))

    def quantile(self, share: float) -> float:
        """The time that ``share`` of the calls stay below [s]."""
        return float(np.quantile(self.seconds, share))

    def over(self, reference: "Times") -> float:
        """Median ratio to a contender that took turns with this one, call by call."""
        calls = min(len(self.seconds), len(reference.seconds))
        return float(np.median(self.seconds[:calls] / reference.seconds[:calls]))

    def summary(self) -> dict[str, float | int]:
        """Median, 95 and 99 % quantiles and maximum in milliseconds, and the number of calls."""
        values = {"median": self.median, "p95": self.quantile(0.95), "p99": self.quantile(0.99)}
        values["max"] = float(self.seconds.max())
        return {name: 1e3 * value for name, value in values.items()} | {"samples": len(self.seconds)}


def take_turns(
    contenders: Mapping[str, Callable[[], Any]],
    seconds: float,
    least: int = 5,
    most: int = 1000,
    flushed: bool = False,
) -> dict[str, Times]:
    """Calls the contenders in turns and times every call.

    Args:
        contenders: What is called, by name; whoever is given a sequence of tasks advances by one with every call.
        seconds: Processor time all of them may take together, the flushing apart [s].
        least: Rounds at least, whatever the time.
        most: Rounds at most.
        flushed: Whether the caches are emptied before every call.

    Raises:
        SettingError: Fewer than one round, or no time.
    """
    check_number("seconds", seconds, above=0)
    check_number("least", least, least=1, whole=True)
    buffer = np.zeros(EVICTING // 8 if flushed else 0)
    asking = _price_of_asking()
    for call in contenders.values():
        for _ in range(WARM_UP):
            call()
    taken: dict[str, list[float]] = {name: [] for name in contenders}
    spent = 0.0
    for count in range(max(least, most)):
        if count >= least and spent >= seconds:
            break
        for name, call in contenders.items():
            if flushed:
                buffer += 1.0
            began = time.thread_time_ns()
            call()
            took = max(time.thread_time_ns() - began - asking, 0) * 1e-9
            taken[name].append(took)
            spent += took
    return {name: Times(np.array(values)) for name, values in taken.items()}


def _price_of_asking() -> int:
    """What two questions for the time take, without anything in between [ns]."""
    differences = []
    for _ in range(2000):
        began = time.thread_time_ns()
        differences.append(time.thread_time_ns() - began)
    return int(np.median(differences))
