"""Tells of one run what a report shows of it, from its ``metrics.json``.

Results may be damaged, or of any other origin: numbers are finite and texts are one
printable line from here on, and a run that cannot give them raises.
"""

import json
import math
import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from sys import intern
from typing import Any, NamedTuple

from gpmpc._provenance import code_fingerprint_or_none, flattened, own_code
from gpmpc.studies._document import plain_text
from gpmpc.studies._run_folder import ERROR, describe_code

# Whatever the content of a damaged file may raise when it is read.
READ_ERRORS = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RecursionError,
)

Choices = dict[str, str]
Result = Mapping[str, Any]  # content of metrics.json or error.json


class Measure(NamedTuple):
    """A number that runs are tabulated by."""

    #: with its unit; {unit} stands for that of the runs' positions or angles
    label: str
    #: takes it from the result of a run; None where the run has none. It may not raise
    #: for results of older versions: such runs would be skipped
    of: Callable[[Result], float | None]


def _outside(result: Result) -> float | None:
    """Returns the steps outside the constraint that was broken most often [%]."""
    rates = [100 * violation["rate"] for violation in result["violations"].values()]
    return max(rates, default=None)


MEASURES: dict[str, Measure] = {
    "rmse": Measure("RMSE [{unit}]", lambda result: result["rmse"]["total"]),
    "outside": Measure("steps outside bounds [%]", _outside),
    "failed": Measure(
        "failed solves [%]",
        lambda result: 100 * sum(result["failures"].values()) / result["steps"],
    ),
    "decision": Measure(
        "decision, median [ms]",
        lambda result: 1e3 * result["times"]["total"]["median"],
    ),
    "training": Measure("training [s]", lambda result: result["times"]["training"]),
}


_EXACT = 1e15  # whole floats below have all their digits

_COLUMNS = (
    "state",
    "folder",
    "unit",
    "settings",
    "origin",
    "code",
    "lost",
    "suspicious",
    "error",
    "search_options",
)
# Of a command, by which it finds its settings; each with a value.
_SEARCH_OPTIONS = ("--config-name", "--config-dir")


class Settings(Mapping[str, Any]):
    """Settings by dotted key, as those of another run with some changes.

    Args:
        base: Those of the other one, with the same keys.
        changes: What differs.
    """

    __slots__ = ("base", "changes")

    def __init__(self, base: dict[str, Any], changes: dict[str, Any]):
        self.base = base
        self.changes = changes

    def __getitem__(self, key: str) -> Any:
        return self.changes[key] if key in self.changes else self.base[key]

    def __iter__(self) -> Iterator[str]:
        return iter(self.base)

    def __len__(self) -> int:
        return len(self.base)


@dataclass(frozen=True, slots=True)
class RunRecord:
    """One run, there or not; see ``Report``."""

    choices: Choices
    state: str
    folder: Path | None = None
    unit: str = ""
    settings: Settings = field(default_factory=lambda: Settings({}, {}))
    origin: Mapping[str, str] = field(default_factory=dict)
    code: str = ""
    lost: str = ""
    suspicious: str = ""
    error: str = ""
    #: that it was lost, or suspicious at its end, as a sweep says it
    warning: str = ""
    #: the version of the code that flew it, in words
    made_by: str = ""
    #: the options of the command by which its settings were found, as typed
    search_options: str = ""
    measures: Mapping[str, float | None] = field(default_factory=dict)
    #: the folder of the sweep that asked for it, of one that is missing
    planned_in: Path | None = None

    @property
    def sweep(self) -> Path | None:
        """The folder that its own folder is in, or would be."""
        return self.planned_in if self.folder is None else self.folder.parent

    def setting(self, key: str) -> str:
        """Returns the value of a setting that was not chosen; empty if unknown."""
        value = self.settings.get(f"options.{key}")
        if value is None:
            value = self.settings.get(key, "")
        return _text_of(value)

    def is_of_this_code(self) -> bool:
        """Whether the code that flew it is that which would fly it now."""
        sections: dict[str, dict[str, Any]] = {}  # by dotted key
        for key, value in self.settings.items():
            section, _, name = key.rpartition(".")
            sections.setdefault(section, {})[name] = value
        own = own_code([*sections.values()])
        return self.code == _code_text(code_fingerprint_or_none(), own)

    def row(self) -> dict[str, Any]:
        """Returns its columns in ``Report.runs`` but for cell and seed."""
        columns = {name: getattr(self, name) for name in _COLUMNS}
        columns["sweep"] = self.sweep
        return columns | {name: self.measures.get(name) for name in MEASURES}


def read_record(path: Path, content: Result) -> RunRecord:
    """Returns a run that finished or failed, from the content of its file."""
    choices = parsed(content["choices"])
    settings = content["settings"]
    options = settings.get("options", {}) if isinstance(settings, Mapping) else None
    if not isinstance(options, Mapping):
        raise TypeError("settings and their options are not by name")
    origin = _origin(content)
    code = _code(content)
    if path.name == ERROR:
        return RunRecord(
            choices=choices,
            state="failed",
            folder=path.parent,
            settings=Settings(flattened(settings), {}),
            origin=origin,
            code=code,
            error=plain_text(content["error"]),
            made_by=_made_by(content),
            search_options=_search_options(content),
        )
    measures = {name: measure.of(content) for name, measure in MEASURES.items()}
    for name, value in measures.items():
        if value is not None and not _is_finite_number(value):
            raise ValueError(f"{name}: must be a finite number; got {value!r:.80}")
    loss = _loss(content)
    return RunRecord(
        choices=choices,
        state="finished",
        folder=path.parent,
        unit=plain_text(content["unit"]),
        settings=Settings(flattened(settings), {}),
        origin=origin,
        code=code,
        lost=loss,
        suspicious="" if loss else _suspicion(content),
        warning=warning_of(content) or "",
        made_by=_made_by(content),
        search_options=_search_options(content),
        measures=measures,
    )


