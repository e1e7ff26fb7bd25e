"""Copies steps as they are recorded, and encodes the copies as messages later."""

import math
from collections.abc import Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any

import foxglove
import numpy as np
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from gpmpc.exceptions import ShapeError
from gpmpc.recording._schema import (
    PLAN,
    QP,
    STEP,
    TOPICS,
    descriptor,
    message_classes,
)
from gpmpc.recording._system import RecordedSystem
from gpmpc.status import Status
from gpmpc.step import Step

if TYPE_CHECKING:
    from gpmpc.mpc import Decision

Array = np.ndarray
_STATE_ARRAYS = ("reference", "state", "measured", "innovation")  # (n,) of a step
_PROGRAM_ARRAYS = (
    "P",
    "q",
    "G",
    "lower",
    "upper",
)  # as in ``QPSolution.arrays``: bounds of the box first
_STATUS_NUMBERS = {status: number for number, status in enumerate(Status)}


class StepCopy:
    """A step with copies of its arrays in one piece of memory.

    Those of ``step`` itself may have changed since.

    Args:
        step: With n states and m inputs.
        n: Number of states.
        m: Number of inputs.
        record_problem: Whether the step's quadratic program is copied, too.

    Raises:
        ShapeError: An array does not fit n states and m inputs.
    """

    def __init__(self, step: Step, n: int, m: int, record_problem: bool):
        arrays = _arrays_of_step(step)
        expected_shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_STATE_ARRAYS, (n,))
        expected_shapes["input"] = (m,)
        expected_shapes["belief_covariance"] = (n, n)
        decision = step.decision
        if decision is not None:
            H = len(decision.inputs)
            arrays |= _arrays_of_decision(decision, record_problem)
            expected_shapes["inputs"] = (H, m)
            expected_shapes["means"] = (H + 1, n)
            expected_shapes["covariances"] = (H + 1, n, n)
        contiguous: dict[str, Any] = {
            name: np.ascontiguousarray(array, dtype=float)
            for name, array in arrays.items()
        }
        for name, shape in expected_shapes.items():
            if contiguous[name].shape != shape:
                raise ShapeError(
                    f"step {step.k}: {name} must be {shape}; "
                    f"got {contiguous[name].shape}"
                )
        self.step = step
        # One after the other in the order of ``_shapes``, as ``arrays`` splits them.
        self.data = b"".join(contiguous.values())
        self._shapes = {name: array.shape for name, array in contiguous.items()}

    @cached_property
    def arrays(self) -> dict[str, Array]:
        """Views of the copy by name: of the step, its plan, solution and program."""
        ends = np.cumsum([math.prod(shape) for shape in self._shapes.values()])
        flat = np.split(np.frombuffer(self.data), ends[:-1])
        return {
            name: values.reshape(shape)
            for values, (name, shape) in zip(flat, self._shapes.items(), strict=True)
        }

    @property
    def status(self) -> Status:
        """The status of the step, or of its decision; without one it was not solved."""
        if self.step.status:
            return self.step.status
        decision = self.step.decision
        if decision is not None and decision.status:
            return decision.status
        return Status.INVALID_MEASUREMENT


def _arrays_of_step(step: Step) -> dict[str, Any]:
    names = (*_STATE_ARRAYS, "input", "belief_covariance")
    return {name: getattr(step, name) for name in names}


def _arrays_of_decision(decision: "Decision", record_problem: bool) -> dict[str, Any]:
    """Returns the arrays of a plan and, as far as there are any, of its program."""
    arrays: dict[str, Any] = {
        "inputs": decision.inputs,
        "means": decision.means,
        "covariances": decision.covariances,
    }
    solution = decision.solution
    program = decision.problem
    if solution is not None:
        arrays["x"] = solution.x
        arrays["record"] = solution.record
    if not record_problem:
        return arrays
    if solution is not None:
        arrays |= zip(_PROGRAM_ARRAYS, solution.arrays, strict=True)
        arrays["caps"] = solution.caps
    elif program is not None:
        for name in _PROGRAM_ARRAYS:
            arrays[name] = getattr(program, name)
        arrays["caps"] = np.full(len(program.lower), np.inf)
    return arrays


