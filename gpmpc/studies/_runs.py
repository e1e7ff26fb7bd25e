"""Puts a tree of runs together: what was varied, the results, what failed and what is missing.

A *cell* is one combination of the varied settings; its runs differ in their seed. Missing is only what a sweep asked
for, in the plans that it leaves in the tree. Runs are read from their ``metrics.json`` and ``error.json`` alone. Those
may be damaged, or of any other origin: numbers are finite and texts are one printable line from here on, and a run that
cannot give them is skipped, with the reason.
"""

import json
import math
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from gpmpc._provenance import flattened
from gpmpc.exceptions import DataError
from gpmpc.studies._document import plain_text
from gpmpc.studies._run_folder import ERROR, METRICS, PLAN, describe_code, folder_name

SEED = "seed"
_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RecursionError,
)  # of a file

Choices = dict[str, str]
Row = dict[str, Any]  # of a cell


# Label with its unit, where {unit} stands for that of the runs' positions or angles, and the number of a run's result.
MEASURES: dict[str, tuple[str, Callable[[Mapping[str, Any]], float | None]]] = {
    "rmse": ("RMSE [{unit}]", lambda r: r["rmse"]["total"]),
    "outside": (
        "steps outside bounds [%]",
        lambda r: max(
            (100 * v["rate"] for v in r["violations"].values()), default=None
        ),
    ),
    "failed": (
        "failed solves [%]",
        lambda r: 100 * sum(r["failures"].values()) / r["steps"],
    ),
    "decision": (
        "decision, median [ms]",
        lambda r: 1e3 * r["times"]["total"]["median"],
    ),
    "training": ("training [s]", lambda r: r["times"]["training"]),
}


_ABSENT = {
    "folder": None,
    "unit": "",
    "settings": {},
    "origin": {},
    "code": "",
    "lost": "",
    "suspicious": "",
    "error": "",
} | dict.fromkeys(MEASURES)


@dataclass(frozen=True)
class Report:
    """A tree of runs.

    ``runs`` has a row for every run that is there or was asked for, cell by cell and seed by seed. Its columns are
    ``cell``, the position in ``cells``; ``seed``, a text; ``state``: "finished", "failed", "missing" (there is nothing
    of it) or "skipped" (it cannot be read); the measures, NaN where the run has none;
    ``lost``, ``suspicious`` (at its end) and ``error``, since when and why; ``folder``; ``unit`` of the errors;
    ``settings`` by dotted key; ``origin``: date, commit and machine; ``code``: names the code that made
    it, "" where there is none or it does not tell.
    """

    tree: Path  #: where it is
    variables: tuple[str, ...]  #: settings that were varied, without the seed
    constants: Choices  #: what was asked for of all runs alike
    cells: tuple[tuple[str, ...], ...]  #: values of the variables, in order
    runs: pd.DataFrame  #: see above
    skipped: tuple[
        str, ...
    ] = ()  #: what could not be read of it, with the reason, one line each

    @cached_property
    def there(self) -> list[Any]:
        """Every run that finished or failed; columns are attributes."""
        return [*self.runs[self.runs.folder.notna()].itertuples()]

    @cached_property
    def measures(self) -> dict[str, str]:
        """The measures that any run has, and what each is called, with both units where runs are of both subsystems."""
        known = self.runs[[*MEASURES]].notna().any()
        unit = " or ".join(sorted({*self.runs.unit} - {""})) or "m"
        return {
            name: label.format(unit=unit)
            for name, (label, _) in MEASURES.items()
            if known[name]
        }

    def base_settings(self) -> list[str]:
        """Returns the settings that all runs share, one ``key: value`` each."""
        first, *others = self.there
        shared = (
            item
            for item in first.settings.items()
            if all(item in run.settings.items() for run in others)
        )
        return [plain_text(f"{key}: {json.dumps(value)}") for key, value in shared]

    def commands(self) -> list[str]:
        """Returns the commands that fill the cells in which runs are missing or failed, one a cell.

        Skipped runs are not among them: a run is not flown over what lies in its folder.
        """
        commands = []
        for cell, runs in self.runs[
            self.runs.state.isin(("missing", "failed"))
        ].groupby("cell"):
            chosen = self.constants | dict(
                zip(self.variables, self.cells[cell], strict=True)
            )
            settings = _spelled(
                {key: value for key, value in chosen.items() if value != "default"}
            )
            sweep = [f"{SEED}={','.join(runs.seed)}", f"folder={self.tree}"]
            commands.append(
                plain_text(shlex.join(["gpmpc", "run", "-m", *settings, *sweep]))
            )
        return commands


