"""Keeps a run in a folder: is it finished, what are its results, what made it.

    config.yaml    the resolved settings
    run.mcap       every step; episode_1.mcap and so on, those of earlier episodes
    metrics.json   the results; written last and in one piece: where it is, the run is
                   finished
    error.json     why it failed, where it did
    .error.json    why the attempt before this one failed, and how many attempts were
                   ended from outside
    .lock          locked while a process works on it; says which one

Any number of processes can work on one tree of such folders: who works on a folder
holds a lock on it, which the system takes back from a process that dies. So the folder
alone tells how far a run is (``RunState``), whatever the process that flew it said.

A finished run is one of the code that flew it. It is not thrown away where the code has
changed since, but whoever shows its numbers says so: ``of_other_code`` tells.
"""

import errno
import hashlib
import json
import os
import re
import socket
import time
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from filelock import lock_descriptor

from gpmpc._files import remove_partial, write_whole
from gpmpc._provenance import flattened, is_of_this_code, own_code, provenance
from gpmpc.exceptions import DataError, GpmpcError, SettingError

METRICS = "metrics.json"
ERROR = "error.json"
CONFIG = "config.yaml"
RECORDING = "run.mcap"
EPISODES = "episode_*.mcap"  # recordings of the flights that it learned from
PLAN_PREFIX = "sweep-"  # beginning of the names of the files that list a sweep's runs
_LOCK = ".lock"  # stays, and says who worked on the folder last
_EARLIER_ERROR = ".error.json"
_PROBES = 5  # of a lock that may only be looked at by another process
_PROBE_INTERVAL = 0.01  # between two of them [s]
# Of opening a file of another user, or on a file system that may only be read.
_NOT_WRITABLE = (errno.EACCES, errno.EPERM, errno.EROFS)
_NOT_IN_NAME = re.compile(r"[^a-z0-9_=.,+\-\[\]@]")
# Paths that Hydra reads as they stand, and words that it reads as other values.
_PLAIN_PATH = re.compile(r"(/|[A-Za-z_])[\w./+-]*", re.ASCII)
_VALUES_BY_NAME = ("true", "false", "null", "nan", "inf")
LONGEST_NAME = 150  # characters of a folder's name; file systems take 255 bytes


class Busy(GpmpcError):
    """Another process works on this run."""


class RunState(Enum):
    """How far a run is, as its folder tells."""

    NOT_BEGUN = "not begun"
    #: a living process holds the lock
    RUNNING = "running"
    FINISHED = "finished"
    FAILED = "failed"
    #: begun, and neither ended nor in anybody's hands: its process was killed
    ABANDONED = "abandoned"


