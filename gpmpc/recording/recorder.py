"""Problem: keep every step of a run in a file that explains itself and survives a crash, without slowing the loop down.

``record(step)`` copies the step's numbers into a pipe, in some ten or twenty microseconds; another process (``writer``)
does the rest. What the pipe cannot take at once is held back, up to ``LIMIT``; then ``record`` waits for the writer, so
memory is bounded and nothing is lost. A writer that fails (a full disk) is reported by the next ``record``, or by
``close``.

Before the first step the file holds where it comes from (commit, versions, host, command, the caller's metadata), the
resolved configuration, units and frames, flushed to the disk. An unfinished file has no footer; see ``recovery``.
"""

import contextlib
import fcntl
import json
import os
import platform
import select
import subprocess
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from gpmpc.exceptions import RecordingError, ShapeError, check_number
from gpmpc.provenance import provenance
from gpmpc.recording import schemas, wire
from gpmpc.step import Step

LIMIT = 64 * 1024 * 1024  # held back at most [bytes]
PIPE = 1024 * 1024  # what Linux lets a pipe hold without privileges [bytes]
_WRITER = "import sys; sys.path[:] = {path!r}; from gpmpc.recording.writer import main; main({descriptor})"


class McapRecorder:
    """Writes the steps of one run to an MCAP file; a context manager.

    Args:
        path: The file, such as ``run.mcap``; its folder is made, an older file is replaced.
        state_names: Names of the n states; they become field names. x, y, z and phi, theta, psi are drawn in space.
        input_names: Names of the m inputs.
        time_step: Of the plant [s]; it dates the stages of a plan.
        units: By name of state or input, such as ``{"x": "m"}``.
        config: The resolved configuration, as YAML text or as plain data (written as JSON, which is YAML).
        metadata: More to know of the run, such as its seed.
        input_bounds: Lower and upper bounds of the input (2, m), repeated in every step for plots.
        frame: Name of the frame that positions are in.
        z_down: Whether that frame's z axis points downwards, as the quadrotor's does.
        start_time_ns: Time stamp of the run's time 0 [ns since 1970]. With 0, equal runs give equal files.
        record_problems: Keep every step's quadratic program, so that it can be replayed.

    Raises:
        SettingError: Names that cannot be fields, units of unknown names, a time step that is not positive.
        ShapeError: Bounds that are not (2, m).
        RecordingError: The file cannot be written, or another process is writing it.
    """

    def __init__(
        self,
        path: str | Path,
        state_names: Sequence[str],
        input_names: Sequence[str],
        *,
        time_step: float,
        units: Mapping[str, str] | None = None,
        config: Mapping[str, Any] | str = "",
        metadata: Mapping[str, Any] | None = None,
        input_bounds: Any = None,
        frame: str = "world",
        z_down: bool = True,
        start_time_ns: int = 0,
        record_problems: bool = True,
    ):
        self.path = Path(path)
        states, inputs = (
            schemas.check_names("state_names", state_names),
            schemas.check_names("input_names", input_names),
        )
        self._n, self._m = len(states), len(inputs)
        check_number("time_step", time_step, above=0, unit="[s]")
        check_number("start_time_ns", start_time_ns, least=0, whole=True, unit="[ns]")
        if input_bounds is not None and np.shape(input_bounds) != (2, len(inputs)):
            raise ShapeError(f"input bounds must be (2, {len(inputs)}); got {np.shape(input_bounds)}")
        about = provenance() | {"host": platform.node()} | dict(metadata or {})
        setup = {
            "state_names": states,
            "input_names": inputs,
            "time_step": float(time_step),
            "units": schemas.units_by_field(dict(units or {}), states, inputs),
            "frames": {"positions": frame, "z axis": "down" if z_down else "up", "display": "z axis up"},
            "run": _flat(about) | {"state_names": " ".join(states), "input_names": " ".join(inputs)},
            "config": config if isinstance(config, str) else json.dumps(config, indent=2, default=str),
            "input_bounds": None if input_bounds is None else np.asarray(input_bounds, dtype=float).tolist(),
            "frame": frame,
            "z_down": z_down,
            "start_time_ns": start_time_ns,
            "record_problems": record_problems,
        }
        self._error: str | None = None
        self._held: deque[memoryview] = deque()
        self._held_bytes = 0
        self._process = self._start(self._open())
        self._pipe = self._process.stdin.fileno()
        os.set_blocking(self._pipe, False)
        with contextlib.suppress(AttributeError, OSError):  # not Linux, or this user's pipes hold enough already
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, PIPE)
        self._send(wire.frame(wire.SETUP, json.dumps(setup).encode()))
        self._release(0)
        answer = self._answer()
        if answer != "ready":
            self._fail(answer)

    def record(self, step: Step) -> None:
        """Takes a copy of a step.

        Raises:
            ShapeError: An array does not fit the names of states and inputs.
            RecordingError: The writer has failed, at an earlier step; or the recorder is closed.
        """
        if self._error is not None:
            raise RecordingError(self._error)
        self._send(wire.pack(step, self._n, self._m))

    def close(self, outcome: str = "complete") -> None:
        """Waits until everything is on the disk and the file finished.

        Args:
            outcome: How the run ended; kept as metadata.

        Raises:
            RecordingError: It could not be written; the file is left unfinished.
        """
        if self._process.returncode is not None:  # closed before
            return
        if self._error is None:
            self._send(wire.frame(wire.END, outcome.encode()))
            self._release(0)
        answer = self._answer()
        if answer != "done":
            self._fail(answer)
        self._end()
        self._error = f"{self.path}: the recording is closed"

    def __enter__(self) -> "McapRecorder":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: Any) -> None:
        if error is None:
            self.close()
            return
        with contextlib.suppress(RecordingError):  # most likely the same error
            self.close(f"{kind.__name__}: {error}")  # a run that ended in an error has been recorded up to there

    def _open(self) -> int:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT, 0o666)
        except OSError as error:
            raise RecordingError(f"{self.path}: cannot be written: {error.strerror}") from error
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)  # held until the writer has ended
            os.ftruncate(descriptor, 0)
        except OSError as error:
            os.close(descriptor)
            raise RecordingError(f"{self.path}: another process is recording to this file") from error
        return descriptor

    def _start(self, descriptor: int) -> subprocess.Popen:
        code = _WRITER.format(path=[entry or os.getcwd() for entry in sys.path], descriptor=descriptor)
        try:
            return subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                pass_fds=[descriptor],
                start_new_session=True,  # an interrupt from the keyboard ends the loop, which then closes the file
            )
        finally:
            os.close(descriptor)

    def _send(self, frame: bytes) -> None:
        """Writes what the pipe takes and holds back the rest."""
        if self._held:
            self._release(LIMIT)
        written = 0 if self._held else self._write(frame)
        if written < len(frame):
            self._held.append(memoryview(frame)[written:])
            self._held_bytes += len(frame) - written
            self._release(LIMIT)

    def _release(self, limit: int) -> None:
        """Writes what is held back: as much as the pipe takes, and until no more than ``limit`` bytes are left."""
        while self._held:
            written = self._write(self._held[0])
            self._held_bytes -= written
            self._held[0] = self._held[0][written:]
            if not self._held[0]:
                self._held.popleft()
            elif self._held_bytes > limit:
                select.select([], [self._pipe], [])
            else:
                return

    def _write(self, data: bytes | memoryview) -> int:
        try:
            return os.write(self._pipe, data)
        except BlockingIOError:
            return 0
        except BrokenPipeError:
            self._fail(self._answer())

    def _answer(self) -> str:
        """The writer's next line; empty if it has died."""
        return self._process.stdout.readline().decode().strip()

    def _fail(self, answer: str) -> NoReturn:
        self._end()
        reason = answer or "the process that writes it died"
        self._error = f"{self.path}: the recording stopped and is unfinished: {reason}"
        raise RecordingError(self._error)

    def _end(self) -> None:
        self._held.clear()
        self._held_bytes = 0
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()


def _flat(data: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Nested data as the text pairs that a metadata record holds, keys dotted."""
    pairs: dict[str, str] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            pairs |= _flat(value, f"{prefix}{key}.")
        else:
            pairs[f"{prefix}{key}"] = str(value)
    return pairs