def _is_finite_number(value: Any) -> bool:
    return type(value) in (int, float) and math.isfinite(value)


def _loss(content: Result) -> str:
    """Returns since when and why a run was lost; empty where it was not."""
    loss = content.get("lost") or ""
    if isinstance(loss, Mapping):
        loss = ", ".join(f"{key} {value}" for key, value in loss.items())
    return plain_text(str(loss))


def _suspicion(content: Result) -> str:
    """Returns since when and why a run was suspicious at its end, as it tells."""
    judgement = content.get("judgement") or {}
    if judgement.get("level") != "suspicious":
        return ""
    text = f"step {judgement.get('step')}, reason {judgement.get('reason')}"
    return plain_text(text)


def _origin(content: Result) -> dict[str, str]:
    """Returns date, commit and machine of a run, as far as it tells them."""
    provenance = content.get("provenance") or {}
    git = provenance.get("git") or {}
    if git:
        commit = git["commit"][:10]
        if git.get("dirty"):
            commit += ", changed"
    else:
        commit = (provenance.get("versions") or {}).get("gpmpc")
    machine = [
        f"{value} cores" if key == "cores" else str(value)
        for key, value in (provenance.get("machine") or {}).items()
    ]
    origin = {
        "date": provenance.get("created"),
        "commit": commit,
        "machine": ", ".join(machine),
    }
    return {key: plain_text(str(value)) for key, value in origin.items() if value}


def _code(content: Result) -> str:
    """Returns a text that differs where the code of two runs differs.

    Older runs tell only their commit or version.
    """
    provenance = content.get("provenance") or {}
    of_gpmpc = provenance.get("code") or describe_code(provenance)
    of_user = provenance.get("own_code") or {}
    return plain_text(_code_text(of_gpmpc, of_user))


def _code_text(of_gpmpc: str | None, of_user: Mapping[str, str]) -> str:
    return json.dumps([of_gpmpc, of_user], sort_keys=True)


def _text_of(value: Any) -> str:
    """Returns a value of a setting as reports name it; empty where it is a mapping."""
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        is_whole = value.is_integer() and abs(value) < _EXACT
        return str(int(value)) if is_whole else str(value)
    if isinstance(value, str):
        return plain_text(value)
    if isinstance(value, list):
        return f"[{','.join(map(_text_of, value))}]"
    return ""


@lru_cache(maxsize=100_000)
def plain_value(text: str) -> str:
    """Returns a typed value as reports name it: 1e-1, 0.10 and 0.1 are one."""
    quote = text[:1]
    if quote in ("'", '"') and len(text) > 1 and text.endswith(quote):
        return text[1:-1].replace(f"\\{quote}", quote)
    if text.startswith("["):
        with suppress(ValueError):  # a list of words
            return _text_of(json.loads(text))
        return text
    for number in (int, float):
        with suppress(ValueError):
            return _text_of(number(text))
    return text


def checked_options(text: str) -> str:
    """Returns options of a command as they were typed.

    Raises:
        ValueError: They are no words of a command, such as with a quote left open.
    """
    options = intern(plain_text(text))
    shlex.split(options)
    return options


def parsed(choices: Any) -> Choices:
    """Returns choices, ``key=value`` each, by key."""
    if not isinstance(choices, list):
        raise TypeError(f"choices must be a list; got {choices!r:.80}")
    values = {}
    for choice in choices:
        key, _, value = plain_text(choice).partition("=")
        values[intern(key)] = intern(value)
    return values


def warning_of(result: Result) -> str | None:
    """Returns in a line that a flight was lost, or suspicious at its end, and why."""
    loss = result.get("lost")
    judgement = result.get("judgement")
    if loss:
        return plain_text(f"lost: {_since(loss)}")
    if isinstance(judgement, Mapping) and judgement.get("level") == "suspicious":
        return plain_text(f"suspicious: {_since(judgement)}")
    return None


def _since(event: Any) -> str:
    """Returns from which step on, and why, as far as a result tells."""
    if not isinstance(event, Mapping):
        return str(event)
    return f"from step {event.get('step')} on: {event.get('reason')}"


def _made_by(content: Result) -> str:
    return plain_text(describe_code(content.get("provenance") or {}))


def _search_options(content: Result) -> str:
    """Returns how the command that made a run found its settings, as it was typed."""
    provenance = content.get("provenance") or {}
    options = []
    with suppress(ValueError):  # an older command, whose quotes were not kept
        command = shlex.split(provenance.get("command") or "")
        for word, next_word in pairwise([*command, ""]):
            option, equals, value = word.partition("=")
            if option in _SEARCH_OPTIONS:
                options += [option, value if equals else next_word]
    return plain_text(shlex.join(options))
