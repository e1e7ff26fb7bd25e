"""Keeps what a report shows of the runs of a tree in one file, so that it reads one.

    FOLDER/index.jsonl    a line a run, written when its end was seen

Settings are stored once as a base line; a run's line names its base and the values
that differ.

The folders stay the truth. A line counts as long as the file that it was taken from has
the size and the time of then. What is missing, or does not count any more, whoever
needs it reads from its folder, and adds a line. So the file may be removed, cut short
or out of date: it is never wrong. Lines are only added, each in one piece and under a
lock. They may be of any origin, and are checked like the results.
"""

import json
import math
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from sys import intern
from typing import Any

from filelock import lock_descriptor

from gpmpc.studies._document import plain_text
from gpmpc.studies._run_folder import ERROR, METRICS
from gpmpc.studies._run_record import (
    MEASURES,
    READ_ERRORS,
    RunRecord,
    Settings,
    checked_options,
    read_record,
)

INDEX = "index.jsonl"
_MOST_UNWRITTEN = 500  # lines
_STATES = {METRICS: "finished", ERROR: "failed"}
_TEXTS = ("unit", "code", "lost", "suspicious", "error", "warning", "made_by")


@dataclass(frozen=True, slots=True)
class _Line:
    """A run as the index has it."""

    file: str
    #: when the file was written [ns], and its size
    written: int
    size: int
    record: RunRecord
    #: of the settings that a sweep asked for, and that the run has
    fingerprint: str | None