def read_report(tree: str | Path) -> Report:
    """Reads every run below a folder and puts them together.

    Raises:
        DataError: There is no such folder, or no run in it that can be read.
    """
    tree = Path(tree)
    if not tree.is_dir():
        raise DataError(f"{tree}: no such folder")
    runs = []
    plans = []
    unread = set()
    skipped = []
    results = {
        path.parent: path
        for name in (ERROR, METRICS)
        for path in sorted(tree.rglob(name))
    }
    for path in [*results.values(), *sorted(tree.rglob(f"{PLAN}*.json"))]:
        planned = path.name.startswith(PLAN)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            if planned:
                plans += [_parsed(choices) for choices in content["runs"]]
            else:
                runs.append((_parsed(content["choices"]), _run(path, content)))
        except _DAMAGE as error:
            lacking = f"it lacks {error}; of an older version?"
            reason = (
                lacking
                if isinstance(error, KeyError)
                else f"{type(error).__name__}: {error}"
            )
            skipped.append(
                plain_text(
                    f"{path}: is not what a {'sweep' if planned else 'run'} writes: {reason}"
                )
            )
            unread.add(path.parent.name)
    if not runs:
        raise DataError(
            skipped[0] if skipped else f"{tree}: holds no run, finished or failed"
        )
    there = {frozenset(choices.items()) for choices, _ in runs}
    for plan in plans:
        if frozenset(plan.items()) not in there:
            state = "skipped" if folder_name(_spelled(plan)) in unread else "missing"
            runs.append((plan, _ABSENT | {"state": state}))
    return Report(tree, *_cells(runs), tuple(skipped))


def _cells(
    runs: list[tuple[Choices, Row]],
) -> tuple[tuple[str, ...], Choices, tuple[tuple[str, ...], ...], pd.DataFrame]:
    """Returns what was varied, what was not, the combinations that there are, and the runs by combination and seed."""
    keys = dict.fromkeys([*(key for choices, _ in runs for key in choices), SEED])
    # A run that did not choose had a setting; of one that is not there it is that of the others.
    usual = {
        key: [
            _setting(run, key)
            for choices, run in runs
            if run["settings"] and key not in choices
        ]
        for key in keys
    }
    filled = []
    for choices, run in runs:
        guesses = {
            key: _setting(run, key) or next(iter(usual[key]), "") or "default"
            for key in keys
        }
        filled.append(
            {key: choices.get(key) or guess for key, guess in guesses.items()}
        )
    values = {key: {choices[key] for choices in filled} for key in keys if key != SEED}
    variables = tuple(sorted(key for key in values if len(values[key]) > 1))
    constants = {
        key: value
        for key, (value, *more) in values.items()
        if not more and value != "default"
    }
    found: dict[tuple[tuple[str, ...], str], Row] = {}
    for choices, (_, run) in zip(filled, runs, strict=True):
        place = tuple(choices[key] for key in variables), choices[SEED]
        if (
            run["state"] == "finished" or place not in found
        ):  # what is there comes first
            found[place] = run
    cells = tuple(
        sorted(
            {values for values, _ in found}, key=lambda values: [*map(in_order, values)]
        )
    )
    number = {values: i for i, values in enumerate(cells)}
    order = sorted(found, key=lambda place: (number[place[0]], in_order(place[1])))
    rows = [
        found[values, seed] | {"cell": number[values], "seed": seed}
        for values, seed in order
    ]
    types = dict.fromkeys(MEASURES, float) | {"cell": int}
    return variables, constants, cells, pd.DataFrame(rows, dtype=object).astype(types)


