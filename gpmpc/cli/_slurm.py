"""Flies chunks as array jobs of Slurm, and reads from its queue how they ended.

    chunks -> FOLDER/.slurm/NAME/chunks -> sbatch -> squeue, until none is left

The name of an array says where its chunks are, so that whoever repeats a sweep finds
the jobs that still wait or run, and watches them instead of submitting their runs
again. The queue forgets jobs soon after their end; then the accounting is asked, where
there is one, and else the job's log, to which Slurm writes why it ended a job.
"""

import pickle
import re
import secrets
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Generator, Iterator, Mapping, Sequence, Set
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from filelock import FileLock

from gpmpc._files import write_whole
from gpmpc.cli._launchers import Cause, Chunk, ChunkEnd, Refused, Work
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import SettingError, check_number
from gpmpc.parallel import THREADS

CHUNKS = "chunks"  # name of the file that a job reads
DONE = "gpmpc: done on "  # last line of a job's log, with the host
_SUBMITTED = "submitted"  # name of the file that says that Slurm took an array
_ENDED = "ended"  # name of the file that says that all jobs of an array have ended
_LOGS = ".slurm"  # folder in the sweep's
_PREFIX = "gpmpc-"  # of the names of arrays
_MOST_TASKS = 1000  # of an array, where Slurm does not say
_FIRST_LOOK = 0.5  # after which the queue is looked at again [s]
_LAST_LOOK = 10.0  # at most [s]
_SLOWER = 1.3  # each look comes later than the one before by this factor
_WAITS = (2.0, 10.0, 30.0)  # before a submission is tried again [s]
_SILENCE = 60.0  # of Slurm, after which that is said [s]
_PATIENCE = 60.0  # for the answer of one of its commands [s]
_TAIL = 4000  # characters of a log that are read
_FORMAT = "%j|%K|%F_%K|%T|%r|%N"
_FIELDS = 1 + _FORMAT.count("|")
_COMMANDS = ("sbatch", "squeue", "scontrol", "scancel")

_CAUSES = {
    "CANCELLED": Cause.CANCELLED,
    "REVOKED": Cause.CANCELLED,
    "TIMEOUT": Cause.TIME,
    "DEADLINE": Cause.TIME,
    "OUT_OF_MEMORY": Cause.MEMORY,
    "NODE_FAIL": Cause.NODE,
    "BOOT_FAIL": Cause.NODE,
    "PREEMPTED": Cause.NODE,
}
_ENDED_STATES = frozenset({"COMPLETED", "FAILED", *_CAUSES})
# What Slurm writes to the log of a job that it ends. The first one counts.
_LOGGED = (
    (re.compile(r"memory limit|oom.kill|out.of.memory", re.IGNORECASE), Cause.MEMORY),
    (re.compile(r"CANCELLED AT \S+ DUE TO TIME LIMIT"), Cause.TIME),
    (re.compile(r"CANCELLED AT \S+ DUE TO NODE FAILURE"), Cause.NODE),
    (re.compile(r"CANCELLED AT \S+ DUE TO PREEMPTION"), Cause.NODE),
    (re.compile(r"\*\*\* (JOB|STEP) \S+ ON \S+ CANCELLED AT"), Cause.CANCELLED),
)
# What it writes before it starts a job anew, behind which another attempt begins.
_REQUEUED = re.compile(r"CANCELLED AT \S+ DUE TO JOB REQUEUE[^\n]*\n?")
# A job that waits for a reason of these was given up by Slurm.
_GIVEN_UP = (
    "launch failed requeued held",
    "JobHoldMaxRequeue",
    "DependencyNeverSatisfied",
)
# What sbatch writes where Slurm has too much to do, or restarts.
_BUSY = re.compile(
    r"timed out|unable to contact|connection (refused|reset)|temporarily|try again",
    re.IGNORECASE,
)
# What ``_slurm_job`` prints.
_OWN_ERROR = re.compile(r"^gpmpc: error: (.+)$", re.MULTILINE)


class _Job(NamedTuple):
    """One job of an array, as Slurm tells."""

    number: str
    state: str
    reason: str
    host: str


@dataclass
class _Array:
    """Chunks that were submitted together; job i flies chunk i."""

    name: str
    folder: Path
    chunks: Sequence[Chunk]
    timeout_min: int  # wall time of its jobs [min]
    mem_gb: float  # memory of its jobs [GB]
    #: when another call submitted it [ns]; None where this one did
    adopted_from: int | None = None
    #: chunks whose jobs may not have ended yet
    waiting: set[int] = field(default_factory=set)
    #: looks at the queue without a job, by chunk
    absences: dict[int, int] = field(default_factory=dict)


