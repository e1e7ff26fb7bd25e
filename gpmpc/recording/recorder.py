"""Problem: keep every step of a run in a file that explains itself and survives a crash, without slowing the loop down.

``record(step)`` copies the step's numbers into memory that it shares with another process (``writer``), which does the
rest: some ten or twenty microseconds. If that memory is full, ``record`` waits for the writer, so memory is bounded and
nothing is lost. A writer that fails (a full disk) is reported by one of the next calls of ``record``, at the latest by
``close``.

Before the first step the file holds where it comes from (commit, versions, host, command, the caller's metadata), the
resolved configuration, units and frames, flushed to the disk. An unfinished file has no footer; see ``recovery``.
"""

import contextlib
import fcntl
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from gpmpc.exceptions import RecordingError, ShapeError, check_number
from gpmpc.provenance import provenance
from gpmpc.recording import schemas, wire
from gpmpc.recording.ring import BATCH, CAPACITY, PAUSE, POSITION, Ring, open_memory
from gpmpc.step import Step

_WRITER = "import sys; sys.path[:] = {path!r}; from gpmpc.recording.writer import main; main({file}, {memory})"
_WAIT = 0.0005  # between two looks whether there is room [s]


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
        self._closed = self._failed = False
        self._announced, self._rung = 0, 0.0  # position and time [s] of the doorbell
        self._start()
        self._send(wire.frame(wire.SETUP, json.dumps(setup).encode()), ring=True)
        answer = self._answer()
        if answer != "ready":
            self._fail(answer)

    def record(self, step: Step) -> None:
        """Takes a copy of a step.

        Raises:
            ShapeError: An array does not fit the names of states and inputs.
            RecordingError: The writer has failed at an earlier step, the recorder is closed, or a step is too large.
        """
        if self._error is not None:
            raise RecordingError(self._error)
        self._send(*wire.pack(step, self._n, self._m))

    def close(self, outcome: str = "complete") -> None:
        """Waits until everything is on the disk and the file finished.

        Args:
            outcome: How the run ended; kept as metadata.

        Raises:
            RecordingError: It could not be written; the file is left unfinished.
        """
        if self._failed:
            raise RecordingError(self._error)
        if self._closed:
            return
        self._send(wire.frame(wire.END, outcome.encode()), ring=True)
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

    def _start(self) -> None:
        file = self._open()
        memory = None
        try:
            memory = open_memory()
            self._ring = Ring(memory)
            self._ring.touch()
            code = _WRITER.format(path=[entry or os.getcwd() for entry in sys.path], file=file, memory=memory)
            self._process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                bufsize=0,
                pass_fds=[file, memory],
                start_new_session=True,  # an interrupt from the keyboard ends the loop, which then closes the file
            )
        except OSError as error:
            raise RecordingError(f"{self.path}: its writer cannot be started: {error.strerror}") from error
        finally:
            for descriptor in (file, memory):
                if descriptor is not None:
                    os.close(descriptor)
        self._doorbell = self._process.stdin.fileno()
        os.set_blocking(self._doorbell, False)

    def _send(self, head: bytes, arrays: Sequence[np.ndarray] = (), length: int = 0, ring: bool = False) -> None:
        """Puts a frame into the shared memory, and rings if enough has come together or enough time has passed."""
        if 2 * (size := len(head) + length) > CAPACITY:
            raise RecordingError(f"{self.path}: a step of {size} bytes is too large; at most {CAPACITY // 2}")
        while not self._ring.give(head, arrays, length):
            self._announce()
            if self._process.poll() is not None:
                self._fail(self._answer())
            time.sleep(_WAIT)
        now = time.perf_counter()
        if ring or self._ring.given - self._announced > BATCH or now - self._rung > PAUSE:
            self._rung = now
            self._announce()

    def _announce(self) -> None:
        self._announced = self._ring.given
        try:
            os.write(self._doorbell, POSITION.pack(self._announced))
        except BlockingIOError:  # thousands of unheard rings: this one has to be heard as well
            os.set_blocking(self._doorbell, True)
            os.write(self._doorbell, POSITION.pack(self._announced))
            os.set_blocking(self._doorbell, False)
        except BrokenPipeError:
            self._fail(self._answer())

    def _answer(self) -> str:
        """The writer's next line; empty if it has died."""
        return self._process.stdout.readline().decode().strip()

    def _fail(self, answer: str) -> NoReturn:
        self._end()
        self._failed = True
        reason = answer or "the process that writes it died"
        self._error = f"{self.path}: the recording stopped and is unfinished: {reason}"
        raise RecordingError(self._error)

    def _end(self) -> None:
        self._closed = True
        del self._ring
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
