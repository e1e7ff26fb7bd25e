"""What exported code takes on a chip: flash, RAM, stack and instructions.

    controller -> C -> compiler -> flash, RAM, stack
                         |_ a flight replayed in QEMU -> instructions of each step

Flash holds the code, its tables, and what is linked from libm and the compiler's
library; RAM what an application keeps for a controller, and these libraries' variables.
What starts the chip is not counted; on this machine, where libraries are shared, they
are not either. The stack is the deepest chain of calls in the exported file, which gcc
tells: nothing recurses. Instructions are counted by QEMU's ``-icount``; they are not a
time on hardware.
"""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, check_choice
from gpmpc.export._checks import check_kappas
from gpmpc.export._filter import Estimator
from gpmpc.export._functions import FunctionWriter, parameter_rows
from gpmpc.export._replay import Question
from gpmpc.export._text import Numbers, Precision
from gpmpc.export._write import write_code
from gpmpc.mpc import GPMPC

Array = np.ndarray
ChipName = Literal["cortex-m4f", "cortex-m7", "host"]

_HERE = Path(__file__).parent / "chip"
_NANOSECONDS_A_TICK = 40  # SysTick of the boards runs at 25 MHz
_BOARD_MEMORY = 4 * 1024 * 1024  # flash, and RAM, of the boards in QEMU
# besides ``gpmpc_step``, what an application calls and keeps
_FURTHER_SYMBOLS = ("gpmpc_reset", "gpmpc_hold", "controller", "reference")
_CALL = re.compile(
    r'edge: \{ sourcename: "(?P<from>[^"]+)" targetname: "(?P<to>[^"]+)"'
)
_FRAME = re.compile(r'node: \{ title: "(?P<name>[^"]+)" .*?(?P<bytes>\d+) bytes \(')


class _Chip(NamedTuple):
    """How code is compiled for a chip, and where it runs."""

    title: str  #: for people
    prefix: str  #: of the compiler's tools
    options: str  #: of the compiler
    board: str = ""  #: of QEMU; empty where instructions are not counted


_CHIPS = {
    "cortex-m4f": _Chip(
        title="Cortex-M4F",
        prefix="arm-none-eabi-",
        options="-mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -mfloat-abi=hard -mthumb",
        board="mps2-an386",
    ),
    "cortex-m7": _Chip(
        title="Cortex-M7",
        prefix="arm-none-eabi-",
        options="-mcpu=cortex-m7 -mfpu=fpv5-d16 -mfloat-abi=hard -mthumb",
        board="mps2-an500",
    ),
    "host": _Chip(
        title="this machine",
        prefix="",
        options="-fno-asynchronous-unwind-tables",
    ),
}


@dataclass(frozen=True)
class Footprint:
    """What exported code takes on a chip."""

    flash: int  #: code and tables, on a chip with libraries [B]
    ram: int  #: a controller and a reference, on a chip with libraries' variables [B]
    stack: int | None  #: the deepest chain of calls [B]; None where it is not known
    compiler: str  #: chip and compiler that measured it
    #: of every step that was replayed (K,); None where they were not counted
    instructions: Array | None = None
    #: that the replay applied (K, m); None where there was none
    inputs: Array | None = None

    @property
    def memory(self) -> int:
        """What ``ram`` of a budget limits: RAM, and the stack if it is known [B]."""
        return self.ram + (self.stack or 0)

    @property
    def worst(self) -> int | None:
        """Instructions of the longest step; None where they were not counted."""
        if self.instructions is None:
            return None
        return int(self.instructions.max())


def check_chip(chip: str) -> None:
    """Raises ``SettingError`` unless code can be compiled for a chip here."""
    check_choice("chip", chip, tuple(_CHIPS))
    for program in _programs(_CHIPS[chip]):
        if shutil.which(program) is None:
            rule = f"{_CHIPS[chip].title} needs {program}, which is not installed"
            raise SettingError("chip", rule)


def _programs(chip: _Chip) -> tuple[str, str]:
    """Returns the names of a chip's compiler and of what measures its files."""
    compiler = f"{chip.prefix}gcc" if chip.prefix else "cc"
    return compiler, f"{chip.prefix}size"


def counts_instructions(chip: str) -> bool:
    """Returns whether instructions of a chip can be counted on this machine."""
    return bool(_CHIPS[chip].board) and shutil.which("qemu-system-arm") is not None


