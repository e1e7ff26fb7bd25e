"""Exported controllers in Python: the same C, compiled and called by ctypes."""

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import SettingError
from gpmpc.export._functions import FunctionWriter
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


class CompiledLibrary:
    """The exported C of a controller, compiled for this machine.

    Args:
        controller: What is exported.
        precision: Of all numbers, ``"double"`` or ``"float"``.
        on_failure: See ``export_c``.
        compiler: A C compiler, with options.

    Raises:
        SettingError: The controller cannot be exported, or there is no compiler.
    """

    def __init__(
        self,
        controller: GPMPC,
        precision: Precision = "double",
        on_failure: str = "previous_plan",
        compiler: Sequence[str] = COMPILER,
    ):
        if shutil.which(compiler[0]) is None:
            rule = "must be a C compiler that is installed, such as gcc"
            raise SettingError("compiler", f"{rule}; got {compiler[0]!r}")
        self.number = ctypes.c_double if precision == "double" else ctypes.c_float
        self.dtype = np.dtype(self.number)
        with tempfile.TemporaryDirectory() as folder:
            export = write_code(controller, Path(folder), precision, on_failure)
            library = Path(folder) / "gpmpc.so"
            command = [*compiler, "-std=c99", "-shared", "-fPIC"]
            _compile([*command, "-o", str(library), str(export.source), "-lm"])
            self.code = ctypes.CDLL(str(library))
        self.code.gpmpc_memory.restype = ctypes.c_ulong
        self.Kept = _kept_type(controller, self.number)
        self.ReferenceType = _reference_type(controller, self.number)

    def new_memory(self) -> ctypes.Array:
        """Returns the memory of a controller before its first step."""
        memory = ctypes.create_string_buffer(self.code.gpmpc_memory())
        self.code.gpmpc_reset(memory)
        return memory

    def kept(self, memory: ctypes.Array) -> Any:
        """Returns what a memory keeps from step to step, as a view of it."""
        return self.Kept.from_buffer(memory)

    def reference(
        self, reference: Reference, horizon: int, parameters: Any = None
    ) -> Any:
        """Returns a reference, and parameters, as the code takes them."""
        followed = reference.over(horizon)
        converted = self.ReferenceType()
        if parameters is not None:
            view(converted.parameters)[:] = read_parameters(parameters, horizon)
        view(converted.states)[:] = followed.states
        if followed.inputs is not None:
            view(converted.inputs)[:] = followed.inputs
            converted.has_inputs = 1
        return converted

    def step(
        self, memory: ctypes.Array, belief: Gaussian, reference: Any, inputs: int
    ) -> Array:
        """Decides the input (m,) of a time step."""
        mean = np.ascontiguousarray(belief.mean, dtype=self.dtype)
        covariance = np.ascontiguousarray(belief.covariance, dtype=self.dtype)
        input = np.empty(inputs, dtype=self.dtype)
        self.code.gpmpc_step_belief(
            memory,
            mean.ctypes.data_as(ctypes.c_void_p),
            covariance.ctypes.data_as(ctypes.c_void_p),
            ctypes.byref(reference),
            input.ctypes.data_as(ctypes.c_void_p),
        )
        return input.astype(float)