def in_order(value: str) -> tuple[int, float, str]:
    """Returns a key that sorts numbers by their size, then words."""
    try:
        return 0, float(value), value
    except ValueError:
        return 1, 0.0, value


def _run(path: Path, content: Mapping[str, Any]) -> Row:
    """Returns a run that finished or failed, from its result."""
    settings = content["settings"]
    if not isinstance(settings, Mapping) or not isinstance(
        settings.get("options", {}), Mapping
    ):
        raise TypeError("settings and their options are not by name")
    run = _ABSENT | {
        "folder": path.parent,
        "settings": flattened(settings),
        "origin": _origin(content),
        "code": _code(content),
    }
    if path.name == ERROR:
        return run | {"state": "failed", "error": plain_text(content["error"])}
    numbers = {name: of(content) for name, (_, of) in MEASURES.items()}
    for name, value in numbers.items():
        if value is not None and (
            type(value) not in (int, float) or not math.isfinite(value)
        ):
            raise ValueError(f"{name}: must be a finite number; got {value!r:.80}")
    lost = content.get("lost") or ""
    lost = plain_text(
        ", ".join(f"{k} {v}" for k, v in lost.items())
        if isinstance(lost, Mapping)
        else str(lost)
    )
    return (
        run
        | numbers
        | {
            "state": "finished",
            "lost": lost,
            "suspicious": "" if lost else _suspicion(content),
            "unit": plain_text(content["unit"]),
        }
    )


def _suspicion(content: Mapping[str, Any]) -> str:
    """Returns since when and why a run was suspicious at its end, as far as it tells."""
    judgement = content.get("judgement") or {}
    if judgement.get("level") != "suspicious":
        return ""
    text = f"step {judgement.get('step')}, reason {judgement.get('reason')}"
    return plain_text(text)


def _origin(content: Mapping[str, Any]) -> dict[str, str]:
    """Returns date, commit and machine of a run, as far as it tells them."""
    about = content.get("provenance") or {}
    git = about.get("git") or {}
    machine = about.get("machine") or {}
    versions = about.get("versions") or {}
    commit = (
        f"{git['commit'][:10]}{', changed' if git.get('dirty') else ''}"
        if git
        else versions.get("gpmpc")
    )
    made = ", ".join(
        f"{value} cores" if key == "cores" else str(value)
        for key, value in machine.items()
    )
    named = {"date": about.get("created"), "commit": commit, "machine": made}
    return {key: plain_text(str(value)) for key, value in named.items() if value}


def _code(content: Mapping[str, Any]) -> str:
    """Returns a text that differs where the code of two runs differs, as far as they tell.

    Older runs tell their commit or version alone.
    """
    about = content.get("provenance") or {}
    own_code = about.get("own_code") or {}
    named = about.get("code") or describe_code(about)
    return plain_text(json.dumps([named, own_code], sort_keys=True))


def _parsed(choices: Any) -> Choices:
    """Returns choices, ``key=value`` each, by key."""
    if not isinstance(choices, list):
        raise TypeError(f"choices must be a list; got {choices!r:.80}")
    return {
        key: value
        for key, _, value in (plain_text(choice).partition("=") for choice in choices)
    }


def _spelled(choices: Choices) -> list[str]:
    return [f"{key}={value}" if value else key for key, value in choices.items()]


def _setting(run: Row, key: str) -> str:
    """Returns the value that a run had which did not choose; empty where its settings do not tell."""
    settings = run["settings"]
    value = settings.get(f"options.{key}")
    value = settings.get(key, "") if value is None else value
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return plain_text(str(value)) if isinstance(value, int | float | str) else ""
