"""A flight that the exported example replays, beside what Python decided on."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gpmpc._files import write_whole
from gpmpc.mpc import GPMPC, ControlLoop, Reference
from gpmpc.mpc._policy import OnFailure
from gpmpc.status import Status

_STATUSES = list(Status)


class Question(NamedTuple):
    """What a controller is asked at a step."""

    measured: Any  #: the state (n,)
    reference: Reference  #: over the horizon, or a set point


def write_replay(
    controller: GPMPC,
    questions: Iterable[Question],
    path: str | Path,
    on_failure: OnFailure = "previous_plan",
) -> int:
    """Writes ``replay.txt``: questions, and how Python answers them.

    Args:
        controller: Which was exported.
        questions: Of a flight, step by step.
        path: The file.
        on_failure: The policy that was exported.

    Returns:
        The number of steps.
    """
    loop = ControlLoop(controller, on_failure)
    lines = []
    for measured, reference in questions:
        input = loop.input(measured, reference)
        assert loop.last is not None  # it has decided
        over = reference.over(controller.horizon)
        inputs = over.inputs
        if inputs is None:
            inputs = np.zeros((controller.horizon, len(input)))
        numbers = np.concatenate(
            [np.ravel(part) for part in (measured, over.states, inputs, input)]
        )
        text = " ".join(repr(float(number)) for number in numbers)
        lines.append(f"{text} {_STATUSES.index(loop.last.status)}")
    write_whole(path, "\n".join(lines) + "\n")
    return len(lines)
