"""Decodes the messages of a run to arrays; the counterpart of ``_encoding``.

A message whose checksum is right may come from another program, so the sizes of its
arrays are checked.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from google.protobuf.message import DecodeError
from mcap.records import Message

from gpmpc._bounds import memory_limit
from gpmpc.exceptions import RecordingError, SettingError
from gpmpc.recording._content import FileContent, Names
from gpmpc.recording._problems import RecordedProblem
from gpmpc.recording._schema import (
    LEVELS,
    PLAN,
    QP,
    STEP,
    TOPICS,
    descriptor,
    message_classes,
)
from gpmpc.status import Status

Array = np.ndarray
STATUSES = tuple(Status)
_Decoded = TypeVar("_Decoded")


class DecodedMessages(NamedTuple):
    """The messages of a run; those of protobuf have the fields of ``_schema.PROTO``."""

    steps: list[Any]
    plans: list[Any]
    problems: dict[int, RecordedProblem]  # by k


class PlanArrays(NamedTuple):
    """The plans of K steps; NaN where there is none, or beyond a shorter one."""

    inputs: Array  # (K, H, m)
    means: Array  # (K, H + 1, n)
    covariances: Array  # (K, H + 1, n, n)


def decode_messages(path: Path, content: FileContent, names: Names) -> DecodedMessages:
    """Decodes the messages of a file.

    Raises:
        RecordingError: One cannot be decoded, or its parts do not belong together.
    """
    n = len(names.states)
    try:
        classes = message_classes(
            descriptor(names.states, names.inputs, arrays_as_bytes=True)
        )
    except SettingError as error:
        raise RecordingError(f"{path}: its metadata are damaged; {error}") from error

    def decode(topic: str, check: Callable[[Any], _Decoded]) -> list[_Decoded]:
        parse = classes[TOPICS[topic]].FromString
        return [
            _decode(path, topic, record, parse, check)
            for record in content.messages[topic]
        ]

    return DecodedMessages(
        steps=decode(STEP, lambda message: _checked_step(message, n)),
        plans=decode(PLAN, lambda message: _checked_plan(message, n)),
        problems=dict(decode(QP, lambda message: (message.k, _read_problem(message)))),
    )


def _decode(
    path: Path,
    topic: str,
    record: Message,
    parse: Callable[[bytes], Any],
    check: Callable[[Any], _Decoded],
) -> _Decoded:
    """Parses and checks the message of a record."""
    try:
        return check(parse(record.data))
    except (DecodeError, ValueError) as error:
        raise RecordingError(
            f"{path}: message {record.sequence} of {topic} is damaged: {error}"
        ) from error


def _checked_step(message: Any, n: int) -> Any:
    """Returns the message of a step with n states; ``ValueError`` if it is none."""
    _unpack(message, "belief_covariance", n, n)
    if not 0 <= message.status < len(STATUSES):
        raise ValueError(f"status {message.status} is unknown")
    if message.judgement not in LEVELS:
        raise ValueError(f"judgement {message.judgement!r:.40} is unknown")
    return message


def _checked_plan(message: Any, n: int) -> Any:
    """Returns the message of a plan with n states; ``ValueError`` if it is none."""
    _unpack(message, "covariances", len(message.stages), n, n)
    if not message.stages:
        raise ValueError("it has no stage")
    return message


def _read_problem(message: Any) -> RecordedProblem:
    """Reads a quadratic program; ``ValueError`` if its arrays do not fit together."""
    n = message.variables
    m = message.rows
    M = n + m
    has_solution = bool(message.x or message.multipliers)
    return RecordedProblem(
        P=_unpack(message, "P", n, n),
        q=_unpack(message, "q", n),
        G=_unpack(message, "G", m, n),
        lower=_unpack(message, "lower", M),
        upper=_unpack(message, "upper", M),
        softness=_unpack(message, "softness", 2, M),
        x=_unpack(message, "x", n if has_solution else 0),
        multipliers=_unpack(message, "multipliers", M if has_solution else 0),
    )


def _unpack(message: Any, field: str, *shape: int) -> Array:
    """Reads a packed array; ``ValueError`` where it has another size."""
    data = getattr(message, field)
    if min(shape) < 0 or len(data) != 8 * math.prod(shape):
        raise ValueError(f"{field} must be {shape}; got {len(data)} bytes")
    return np.frombuffer(data).reshape(shape)


def column(messages: Sequence[Any], field: str, dtype: Any) -> Array:
    """Returns a field of messages (K,)."""
    return np.array([getattr(message, field) for message in messages], dtype=dtype)


def columns(messages: Sequence[Any], field: str, names: Sequence[str]) -> Array:
    """Returns the scalar fields inside a field of messages (K, len(names))."""
    return _scalars([getattr(message, field) for message in messages], names)


def _scalars(messages: Sequence[Any], names: Sequence[str]) -> Array:
    values = [[getattr(message, name) for name in names] for message in messages]
    return np.array(values).reshape(-1, len(names))


def input_bounds(steps: Sequence[Any], inputs: Sequence[str]) -> Array:
    """Returns lower and upper bounds (2, m), which are equal in all steps."""
    if steps and steps[0].HasField("input_lower"):
        return _scalars([steps[0].input_lower, steps[0].input_upper], inputs)
    return np.tile([[-np.inf], [np.inf]], len(inputs))


def belief_covariances(steps: Sequence[Any], n: int) -> Array:
    """Returns the covariances of the beliefs (K, n, n)."""
    data = b"".join(step.belief_covariance for step in steps)
    return np.frombuffer(data).reshape(-1, n, n)


def plan_arrays(
    path: Path, plans: Sequence[Any], steps: Sequence[Any], names: Names
) -> PlanArrays:
    """Puts the plans in the rows of their steps.

    Raises:
        RecordingError: One long plan would make the arrays of all too large.
    """
    horizon = max((len(plan.stages) - 1 for plan in plans), default=0)
    n = len(names.states)
    m = len(names.inputs)
    size = 8 * len(steps) * (horizon + 1) * (n * n + n + m)
    if size > memory_limit(path):
        raise RecordingError(
            f"{path}: a plan of {horizon} stages would make arrays of "
            f"{size / 1e6:.0f} MB with the others"
        )
    arrays = PlanArrays(
        inputs=np.full((len(steps), horizon, m), np.nan),
        means=np.full((len(steps), horizon + 1, n), np.nan),
        covariances=np.full((len(steps), horizon + 1, n, n), np.nan),
    )
    rows = {occurrence: row for row, occurrence in enumerate(_occurrences(steps))}
    for occurrence, plan in zip(_occurrences(plans), plans, strict=True):
        if occurrence not in rows:  # the step is lost
            continue
        row = rows[occurrence]
        stages = plan.stages
        H = len(stages) - 1
        arrays.means[row, : H + 1] = columns(stages, "mean", names.states)
        arrays.inputs[row, :H] = columns(stages[:-1], "input", names.inputs)
        arrays.covariances[row, : H + 1] = _unpack(plan, "covariances", H + 1, n, n)
    return arrays


def _occurrences(messages: Sequence[Any]) -> Iterator[tuple[int, int]]:
    """Yields the number k of each message's step, and how often it has come so far."""
    counts: Counter[int] = Counter()
    for message in messages:
        counts[message.k] += 1
        yield message.k, counts[message.k]
