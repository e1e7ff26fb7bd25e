"""Copies steps as they are recorded, and serialises the copies later."""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import foxglove
import numpy as np
from foxglove.messages import Log, LogLevel, Timestamp

from gpmpc.exceptions import ShapeError
from gpmpc.recording import _messages
from gpmpc.recording._messages import PLAN, QP, QP_ARRAYS, STEP, TOPICS, RecordedSystem
from gpmpc.status import Status
from gpmpc.step import Step

if TYPE_CHECKING:
    from gpmpc.mpc.controller import Decision
    from gpmpc.qp import QPSolution

Array = np.ndarray
_ndarray, _float64 = np.ndarray, np.dtype(np.float64)
_NUMBERS = {status: number for number, status in enumerate(Status)}
_ARRAYS = (
    "reference",
    "state",
    "measured",
    "innovation",
    "input",
    "belief_covariance",
    "inputs",
    "means",
    "covariances",
)
_MARK = np.array([-1.2345678901234567e300]).tobytes()  # no tag or length looks like it


class Packed(NamedTuple):
    """A step with its arrays copied into one piece of memory."""

    step: Step  # its numbers hold; its arrays may have changed since
    gp_size: int
    shapes: list[tuple[int, ...]]
    data: bytes


def pack(step: Step, gp_size: int | None, n: int, m: int, record_problems: bool) -> Packed:
    """Copies a step.

    Raises:
        ShapeError: An array of the step does not fit n states and m inputs.
    """
    decision, given = step.decision, ()
    arrays: list[Any] = [step.reference, step.state, step.measured, step.innovation, step.input, step.belief_covariance]
    expected = [(n,), (n,), (n,), (n,), (m,), (n, n)]
    if decision is not None:
        H, solution, problem = len(decision.inputs), decision.solution, decision.problem
        arrays += [decision.inputs, decision.means, decision.covariances]
        expected += [(H, m), (H + 1, n), (H + 1, n, n)]
        if solution is not None:
            arrays += [solution.x, solution.record]
            given = (*solution.arrays, solution.softness)
        elif problem is not None:
            hard = np.vstack([np.zeros(len(problem.lower)), np.full(len(problem.lower), np.inf)])
            given = (problem.P, problem.q, problem.G, problem.lower, problem.upper, hard)
        if record_problems:
            arrays += given
    for i, array in enumerate(arrays):
        if array.__class__ is not _ndarray or array.dtype is not _float64 or not array.flags.c_contiguous:
            arrays[i] = np.ascontiguousarray(array, dtype=float)
    shapes = [array.shape for array in arrays]
    if shapes[: len(expected)] != expected:
        wrong = next(i for i, shape in enumerate(expected) if shapes[i] != shape)
        raise ShapeError(f"step {step.k}: {_ARRAYS[wrong]} must be {expected[wrong]}; got {shapes[wrong]}")
    return Packed(step, step.gp_size if gp_size is None else gp_size, shapes, b"".join(arrays))


class Kept(NamedTuple):
    """A step whose arrays are its own."""

    step: Step  # for its numbers
    gp_size: int
    reference: Array
    state: Array
    measured: Array
    innovation: Array
    input: Array
    belief_covariance: Array
    plan: Sequence[Array] | None  # inputs, means, covariances
    solution: "QPSolution | None"
    qp: Sequence[Array] | None  # P, q, G, lower, upper, softness

    @property
    def status(self) -> Status:
        """How the solve ended."""
        status = self.step.status or (self.step.decision and self.step.decision.status)
        return status or Status.INVALID_MEASUREMENT


def unpack(packed: Packed) -> Kept:
    """Finds the arrays of a step again; they are views of the copy."""
    numbers, arrays, start = np.frombuffer(packed.data), [], 0
    for shape in packed.shapes:
        end = start + math.prod(shape)
        arrays.append(numbers[start:end].reshape(shape))
        start = end
    decision, solution, rest = packed.step.decision, None, arrays[9:]
    if decision is not None and decision.solution is not None:
        solution = decision.solution._replace(x=rest[0], record=rest[1])
        rest = rest[2:]
    return Kept._make((packed.step, packed.gp_size, *arrays[:6], arrays[6:9] or None, solution, rest or None))