def check_counts_instructions(chip: str) -> None:
    """Raises ``SettingError`` unless instructions can be counted on this machine."""
    if not _CHIPS[chip].board:
        rule = "instructions are counted for cortex-m4f and cortex-m7 alone"
        raise SettingError("budget", f"{rule}; got the chip {chip}")
    if not counts_instructions(chip):
        rule = "instructions are counted by qemu-system-arm, which is not installed"
        raise SettingError("budget", rule)


def available_chip() -> ChipName:
    """Returns Cortex-M4F where there is a compiler for it, else this machine."""
    return "cortex-m4f" if shutil.which("arm-none-eabi-gcc") else "host"


@explains_arguments
def measure_footprint(
    controller: GPMPC,
    questions: Sequence[Question] = (),
    chip: ChipName | None = None,
    precision: Precision = "double",
    on_failure: str = "previous_plan",
    estimator: Estimator | None = None,
) -> Footprint:
    """Compiles exported code for a chip and measures what it takes.

    Args:
        controller: What is exported.
        questions: Of a flight, step by step: they are replayed in QEMU, where it is
            installed, and instructions are counted.
        chip: ``"cortex-m4f"`` and ``"cortex-m7"`` by ``arm-none-eabi-gcc``, ``"host"``
            by ``cc``. By default the first where there is a compiler for it, else the
            last.
        precision: See ``export_c``.
        on_failure: See ``export_c``.
        estimator: See ``export_c``; questions hold what sensors show then.

    Raises:
        SettingError: The controller cannot be exported, or there is no compiler.
    """
    chip = available_chip() if chip is None else chip
    check_chip(chip)
    with tempfile.TemporaryDirectory() as name:
        build = _Build(Path(name), _CHIPS[chip])
        write_code(controller, build.folder, precision, on_failure, estimator)
        footprint = build.footprint()
        fits_board = max(footprint.flash, footprint.memory) < _BOARD_MEMORY * 3 // 4
        if not (len(questions) and counts_instructions(chip) and fits_board):
            return footprint
        flight = _flight_header(controller, questions, precision)
        rows = build.replay(flight)
    return Footprint(
        flash=footprint.flash,
        ram=footprint.ram,
        stack=footprint.stack,
        compiler=footprint.compiler,
        instructions=rows[:, 0] * _NANOSECONDS_A_TICK,
        inputs=rows[:, 2:],
    )


class _Build:
    """A folder in which a controller's code is compiled for a chip."""

    def __init__(self, folder: Path, chip: _Chip):
        self.folder = folder
        self._chip = chip
        self._compiler, self._size = _programs(chip)

    def footprint(self) -> Footprint:
        """Compiles the code; returns what it takes."""
        stack = self._compile_for_stack()
        self._compile("memory.c", (_HERE / "memory.c").read_text())
        sizes = self._sizes()
        version = self._run(self._compiler, "--version").splitlines()[0]
        return Footprint(
            flash=sizes.text + sizes.data,
            ram=sizes.data + sizes.bss,
            stack=stack,
            compiler=f"{self._chip.title}, {version}, -O2",
        )

    def replay(self, flight: str) -> Array:
        """Runs a flight in QEMU; returns ticks, status and input of each step."""
        (self.folder / "flight.h").write_text(flight)
        script = _HERE / "board.ld"
        self._compile("replay.c", (_HERE / "replay.c").read_text(), "gnu99")
        self._link("replay.elf", "--specs=rdimon.specs", f"-T{script}", "replay.o")
        printed = self._run(
            *("qemu-system-arm", "-M", self._chip.board, "-nographic"),
            *("-icount", "shift=0", "-kernel", "replay.elf"),
            *("-semihosting-config", "enable=on,target=native"),
        )
        return np.array([line.split() for line in printed.splitlines()], dtype=float)

    def _compile_for_stack(self) -> int | None:
        """Compiles the controller; returns the bytes of its deepest chain of calls."""
        text = (self.folder / "gpmpc.c").read_text()
        try:
            self._compile("gpmpc.c", text, "c99", "-fcallgraph-info=su")
        except SettingError:  # not gcc, or one older than 10
            self._compile("gpmpc.c", text)
            return None
        return _deepest_chain((self.folder / "gpmpc.ci").read_text())

    def _compile(
        self, name: str, text: str, standard: str = "c99", *further: str
    ) -> None:
        """Writes and compiles a file of the folder."""
        (self.folder / name).write_text(text)
        options = [*self._chip.options.split(), f"-std={standard}", "-O2"]
        options += ["-ffp-contract=fast", *further]
        self._run(self._compiler, *options, "-I.", "-c", name)

    def _sizes(self) -> "_Sections":
        """Returns the sizes of code and memory, on a chip with the libraries."""
        if self._chip.board:
            symbols = ("gpmpc_step", *_FURTHER_SYMBOLS)
            options = [f"-Wl,-u,{symbol}" for symbol in symbols]
            entry = ("-Wl,--gc-sections", f"-Wl,-e,{symbols[0]}")
            self._link("image.elf", "--specs=nosys.specs", *entry, *options, "memory.o")
            return self._sections("image.elf")
        code = self._sections("gpmpc.o")
        memory = self._sections("memory.o")
        return _Sections(*np.add(code, memory).tolist())

    def _link(self, name: str, *options: str) -> None:
        """Links the controller with libraries, and with what options name."""
        chip = self._chip.options.split()
        libraries = ("gpmpc.o", "-lm", "-lc")
        self._run(
            self._compiler, *chip, "-nostartfiles", *options, *libraries, "-o", name
        )

    def _sections(self, name: str) -> "_Sections":
        """Returns the sizes of an object file or a program."""
        sizes = self._run(self._size, name).splitlines()[1].split()
        return _Sections(text=int(sizes[0]), data=int(sizes[1]), bss=int(sizes[2]))

    def _run(self, *command: str) -> str:
        """Runs a program in the folder; returns what it prints."""
        done = subprocess.run(
            command, cwd=self.folder, capture_output=True, text=True, check=False
        )
        if done.returncode:
            lines = done.stderr.strip().splitlines() or ["without a word"]
            reason = next((line for line in lines if "error" in line), lines[0])
            raise SettingError("chip", f"{command[0]} failed: {reason}")
        return done.stdout


