"""Copies steps as they are recorded, and serialises the copies later."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import foxglove
import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from gpmpc.exceptions import ShapeError
from gpmpc.recording import _messages
from gpmpc.recording._messages import PLAN, QP, QP_ARRAYS, STEP, TIMING, TOPICS, RecordedSystem
from gpmpc.status import Status
from gpmpc.step import Step

Array = np.ndarray
_ndarray, _float64 = np.ndarray, np.dtype(np.float64)
_ARRAYS = ("reference", "state", "measured", "innovation", "input", "belief_covariance")
_ARRAYS += ("inputs", "means", "covariances")
_NUMBERS = {status: number for number, status in enumerate(Status)}


class PackedStep(NamedTuple):
    """A step with its arrays copied into one piece of memory: a microsecond, where a copy each takes ten."""

    step: Step  # its numbers hold; its arrays may have changed since
    gp_size: int
    shapes: list[tuple[int, ...]]
    data: bytes


def pack(step: Step, gp_size: int | None, n: int, m: int, record_problems: bool) -> PackedStep:
    """Copies a step."""
    decision = step.decision
    problem: tuple[Any, ...] = ()
    arrays: list[Any] = [step.reference, step.state, step.measured, step.innovation, step.input, step.belief_covariance]
    expected: list[tuple[int, ...]] = [(n,), (n,), (n,), (n,), (m,), (n, n)]
    if decision is not None:
        H, solution, program = len(decision.inputs), decision.solution, decision.problem
        arrays += [decision.inputs, decision.means, decision.covariances]
        expected += [(H, m), (H + 1, n), (H + 1, n, n)]
        if solution is not None:
            arrays += [solution.x, solution.record]
            problem = (*solution.arrays, solution.softness)
        elif program is not None:
            hard = np.vstack([np.zeros(len(program.lower)), np.full(len(program.lower), np.inf)])
            problem = (program.P, program.q, program.G, program.lower, program.upper, hard)
        if record_problems:
            arrays += problem
    for i, array in enumerate(arrays):
        if array.__class__ is not _ndarray or array.dtype is not _float64 or not array.flags.c_contiguous:
            arrays[i] = np.ascontiguousarray(array, dtype=float)
    shapes = [array.shape for array in arrays]
    for name, shape, needed in zip(_ARRAYS, shapes, expected, strict=False):
        if shape != needed:
            raise ShapeError(f"step {step.k}: {name} must be {needed}; got {shape}")
    return PackedStep(step, step.gp_size or gp_size or 0, shapes, b"".join(arrays))


class StepCopy:
    """A step whose arrays are views of its copy.

    Attributes:
        step: For its numbers.
        gp_size: Transitions that the model holds.
        reference, state, measured, innovation, input, belief_covariance: As in ``Step``.
        plan: Inputs, means and covariances; empty without a decision.
        solution: Of the quadratic program; None without one.
        problem: P, q, G, lower, upper, softness; empty where they are not recorded.
        status: How the solve ended.
    """

    def __init__(self, packed: PackedStep):
        self.step, self.gp_size = packed.step, packed.gp_size
        numbers, ends = np.frombuffer(packed.data), np.cumsum([math.prod(shape) for shape in packed.shapes])
        arrays = [part.reshape(s) for part, s in zip(np.split(numbers, ends[:-1]), packed.shapes, strict=True)]
        self.reference, self.state, self.measured, self.innovation, self.input, self.belief_covariance = arrays[:6]
        self.plan, rest, self.solution = arrays[6:9], arrays[9:], None
        decision = self.step.decision
        if decision is not None and decision.solution is not None:
            self.solution = decision.solution._replace(x=rest[0], record=rest[1])
            rest = rest[2:]
        self.problem = rest
        self.status = self.step.status or (decision and decision.status) or Status.INVALID_MEASUREMENT


class Encoder:
    """Serialises steps as messages.

    Args:
        system: What is recorded.
    """

    def __init__(self, system: RecordedSystem):
        self._states, self._inputs, self._time_step = system.state_names, system.input_names, system.time_step
        self._schema = FileDescriptorSet(file=[_messages.descriptor(self._states, self._inputs)]).SerializeToString()
        own = _messages.message_classes(_messages.descriptor(self._states, self._inputs, "bytes"))
        self._step, self._plan, self._qp = (own[TOPICS[topic]] for topic in (STEP, PLAN, QP))
        bounds: Any = () if system.input_bounds is None else np.array(system.input_bounds, dtype=float).tolist()
        self._bounds = {f"input_{side}": self._input(b) for side, b in zip(("lower", "upper"), bounds, strict=False)}

    def channels(self, context: foxglove.Context) -> dict[str, foxglove.Channel]:
        """Opens the channels by topic."""
        found = {}
        for topic, name in TOPICS.items():
            schema = foxglove.Schema(name=f"gpmpc.{name}", encoding="protobuf", data=self._schema)
            found[topic] = foxglove.Channel(topic, schema=schema, message_encoding="protobuf", context=context)
        return found

    def encode(self, copy: StepCopy) -> Iterator[tuple[str, bytes]]:
        """Yields topics and messages of a step."""
        step, decision, solution = copy.step, copy.step.decision, copy.solution
        head = {"time": step.time, "k": step.k}
        times = (0.0, 0.0, 0.0)
        if decision is not None:
            times = decision.timing.model, decision.timing.build, decision.timing.solve
        yield (
            STEP,
            self._step(
                reference=self._state(copy.reference.tolist()),
                state=self._state(copy.state.tolist()),
                measured=self._state(copy.measured.tolist()),
                innovation=self._state(copy.innovation.tolist()),
                belief_std=self._state(_deviations(copy.belief_covariance).tolist()),
                input=self._input(copy.input.tolist()),
                belief_covariance=copy.belief_covariance.tobytes(),
                status=_NUMBERS[copy.status],
                iterations=0 if decision is None else decision.iterations,
                active_set_size=0 if solution is None else np.count_nonzero(solution.active_set),
                timing=dict(zip(TIMING, (*times, sum(times)), strict=True)),
                gp_size=copy.gp_size,
                gp_version=step.gp_version,
                failed=step.failed,
                novelty=np.nan if decision is None else decision.novelty,
                **self._bounds,
                **head,
            ).SerializeToString(),
        )
        if copy.plan:
            inputs, means, covariances = copy.plan
            plan = self._plan(covariances=covariances.tobytes(), **head)
            for i, (mean, std) in enumerate(zip(means, _deviations(covariances), strict=True)):
                last = {"input": self._input(inputs[i].tolist())} if i < len(inputs) else {}
                time = step.time + self._time_step * i
                plan.stages.add(time=time, mean=self._state(mean.tolist()), std=self._state(std.tolist()), **last)
            yield PLAN, plan.SerializeToString()
        if copy.problem:
            variables, rows = len(copy.problem[1]), len(copy.problem[2])
            solved: Any = ((), ()) if solution is None else (solution.x, solution.multipliers)
            arrays = {k: np.array(a).tobytes() for k, a in zip(QP_ARRAYS, (*copy.problem, *solved), strict=True)}
            yield QP, self._qp(variables=variables, rows=rows, **arrays, **head).SerializeToString()

    def _state(self, values: Any) -> dict[str, float]:
        return dict(zip(self._states, values, strict=True))

    def _input(self, values: Any) -> dict[str, float]:
        return dict(zip(self._inputs, values, strict=True))


def _deviations(covariances: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0))