class Slurm:
    """Flies chunks as array jobs of Slurm.

    Args:
        tree: The sweep's folder, on a file system that all nodes see.
        timeout_min: Wall time of a job [min].
        mem_gb: Memory of a job [GB].
        cpus_per_task: Processors of a job.
        array_parallelism: Jobs at the same time, at most.
        partition, account, qos, constraint: As for sbatch; None leaves them to Slurm.
        setup: Lines of shell before a job's command.
        additional_parameters: Other options of sbatch, by name; true makes a flag.
    """

    workers = None

    def __init__(
        self,
        tree: Path,
        timeout_min: int = 60,
        mem_gb: float = 4,
        cpus_per_task: int = 1,
        array_parallelism: int = 100,
        partition: str | None = None,
        account: str | None = None,
        qos: str | None = None,
        constraint: str | None = None,
        setup: Sequence[str] = (),
        additional_parameters: Mapping[str, Any] | None = None,
    ):
        self._timeout_min = timeout_min
        self._mem_gb = mem_gb
        key = "hydra.launcher."
        check_number(key + "timeout_min", timeout_min, least=1, whole=True)
        check_number(key + "mem_gb", mem_gb, above=0)
        check_number(key + "cpus_per_task", cpus_per_task, least=1, whole=True)
        check_number(key + "array_parallelism", array_parallelism, least=1, whole=True)
        if isinstance(setup, str):
            raise SettingError(key + "setup", f"must be a list of lines; got {setup!r}")
        if any(str(line).lstrip().startswith("#SBATCH") for line in setup):
            raise SettingError(
                key + "setup",
                "holds #SBATCH, which would be ignored; options of sbatch are "
                "additional_parameters",
            )
        for command in _COMMANDS:
            if shutil.which(command) is None:
                raise SettingError(
                    "launcher",
                    f"slurm needs {command}; start the sweep on a login node",
                )
        self._at_once = array_parallelism
        self._setup = [*setup]
        self._logs = tree / _LOGS
        self._adopted: list[_Array] = []
        self._options = {
            "time": timeout_min,
            "mem": f"{max(1, round(1024 * mem_gb))}M",
            "cpus-per-task": cpus_per_task,
            "partition": partition,
            "account": account,
            "qos": qos,
            "constraint": constraint,
            **(additional_parameters or {}),
        }

    def exclusive_launch(self) -> AbstractContextManager[object]:
        """Keeps other sweeps of this tree from submitting inside."""
        self._logs.mkdir(parents=True, exist_ok=True)
        return FileLock(self._logs / "lock")

    def call(self, function: Work, argument: Any) -> None:
        function(argument)

    def adopt(self, paths: Set[str]) -> Sequence[Chunk]:
        """Adopts chunks of arrays whose end nobody has seen yet."""
        self._adopted = []
        for array in self._unended():
            array.waiting = {
                index
                for index, chunk in enumerate(array.chunks)
                if any(str(folder.path) in paths for folder in chunk.folders)
            }
            if array.waiting:
                self._adopted.append(array)
        return [
            array.chunks[index] for array in self._adopted for index in array.waiting
        ]

    def launch(
        self, work: Work, chunks: Sequence[Chunk]
    ) -> Generator[ChunkEnd, None, None]:
        """Submits chunks; yields how they, and the adopted ones, end.

        Where Slurm refuses one array after others, such as by a limit of jobs a user,
        it and those after it are left for a later call.

        Raises:
            Refused: Slurm takes no such job.
        """
        most = _most_tasks()
        chunks_by_array = [chunks[i : i + most] for i in range(0, len(chunks), most)]
        at_once = max(1, self._at_once // max(1, len(chunks_by_array)))
        arrays = [*self._adopted]
        for chunks_of_array in chunks_by_array:
            try:
                arrays.append(self._submit(work, chunks_of_array, at_once))
            except Refused as error:
                if not arrays:
                    raise
                print_error(
                    f"{error}; what it has taken goes on, and the rest is submitted "
                    "behind it"
                )
                break
        return self._watch(arrays)

    def close(self) -> None:
        pass

    def _unended(self) -> Iterator[_Array]:
        """Yields the arrays in the sweep's folder whose end was not seen yet."""
        folders = [
            folder
            for folder in sorted(self._logs.glob(f"{_PREFIX}*"))
            if not (folder / _ENDED).exists() and (folder / CHUNKS).exists()
        ]
        queue = _queue() if folders else None
        for folder in folders:
            # Where Slurm does not know it, its sweep was killed before it submitted it.
            in_queue = queue is None or any(name == folder.name for name, _ in queue)
            if in_queue or (folder / _SUBMITTED).exists():
                array = self._read_array(folder)
                if array is not None:
                    yield array

    def _read_array(self, folder: Path) -> _Array | None:
        """Reads an array that was submitted; None, and a line, where that fails.

        It may be of another gpmpc, whose classes are not there any more.
        """
        try:
            written = (folder / CHUNKS).stat().st_mtime_ns
            content = pickle.loads((folder / CHUNKS).read_bytes())
            chunks = [pickle.loads(chunk) for chunk in content["chunks"]]
        except Exception as error:  # whatever unpickling raises
            reason = f"{type(error).__name__}: {_one_line(str(error))}"
            print_error(
                f"{folder}: cannot be read ({reason}), and its jobs are not watched; "
                f"to end them: scancel -n {folder.name}"
            )
            return None
        return _Array(
            folder.name,
            folder,
            chunks,
            timeout_min=content.get("timeout_min", self._timeout_min),
            mem_gb=content.get("mem_gb", self._mem_gb),
            adopted_from=written,
            waiting={*range(len(chunks))},
        )

    def _submit(self, work: Work, chunks: Sequence[Chunk], at_once: int) -> _Array:
        """Submits an array of one job a chunk."""
        name = _PREFIX + secrets.token_hex(4)
        folder = self._logs / name
        folder.mkdir(parents=True)
        content = {
            "work": work,
            "chunks": [pickle.dumps(chunk) for chunk in chunks],
            "timeout_min": self._timeout_min,
            "mem_gb": self._mem_gb,
        }
        write_whole(folder / CHUNKS, pickle.dumps(content))
        options = self._options | {
            "job-name": name,
            "array": f"0-{len(chunks) - 1}%{at_once}",
            # sbatch replaces what follows a % in the folder, too
            "output": f"{str(folder).replace('%', '%%')}/%a.log",
            "open-mode": "append",
            "chdir": Path.cwd(),
        }
        sbatch_options = [
            word for key, value in options.items() for word in _option(key, value)
        ]
        try:
            job = _sbatch(sbatch_options, self._script(folder), name)
        except Refused:
            if _queue() is not None:  # so that it is known that no job needs the folder
                shutil.rmtree(folder)
            raise
        write_whole(folder / _SUBMITTED, f"{job}\n")
        return _Array(
            name,
            folder,
            chunks,
            timeout_min=self._timeout_min,
            mem_gb=self._mem_gb,
            waiting={*range(len(chunks))},
        )

    def _script(self, folder: Path) -> str:
        """Returns what a job runs."""
        job = [sys.executable, "-m", "gpmpc.cli._slurm_job", str(folder)]
        lines = [
            "#!/bin/sh",
            *(f"export {name}=1" for name in THREADS),
            *self._setup,
            f'exec {shlex.join(job)} "$SLURM_ARRAY_TASK_ID"',
        ]
        return "\n".join(lines) + "\n"

    def _watch(self, arrays: Sequence[_Array]) -> Generator[ChunkEnd, None, None]:
        """Looks at the queue until all jobs of the arrays have ended; yields ends."""
        interval = _FIRST_LOOK
        last_answer = time.monotonic()
        silence_reported = False
        try:
            while any(array.waiting for array in arrays):
                answer = _squeue()
                if answer.returncode == 0:
                    last_answer = time.monotonic()
                    silence_reported = False
                    ends = [*self._look(arrays, _jobs_of(answer.stdout))]
                else:
                    ends = [*self._look_at_logs(arrays)]
                silence = time.monotonic() - last_answer
                if silence > _SILENCE and not silence_reported:
                    silence_reported = True
                    print_error(
                        "squeue has told nothing for a minute "
                        f"({_one_line(answer.stderr) or 'and not why'}); waiting for "
                        "it, or for the logs of the jobs"
                    )
                yield from ends
                interval = _FIRST_LOOK if ends else interval
                if any(array.waiting for array in arrays):
                    time.sleep(interval)
                interval = min(_SLOWER * interval, _LAST_LOOK)
        # Who consumes the ends may be interrupted, too, and closes this generator.
        except (KeyboardInterrupt, GeneratorExit):
            for array in arrays:
                if array.waiting:
                    print_error(f"jobs go on; to end them: scancel -n {array.name}")
            raise

    def _look(
        self, arrays: Sequence[_Array], jobs: Mapping[tuple[str, int], _Job]
    ) -> Iterator[ChunkEnd]:
        """Yields the ends that the queue tells, and notes them."""
        for array in arrays:
            if not array.waiting:
                continue
            ended = self._newly_ended(array, jobs)
            array.waiting -= ended.keys()
            for index, job in ended.items():
                yield self._chunk_end(array, index, job)
            # ``waiting`` are those that this sweep wants; others may run as well.
            states = [jobs.get((array.name, i)) for i in range(len(array.chunks))]
            some_wait = any(job and job.state not in _ENDED_STATES for job in states)
            if not array.waiting and not some_wait:
                write_whole(array.folder / _ENDED, "")

    def _look_at_logs(self, arrays: Sequence[_Array]) -> Iterator[ChunkEnd]:
        """Yields the jobs that came to their end, as their logs tell."""
        for array in arrays:
            for index in sorted(array.waiting):
                if _done_on(_tail(array.folder / f"{index}.log") or ""):
                    array.waiting.discard(index)
                    yield self._chunk_end(array, index, job=None)

    def _newly_ended(
        self, array: _Array, jobs: Mapping[tuple[str, int], _Job]
    ) -> dict[int, _Job | None]:
        """Returns the jobs of an array that have ended since the last look.

        None stands for one that Slurm has forgotten. A job must be missing twice.
        """
        ended: dict[int, _Job | None] = {}
        for index in sorted(array.waiting):
            job = jobs.get((array.name, index))
            if job is None:
                array.absences[index] = array.absences.get(index, 0) + 1
                if array.absences[index] > 1:
                    ended[index] = None
            elif job.state == "PENDING" and job.reason in _GIVEN_UP:
                _cancel(job)
                ended[index] = job
            elif job.state in _ENDED_STATES:
                ended[index] = job
        if None in ended.values():
            accounted = _accounted(array.name)
            for index, job in ended.items():
                ended[index] = job or accounted.get(index)
        return ended

    def _chunk_end(self, array: _Array, index: int, job: _Job | None) -> ChunkEnd:
        """Returns how a job ended."""
        log = _tail(array.folder / f"{index}.log")
        cause = _cause(job, log)
        host = job.host if job else _done_on(log or "")
        reason = ""
        if cause is not None:
            on_host = f" on {host}" if host else ""
            number = job.number if job else f"{array.name}_{index}"
            outcome = self._reason(cause, array, job, log)
            reason = f"job {number}{on_host} {outcome}"
        return ChunkEnd(
            array.chunks[index], host, cause, reason, adopted_from=array.adopted_from
        )

    def _reason(
        self, cause: Cause, array: _Array, job: _Job | None, log: str | None
    ) -> str:
        """Returns why a job ended, and what helps, as the end of a sentence."""
        if cause is Cause.TIME:
            return (
                f"reached its wall time of {array.timeout_min} min; more by "
                "hydra.launcher.timeout_min, or fewer runs a job by chunk"
            )
        if cause is Cause.MEMORY:
            return (
                f"needed more than its {array.mem_gb:g} GB; more by "
                "hydra.launcher.mem_gb"
            )
        if cause is Cause.CANCELLED:
            return "was cancelled"
        if cause is Cause.NODE:
            return "was ended with its node, or preempted"
        if log is None:
            state = job.reason if job else "forgotten"
            return f"left no log ({state}); does the node see {self._logs}?"
        own = _OWN_ERROR.findall(log)
        if own:
            return f"failed: {own[-1]}"
        how = f" ({job.reason})" if job and job.reason else ""
        last_words = f"; its log ends: {_one_line(log)[-200:]!r}" if log.strip() else ""
        return f"died, and nobody says why{how}{last_words}"


def has_jobs(tree: Path) -> bool:
    """Whether jobs of a sweep's folder wait or run, as far as Slurm tells."""
    arrays = {
        folder.name
        for folder in (tree / _LOGS).glob(f"{_PREFIX}*")
        if not (folder / _ENDED).exists()
    }
    if not arrays or shutil.which("squeue") is None:
        return False
    return any(
        name in arrays and job.state not in _ENDED_STATES
        for (name, _), job in (_queue() or {}).items()
    )


def _option(key: str, value: Any) -> list[str]:
    """Returns an option of sbatch; true makes a flag, false and None leave it out."""
    if value is None or value is False:
        return []
    return [f"--{key}"] if value is True else [f"--{key}={value}"]


def _cause(job: _Job | None, log: str | None) -> Cause | None:
    """Returns why a job did not come to its end; None where it did."""
    if log is None:
        return _cause_without_log(job)
    if job is None and _done_on(log):
        return None
    if job is not None:
        if job.state == "COMPLETED":
            return None
        if job.state in _CAUSES:
            return _CAUSES[job.state]
    for pattern, cause in _LOGGED:
        if pattern.search(log):
            return cause
    if _OWN_ERROR.search(log):
        return Cause.ERROR
    return Cause.CRASH


def _cause_without_log(job: _Job | None) -> Cause | None:
    """Returns why a job ended that left no log."""
    if job is None:  # the queue forgets at once what is cancelled before it runs
        return Cause.CANCELLED
    if job.state == "COMPLETED":  # by what it says
        return None
    return _CAUSES.get(job.state, Cause.ERROR)


def _done_on(log: str) -> str:
    """Returns the host on which a job came to its end; empty if it did not."""
    last_line = log.rstrip().rpartition("\n")[2]
    return last_line.removeprefix(DONE) if last_line.startswith(DONE) else ""


def _sbatch(options: Sequence[str], script: str, name: str) -> str:
    """Submits an array; where Slurm is too busy to answer, again, unless it took it.

    Returns:
        The number of its job.

    Raises:
        Refused: Slurm refuses it, or stays busy.
    """
    command = ["sbatch", "--parsable", *options]
    waits = iter(_WAITS)
    answer = _run(command, script=script)
    while answer.returncode:
        jobs = _queue()
        for (array, _), job in (jobs or {}).items():
            if array == name:
                return job.number.partition("_")[0]
        wait = next(waits, None)
        if wait is None or not _BUSY.search(answer.stderr):
            raise Refused(f"Slurm refuses the sweep: {_one_line(answer.stderr)}")
        time.sleep(wait)
        if jobs is not None:  # else it may have taken it, and is asked once more
            answer = _run(command, script=script)
    return answer.stdout.strip()


def _queue() -> dict[tuple[str, int], _Job] | None:
    """Returns this user's jobs by array's name and index; None if Slurm is silent."""
    answer = _squeue()
    return None if answer.returncode else _jobs_of(answer.stdout)


def _squeue() -> subprocess.CompletedProcess[str]:
    """Asks for this user's jobs."""
    command = ["squeue", "--me", "--array", "--noheader", "--states=all"]
    return _run([*command, f"--format={_FORMAT}"])


def _jobs_of(listing: str) -> dict[tuple[str, int], _Job]:
    """Returns the jobs that squeue lists, by array's name and index."""
    jobs = {}
    for line in listing.splitlines():
        fields = line.split("|")
        if len(fields) != _FIELDS:  # such as "CLUSTER: name" above those of a cluster
            continue
        name, index, *job = fields
        if name.startswith(_PREFIX) and index.isdecimal():
            jobs[name, int(index)] = _Job(*job)
    return jobs


def _accounted(name: str) -> dict[int, _Job]:
    """Returns the jobs of an array that the accounting knows; empty without one."""
    if shutil.which("sacct") is None:
        return {}
    command = ["sacct", "--noheader", "--allocations", "--parsable2", f"--name={name}"]
    answer = _run([*command, "--format=JobID,State,NodeList"])
    if answer.returncode:
        return {}
    jobs = {}
    for line in answer.stdout.splitlines():
        fields = line.split("|")
        if len(fields) != 3:
            continue
        number, state, host = fields
        index = number.rpartition("_")[2]
        state = state.partition(" ")[0]  # of "CANCELLED by 1000"
        if index.isdecimal() and state in _ENDED_STATES:
            host = "" if host == "None assigned" else host
            jobs[int(index)] = _Job(number, state, "", host)
    return jobs


def _cancel(job: _Job) -> None:
    """Takes a job that Slurm gave up out of its queue."""
    _run(["scancel", job.number])


def _most_tasks() -> int:
    """Returns how many jobs an array may have."""
    settings = _run(["scontrol", "show", "config"]).stdout
    match = re.search(r"^MaxArraySize\s*=\s*(\d+)", settings, re.MULTILINE)
    return max(1, int(match[1]) - 1) if match else _MOST_TASKS


def _run(
    command: Sequence[str], script: str | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs a command of Slurm, which may fail, with a script on its standard input.

    One that does not answer in time has failed.
    """
    try:
        return subprocess.run(
            command,
            input=script,
            capture_output=True,
            text=True,
            check=False,
            timeout=_PATIENCE,
        )
    except subprocess.TimeoutExpired:
        reason = f"{command[0]} timed out"
        return subprocess.CompletedProcess(command, 1, stdout="", stderr=reason)


def _tail(log: Path) -> str | None:
    """Returns the end of the last attempt's log; None where there is none."""
    try:
        text = log.read_text(encoding="utf-8", errors="replace")[-_TAIL:]
    except OSError:
        return None
    return _REQUEUED.split(text)[-1]


def _one_line(text: str) -> str:
    return " ".join(text.split())