class _Sections(NamedTuple):
    """Sizes of the sections of an object file or a program [B]."""

    text: int  #: code and constants
    data: int  #: variables that begin with a value
    bss: int  #: variables that begin with zero


def _deepest_chain(graph: str) -> int:
    """Returns the bytes of the deepest chain of calls in gcc's graph of a file."""
    frames = {match["name"]: int(match["bytes"]) for match in _FRAME.finditer(graph)}
    called: dict[str, list[str]] = {}
    for match in _CALL.finditer(graph):
        called.setdefault(match["from"], []).append(match["to"])
    depths: dict[str, int] = {}

    def depth(name: str) -> int:
        if name not in depths:
            below = [depth(other) for other in called.get(name, ())]
            depths[name] = frames.get(name, 0) + max(below, default=0)
        return depths[name]

    return max((depth(name) for name in frames), default=0)


def _flight_header(
    controller: GPMPC, questions: Sequence[Question], precision: Precision
) -> str:
    """Returns measurements and references of a flight as C."""
    numbers = Numbers(precision)
    H = controller.horizon
    m = controller.prediction.input_dim
    count = FunctionWriter(controller, Numbers("double")).parameters
    references = []
    for question in questions:
        followed = question.reference.over(H)
        check_kappas(followed)
        inputs = np.zeros((H, m)) if followed.inputs is None else followed.inputs
        rows = parameter_rows(question.parameters, H, count) if count else [[0.0]]
        fields = [
            _braces(numbers, followed.states),
            _braces(numbers, inputs),
            str(int(followed.inputs is not None)),
            _braces(numbers, rows),
        ]
        references.append("{" + ", ".join(fields) + "}")
    measured = _braces(numbers, [question.measured for question in questions])
    listed = ",\n".join(references)
    return (
        f"#define STEPS {len(questions)}\n"
        f"static const gpmpc_real measured[STEPS][GPMPC_MEASURED] = {measured};\n"
        f"static const gpmpc_reference references[STEPS] = {{{listed}}};\n"
    )


def _braces(numbers: Numbers, rows: Any) -> str:
    """Returns a table as the initial value of an array of arrays in C."""

    def number(value: float) -> str:
        return "NAN" if np.isnan(value) else numbers.number(value)

    listed = [
        "{" + ", ".join(number(float(value)) for value in row) + "}"
        for row in np.asarray(rows, dtype=float)
    ]
    return "{" + ",\n ".join(listed) + "}"