class Encoder:
    """Serialises steps as messages.

    Args:
        system: What is recorded.
    """

    def __init__(self, system: RecordedSystem):
        states, inputs, self._time_step = system.state_names, system.input_names, system.time_step
        declared = _messages.descriptor(states, inputs)
        self._schema = _messages.schema_data(declared)
        classes = _messages.message_classes(declared)
        self._encode = {name: DoublesEncoder(classes[name]).encode for name in ("State", "Input", "Timing", "Stage")}
        self._encode_last = DoublesEncoder(classes["Stage"], without="input").encode
        twins = _messages.message_classes(_messages.descriptor(states, inputs, _messages.WRITTEN))
        self._step, self._plan, self._qp = twins["Step"], twins["Plan"], twins["QuadraticProgram"]
        bounds = () if system.input_bounds is None else self._encode["Input"](np.array(system.input_bounds))
        self._bounds = dict(zip(("input_lower", "input_upper"), bounds, strict=False))

    def channels(self, context: foxglove.Context) -> dict[str, foxglove.Channel]:
        """Opens the channels by topic."""
        schemas = {t: foxglove.Schema(name=n, encoding="protobuf", data=self._schema) for t, n in TOPICS.items()}
        return {
            topic: foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=context)
            for topic, schema in schemas.items()
        }

    def encode(self, kept: Sequence[Kept]) -> Iterator[tuple[str, int, bytes]]:
        """Yields topics, numbers of the steps in ``kept``, and messages, step by step."""
        # The numbers of all steps at once: a call of NumPy costs more than they do.
        covariances = np.array([step.belief_covariance for step in kept])
        groups = [np.array([(s.reference, s.state, s.measured, s.innovation) for s in kept])]
        groups.append(_deviation(covariances)[:, None])
        states = iter(self._encode["State"](np.concatenate(groups, axis=1).reshape(-1, covariances.shape[-1])))
        inputs = self._encode["Input"](np.array([step.input for step in kept]))
        timings = self._encode["Timing"](np.array([_times(step.step.decision) for step in kept]))
        plans = [(step.step.time, step.plan) for step in kept if step.plan is not None]
        stages = self._encode_stages(plans)
        for row, step in enumerate(kept):
            about, decision, solution = step.step, step.step.decision, step.solution
            head = {"time": about.time, "k": about.k}
            yield (
                STEP,
                row,
                self._step(
                    reference=next(states),
                    state=next(states),
                    measured=next(states),
                    innovation=next(states),
                    belief_std=next(states),
                    input=inputs[row],
                    belief_covariance=step.belief_covariance.tobytes(),
                    status=_NUMBERS[step.status],
                    iterations=0 if decision is None else decision.iterations,
                    active_set_size=0 if solution is None else np.count_nonzero(solution.active_set),
                    timing=timings[row],
                    gp_size=step.gp_size,
                    gp_version=about.gp_version,
                    failed=about.failed,
                    **self._bounds,
                    **head,
                ).SerializeToString(),
            )
            if step.plan is not None:
                plan = self._plan(stages=next(stages), covariances=step.plan[2].tobytes(), **head)
                yield PLAN, row, plan.SerializeToString()
            if step.qp is not None:
                rows, variables = step.qp[2].shape
                solved = ((), ()) if solution is None else (solution.x, solution.multipliers)
                arrays = {name: np.array(a).tobytes() for name, a in zip(QP_ARRAYS, (*step.qp, *solved), strict=True)}
                yield QP, row, self._qp(variables=variables, rows=rows, **arrays, **head).SerializeToString()

    def _encode_stages(self, plans: Sequence[tuple[float, Sequence[Array]]]) -> Iterator[list[bytes]]:
        """Yields the serialised stages of every plan, given when it begins [s], its inputs, means, covariances."""
        if not plans:
            return
        lengths = [len(means) for _, (_, means, _) in plans]
        times = [time + self._time_step * np.arange(len(means)) for time, (_, means, _) in plans]
        inputs = np.concatenate([part for _, (inputs, *_) in plans for part in (inputs, inputs[-1:])])
        means, covariances = (np.concatenate([plan[i] for _, plan in plans]) for i in (1, 2))
        table = np.column_stack([np.concatenate(times), means, _deviation(covariances), inputs])
        ends = np.cumsum(lengths)
        stages = self._encode["Stage"](table)
        last = self._encode_last(table[ends - 1, : -inputs.shape[1]])
        for begin, end, final in zip(ends - lengths, ends, last, strict=True):
            yield [*stages[begin : end - 1], final]


def _times(decision: "Decision | None") -> tuple[float, float, float, float]:
    if decision is None:
        return 0.0, 0.0, 0.0, 0.0
    times = decision.timing.model, decision.timing.build, decision.timing.solve
    return *times, sum(times)


def _deviation(covariance: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariance, axis1=-2, axis2=-1), 0))


def failure_log(kept: Kept, nanoseconds: int) -> Log:
    """Says what went wrong at a step."""
    status, failed = kept.status, kept.step.failed
    policy = "; the policy for failures chose the input" if failed else ""
    return Log(
        timestamp=Timestamp(sec=nanoseconds // 10**9, nsec=nanoseconds % 10**9),
        level=LogLevel.Error if failed else LogLevel.Warning,
        name="gpmpc",
        message=f"step {kept.step.k}: {status.name}: {status.advice}{policy}",
    )


class DoublesEncoder:
    """Serialises messages of one type, all of whose fields, and those of its nested messages, are ``double``.

    Such a message always has the same bytes but for the numbers. Their places are found once, by serialising a message
    of marks, and from then on filled for many messages at a time.

    Args:
        message_class: The type.
        without: Name of a field that is absent.
    """

    def __init__(self, message_class: Any, without: str | None = None):
        message = message_class()
        _mark(message)
        if without is not None:
            message.ClearField(without)
        template = message.SerializeToString()
        starts = [i for i in range(len(template)) if template.startswith(_MARK, i)]
        self._template = np.frombuffer(template, np.uint8)
        self._places = np.add.outer(starts, np.arange(8)).ravel()

    def encode(self, values: np.ndarray) -> list[bytes]:
        """Serialises K messages, given the numbers of each in the order of its fields (K, count)."""
        rows = np.empty((len(values), len(self._template)), np.uint8)
        rows[:] = self._template
        rows[:, self._places] = np.ascontiguousarray(values, dtype=float).view(np.uint8)
        return [row.tobytes() for row in rows]


def _mark(message: Any) -> None:
    for field in message.DESCRIPTOR.fields:
        if field.message_type is None:
            setattr(message, field.name, np.frombuffer(_MARK)[0])
        else:
            _mark(getattr(message, field.name))