class CompiledController:
    """A ``GPMPC`` as compiled C: a ``Controller`` that decides as it does.

    Args:
        controller: What is exported, of one program a step.
        precision: Of all numbers, ``"double"`` or ``"float"``.
        compiler: A C compiler, with options.

    Raises:
        SettingError: The controller cannot be exported, or there is no compiler.
    """

    def __init__(
        self,
        controller: GPMPC,
        precision: Precision = "double",
        compiler: Sequence[str] = COMPILER,
    ):
        self._controller = controller
        self._library = CompiledLibrary(controller, precision, compiler=compiler)
        self.horizon = controller.horizon
        self.problem = controller.problem
        self.initial_input = controller.initial_input

    @property
    def signals(self) -> Signals:
        """Names of states and inputs, and time step, as far as the model knows them."""
        return self._controller.signals

    def control(
        self,
        belief: Gaussian,
        reference: Reference,
        previous: Decision | None = None,
        parameters: Any = None,
    ) -> Decision:
        """Decides the input for one step; see ``GPMPC.control``."""
        began = perf_counter()
        library = self._library
        memory = library.new_memory()
        kept = library.kept(memory)
        if previous is not None:
            self._continue(kept, previous)
        converted = library.reference(reference, self.horizon, parameters)
        input = library.step(memory, belief, converted, len(self.initial_input))
        timing = Timing(solve=perf_counter() - began)
        return _decision(kept, input, timing)

    def _continue(self, kept: Any, previous: Decision) -> None:
        """Writes the last decision to what the code keeps."""
        memory = getattr(previous, "memory", None)
        if memory is not None:
            ctypes.memmove(ctypes.byref(kept), memory, ctypes.sizeof(kept))
        elif previous.solution is not None:
            _write_solution(kept.solution, previous.solution)
        view(kept.input)[:] = previous.input
        if previous.disturbance is not None:
            view(kept.disturbance)[:] = previous.disturbance
        kept.has_input = int(np.isfinite(previous.input).all())
        kept.has_plan = int(previous.applicable)
        if previous.applicable:
            view(kept.means)[:] = previous.means
            view(kept.inputs)[:] = previous.inputs


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

    Attributes:
        status: Of the last step.
        failed: Whether its input was chosen by the policy.
        seconds: That the last step took [s].
        memory_bytes: Of the controller.
    """

    def __init__(
        self,
        controller: GPMPC,
        precision: Precision = "double",
        on_failure: str = "previous_plan",
        compiler: Sequence[str] = COMPILER,
    ):
        self._controller = controller
        self._library = CompiledLibrary(controller, precision, on_failure, compiler)
        self._memory = self._library.new_memory()
        self.memory_bytes = len(self._memory)
        self.status = Status.SOLVED
        self.failed = False
        self.seconds = 0.0

    def input(self, state: Any, reference: Any, parameters: Any = None) -> Array:
        """Returns the input to apply now (m,); see ``ControlLoop.input``."""
        belief = state
        if not isinstance(state, Gaussian):
            belief = Gaussian.certain(np.asarray(state, dtype=float))
        controller = self._controller
        followed = self._library.reference(
            read_reference(reference), controller.horizon, parameters
        )
        m = len(controller.initial_input)
        began = perf_counter()
        input = self._library.step(self._memory, belief, followed, m)
        self.seconds = perf_counter() - began
        kept = self._library.kept(self._memory)
        self.status = _STATUSES[kept.status]
        self.failed = bool(kept.failed)
        return input


def view(numbers: Any) -> Array:
    """Returns an array of C as one of NumPy that shares its memory."""
    return np.ctypeslib.as_array(numbers)


def _write_solution(kept: Any, solution: QPSolution) -> None:
    """Writes the last program's solution in Python to what the code starts from."""
    n = len(solution.x)
    M = len(solution.caps)
    labels = layout.working_labels(solution.record, n, M)
    kept.status = int(solution.record[layout.STATUS])
    kept.rows = M - n
    kept.working = len(labels)
    view(kept.label)[: len(labels)] = labels
    view(kept.multiplier)[:M] = solution.multipliers
    view(kept.x)[:] = solution.x


def _decision(kept: Any, input: Array, timing: Timing) -> Decision:
    """Returns the decision that a step of the code ended with."""
    failed = bool(kept.failed)
    status = _STATUSES[kept.status]
    means = view(kept.means).astype(float)
    inputs = view(kept.inputs).astype(float)
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
        disturbance=view(kept.disturbance).astype(float),
        suboptimal=not (failed or status.solved),
        violation=float(kept.violation),
        memory=bytes(kept),
    )


def _kept_type(controller: GPMPC, number: Any) -> type[ctypes.Structure]:
    """Returns the type of what ``gpmpc_controller`` begins with (``core.h``)."""
    n = controller.prediction.state_dim
    m = controller.prediction.input_dim
    H = controller.horizon
    rates = H * m if controller.problem.input_rates.finite else 0
    rows = H * m + rates + H * controller.prediction.constraints.per_stage
    constraints = H * m + rows

    class Solution(ctypes.Structure):
        _fields_ = (
            ("status", ctypes.c_int),
            ("iterations", ctypes.c_int),
            ("rows", ctypes.c_int),
            ("working", ctypes.c_int),
            ("label", ctypes.c_int * constraints),
            ("multiplier", number * constraints),
            ("x", number * (H * m)),
        )

    class Kept(ctypes.Structure):
        _fields_ = (
            ("has_input", ctypes.c_int),
            ("has_plan", ctypes.c_int),
            ("input", number * m),
            ("means", (number * n) * (H + 1)),
            ("inputs", (number * m) * H),
            ("disturbance", number * n),
            ("solution", Solution),
            ("status", ctypes.c_int),
            ("failed", ctypes.c_int),
            ("violation", number),
        )

    return Kept


def _reference_type(controller: GPMPC, number: Any) -> type[ctypes.Structure]:
    """Returns the type ``gpmpc_reference`` (``core.h``)."""
    n = controller.prediction.state_dim
    m = controller.prediction.input_dim
    H = controller.horizon
    parameters = FunctionWriter(controller, Numbers("double")).parameters

    class ReferenceType(ctypes.Structure):
        _fields_ = (
            ("states", (number * n) * (H + 1)),
            ("inputs", (number * m) * H),
            ("has_inputs", ctypes.c_int),
            ("parameters", (number * max(1, parameters)) * H),
        )

    return ReferenceType


def _compile(command: Sequence[str]) -> None:
    """Runs a compiler.

    Raises:
        SettingError: It fails.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = done.stderr.strip().partition("\n")[0]
        raise SettingError("compiler", f"{command[0]} failed: {reason}")