@dataclass(frozen=True)
class RunFolder:
    """One run's folder."""

    path: Path  #: where it is

    @property
    def state(self) -> RunState:
        """Reads how far the run is.

        A run that is flown again is running from ``begin`` on, which puts the end of
        the attempt before aside.
        """
        if self.finished:
            return RunState.FINISHED
        if (self.path / ERROR).exists():
            return RunState.FAILED
        if is_locked(self.path / _LOCK):
            return RunState.RUNNING
        # It may have ended between the looks.
        if self.finished:
            return RunState.FINISHED
        if (self.path / ERROR).exists():
            return RunState.FAILED
        if (self.path / CONFIG).exists():
            return RunState.ABANDONED
        return RunState.NOT_BEGUN

    @property
    def last_worker(self) -> str:
        """Returns who worked on it last, "process 12 on HOST"; empty if unknown."""
        try:
            text = (self.path / _LOCK).read_text(encoding="utf-8", errors="replace")
        except FileNotFoundError:
            return ""
        return " ".join(text.split())

    @property
    def finished(self) -> bool:
        """Whether there is a result."""
        return (self.path / METRICS).exists()

    @property
    def failed_at(self) -> int | None:
        """When the run failed [ns]; None where it did not."""
        try:
            return (self.path / ERROR).stat().st_mtime_ns
        except FileNotFoundError:
            return None

    def outcome_since(self, last_known_failure: int | None) -> RunState | None:
        """Returns FINISHED or FAILED; None where the run has not ended.

        A failure of the same moment is the same failure.

        Args:
            last_known_failure: When an attempt failed that does not count [ns]; None
                where every one does.
        """
        if self.finished:
            return RunState.FINISHED
        if self.failed_at not in (None, last_known_failure):
            return RunState.FAILED
        return None

    @property
    def ended_at(self) -> int | None:
        """When the last attempt finished or failed [ns]; None where it did not."""
        try:
            return (self.path / METRICS).stat().st_mtime_ns
        except FileNotFoundError:
            return self.failed_at

    @property
    def begun_at(self) -> int | None:
        """When the last attempt began [ns]; None where none did."""
        try:
            return (self.path / CONFIG).stat().st_mtime_ns
        except FileNotFoundError:
            return None

    @property
    def seconds(self) -> float | None:
        """How long the last attempt took [s]; None where none has ended.

        A finished run says so itself; of others, and of older versions' runs, the times
        of the files tell, which a copy may have lost.
        """
        with suppress(OSError, ValueError, KeyError, TypeError):
            content = json.loads((self.path / METRICS).read_text(encoding="utf-8"))
            return float(content["times"]["run"])
        began = self.begun_at
        ended = self.ended_at
        if began is None or ended is None or ended < began:
            return None
        return 1e-9 * (ended - began)

    @contextmanager
    def locked(self, wait: bool = True) -> Iterator[None]:
        """Makes the folder, clears it of half-written files and holds its lock.

        Raises:
            Busy: Another process holds the lock, and ``wait`` is false.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        file = os.open(self.path / _LOCK, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not (wait and lock_descriptor(file)) and not _lock_soon(file):
                raise Busy(f"{self.path}: another process works on this run")
            os.truncate(file, 0)
            os.write(file, f"process {os.getpid()} on {socket.gethostname()}".encode())
            remove_partial(self.path)
            yield
        finally:
            os.close(file)

    def begin(self, config: str) -> None:
        """Puts aside how an earlier attempt ended, and keeps the resolved settings.

        Its result and its recordings go: they are of the attempt before.
        """
        with suppress(FileNotFoundError):
            os.replace(self.path / ERROR, self.path / _EARLIER_ERROR)
        write_whole(self.path / CONFIG, config, flush=False)
        (self.path / METRICS).unlink(missing_ok=True)
        for recording in (self.path / RECORDING, *self.path.glob(EPISODES)):
            recording.unlink(missing_ok=True)

    def finish(self, result: Mapping[str, Any]) -> None:
        """Makes the run a finished one, without a trace of earlier failures.

        The settings are on the disk before the result is.
        """
        with suppress(FileNotFoundError), open(self.path / CONFIG, "rb+") as config:
            os.fsync(config.fileno())
        write_whole(self.path / METRICS, json.dumps(result, indent=1) + "\n")
        (self.path / _EARLIER_ERROR).unlink(missing_ok=True)

    def fail(self, error: BaseException, about: Mapping[str, Any]) -> None:
        """Keeps why the run failed, with the traceback."""
        kind = type(error).__name__
        content = {
            **about,
            "error": " ".join(str(error).split()) or kind,
            "kind": kind,
            "traceback": "".join(traceback.format_exception(error)),
        }
        write_whole(self.path / ERROR, json.dumps(content, indent=1) + "\n")

    def end_from_outside(
        self, reason: str, kind: str, about: Mapping[str, Any], is_attempt: bool = True
    ) -> None:
        """Keeps why an attempt ended that could not say so itself.

        Args:
            reason: In a line.
            kind: Such as "time" or "memory".
            about: What else is kept, such as the choices.
            is_attempt: Whether it counts among ``outside_attempts``.

        Raises:
            Busy: A process works on the run, so that it goes on.
        """
        with self.locked(wait=False):
            if self.finished:
                return
            content = {
                **about,
                "error": " ".join(reason.split()),
                "kind": kind,
                "attempts": self.outside_attempts + is_attempt,
                "traceback": "",
            }
            write_whole(self.path / ERROR, json.dumps(content, indent=1) + "\n")

    @property
    def outside_attempts(self) -> int:
        """Number of attempts that were ended from outside, and could not say why."""
        for name in (ERROR, _EARLIER_ERROR):
            try:
                content = json.loads((self.path / name).read_text(encoding="utf-8"))
            except (OSError, ValueError):
                continue
            attempts = _mapping(content).get("attempts")
            return attempts if type(attempts) is int else 0
        return 0

    def error(self) -> str:
        """Returns in a line why the run failed."""
        try:
            content = json.loads((self.path / ERROR).read_text(encoding="utf-8"))
            return " ".join(content["error"].split())
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            return f"{ERROR} cannot be read: {type(error).__name__}: {error}"

    def remarks(self) -> list[str]:
        """Returns the warnings of the flight that ended the run; none if unknown."""
        name = METRICS if self.finished else ERROR
        try:
            content = json.loads((self.path / name).read_text(encoding="utf-8"))
            remarks = content["provenance"]["remarks"]
            return [" ".join(remark.split()) for remark in remarks]
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            return []

    def result(self, settings: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Reads the result of the finished run.

        Raises:
            DataError: The file is none that a run writes.
            SettingError: The run has other settings than ``settings``.
        """
        path = self.path / METRICS
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            settings_of_run = content["settings"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{path}: is not what a run writes: {type(error).__name__}: {error}"
            ) from error
        if settings is None:
            return content
        differing = difference(settings_of_run, settings)
        if differing:
            raise SettingError(
                "folder",
                f"{self.path} holds a finished run of other settings ({differing}); "
                "choose another folder, or remove that one to fly it again",
            )
        return content


