"""A flight that the exported example replays, beside what Python decided on."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from gpmpc._files import write_whole
from gpmpc.export._checks import check_kappas
from gpmpc.export._filter import Estimator, check_estimator
from gpmpc.export._functions import FunctionWriter, parameter_rows
from gpmpc.export._text import Numbers
from gpmpc.export._write import MARK, check_unwritten
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import GPMPC, ControlLoop, Reference
from gpmpc.mpc._policy import OnFailure
from gpmpc.status import Status

_STATUSES = list(Status)


class Question(NamedTuple):
    """What a controller is asked at a step."""

    measured: Any  #: the state (n,), with a filter what sensors show (p,)
    reference: Reference  #: over the horizon, or a set point
    parameters: Any = None  #: of outputs and smooth constraints (q,) or (H, q)


class Answer(NamedTuple):
    """How Python answers a question."""

    question: Question
    input: np.ndarray  #: (m,)
    status: Status
    belief: Gaussian  #: over the state, that it decided for
    seconds: float  #: that it took [s]


def answers(
    controller: GPMPC,
    questions: Iterable[Question],
    on_failure: OnFailure = "previous_plan",
    estimator: Estimator | None = None,
) -> Iterator[Answer]:
    """Yields Python's answers to the questions of a flight, step by step.

    Args:
        controller: Decides.
        questions: Step by step.
        on_failure: The policy.
        estimator: A filter of which the controller is given the belief.

    Raises:
        SettingError: The filter has a part that C cannot hold.
    """
    if estimator is not None:
        check_estimator(controller, estimator)
    loop = ControlLoop(controller, on_failure)
    for question in questions:
        began = perf_counter()
        if estimator is None:
            belief = Gaussian.certain(np.asarray(question.measured, dtype=float))
        else:
            belief = estimator.belief
            if loop.last is not None:
                belief = estimator.filter.predict(belief, loop.last.input)
            belief = estimator.filter.update(belief, question.measured).belief
            estimator = estimator._replace(belief=belief)
        input = loop.input(belief, question.reference, question.parameters)
        assert loop.last is not None  # it has decided
        seconds = perf_counter() - began
        yield Answer(question, input, loop.last.status, belief, seconds)


def write_replay(
    controller: GPMPC,
    questions: Iterable[Question],
    path: str | Path,
    on_failure: OnFailure = "previous_plan",
    estimator: Estimator | None = None,
) -> int:
    """Writes ``replay.txt``: questions, and how Python answers them.

    Args:
        controller: Which was exported.
        questions: Of a flight, step by step.
        path: The file, which goes over an older replay.
        on_failure: The policy that was exported.
        estimator: The filter that was exported.

    Returns:
        The number of steps.

    Raises:
        ShapeError: Parameters of another number than the controller takes.
        SettingError: A reference with kappas, which exported code does not take. Or
            the file is one of somebody else.
    """
    check_unwritten([Path(path)])
    count = FunctionWriter(controller, Numbers("double")).parameters
    lines = []
    for answer in answers(controller, questions, on_failure, estimator):
        numbers = np.concatenate(_numbers_of(answer, controller.horizon, count))
        text = " ".join(repr(float(number)) for number in numbers)
        lines.append(f"{text} {_STATUSES.index(answer.status)}")
    write_whole(path, "\n".join([f"# {MARK}", *lines]) + "\n")
    return len(lines)


def _numbers_of(answer: Answer, horizon: int, parameters: int) -> list[np.ndarray]:
    """Returns the numbers of a line, in the order in which C reads them."""
    question = answer.question
    followed = question.reference.over(horizon)
    check_kappas(followed)
    inputs = followed.inputs
    has_inputs = inputs is not None
    if inputs is None:
        inputs = np.zeros((horizon, len(answer.input)))
    rows = parameter_rows(question.parameters, horizon, parameters)
    arrays = (
        question.measured,
        followed.states,
        has_inputs,
        inputs,
        rows,
        answer.input,
    )
    return [np.ravel(np.asarray(array, dtype=float)) for array in arrays]
