"""Copies steps as they are recorded, and serialises the copies later."""

import math
from collections.abc import Iterator
from functools import cached_property
from typing import Any

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
_NAMES = ("reference", "state", "measured", "innovation", "input", "belief_covariance")
_NAMES += ("inputs", "means", "covariances")
_NUMBERS = {status: number for number, status in enumerate(Status)}


class StepCopy:
    """A step whose arrays are copied into one piece of memory: a microsecond, where a copy each takes ten.

    Attributes:
        step: Its numbers hold; its arrays may have changed since.
        gp_size: Transitions that the model holds.
        data: The copy.

    Raises:
        ShapeError: An array does not fit n states and m inputs.
    """

    def __init__(self, step: Step, gp_size: int | None, n: int, m: int, record_problem: bool):
        decision = step.decision
        problem: tuple[Any, ...] = ()
        arrays: list[Any] = [step.reference, step.state, step.measured, step.innovation]
        arrays += [step.input, step.belief_covariance]
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
            if record_problem:
                arrays += problem
        for i, array in enumerate(arrays):
            if array.__class__ is not _ndarray or array.dtype is not _float64 or not array.flags.c_contiguous:
                arrays[i] = np.ascontiguousarray(array, dtype=float)
        self._shapes = [array.shape for array in arrays]
        for name, shape, needed in zip(_NAMES, self._shapes, expected, strict=False):
            if shape != needed:
                raise ShapeError(f"step {step.k}: {name} must be {needed}; got {shape}")
        self.step, self.gp_size, self.data = step, step.gp_size or gp_size or 0, b"".join(arrays)

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Views of the copy by name: of the step, and where there are any of its plan, solution and program."""
        solved = self.step.decision is not None and self.step.decision.solution is not None
        names = [*_NAMES[: None if self.step.decision else 6], *(("x", "record") if solved else ()), *QP_ARRAYS[:6]]
        numbers, ends = np.frombuffer(self.data), np.cumsum([math.prod(shape) for shape in self._shapes])
        parts = zip(names, np.split(numbers, ends[:-1]), self._shapes, strict=False)  # without a program
        return {name: part.reshape(shape) for name, part, shape in parts}

    @property
    def status(self) -> Status:
        """How the solve ended."""
        decision = self.step.decision
        return self.step.status or (decision and decision.status) or Status.INVALID_MEASUREMENT


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
        bounds = () if system.input_bounds is None else np.array(system.input_bounds, dtype=float)
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
        step, decision, arrays = copy.step, copy.step.decision, copy.arrays
        head = {"time": step.time, "k": step.k}
        timing, solution = (None, None) if decision is None else (decision.timing, decision.solution)
        if solution is not None:
            solution = solution._replace(x=arrays["x"], record=arrays["record"])
        times = (0.0, 0.0, 0.0) if timing is None else (timing.model, timing.build, timing.solve)
        groups = {name: self._state(arrays[name]) for name in ("reference", "state", "measured", "innovation")}
        message = self._step(
            **head,
            **groups,
            belief_std=self._state(_deviations(arrays["belief_covariance"])),
            input=self._input(arrays["input"]),
            belief_covariance=arrays["belief_covariance"].tobytes(),
            status=_NUMBERS[copy.status],
            iterations=0 if decision is None else decision.iterations,
            active_set_size=0 if solution is None else np.count_nonzero(solution.active_set),
            timing=dict(zip(TIMING, (*times, sum(times)), strict=True)),
            gp_size=copy.gp_size,
            gp_version=step.gp_version,
            failed=step.failed,
            novelty=np.nan if decision is None else decision.novelty,
            **self._bounds,
        )
        yield STEP, message.SerializeToString()
        if decision is not None:
            means, stds = arrays["means"], _deviations(arrays["covariances"])
            plan = self._plan(covariances=arrays["covariances"].tobytes(), **head)
            inputs = [*({"input": self._input(values)} for values in arrays["inputs"]), {}]  # none at the last stage
            for i, (mean, std, given) in enumerate(zip(means, stds, inputs, strict=True)):
                time = step.time + self._time_step * i
                plan.stages.add(time=time, mean=self._state(mean), std=self._state(std), **given)
            yield PLAN, plan.SerializeToString()
        if "P" in arrays:
            if solution is not None:
                arrays = arrays | {"multipliers": solution.multipliers}
            program = {name: np.array(arrays[name]).tobytes() for name in QP_ARRAYS if name in arrays}
            size = {"variables": len(arrays["q"]), "rows": len(arrays["G"])}
            yield QP, self._qp(**size, **program, **head).SerializeToString()

    def _state(self, values: Array) -> dict[str, float]:
        return dict(zip(self._states, values.tolist(), strict=True))

    def _input(self, values: Array) -> dict[str, float]:
        return dict(zip(self._inputs, values.tolist(), strict=True))


def _deviations(covariances: Array) -> Array:
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0))
