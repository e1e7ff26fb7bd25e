"""Exported controllers in Python: the same C, compiled and called by ctypes."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from time import perf_counter
from typing import Any

import numpy as np
import torch

from gpmpc._arrays import read_array
from gpmpc._dynamics import DynamicsModel, to_array
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.export._c_types import fields_type, reference_type
from gpmpc.export._checks import check_kappas
from gpmpc.export._filter import Estimator
from gpmpc.export._functions import FunctionWriter, parameter_rows
from gpmpc.export._text import Numbers
from gpmpc.export._write import Precision, write_code
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import GPMPC, Decision, PredictionSettings, Problem, Reference, Timing
from gpmpc.mpc._controller import read_parameters, read_reference
from gpmpc.propagation import Propagator
from gpmpc.qp import QPSolution, QPSolver
from gpmpc.qp import _record as layout
from gpmpc.signals import Signals
from gpmpc.status import Status

Array = np.ndarray

#: fast, and with products rounded as the compiled loops of Python round them
COMPILER = ("cc", "-O3", "-march=native", "-ffp-contract=fast", "-fno-math-errno")
_STATUSES = list(Status)
_ONE_PROGRAM = PredictionSettings()


@dataclass(frozen=True)
class CompiledDecision(Decision):
    """A decision of compiled code."""

    #: what the code keeps for its next step
    memory: Any = None


class ControllerStruct:
    """One ``gpmpc_controller`` of C.

    Attributes:
        fields: What it keeps from step to step, as a view of its memory.
        size: Bytes.
        seconds: That the code took for the last step [s].
    """

    def __init__(self, size: int, fields_type: Any):
        self._memory = ctypes.create_string_buffer(size)
        self.fields = fields_type.from_buffer(self._memory)
        self.size = size
        self.seconds = 0.0


class CompiledLibrary:
    """The exported C of a controller, compiled for this machine.

    Args:
        controller: What is exported.
        precision: Of all numbers, ``"double"`` or ``"float"``.
        on_failure: See ``export_c``.
        compiler: A C compiler, with options.
        estimator: See ``export_c``.

    Raises:
        SettingError: The controller cannot be exported, or there is no compiler.
    """

    def __init__(
        self,
        controller: GPMPC,
        precision: Precision = "double",
        on_failure: str = "previous_plan",
        compiler: Sequence[str] = COMPILER,
        estimator: Estimator | None = None,
    ):
        if shutil.which(compiler[0]) is None:
            rule = "must be a C compiler that is installed, such as gcc"
            raise SettingError("compiler", f"{rule}; got {compiler[0]!r}")
        number = ctypes.c_double if precision == "double" else ctypes.c_float
        self.dtype = np.dtype(number)
        self._states = controller.prediction.state_dim
        self._measured = self._states
        if estimator is not None:
            self._measured = estimator.filter.measurement.output_dim
        self._inputs = controller.prediction.input_dim
        self._horizon = controller.horizon
        self._penalized = controller.problem.cost.penalized
        with tempfile.TemporaryDirectory() as folder:
            export = write_code(
                controller, Path(folder), precision, on_failure, estimator
            )
            library = Path(folder) / "gpmpc.so"
            command = [*compiler, "-std=c99", "-shared", "-fPIC"]
            _compile([*command, "-o", str(library), str(export.source), "-lm"])
            self._code = ctypes.CDLL(str(library))
        self._code.gpmpc_memory.restype = ctypes.c_ulong
        self._fields_type = fields_type(controller, number, estimator is not None)
        self._parameters = FunctionWriter(controller, Numbers("double")).parameters
        self._reference_type = reference_type(controller, number, self._parameters)

    def new_controller(self) -> ControllerStruct:
        """Returns a controller before its first step."""
        controller = ControllerStruct(self._code.gpmpc_memory(), self._fields_type)
        self.reset(controller)
        return controller

    def reset(self, controller: ControllerStruct) -> None:
        """Makes the next step of a controller a first one."""
        self._code.gpmpc_reset(ctypes.byref(controller.fields))

    def reference(self, reference: Reference, parameters: Any = None) -> Any:
        """Returns a reference, and parameters, as the code takes them.

        Raises:
            ShapeError: One of another size than the controller's, or without inputs
                from which deviations are weighed.
            DataError: One that is not finite.
            SettingError: Kappas, which exported code takes from the problem.
        """
        followed = reference.over(self._horizon)
        check_kappas(followed)
        stages = self._horizon + 1
        _check_numbers("a reference", followed.states, (stages, self._states))
        converted = self._reference_type()
        if self._parameters:
            rows = parameter_rows(parameters, self._horizon, self._parameters)
            view(converted.parameters)[:] = rows
        view(converted.states)[:] = followed.states
        shape = (self._horizon, self._inputs)
        if followed.inputs is not None:
            _check_numbers("reference inputs", followed.inputs, shape)
            view(converted.inputs)[:] = followed.inputs
            converted.has_inputs = 1
        elif self._penalized == "deviations":
            rule = f"penalized 'deviations' needs reference inputs {shape}"
            raise ShapeError(f"{rule}; got none")
        return converted

    def step(
        self, controller: ControllerStruct, measured: Any, reference: Any
    ) -> Array:
        """Decides the input (m,) of a time step.

        Args:
            controller: Of this library.
            measured: What ``gpmpc_step`` takes; a ``Gaussian`` is a belief.
            reference: See ``reference``.

        Raises:
            ShapeError: What is measured has another size.
        """
        input = np.empty(self._inputs, dtype=self.dtype)
        if isinstance(measured, Gaussian):
            step = self._code.gpmpc_step_belief
            numbers = [to_array(measured.mean), to_array(measured.covariance)]
            _check_shape("a belief", numbers[0], (self._states,))
        else:
            step = self._code.gpmpc_step
            numbers = [measured]
            _check_shape("a measurement", measured, (self._measured,))
        arrays = [np.ascontiguousarray(part, dtype=self.dtype) for part in numbers]
        arguments = (
            ctypes.byref(controller.fields),
            *(_address(array) for array in arrays),
            ctypes.byref(reference),
            _address(input),
        )
        began = perf_counter()
        step(*arguments)
        controller.seconds = perf_counter() - began
        return input.astype(float)


def _check_shape(name: str, numbers: Any, shape: tuple[int, ...]) -> None:
    """Raises ``ShapeError`` unless there are as many numbers as the code reads."""
    got = np.shape(numbers)
    if got != shape:
        raise ShapeError(f"{name} must have the shape {shape}; got {got}")


def _check_numbers(name: str, numbers: Any, shape: tuple[int, ...]) -> None:
    """Raises an error unless there are as many numbers, all finite."""
    _check_shape(name, numbers, shape)
    if not np.isfinite(np.asarray(numbers, dtype=float)).all():
        raise DataError(f"{name} must be finite")


def _address(array: Array) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


class CompiledController:
    """A ``GPMPC`` as compiled C: a ``Controller`` that decides as it does.

    Its decisions hold the means of a plan alone: the covariances, by which it keeps
    chance constraints, stay in the code.

    Args:
        controller: What is exported, of one program a step.
        precision: Of all numbers, ``"double"`` or ``"float"``.
        compiler: A C compiler, with options.

    Attributes:
        source: The controller that was compiled.

    Raises:
        SettingError: The controller cannot be exported, or there is no compiler.
    """

    def __init__(
        self,
        controller: GPMPC,
        precision: Precision = "double",
        compiler: Sequence[str] = COMPILER,
    ):
        self.source = controller
        self._library = CompiledLibrary(controller, precision, compiler=compiler)
        self._struct = self._library.new_controller()
        # a call of C lets other threads of Python go on
        self._is_deciding = Lock()
        self.horizon = controller.horizon
        self.problem = controller.problem
        self.initial_input = controller.initial_input

    #: what its decisions say of a plan leaves out all noise, whatever it plans with
    plans_means_alone = True

    @property
    def model(self) -> DynamicsModel:
        """The model that it predicts with."""
        return self.source.prediction.model

    @property
    def signals(self) -> Signals:
        """Names of states and inputs, and time step, as far as the model knows them."""
        return self.source.signals

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
    ) -> Decision:
        """Decides the input for one step; see ``GPMPC.control``."""
        belief = belief.in_order(self.signals.state_names)
        reference = reference.in_order(self.signals)
        if parameters is not None:
            parameters = read_parameters(parameters, self.horizon)
        followed = self._library.reference(reference, parameters)
        fields = self._struct.fields
        with self._is_deciding:
            self._library.reset(self._struct)
            if previous is not None:
                _continue(fields, previous)
            input = self._step(belief, followed)
            timing = Timing(solve=self._struct.seconds)
            return _decision(fields, input, timing)

    def _step(self, belief: Gaussian, reference: Any) -> Array:
        """Decides the input (m,) from what the code keeps."""
        return self._library.step(self._struct, belief, reference)


def compiled_controller(
    model: DynamicsModel,
    propagator: Propagator,
    problem: Problem,
    horizon: int,
    initial_input: Sequence[float],
    prediction: PredictionSettings = _ONE_PROGRAM,
    solver: QPSolver | None = None,
    precision: Precision = "double",
) -> CompiledController:
    """Makes a ``GPMPC`` of one program a step, and compiles it.

    Arguments and errors are those of ``GPMPC`` and ``CompiledController``.
    """
    controller = GPMPC(
        model,
        propagator,
        problem,
        horizon,
        initial_input,
        prediction=prediction,
        solver=solver,
        iterations=1,
    )
    return CompiledController(controller, precision)


class CompiledLoop:
    """An exported controller that steers a plant, as ``ControlLoop`` does.

    Args:
        controller: What is exported.
        precision: Of all numbers.
        on_failure: ``"previous_plan"`` or ``"hold"``.
        compiler: A C compiler, with options.
        estimator: A filter that is exported with the controller.

    Attributes:
        status: Of the last step.
        failed: Whether its input was chosen by the policy.
        seconds: That the code took for the last step [s].
        memory_bytes: Of the controller.
    """

    def __init__(
        self,
        controller: GPMPC,
        precision: Precision = "double",
        on_failure: str = "previous_plan",
        compiler: Sequence[str] = COMPILER,
        estimator: Estimator | None = None,
    ):
        self._library = CompiledLibrary(
            controller, precision, on_failure, compiler, estimator
        )
        self._filters = estimator is not None
        self._signals = controller.signals
        self._struct = self._library.new_controller()
        self.memory_bytes = self._struct.size
        self.status = Status.SOLVED
        self.failed = False
        self.seconds = 0.0

    @property
    def belief(self) -> Gaussian:
        """What the filter believed when the last step decided.

        Raises:
            SettingError: The controller was exported without a filter.
        """
        if not self._filters:
            raise SettingError("estimator", "there is no belief without one")
        mean = view(self._struct.fields.mean).astype(float)
        covariance = view(self._struct.fields.covariance).astype(float)
        return Gaussian(torch.from_numpy(mean), torch.from_numpy(covariance))

    def input(self, measured: Any, reference: Any, parameters: Any = None) -> Array:
        """Returns the input to apply now (m,); see ``ControlLoop.input``.

        Args:
            measured: The state (n,), with a filter what sensors show (p,), or a
                ``Gaussian`` over the state.
            reference: A set point (n,), states (H + 1, n), or a ``Reference``.
            parameters: Of outputs and smooth constraints.
        """
        names = () if self._filters else self._signals.state_names
        if isinstance(measured, Gaussian):
            measured = measured.in_order(self._signals.state_names)
        else:
            measured = read_array("measured", measured, names)
        followed = read_reference(reference).in_order(self._signals)
        converted = self._library.reference(followed, parameters)
        input = self._library.step(self._struct, measured, converted)
        self.seconds = self._struct.seconds
        fields = self._struct.fields
        self.status = _STATUSES[fields.status]
        self.failed = bool(fields.failed)
        return input


def view(numbers: Any) -> Array:
    """Returns an array of C as one of NumPy that shares its memory."""
    return np.ctypeslib.as_array(numbers)


def _continue(fields: Any, previous: Decision) -> None:
    """Writes the last decision to what the code keeps.

    Of a decision of another controller, of other sizes, only the input counts, and the
    estimate of a disturbance of as many states.
    """
    _check_shape("input of the last decision", previous.input, (len(fields.input),))
    sizes = (view(fields.means).shape, view(fields.inputs).shape)
    fits = (np.shape(previous.means), np.shape(previous.inputs)) == sizes
    memory = getattr(previous, "memory", None)
    if fits and memory is not None and len(memory) == ctypes.sizeof(fields):
        ctypes.memmove(ctypes.byref(fields), memory, ctypes.sizeof(fields))
    elif fits and previous.solution is not None:
        _write_solution(fields.solution, previous.solution)
    # a policy may have moved the plan since the memory was kept
    view(fields.input)[:] = previous.input
    estimate = previous.disturbance
    if estimate is None or np.shape(estimate) != np.shape(fields.disturbance):
        estimate = 0.0
    view(fields.disturbance)[:] = estimate
    fields.has_input = int(np.isfinite(previous.input).all())
    fields.has_plan = int(fits and previous.applicable)
    fields.policy_steps = previous.policy_steps
    if fields.has_plan:
        view(fields.means)[:] = previous.means
        view(fields.inputs)[:] = previous.inputs


def _write_solution(target: Any, solution: QPSolution) -> None:
    """Writes the last program's solution in Python to what the code starts from.

    One of more rows than there are, or of another method, is no guess.
    """
    n = len(solution.x)
    M = len(solution.caps)
    if n != len(target.x) or len(target.label) < M or not len(solution.record):
        return
    labels = layout.working_labels(solution.record, n, M)
    target.status = int(solution.record[layout.STATUS])
    target.rows = M - n
    target.working = len(labels)
    view(target.label)[: len(labels)] = labels
    view(target.multiplier)[:M] = solution.multipliers
    view(target.x)[:] = solution.x


def _decision(fields: Any, input: Array, timing: Timing) -> Decision:
    """Returns the decision that a step of the code ended with."""
    failed = bool(fields.failed)
    status = _STATUSES[fields.status]
    means = view(fields.means).astype(float)
    inputs = view(fields.inputs).astype(float)
    if failed:
        means = np.full_like(means, np.nan)
        inputs = np.tile(input, (len(inputs), 1))
    n = means.shape[1]
    return CompiledDecision(
        input=input,
        inputs=inputs,
        means=means,
        covariances=np.zeros((len(means), n, n)),
        status=status,
        iterations=1,
        timing=timing,
        disturbance=view(fields.estimate).astype(float),
        suboptimal=not (failed or status.solved),
        violation=float(fields.violation),
        memory=bytes(fields),
    )


def _compile(command: Sequence[str]) -> None:
    """Runs a compiler.

    Raises:
        SettingError: It fails.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ["without a word"]
        reason = next((line for line in lines if "error" in line), lines[0])
        raise SettingError("compiler", f"{command[0]} failed: {reason}")
