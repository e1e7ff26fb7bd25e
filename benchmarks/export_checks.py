"""Checks of exported C by tools: compilers, a linter, sanitizers, the symbols it needs.

``benchmarks.export --check`` runs them for every controller and precision.
"""

import ctypes
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from gpmpc._dynamics import to_array
from gpmpc.export import CompiledController, export_c
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import GPMPC

REPLAY = Path(__file__).with_name("export_replay.c")
SANITIZED = (
    "clang",
    "-std=c99",
    "-O1",
    "-g",
    "-ffp-contract=fast",
    "-march=native",
    "-fsanitize=address,undefined",
    "-fno-sanitize-recover=all",
)
STRICT = ("gcc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")
LINTER = (
    "cppcheck",
    "--std=c99",
    "--enable=warning,performance,portability",
    "--suppress=missingIncludeSystem",
    "--error-exitcode=1",
    "--quiet",
    # one configuration, as a compiler sees it
    "-D__GNUC__=12",
    "-U__cplusplus",
)
# The linter takes minutes over the contents of long tables, and none over their sizes.
LONG_TABLE = re.compile(r"(static const \w+ \w+\[\d+\] = \{)[^}]{400,}\}")
# What compilers call beside libm where they copy or clear memory.
MEMORY_FUNCTIONS = {"memcpy", "memset", "memmove", "__stack_chk_fail"}
LINKER_TABLES = {"_GLOBAL_OFFSET_TABLE_"}
# functions of math.h that glibc holds outside libm as well
ELSEWHERE_TOO = {"copysign", "copysignf", "frexp", "ldexp", "modf", "scalbn"}


def check_source(source: Path) -> list[str]:
    """Compiles a source strictly, lints it, and looks for what it needs.

    Returns:
        The functions that it needs from elsewhere, by name.

    Raises:
        RuntimeError: A tool has something to say, or it needs more than libm.
    """
    object_file = source.with_suffix(".o")
    _run([*STRICT, "-c", str(source), "-o", str(object_file)])
    without_tables = source.with_name("linted.c")
    without_tables.write_text(LONG_TABLE.sub(r"\g<1>0}", source.read_text()))
    _run([*LINTER, str(without_tables)])
    needed = undefined_symbols(object_file)
    foreign = foreign_symbols(needed)
    if foreign:
        raise RuntimeError(f"{source} needs {', '.join(foreign)}")
    return needed


def undefined_symbols(object_file: Path) -> list[str]:
    """Returns the names that a linker has to find elsewhere."""
    lines = _run(["nm", "--undefined-only", str(object_file)]).splitlines()
    return sorted(line.split()[-1] for line in lines)


def foreign_symbols(names: list[str]) -> list[str]:
    """Returns those of names that are not of libm, such as what allocates memory."""
    libm = ctypes.CDLL("libm.so.6")
    libc = ctypes.CDLL("libc.so.6")
    allowed = MEMORY_FUNCTIONS | LINKER_TABLES | ELSEWHERE_TOO
    foreign = []
    for name in names:
        is_of_libm = hasattr(libm, name) and not hasattr(libc, name)
        if not is_of_libm and name not in allowed:
            foreign.append(name)
    return foreign


class SanitizedReplay:
    """A process of sanitised code that answers what a compiled controller was asked.

    Args:
        controller: What is exported.
        precision: Of all numbers.
        kept_bytes: That the code keeps from step to step.

    Attributes:
        needed: The functions of libm that the code calls.

    Raises:
        RuntimeError: See ``check_source``.
    """

    def __init__(self, controller: GPMPC, precision: Any, kept_bytes: int):
        self._folder = tempfile.TemporaryDirectory()
        folder = Path(self._folder.name)
        export = export_c(controller, folder, precision)
        self.needed = check_source(export.source)
        program = folder / "replay"
        options = [f"-DKEPT={kept_bytes}", f"-I{export.source.parent}"]
        sources = [str(REPLAY), str(export.source), "-lm"]
        _run([*SANITIZED, *options, "-o", str(program), *sources])
        self._process = subprocess.Popen(
            [str(program)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )

    def ask(self, *parts: bytes) -> None:
        """Hands over the parts of a question, and of its answer.

        Raises:
            RuntimeError: The process has ended: a sanitizer found a fault.
        """
        assert self._process.stdin is not None
        try:
            for part in parts:
                self._process.stdin.write(part)
        except BrokenPipeError:
            self.finish()

    def finish(self) -> tuple[int, float, int]:
        """Returns the number of answers, and how far they are from those handed over.

        That is the largest difference of an input, and the number of other statuses.

        Raises:
            RuntimeError: A sanitizer found a fault.
        """
        printed, complaint = self._process.communicate()
        self._folder.cleanup()
        if self._process.returncode or complaint:
            raise RuntimeError(complaint.decode(errors="replace"))
        questions, largest, other_statuses = printed.split()
        return int(questions), float(largest), int(other_statuses)


class CheckedController(CompiledController):
    """A compiled controller whose questions sanitised code answers, too."""

    def __init__(self, controller: GPMPC, precision: Any):
        super().__init__(controller, precision)
        kept_bytes = ctypes.sizeof(self._struct.fields)
        self.replay = SanitizedReplay(controller, precision, kept_bytes)

    def _step(self, belief: Gaussian, reference: Any) -> np.ndarray:
        fields_before = bytes(self._struct.fields)
        input = super()._step(belief, reference)
        dtype = self._library.dtype
        status = np.intc(self._struct.fields.status)
        self.replay.ask(
            fields_before,
            to_array(belief.mean).astype(dtype).tobytes(),
            to_array(belief.covariance).astype(dtype).tobytes(),
            bytes(reference),
            input.astype(dtype).tobytes(),
            status.tobytes(),
        )
        return input


def _run(command: list[str]) -> str:
    """Runs a program; returns what it prints.

    Raises:
        RuntimeError: It fails.
    """
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    return done.stdout
