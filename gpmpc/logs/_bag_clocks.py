"""Chooses between the stamps in the messages of a bag and the times of its log.

Unless the mapping decides, messages have the times of their stamps where all topics are
stamped by one clock, and those of the log otherwise. A topic without stamps has the
log's clock. So topics have time in common whenever the log can have it.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError
from gpmpc.logs._file import run_name
from gpmpc.logs._findings import Finding

SAME_CLOCK = 1.0  # [s] between two clocks that are taken for one
LEAST_OFFSET = 0.02  # [s] from which on two clocks may not be one
_STAMP_FIELDS = [  # seconds and nanoseconds, as ROS 2, ROS 1, Foxglove and protobuf say
    (f"{place}.{seconds}", f"{place}.{nanoseconds}")
    for place in ("header.stamp", "stamp", "timestamp")
    for seconds, nanoseconds in (
        ("sec", "nanosec"),
        ("sec", "nsec"),
        ("secs", "nsecs"),
        ("seconds", "nanos"),
    )
]


class MessageTimes(NamedTuple):
    """The times (K,) [s] of the messages by topic."""

    times: Mapping[str, Array]
    findings: tuple[Finding, ...] = ()


def choose_times(
    path: Path,
    columns: Mapping[str, Mapping[str, Array]],
    logged: Mapping[str, Array],
    stamp: str,
    topic_by_topic: bool,
) -> MessageTimes:
    """Chooses the times of all messages.

    Args:
        path: Of the file.
        columns: Numbers of the messages (K,) by topic and path.
        logged: Times [s] of the log (K,), by topic.
        stamp: "header", "log", or "" for the rule of this file.
        topic_by_topic: Whether each topic is looked at for itself.

    Raises:
        DataError: The mapping asks for stamps, and the messages of a topic have none.
    """
    stamped = {}
    for topic in columns:
        times = _find_stamps(columns[topic])
        if times is not None:
            stamped[topic] = times
    unstamped = [topic for topic in columns if topic not in stamped]
    if stamp == "header" and unstamped:
        raise DataError(
            f"{path}: stamp: header, but the messages of {unstamped[0]} carry no stamps"
        )
    if stamp == "log" or not stamped:
        return MessageTimes(logged)
    times = {**logged, **stamped}
    if stamp == "header" or topic_by_topic:
        return MessageTimes(times)
    reference = unstamped[0] if unstamped else next(iter(stamped))
    offsets = {
        topic: _clock_offset(topic, reference, logged, times) for topic in stamped
    }
    farthest = max(offsets, key=lambda topic: abs(offsets[topic]))
    if abs(offsets[farthest]) <= SAME_CLOCK:
        late = _late_stamps(path, offsets, reference, times)
        return MessageTimes(times, late)
    text = (
        f"the stamps of {farthest} are {offsets[farthest]:.6g} s off the clock of "
        f"{reference}: all times are those of the log (stamp: header | log decides)"
    )
    finding = Finding("times of the log", run_name(path), 1, text)
    return MessageTimes(logged, (finding,))


def _late_stamps(
    path: Path,
    offsets: Mapping[str, float],
    reference: str,
    times: Mapping[str, Array],
) -> tuple[Finding, ...]:
    """Returns the findings of topics whose stamps are off the reference by a row.

    That may be the time that a message takes from its stamp to the log, or clocks of
    two computers that are not synchronised.

    Args:
        path: Of the file.
        offsets: [s] by topic.
        reference: The topic that they are of.
        times: Of the messages [s], by topic.
    """
    findings = []
    for topic, offset in offsets.items():
        step = (
            np.nanmedian(np.abs(np.diff(times[topic]))) if len(times[topic]) > 1 else 0
        )
        if abs(offset) <= max(step, LEAST_OFFSET):
            continue
        side = "behind" if offset < 0 else "ahead of"
        text = (
            f"the stamps of {topic} are {abs(offset):.3g} s {side} the clock of "
            f"{reference}, as the log sees them: are their clocks the same? (stamp: "
            "header | log decides)"
        )
        findings.append(Finding("stamps apart", run_name(path), 1, text))
    return tuple(findings)


def _clock_offset(
    topic: str,
    reference: str,
    logged: Mapping[str, Array],
    times: Mapping[str, Array],
) -> float:
    """Returns by how much a topic's clock is ahead of the reference's [s].

    Both are compared with the clock of the log.
    """
    order = np.argsort(logged[reference])
    reference_delay = (logged[reference] - times[reference])[order]
    finite = np.isfinite(reference_delay)
    if not finite.any():
        return np.inf
    expected_delay = np.interp(
        logged[topic], logged[reference][order][finite], reference_delay[finite]
    )
    delay = logged[topic] - times[topic]
    return float(np.nanmedian(expected_delay - delay))


def _find_stamps(columns: Mapping[str, Array]) -> Array | None:
    """Reads the stamps (K,) [s] in a topic's messages; None where they carry none.

    They carry none where all are equal, such as zero. A single zero is a time: a
    simulated clock begins with it.
    """
    for seconds, nanoseconds in _STAMP_FIELDS:
        if seconds in columns and nanoseconds in columns:
            times = columns[seconds] + columns[nanoseconds] / 1e9
            finite = times[np.isfinite(times)]
            is_set = len(finite) > 0 and (np.ptp(finite) > 0 or finite[0] != 0)
            is_stuck = len(finite) > 1 and np.ptp(finite) == 0
            return times if is_set and not is_stuck else None
    return None
