"""Problem: a measurement takes a quarter of an hour or more, and what ends it early must cost only what was going on.

A part is a list of groups: contenders that take turns, measured in one go. What comes of each is appended to a file at
once, as ``gpmpc tables`` keeps its fits, and the same measurement, begun again, takes it from there. The same is one
of the same settings, code and versions on the same processor; records of another one do not count. The file exists
exactly as long as the measurement is incomplete.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import gpmpc
from gpmpc.experiments.run_folder import difference
from gpmpc.experiments.tables import FitStore, digest
from gpmpc.provenance import PACKAGES, git_commit, versions

DOCUMENTS, RESULTS = ("bench.json", "bench.md", "steps.png", "quality.png"), "bench.jsonl"
IDENTITY = "identity"
HARDWARE = ("processor", "cores", "caches", "threads")  # of a machine; its rates are never twice the same
OTHERS = ("numba", "do-mpc", "daqp")  # packages that figures depend on, besides those that every result names
TOLD = 10  # digits of a fingerprint that a person compares


class Group(NamedTuple):
    """Contenders that take turns.

    Attributes:
        name: No other group of the part has it.
        measure: Measures them; what comes of it is plain data.
    """

    name: str
    measure: Callable[[], Any]


class Part(Protocol):
    """Something that is measured group by group."""

    def groups(self) -> list[Group]:
        """In the order in which they are measured."""

    def rows(self, records: Sequence[Any]) -> list[dict]:
        """What can be said when the first groups, ``len(records)`` of them, are measured."""


def identity(settings: Mapping[str, Any], machine: Mapping[str, Any]) -> dict[str, Any]:
    """What two halves of one measurement have in common, as plain data.

    Args:
        settings: Those that a figure depends on.
        machine: From ``gpmpc.bench.machine.machine``.
    """
    git = git_commit()
    return {
        "settings": dict(settings),
        "commit": git and git["commit"][:TOLD],
        "code": _code(),
        "versions": versions((*PACKAGES, *OTHERS)),
        "machine": {key: machine[key] for key in HARDWARE},
    }


@cache
def _code() -> str:
    """The package's source: of one commit it may have been changed."""
    package = Path(gpmpc.__file__).parent
    return digest(*(path.read_bytes() for path in sorted(package.rglob("*.py"))))[:TOLD]


class Kept:
    """The results of one measurement's groups, in a file.

    Args:
        folder: Where the file is, or will be with the first result.
        identity: Of this measurement; see the function.
        sitting: Of this process, plain data: when it began, and what the machine was like.

    Attributes:
        differs: In what the results that lie there are another measurement's. They do not count, and go with the first
            new one. Empty where there are none.
    """

    def __init__(self, folder: Path, identity: Mapping[str, Any], sitting: Mapping[str, Any]):
        self._folder, self._identity, self._sitting = folder, dict(identity), dict(sitting)
        self._store = FitStore(folder / incomplete(RESULTS))
        then = self._store.records.pop(IDENTITY, None)
        self.differs = "" if then is None else difference(then, self._identity)
        self._begun = then is not None and not self.differs

    @property
    def _results(self) -> dict[str, dict]:
        return self._store.records if self._begun else {}

    def __contains__(self, key: tuple[str, str]) -> bool:
        """Whether there is a result, by the names of part and group."""
        return ": ".join(key) in self._results

    def __getitem__(self, key: tuple[str, str]) -> Any:
        """A group's result."""
        return self._results[": ".join(key)]["result"]

    def __len__(self) -> int:
        """Results."""
        return len(self._results)

    @property
    def sittings(self) -> list[dict]:
        """All that measured something, the first one first, and how many ``groups``."""
        made = [record["sitting"] for record in self._results.values()]
        return [sitting | {"groups": made.count(sitting)} for i, sitting in enumerate(made) if sitting not in made[:i]]

    def counts(self, planned: Mapping[str, Part]) -> dict[str, tuple[int, int]]:
        """Of every part: how many groups have a result, and how many there are."""
        named = {part: [group.name for group in plan.groups()] for part, plan in planned.items()}
        return {part: (sum((part, name) in self for name in names), len(names)) for part, names in named.items()}

    def rows(self, planned: Mapping[str, Part]) -> list[dict]:
        """What all results say."""
        found = []
        for part, plan in planned.items():
            keys = [(part, group.name) for group in plan.groups()]
            found += plan.rows([self[key] for key in keys if key in self])
        return found

    def add(self, key: tuple[str, str], result: Any) -> None:
        """Keeps a group's result; it is on the disk when this returns."""
        if not self._begun:
            self.forget()
            self._store.append(IDENTITY, self._identity)
            del self._store.records[IDENTITY]
            self._begun = True
        self._store.append(": ".join(key), {"sitting": self._sitting, "result": result})

    def forget(self) -> None:
        """Removes every file of an incomplete measurement."""
        for name in (*DOCUMENTS, RESULTS):
            (self._folder / incomplete(name)).unlink(missing_ok=True)
        self._store, self._begun = FitStore(self._folder / incomplete(RESULTS)), False


def incomplete(name: str) -> str:
    """What a file is called as long as its measurement is incomplete."""
    stem, _, ending = name.rpartition(".")
    return f"{stem}.incomplete.{ending}"