class RunIndex:
    """What is known of the runs in the folders below one folder.

    Args:
        tree: That folder.
    """

    def __init__(self, tree: Path):
        self._tree = tree
        self._path = tree / INDEX
        self._bases: dict[str, dict[str, Any]] = {}  # settings
        self._base_of_keys: dict[tuple[str, ...], str] = {}
        self._lines: dict[str, _Line] = {}  # by name of the run's folder
        self._unwritten: list[str] = []
        self._written_bases: set[str] = set()
        self._origins: dict[tuple[tuple[str, str], ...], dict[str, str]] = {}
        self._read()

    def record(self, path: Path) -> RunRecord:
        """Returns the run of a ``metrics.json`` or ``error.json``.

        Raises:
            READ_ERRORS: The file is none that a run writes.
        """
        line = self._valid_line(path)
        if line is not None:
            return line.record
        return self.add(path)

    def add(
        self, path: Path, content: Any = None, fingerprint: str | None = None
    ) -> RunRecord:
        """Adds a run; ``write`` puts it into the file, or one that follows does.

        Args:
            path: Its ``metrics.json`` or ``error.json``.
            content: Of the file; None reads it.
            fingerprint: Of the settings that a sweep asked for, where it has compared
                them with the run's and they are the same.

        Raises:
            READ_ERRORS: The file is none that a run writes.
        """
        status = path.stat()
        if content is None:
            content = json.loads(path.read_text(encoding="utf-8"))
        record = self._compact(read_record(path, content))
        line = _Line(
            file=path.name,
            written=status.st_mtime_ns,
            size=status.st_size,
            record=record,
            fingerprint=fingerprint,
        )
        self._lines[path.parent.name] = line
        base = self._base_of_keys[tuple(record.settings)]
        if base not in self._written_bases:
            self._written_bases.add(base)
            content_of_base = {"base": base, "settings": self._bases[base]}
            self._unwritten.append(json.dumps(content_of_base))
        self._unwritten.append(json.dumps(_content(path.parent.name, base, line)))
        if len(self._unwritten) > _MOST_UNWRITTEN:
            self.write()
        return record

    def record_with(self, path: Path, fingerprint: str) -> RunRecord | None:
        """Returns a run that was found to have the settings of a fingerprint."""
        line = self._valid_line(path)
        if line is None or line.fingerprint != fingerprint:
            return None
        return line.record

    def write(self) -> None:
        """Appends what was added; where that is not possible, nothing is lost."""
        if not self._unwritten:
            return
        text = "\n".join([*self._unwritten, ""])
        self._unwritten.clear()
        with suppress(OSError):
            file = os.open(self._path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
            try:
                lock_descriptor(file)
                size = os.fstat(file).st_size
                if size and os.pread(file, 1, size - 1) != b"\n":  # cut short
                    text = "\n" + text
                unwritten = memoryview(text.encode())
                while unwritten:
                    unwritten = unwritten[os.write(file, unwritten) :]
            finally:
                os.close(file)

    def _valid_line(self, path: Path) -> _Line | None:
        """Returns the line of a run, if it was taken from the file that is there."""
        line = self._lines.get(path.parent.name)
        if line is None or line.file != path.name:
            return None
        try:
            status = os.stat(path)
        except FileNotFoundError:
            return None
        if (status.st_mtime_ns, status.st_size) != (line.written, line.size):
            return None
        return line

    def _read(self) -> None:
        """Reads the lines; of those of one run the last counts."""
        try:
            file = self._path.open(encoding="utf-8", errors="replace")
        except OSError:
            return
        with file:
            for text in file:
                with suppress(*READ_ERRORS):
                    self._read_line(json.loads(text), self._tree)

    def _read_line(self, content: dict[str, Any], tree: Path) -> None:
        if "settings" in content:
            settings = dict(content["settings"])
            base = str(content["base"])
            self._bases[base] = {plain_text(key): settings[key] for key in settings}
            self._base_of_keys[tuple(self._bases[base])] = base
            self._written_bases.add(base)
            return
        name = content["run"]
        base = self._bases[content["base"]]
        changes = content["changes"]
        if not changes.keys() <= base.keys():
            raise ValueError("changes settings that are not there")
        texts: dict[str, Any] = {
            key: intern(plain_text(content[key])) for key in _TEXTS
        }
        record = RunRecord(
            choices=_texts_by_name(content["choices"]),
            state=_STATES[content["file"]],
            folder=tree / name,
            settings=Settings(base, changes),
            origin=self._shared_origin(_texts_by_name(content["origin"])),
            measures=_finite_measures(content["measures"]),
            search_options=checked_options(content.get("search_options", "")),
            **texts,
        )
        self._lines[name] = _Line(
            file=content["file"],
            written=int(content["written"]),
            size=int(content["size"]),
            record=record,
            fingerprint=content["fingerprint"],
        )

    def _compact(self, record: RunRecord) -> RunRecord:
        """Returns a run that shares what others have as well."""
        settings = dict(record.settings)
        keys = tuple(settings)
        if keys not in self._base_of_keys:
            digest = sha256(json.dumps(settings).encode()).hexdigest()[:12]
            self._base_of_keys[keys] = digest
            self._bases[digest] = settings
        base = self._bases[self._base_of_keys[keys]]
        changes = {
            intern(key): value
            for key, value in settings.items()
            if value != base[key] or type(value) is not type(base[key])
        }
        texts: dict[str, Any] = {key: intern(getattr(record, key)) for key in _TEXTS}
        return RunRecord(
            choices=record.choices,
            state=record.state,
            folder=record.folder,
            settings=Settings(base, changes),
            origin=self._shared_origin(record.origin),
            measures=record.measures,
            search_options=intern(record.search_options),
            **texts,
        )

    def _shared_origin(self, origin: Mapping[str, str]) -> dict[str, str]:
        """Returns the same dictionary for equal ones."""
        return self._origins.setdefault(tuple(origin.items()), dict(origin))


def _content(name: str, base: str, line: _Line) -> dict[str, Any]:
    """Returns a line of the file as plain data."""
    record = line.record
    options = {}
    if record.search_options:
        options["search_options"] = record.search_options
    return {
        "run": name,
        "file": line.file,
        "written": line.written,
        "size": line.size,
        "fingerprint": line.fingerprint,
        "base": base,
        "changes": record.settings.changes,
        "choices": record.choices,
        "origin": record.origin,
        "measures": record.measures,
        **{key: getattr(record, key) for key in _TEXTS},
        **options,
    }


def _texts_by_name(content: Mapping[str, Any]) -> dict[str, str]:
    return {
        intern(plain_text(key)): intern(plain_text(value))
        for key, value in content.items()
    }


def _finite_measures(content: Mapping[str, Any]) -> dict[str, float | None]:
    """Returns measures by name; a failed run has none.

    Raises:
        ValueError: One is no finite number, or they are those of another version.
    """
    if content and content.keys() != MEASURES.keys():
        raise ValueError(f"has other measures: {', '.join(content)}")
    for name, value in content.items():
        is_number = type(value) in (int, float) and math.isfinite(value)
        if not (is_number or value is None):
            raise ValueError(f"{name}: must be a finite number; got {value!r:.80}")
    return {intern(name): value for name, value in content.items()}