def is_locked(path: Path) -> bool:
    """Whether a process holds a file's lock; takes it for a moment where none does."""
    try:
        file = os.open(path, os.O_RDWR)
    except FileNotFoundError:
        return False
    except OSError as error:
        if error.errno not in _NOT_WRITABLE:
            raise
        return _is_locked_by_others(path)
    try:
        return not lock_descriptor(file, blocking=False)
    finally:
        os.close(file)


@contextmanager
def lock_held(path: Path) -> Iterator[None]:
    """Holds the lock of a file inside, unless another process does."""
    file = os.open(path, os.O_RDWR)
    try:
        _lock_soon(file)
        yield
    finally:
        os.close(file)


def _is_locked_by_others(path: Path) -> bool:
    """Whether a process holds a lock on a file that may only be read here.

    A shared lock tells; network file systems give readers no other.
    """
    import fcntl  # of POSIX

    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _lock_soon(file: int) -> bool:
    """Takes a lock, although others may take it for a moment to look at it."""
    for _ in range(_PROBES):
        if lock_descriptor(file, blocking=False):
            return True
        time.sleep(_PROBE_INTERVAL)
    return False


def run_header(
    choices: Sequence[str], settings: Mapping[str, Any], command: str
) -> dict[str, Any]:
    """Returns the beginning of metrics.json and error.json: settings and provenance.

    Args:
        choices: What distinguishes the run, ``key=value`` each.
        settings: All that its numbers depend on.
        command: That flies it.
    """
    return {
        "schema": 1,
        "choices": list(choices),
        "settings": dict(settings),
        "seed": settings.get("seed"),
        "provenance": {
            **provenance(),
            "command": command,
            "own_code": own_code(settings),
            "remarks": [],
        },
    }


def of_other_code(result: Mapping[str, Any]) -> str:
    """Returns which code flew a run; empty where it was this code.

    Args:
        result: Content of ``metrics.json``.
    """
    about = _mapping(result.get("provenance"))
    if is_of_this_code(about, result.get("settings")):
        return ""
    return describe_code(about)


def describe_code(about: Mapping[str, Any]) -> str:
    """Returns version and commit of what made a result, as far as it tells them.

    Args:
        about: What ``provenance`` returned there.
    """
    version = _mapping(about.get("versions")).get("gpmpc")
    git = _mapping(about.get("git"))
    facts = ["a gpmpc that did not say which"]
    if version:
        facts = [f"gpmpc {version}"]
    if git.get("commit"):
        facts.append(f"commit {str(git['commit'])[:10]}")
    if git.get("dirty"):
        facts.append("changed")
    return ", ".join(facts)


def _mapping(value: Any) -> Mapping[str, Any]:
    """Returns a part of a file as a mapping, empty where it is none."""
    return value if isinstance(value, Mapping) else {}


def folder_name(choices: Sequence[str]) -> str:
    """Returns a name for a run of these choices, ``key=value`` each.

    Runs of other choices have other names.
    """
    text = ",".join(sorted(choices)) or "default"
    # A comma in a choice could be one between two, and names that are equal up to upper
    # and lower case are equal on some file systems.
    has_own_commas = text.count(",") > max(0, len(choices) - 1)
    if len(text) <= LONGEST_NAME and not (has_own_commas or _NOT_IN_NAME.search(text)):
        return text
    name = re.sub(r"[^\w=.,+\-\[\]@]", "_", text, flags=re.ASCII)[:LONGEST_NAME]
    digest = hashlib.sha256(json.dumps(sorted(choices)).encode()).hexdigest()
    return f"{name}-{digest[:10]}"


def folder_override(tree: Path) -> str:
    """Returns ``folder=TREE`` as Hydra reads it, in quotes where it needs them."""
    path = str(tree)
    is_plain = _PLAIN_PATH.fullmatch(path) and path.lower() not in _VALUES_BY_NAME
    if is_plain:
        return f"folder={path}"
    escaped = path.replace("'", "\\'")
    return f"folder='{escaped}'"


def difference(then: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Returns the first three leaves in which two settings differ, in words.

    Empty where they are equal.
    """
    leaves_then = flattened(then)
    leaves_now = flattened(now)
    differing = []
    for key in dict.fromkeys([*leaves_then, *leaves_now]):
        value_then = leaves_then.get(key)
        value_now = leaves_now.get(key)
        if not is_same(value_then, value_now):
            differing.append(f"{key}: {value_then!r} then, {value_now!r} now")
    shown = differing[:3]
    if len(differing) > 3:
        shown.append(f"and {len(differing) - 3} more")
    return ", ".join(shown)


def is_same(then: Any, now: Any) -> bool:
    """Whether two values of a setting are equal; what is no number equals itself."""
    if isinstance(then, list) and isinstance(now, list) and len(then) == len(now):
        return all(map(is_same, then, now))
    if isinstance(then, Mapping) and isinstance(now, Mapping):
        return then.keys() == now.keys() and all(
            is_same(then[key], now[key]) for key in then
        )
    return then == now or (then != then and now != now)
