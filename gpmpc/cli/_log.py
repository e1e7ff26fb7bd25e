"""``gpmpc log``: what is in a recording, rescue an unfinished one, its steps as a table, a layout to look at it."""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console

from gpmpc._files import write_whole
from gpmpc.cli._commands import Result
from gpmpc.cli._settings import writing
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import DataError, GpmpcError, SettingError
from gpmpc.recording import Run, layout, read_run, recover
from gpmpc.recording._schema import LEVELS
from gpmpc.studies._document import Document, Table, plain_text, terminal

CUT = "unfinished or damaged; this is what could be read"
_ENDINGS = {
    "recover": (".mcap",),
    "export": (".csv", ".parquet"),
    "layout": (".json",),
    "inspect": (".html",),
}
_SUFFIXES = {
    "recover": ".recovered.mcap",
    "export": ".csv",
    "layout": ".layout.json",
    "inspect": ".inspection.html",
}


def condition(run: Run) -> str:
    """Says what is wrong with a recording that is not finished."""
    reasons = "; ".join(flaw.text for flaw in run.flaws)
    return reasons if run.whole else f"{CUT} ({reasons})"


def log(given: argparse.Namespace) -> Result:
    """Does what was asked for with a recording."""
    action = given.action
    file = given.file
    if action == "info":
        if given.output:
            raise GpmpcError(f"log info: writes nothing; got {given.output}")
        return _info(file)
    output = given.output or file.parent / f"{file.stem}{_SUFFIXES[action]}"
    if given.output and action != "recover" and output.suffix not in _ENDINGS[action]:
        raise SettingError(
            "output",
            f"must end in {' or '.join(_ENDINGS[action])}; got {output.name!r}",
        )
    if action == "inspect":
        return _inspect(file, output, given.mapping)
    if action == "recover":
        flawed = _read_steps(file)
        run = recover(file, output)
        messages = sum(count for count, _ in run.channels.values())
        note = f"{messages} messages over {np.ptp(run.times):g} s; "
        note += (
            "the recording was finished, nothing was missing"
            if flawed.finished
            else "; ".join(flaw.text for flaw in flawed.flaws)
        )
    elif action == "layout":
        run = _read_steps(file)
        _write(output, layout(run))
        note = f"open {file} in Foxglove or Lichtblick, then import it as a layout"
    else:
        run = _read_steps(file)
        _write(output, _table_file(run, output.suffix))
        note = f"{len(run.times)} rows, {len(run.columns)} columns"
        note += "" if run.finished else f"; the recording: {condition(run)}"
    print(f"written to {output}: {note}")
    return Result({"output": str(output), "flaws": _flaws(run)})


def _read_steps(file: Path) -> Run:
    """Reads a recording that has steps."""
    run = read_run(file)
    if not len(run.times):
        raise DataError(f"{file}: holds no step ({condition(run) or 'it is finished'})")
    return run


def _flaws(run: Run) -> list[dict[str, Any]]:
    return [asdict(flaw) for flaw in run.flaws]


def _info(file: Path) -> Result:
    run = read_run(file)
    console = Console()
    facts = _facts(run)
    hint = (
        ""
        if "recovered" in run.metadata
        else " (gpmpc log recover makes it readable for other tools)"
    )
    state = "finished" if run.finished else f"{CUT}{hint}"
    if run.whole and not run.finished:
        state = "whole, as far as can be told"
    lines = [f"{file}: {state}", *(f"  {flaw.text}" for flaw in run.flaws)]
    console.print(*lines, sep="\n", soft_wrap=True, highlight=False, markup=False)
    metadata = [
        (n, k, v)
        for n, pairs in run.metadata.items()
        if n != "units"
        for k, v in pairs.items()
    ]
    channels = [
        (topic, schema, count) for topic, (count, schema) in run.channels.items()
    ]
    tables = [
        Table(head, [[plain_text(str(cell)) for cell in row] for row in rows])
        for head, rows in (
            (("topic", "schema", "messages"), channels),
            (("", ""), [*facts.items()]),
            (("metadata", "key", "value"), metadata),
        )
        if rows
    ]
    console.print(terminal(tables))
    counts = {topic: count for topic, (count, _) in run.channels.items()}
    if not len(run.times):
        print_error(f"{file}: holds no step")
    return Result(
        {
            "finished": run.finished,
            "flaws": _flaws(run),
            "channels": counts,
            **facts,
            "metadata": dict(run.metadata),
        },
        0 if len(run.times) else 2,
    )


