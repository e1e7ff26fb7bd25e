"""Runs every condition of a study with every seed, and keeps each record at once.

    conditions x seeds -> trials -> those without a record are run -> store -> tables

Trials are independent: they run in worker processes of one thread each. The record of a
finished one is appended to a file, under the fingerprint of everything that it depends
on, so a study that was killed at any moment goes on where it stopped.
"""

import hashlib
import json
import logging
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from filelock import lock_descriptor
from threadpoolctl import threadpool_limits

from gpmpc._compiling import report_compilation
from gpmpc._provenance import code_fingerprint, own_code
from gpmpc._remarks import remarks_to
from gpmpc.exceptions import (
    Diverged,
    GpmpcError,
    ProblemError,
    SettingError,
    SolverFailure,
    TrainingError,
    UnsupportedModel,
)
from gpmpc.gp import Training, Transitions
from gpmpc.models import DynamicsModel, load_model, save_model
from gpmpc.parallel import in_processes
from gpmpc.studies._document import Document, Table

__all__ = ["Document", "Study", "Table", "TrialSpec", "TrialStore", "run_study"]


_log = logging.getLogger(__name__)


class LostFlight(GpmpcError):
    """A flight went so far astray that its numbers say nothing: a result, too."""


_LinAlgError = torch.linalg.LinAlgError  # pyright: ignore[reportPrivateImportUsage]
# Errors that settings, data and code alone decide: they come again.
_RESULTS = (
    Diverged,
    LostFlight,
    ProblemError,
    SolverFailure,
    TrainingError,
    UnsupportedModel,
    _LinAlgError,
)


@dataclass(frozen=True)
class TrialSpec:
    """One condition with one seed: a trial that can be run."""

    #: first entries of its record, plain data: what the condition is called, which
    #: trial it is
    labels: Mapping[str, Any]
    #: what ``run_trial`` needs of the condition; it can be pickled
    condition: Any
    #: of all random numbers
    seed: int
    #: names everything that the numbers of the record depend on
    fingerprint: str


RunTrial = Callable[[TrialSpec], dict[str, Any]]


class Study(Protocol):
    """A published result: which trials it needs, and how tables follow from records."""

    #: of its documents
    name: str
    #: what its trials are called in JSON
    trial_name: str
    #: whether a trial that raises, such as a lost flight, is a result like any other
    lost_is_result: bool
    #: runs one trial
    run_trial: RunTrial
    #: processes; None takes one a core
    workers: int | None

    def trials(self, folder: Path) -> list[TrialSpec]:
        """Returns every trial in the order of the tables.

        Trained models are kept in ``folder``.
        """
        ...

    def summary(self, records: Sequence[dict]) -> tuple[list[Table], list[str]]:
        """Returns the tables for a terminal and the paragraphs below them."""
        ...

    def document(self, records: Sequence[dict]) -> Document:
        """Returns everything that is written."""
        ...


def run_study(
    run_trial: RunTrial,
    trials: Sequence[TrialSpec],
    store: "TrialStore",
    workers: int | None = None,
    progress: Callable[[dict], None] = lambda record: None,
) -> list[dict]:
    """Runs the trials that the store does not hold yet.

    Args:
        run_trial: From a trial to plain data. What it raises as a ``GpmpcError``, or of
            linear algebra, is the trial's ``error``; the others go on. One that its
            settings and code decide is kept; a trial that failed for another reason,
            such as a full disk or a library that is missing, is run again next time,
            and ``is_result`` of its record is false.
        trials: All of the study.
        store: Where records are kept.
        workers: Processes; None takes one a core.
        progress: Called with every record, whether it was there or is new. What trials
            warn of is logged once before it.

    Returns:
        One record a trial, in their order.

    Raises:
        GpmpcError: A worker process died.
    """
    missing: dict[str, TrialSpec] = {}
    for trial in trials:
        if trial.fingerprint in store.records:
            progress(store.records[trial.fingerprint])
        else:
            missing[trial.fingerprint] = trial
    jobs = list(missing.values())
    not_kept: dict[str, dict] = {}
    remarked: set[str] = set()
    run = partial(_run_in_worker, run_trial)
    try:
        with closing(in_processes(run, jobs, workers)) as finished:
            for index, ended in finished:
                record = ended.record
                if ended.is_result:
                    store.append(jobs[index].fingerprint, record)
                else:
                    record["is_result"] = False
                    not_kept[jobs[index].fingerprint] = record
                for text in ended.remarks:
                    if text not in remarked:
                        remarked.add(text)
                        _log.warning(text)
                progress(record)
    except BrokenProcessPool as error:
        raise GpmpcError(
            "a worker process died (out of memory?); "
            "the same command goes on where it stopped"
        ) from error
    records = store.records | not_kept
    return [records[trial.fingerprint] | dict(trial.labels) for trial in trials]


def is_lost(record: Mapping[str, Any]) -> bool:
    """Whether a trial was lost by what it tries, which is a result."""
    return "error" in record and not is_failed(record)