class Encoder:
    """Encodes steps of a system as messages."""

    def __init__(self, system: RecordedSystem):
        self._states = system.state_names
        self._inputs = system.input_names
        self._time_step = system.time_step
        described = descriptor(self._states, self._inputs)
        self._schema = FileDescriptorSet(file=[described]).SerializeToString()
        classes = message_classes(
            descriptor(self._states, self._inputs, arrays_as_bytes=True)
        )
        self._step_class = classes[TOPICS[STEP]]
        self._plan_class = classes[TOPICS[PLAN]]
        self._program_class = classes[TOPICS[QP]]
        self._bounds: dict[str, dict[str, float]] = {}
        if system.input_bounds is not None:
            lower, upper = np.array(system.input_bounds, dtype=float)
            self._bounds["input_lower"] = self._input_message(lower)
            self._bounds["input_upper"] = self._input_message(upper)

    def channels(self, context: foxglove.Context) -> dict[str, foxglove.Channel]:
        """Opens the channels by topic."""
        channels = {}
        for topic, name in TOPICS.items():
            schema = foxglove.Schema(
                name=f"gpmpc.{name}", encoding="protobuf", data=self._schema
            )
            channels[topic] = foxglove.Channel(
                topic, schema=schema, message_encoding="protobuf", context=context
            )
        return channels

    def encode(self, copy: StepCopy) -> Iterator[tuple[str, bytes]]:
        """Yields topics and messages of a step."""
        yield STEP, self._step_message(copy).SerializeToString()
        if copy.step.decision is not None:
            yield PLAN, self._plan_message(copy).SerializeToString()
        if "P" in copy.arrays:
            yield QP, self._program_message(copy).SerializeToString()

    def _step_message(self, copy: StepCopy) -> Any:
        step = copy.step
        arrays = copy.arrays
        decision = step.decision
        judgement = step.judgement
        covariance = arrays["belief_covariance"]
        message = self._step_class(
            time=step.time,
            k=step.k,
            reference=self._state_message(arrays["reference"]),
            state=self._state_message(arrays["state"]),
            measured=self._state_message(arrays["measured"]),
            input=self._input_message(arrays["input"]),
            innovation=self._state_message(arrays["innovation"]),
            belief_std=self._state_message(deviations(covariance)),
            belief_covariance=covariance.tobytes(),
            status=_STATUS_NUMBERS[copy.status],
            timing=_timing_message(decision),
            gp_size=step.gp_size,
            gp_version=step.gp_version,
            failed=step.failed,
            novelty=np.nan if decision is None else decision.novelty,
            **self._bounds,
        )
        if decision is not None:
            message.iterations = decision.iterations
        solution = _copied_solution(copy)
        if solution is not None:
            message.active_set_size = np.count_nonzero(solution.active_set)
        if judgement is not None:
            message.judgement = judgement.level
            message.reason = judgement.reason
        return message

    def _plan_message(self, copy: StepCopy) -> Any:
        step = copy.step
        covariances = copy.arrays["covariances"]
        message = self._plan_class(
            time=step.time, k=step.k, covariances=covariances.tobytes()
        )
        means = [self._state_message(mean) for mean in copy.arrays["means"]]
        stds = [self._state_message(std) for std in deviations(covariances)]
        times = [step.time + self._time_step * i for i in range(len(means))]
        for i, values in enumerate(copy.arrays["inputs"]):
            message.stages.add(
                time=times[i],
                mean=means[i],
                std=stds[i],
                input=self._input_message(values),
            )
        message.stages.add(time=times[-1], mean=means[-1], std=stds[-1])
        return message

    def _program_message(self, copy: StepCopy) -> Any:
        arrays = copy.arrays
        caps = arrays["caps"]
        message = self._program_class(
            time=copy.step.time,
            k=copy.step.k,
            variables=len(arrays["q"]),
            rows=len(arrays["G"]),
            softness=np.stack([np.zeros_like(caps), caps]).tobytes(),
            **{name: arrays[name].tobytes() for name in _PROGRAM_ARRAYS},
        )
        solution = _copied_solution(copy)
        if solution is not None:
            message.x = arrays["x"].tobytes()
            message.multipliers = solution.multipliers.tobytes()
        return message

    def _state_message(self, values: Array) -> dict[str, float]:
        return dict(zip(self._states, values.tolist(), strict=True))

    def _input_message(self, values: Array) -> dict[str, float]:
        return dict(zip(self._inputs, values.tolist(), strict=True))


def _copied_solution(copy: StepCopy) -> Any:
    """Returns the solution of a step's decision with its copied arrays, if any."""
    decision = copy.step.decision
    if decision is None or decision.solution is None:
        return None
    return decision.solution._replace(x=copy.arrays["x"], record=copy.arrays["record"])


def _timing_message(decision: "Decision | None") -> dict[str, float]:
    timing = None if decision is None else decision.timing
    if timing is None:
        return {"model": 0.0, "build": 0.0, "solve": 0.0, "total": 0.0}
    return {
        "model": timing.model,
        "build": timing.build,
        "solve": timing.solve,
        "total": timing.model + timing.build + timing.solve,
    }


def deviations(covariances: Array) -> Array:
    """Returns the standard deviations (..., n) of covariances (..., n, n)."""
    return np.sqrt(np.maximum(np.diagonal(covariances, axis1=-2, axis2=-1), 0))