def _facts(run: Run) -> dict[str, str]:
    """The numbers of a run in words."""
    units = run.metadata.get("units", {})
    names = [("states", "state", run.state_names), ("inputs", "input", run.input_names)]
    facts = {
        title: ", ".join(f"{n} [{units.get(f'{g}.{n}', '?')}]" for n in group)
        for title, g, group in names
    }
    K = len(run.times)
    facts["steps"] = str(K)
    if K:
        facts["time"] = f"{run.times[0]:g} to {run.times[-1]:g} s"
        counts = {
            status: run.statuses.count(status) for status in dict.fromkeys(run.statuses)
        }
        facts["statuses"] = ", ".join(
            f"{status.name} {count}" for status, count in counts.items()
        )
        facts["not applied"] = str(int(run.failed.sum()))
        judged = [(run.judgements == level).sum() for level in LEVELS[1:]]
        if any(judged):
            counts = zip(LEVELS[1:], judged, strict=True)
            steps = ", ".join(f"{level} {count}" for level, count in counts if count)
            last = f"; at the end {run.judgements[-1]}"
            why = f": {plain_text(run.reasons[-1])}" if run.reasons[-1] else ""
            facts["judgement"] = f"{steps}{last}{why}"
        median, worst = (
            1e3 * float(f(run.timings[:, -1])) for f in (np.median, np.max)
        )
        facts["decision"] = f"median {median:.3g} ms, longest {worst:.3g} ms"
        facts["problems"] = f"{len(run.problems)} kept for replay"
    facts["configuration"] = f"{len(run.config.splitlines())} lines"
    return facts


def _table_file(run: Run, ending: str) -> str | bytes:
    """Returns the steps as CSV, or as Parquet."""
    frame = run.to_pandas()
    frame.attrs = {}  # pandas would store them, as text that others do not read
    if ending == ".csv":
        return frame.to_csv(index=False, lineterminator="\n", na_rep="nan")
    try:
        return frame.to_parquet(index=False)
    except ImportError as error:
        raise GpmpcError(
            "Parquet needs pyarrow: pip install 'gpmpc[report]'"
        ) from error


def _inspect(file: Path, output: Path, mapping_file: Path | None) -> Result:
    from gpmpc.logs import (
        LogMapping,
        inspect_log,
    )  # loads torch, which what is above does without
    from gpmpc.plotting import inspection_figure, png

    mapping = LogMapping.load(mapping_file) if mapping_file else None
    found = inspect_log(file, mapping)
    follows = pd.DataFrame(
        [*found.follows.items()], columns=["input", "explained by the states"]
    )
    frames = {
        "Streams": found.streams,
        "Channels": found.channels.reset_index(),
        "Delays between correlated channels": found.delays,
        "Excitation": follows,
    }
    tables = [
        Table([*frame], frame.to_numpy(object).tolist(), title)
        for title, frame in frames.items()
        if title in ("Streams", "Channels") or len(frame)
    ]
    page = Document(
        found.title,
        tables,
        frames["Channels"],
        lists={"Beware": found.warnings or ["nothing was found"]},
        images={"inspection.png": png(inspection_figure(found), dpi=100)},
    )
    _write(output, page.html())
    Console().print(terminal(tables[:2]))
    Console(soft_wrap=True, highlight=False, markup=False).print(
        *found.warnings, f"written to {output}", sep="\n"
    )
    return Result(
        {
            "output": str(output),
            "warnings": [*found.warnings],
            "channels": page.data.to_dict("records"),
        }
    )


def _write(output: Path, content: str | bytes) -> None:
    with writing(output, "output"):
        write_whole(output, content)
