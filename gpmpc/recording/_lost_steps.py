"""Finds which steps of a recording are lost, repeated or in another order.

How many there were is counted by three: the index that closes a file, the metadata
``end`` of the recorder, and the sequence numbers of the messages. Which is believed:

    a damaged file with an index   the index, which has a checksum of its own
    a whole file                   the larger of index and end: what rewrites a file
                                   makes a new index, and keeps the end
    one that was recovered         the numbering, where it is larger still: index and
                                   end may be of what was left
    without index and end          the numbering, of the steps up to the last one read
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from gpmpc.recording._content import FileContent
from gpmpc.recording._flaws import (
    DAMAGE_KINDS,
    LOST_STEPS,
    WRONG_COUNT,
    WRONG_ORDER,
    Flaw,
)
from gpmpc.recording._schema import RECOVERY_METADATA, STEP

_MOST_SPANS = 3  # of lost steps that are named


class _Count(NamedTuple):
    """The number of steps that were recorded, as far as it is known."""

    number: int
    text: str


def step_flaws(
    content: FileContent, steps: Sequence[Any], flaws: Sequence[Flaw]
) -> list[Flaw]:
    """Says which steps are lost, repeated or in another order, and where.

    Args:
        content: Of the file.
        steps: Messages that were read.
        flaws: Of the file and its metadata.
    """
    sequence = np.array([message.sequence for message in content.messages[STEP]])
    is_numbered = bool(sequence.any())  # not every program numbers its messages
    is_ordered = is_numbered and bool((np.diff(sequence) > 0).all())
    # Without other flaws the order is a rewriting program's choice, and no damage.
    if flaws and is_numbered and not is_ordered:
        text = "its steps do not stand in the order in which they were recorded"
        return [Flaw(WRONG_ORDER, 1, text), *_count_flaws(content, len(steps), "")]
    where = _lost_spans(sequence, steps) if is_ordered else ""
    return _count_flaws(content, len(steps), where)


def _count_flaws(content: FileContent, present: int, where: str) -> list[Flaw]:
    """Compares the number of steps with what end, index and numbering of a file say."""
    by_index = _steps_by_index(content)
    by_end = _steps_by_end(content)
    flaws = []
    if by_index is not None and by_end is not None and by_end < by_index:
        text = f"its end counts {by_end} steps, its index {by_index}"
        flaws.append(Flaw(WRONG_COUNT, 1, text))
    recorded = _recorded_steps(content, by_index, by_end)
    if present > recorded.number > 0:
        text = f"{recorded.number} steps were recorded by its end; there are {present}"
        flaws.append(Flaw(WRONG_COUNT, present - recorded.number, text))
    if present < recorded.number:
        missing = recorded.number - present
        text = f"{missing} of {recorded.text} steps are lost"
        if where:
            text += f": {where}"
        flaws.append(Flaw(LOST_STEPS, missing, text))
    return flaws


def _recorded_steps(
    content: FileContent, by_index: int | None, by_end: int | None
) -> _Count:
    """Chooses between the counts of index, end and numbering: see the module's text."""
    is_damaged = any(flaw.kind in DAMAGE_KINDS for flaw in content.flaws)
    if is_damaged and by_index is not None:
        by_end = None
    counts = [count for count in (by_index, by_end) if count is not None]
    was_recovered = RECOVERY_METADATA in content.metadata
    numbered = _numbered_steps(content)
    if counts and not (was_recovered and numbered > max(counts)):
        return _Count(max(counts), str(max(counts)))
    # Those behind the last that was read are not known.
    return _Count(numbered, f"at least {numbered}")


def _steps_by_end(content: FileContent) -> int | None:
    """Returns how many steps the end of the recording counts."""
    stated = content.metadata.get("end", {}).get("steps", "")
    return int(stated) if stated.isdecimal() and len(stated) < 10 else None


def _steps_by_index(content: FileContent) -> int | None:
    """Returns how many steps the index of the file counts."""
    if content.statistics is None:
        return None
    by_channel = content.statistics.channel_message_counts
    counts = [
        by_channel[number]
        for number, channel in content.channels.items()
        if channel.topic == STEP and number in by_channel
    ]
    return sum(counts) if counts else None


def _numbered_steps(content: FileContent) -> int:
    """Counts the steps up to the last that was read, by their numbering."""
    sequence = [message.sequence for message in content.messages[STEP]]
    if not any(sequence):
        return len(sequence)
    # The first number is 1, or 0 in older files.
    return max(sequence) + (1 if min(sequence) == 0 else 0)


def _lost_spans(sequence: np.ndarray, steps: Sequence[Any]) -> str:
    """Names the steps between which some are lost, by their numbers."""
    spans = []
    if sequence[0] > 1:
        spans.append(f"before step {steps[0].k}")
    gaps = np.flatnonzero(np.diff(sequence) > 1)
    for row in gaps[:_MOST_SPANS]:
        spans.append(f"between steps {steps[row].k} and {steps[row + 1].k}")
    if len(gaps) > _MOST_SPANS:
        spans.append(f"and at {len(gaps) - _MOST_SPANS} other places")
    return ", ".join(spans) or f"after step {steps[-1].k}"