def is_failed(record: Mapping[str, Any]) -> bool:
    """Whether a trial failed by its surroundings, which is no result."""
    return not record.get("is_result", True)


class _EndOfTrial(NamedTuple):
    """What a worker process hands back of a trial."""

    record: dict[str, Any]
    #: whether the record would be the same if the trial were run again
    is_result: bool
    #: what the package warned of on the way
    remarks: Sequence[str]


@report_compilation()
def _run_in_worker(run_trial: RunTrial, trial: TrialSpec) -> _EndOfTrial:
    """Runs one trial in a worker process."""
    record = {**trial.labels, "seed": trial.seed}
    is_result = True
    remarks: list[str] = []
    with remarks_to(remarks.append):
        try:
            with one_thread():
                record |= run_trial(trial)
        except (GpmpcError, _LinAlgError) as error:
            record["error"] = str(error)
            is_result = isinstance(error, _RESULTS)
    return _EndOfTrial(record, is_result, remarks)


class TrialStore:
    """Records of finished trials, in a file of one JSON object a line.

    A line that a crash cut short is skipped. Where two processes may share a file, one
    opens it with ``held``: both would run each trial, and disturb each other's times.

    Args:
        path: The file; ``held`` or the first ``append`` makes it.
    """

    def __init__(self, path: Path):
        self.path = path
        #: by fingerprint
        self.records: dict[str, dict] = {}
        text = ""
        if path.exists():
            text = path.read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines():
            with suppress(ValueError, KeyError, TypeError):
                entry = json.loads(line)
                self.records[entry["fingerprint"]] = entry["record"]
        self._cut_short = text != "" and not text.endswith("\n")

    @staticmethod
    @contextmanager
    def held(path: Path) -> Iterator["TrialStore"]:
        """Opens a store for one process alone.

        Raises:
            GpmpcError: Another process holds it.
        """
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not lock_descriptor(file, blocking=False):
                raise GpmpcError(
                    f"{path}: another process runs these trials; wait for its end, or "
                    "choose another folder"
                )
            yield TrialStore(path)
        finally:
            os.close(file)

    def append(self, fingerprint: str, record: dict) -> None:
        """Keeps a record; it is on the disk when this returns."""
        line = json.dumps({"fingerprint": fingerprint, "record": record}) + "\n"
        if self._cut_short:
            line = "\n" + line
        with self.path.open("a", encoding="utf-8") as file:
            file.write(line)
            file.flush()
            os.fsync(file.fileno())
        self._cut_short = False
        self.records[fingerprint] = record


def fingerprint(settings: Any, arrays: Sequence[Any] = ()) -> str:
    """Returns a text that differs where settings, arrays or code differ.

    A record is kept under it, so that one of other code is not taken for one of this.
    The code is all of gpmpc, and what of the user's own the settings name.

    Args:
        settings: Plain data.
        arrays: NumPy arrays or CPU tensors; None where there is none.

    Raises:
        GpmpcError: The source of the code is not there.
    """
    content = [code_fingerprint(), own_code(settings), settings]
    text = json.dumps(content, sort_keys=True, default=str)
    digest = hashlib.sha256(text.encode())
    for array in arrays:
        if array is None:
            digest.update(json.dumps(None).encode())
            continue
        values = np.ascontiguousarray(array)
        # Shapes keep two arrays apart from others of the same bytes.
        shape = [values.dtype.str, *values.shape]
        digest.update(json.dumps(shape).encode())
        digest.update(values.tobytes())
    return digest.hexdigest()[:32]


def derived_seed(*parts: int) -> int:
    """Returns a seed for a sequence of whole numbers below 2^32.

    Sequences of one length have seeds of their own.
    """
    return int(np.random.SeedSequence(parts).generate_state(1)[0])


def random_rows(count: int, size: int, seed: int, key: str = "size") -> list[int]:
    """Draws ``size`` of ``count`` rows; those of one seed are nested over sizes.

    Returns:
        The rows, sorted.

    Raises:
        SettingError: There are fewer rows than the setting ``key`` asks for.
    """
    if size > count:
        raise SettingError(
            key, f"must be at most {count}, the rows of the data; got {size}"
        )
    return np.sort(np.random.default_rng(seed).permutation(count)[:size]).tolist()


@contextmanager
def one_thread() -> Iterator[None]:
    """Keeps numerical libraries to one thread, so that sums have one order."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        torch.set_num_threads(before)


def trained_model(
    train: Callable[..., Training],
    settings: Any,
    data: Transitions,
    seed: int,
    folder: Path,
) -> Path:
    """Trains GPs unless ``folder`` has those of this code, settings, data and seed.

    Returns:
        The file that holds them.
    """
    name = fingerprint([settings, seed], [data.features, data.next_states])
    path = folder / "models" / f"{name}.safetensors"
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        with one_thread():
            training = train(data, seed=seed)
            save_model(training.posterior, path)
    return path


@lru_cache(maxsize=8)
def read_model(path: Path) -> DynamicsModel:
    """Reads a trained model, once a process."""
    return load_model(path)
