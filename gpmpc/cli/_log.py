"""``gpmpc log``: shows, rescues or exports a recording, and inspects any log."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console

from gpmpc._files import write_whole
from gpmpc.cli._commands import Result
from gpmpc.cli._folders import writing
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import DataError, GpmpcError, SettingError
from gpmpc.recording import Run, layout, read_run, recover
from gpmpc.recording._schema import COMPLETE, LEVELS
from gpmpc.studies._document import Document, Table, plain_text, terminal

CUT = "unfinished or damaged; this is what could be read"
_ENDINGS = {  # of files whose kind the ending chooses
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
    """Says what a recording lacks, and what ended its flight early; else nothing."""
    if run.finished or run.whole:
        return _reasons(run)
    return f"{CUT} ({_reasons(run)})"


def _reasons(run: Run) -> str:
    """Says what is wrong with a recording, and what ended its flight early."""
    reasons = [] if run.finished else [flaw.text for flaw in run.flaws]
    if run.ended_by:
        reasons.append(plain_text(f"the flight ended early: {run.ended_by}"))
    return "; ".join(reasons)


def log(arguments: argparse.Namespace) -> Result:
    """Does with a recording what was asked for."""
    action = arguments.action
    file = arguments.file
    if action != "inspect":
        _check_of_recording(arguments)
    if action == "info":
        if arguments.output:
            raise GpmpcError(f"log info: writes nothing; got {arguments.output}")
        return _info(file)
    output = _output(action, file, arguments.output)
    if action == "inspect":
        return _inspect(arguments, output)
    if action == "recover":
        return _recover(file, output)
    if action == "layout":
        return _layout(file, output)
    return _export(file, output)


def _check_of_recording(arguments: argparse.Namespace) -> None:
    """Raises ``GpmpcError`` where an option is given that only ``inspect`` takes."""
    for option in ("mapping", "time", "time_step"):
        if getattr(arguments, option) not in (None, ""):
            name = option.replace("_", "-")
            raise GpmpcError(
                f"--{name}: is for log inspect; got log {arguments.action}"
            )


def _output(action: str, file: Path, chosen: Path | None) -> Path:
    """Returns where an action writes, by default beside the recording."""
    if chosen is None:
        return file.parent / f"{file.stem}{_SUFFIXES[action]}"
    endings = _ENDINGS.get(action)
    if endings is not None and chosen.suffix not in endings:
        raise SettingError(
            "output", f"must end in {' or '.join(endings)}; got {chosen.name!r}"
        )
    return chosen


def _recover(file: Path, output: Path) -> Result:
    """Writes what is whole in an unfinished recording as a new one."""
    flawed = _read_steps(file)
    run = recover(file, output)
    messages = sum(count for count, _ in run.channels.values())
    state = "; ".join(flaw.text for flaw in flawed.flaws)
    if flawed.finished:
        state = "the recording was finished, nothing was missing"
    note = f"{messages} messages over {np.ptp(run.times):g} s; {state}"
    return _written(output, note, run)


def _layout(file: Path, output: Path) -> Result:
    """Writes a layout for Foxglove or Lichtblick that fits the recording."""
    run = _read_steps(file)
    _write(output, layout(run))
    note = f"open {file} in Foxglove or Lichtblick, then import it as a layout"
    return _written(output, note, run)


def _export(file: Path, output: Path) -> Result:
    """Writes the steps as a table, a row each."""
    run = _read_steps(file)
    _write(output, _table_file(run, output.suffix))
    note = f"{len(run.times)} rows, {len(run.columns)} columns"
    if condition(run):
        note += f"; the recording: {condition(run)}"
    return _written(output, note, run)


def _written(output: Path, note: str, run: Run) -> Result:
    """Prints what was written of a recording."""
    print(f"written to {output}: {note}")
    return Result({"output": str(output), "flaws": _flaws(run)})


def _read_steps(file: Path) -> Run:
    """Reads a recording that has steps."""
    run = read_run(file)
    if not len(run.times):
        raise DataError(f"{file}: holds no step ({_reasons(run) or 'it is finished'})")
    return run


def _flaws(run: Run) -> list[dict[str, Any]]:
    return [asdict(flaw) for flaw in run.flaws]


def _info(file: Path) -> Result:
    """Prints channels, facts and metadata of a recording."""
    run = read_run(file)
    console = Console()
    facts = _facts(run)
    lines = [f"{file}: {_state(run)}", *(f"  {flaw.text}" for flaw in run.flaws)]
    console.print(*lines, sep="\n", soft_wrap=True, highlight=False, markup=False)
    channels = [
        (topic, schema, count) for topic, (count, schema) in run.channels.items()
    ]
    metadata = [
        (name, key, value)
        for name, pairs in run.metadata.items()
        if name != "units"
        for key, value in pairs.items()
    ]
    tables = [
        _plain_table(("topic", "schema", "messages"), channels),
        _plain_table(("", ""), [*facts.items()]),
        _plain_table(("metadata", "key", "value"), metadata),
    ]
    console.print(terminal([table for table in tables if table.rows]))
    if not len(run.times):
        print_error(f"{file}: holds no step")
    data = {
        "finished": run.finished,
        "flaws": _flaws(run),
        "channels": {topic: count for topic, (count, _) in run.channels.items()},
        **facts,
        "metadata": dict(run.metadata),
    }
    return Result(data, 0 if len(run.times) else 2)


def _state(run: Run) -> str:
    """Returns in words whether a recording is finished and whole."""
    if run.finished:
        return "; ".join(filter(None, ["finished", condition(run)]))
    if run.whole:
        return "whole, as far as can be told"
    if "recovered" in run.metadata:
        return CUT
    return f"{CUT} (gpmpc log recover makes it readable for other tools)"


def _plain_table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> Table:
    """Returns a table of texts that may come from anywhere."""
    return Table(header, [[plain_text(str(cell)) for cell in row] for row in rows])


def _facts(run: Run) -> dict[str, str]:
    """Returns the numbers of a run in words."""
    facts = {
        "states": _with_units(run, "state", run.state_names),
        "inputs": _with_units(run, "input", run.input_names),
        "steps": str(len(run.times)),
    }
    if len(run.times):
        facts["time"] = f"{run.times[0]:g} to {run.times[-1]:g} s"
        facts["statuses"] = ", ".join(
            f"{status.name} {run.statuses.count(status)}"
            for status in dict.fromkeys(run.statuses)
        )
        facts["not applied"] = str(int(run.failed.sum()))
        outcome = run.metadata.get("end", {}).get("outcome", COMPLETE)
        if outcome != COMPLETE:
            facts["ended by"] = plain_text(outcome)
        judgement = _judgement(run)
        if judgement:
            facts["judgement"] = judgement
        milliseconds = 1e3 * run.timings[:, -1]
        median = float(np.median(milliseconds))
        longest = float(np.max(milliseconds))
        facts["decision"] = f"median {median:.3g} ms, longest {longest:.3g} ms"
        facts["problems"] = f"{len(run.problems)} kept for replay"
    facts["configuration"] = f"{len(run.config.splitlines())} lines"
    return facts


def _with_units(run: Run, kind: str, names: Sequence[str]) -> str:
    units = run.metadata.get("units", {})
    return ", ".join(f"{name} [{units.get(f'{kind}.{name}', '?')}]" for name in names)


def _judgement(run: Run) -> str:
    """Returns how many steps were suspicious or lost; empty where none was."""
    counts = {level: int((run.judgements == level).sum()) for level in LEVELS[1:]}
    if not any(counts.values()):
        return ""
    steps = ", ".join(f"{level} {count}" for level, count in counts.items() if count)
    text = f"{steps}; at the end {run.judgements[-1]}"
    if run.reasons[-1]:
        text += f": {plain_text(run.reasons[-1])}"
    return text


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


def _inspect(arguments: argparse.Namespace, output: Path) -> Result:
    """Writes a page about a log: streams, channels, delays and excitation."""
    # Loads torch, which the other actions do without.
    from gpmpc.logs import LogMapping, inspect_log
    from gpmpc.plotting import inspection_figure, png

    mapping = LogMapping.load(arguments.mapping) if arguments.mapping else None
    inspection = inspect_log(
        arguments.file, mapping, time=arguments.time, time_step=arguments.time_step
    )
    channels = inspection.channels.reset_index()
    excitation = pd.DataFrame(
        [*inspection.follows.items()], columns=["input", "explained by the states"]
    )
    shown = [
        _frame_table(inspection.streams, "Streams"),
        _frame_table(channels, "Channels"),
    ]
    if_any = [
        _frame_table(inspection.delays, "Delays between correlated channels"),
        _frame_table(excitation, "Excitation"),
    ]
    page = Document(
        title=inspection.title,
        tables=[*shown, *(table for table in if_any if table.rows)],
        data=channels,
        lists={"Beware": inspection.warnings or ["nothing was found"]},
        images={"inspection.png": png(inspection_figure(inspection), dpi=100)},
    )
    _write(output, page.html())
    Console().print(terminal(shown))
    lines = [*inspection.warnings, f"written to {output}"]
    console = Console(soft_wrap=True, highlight=False, markup=False)
    console.print(*lines, sep="\n")
    data = {
        "output": str(output),
        "warnings": [*inspection.warnings],
        "channels": page.data.to_dict("records"),
    }
    return Result(data)


def _frame_table(frame: pd.DataFrame, title: str) -> Table:
    return Table([*frame], frame.to_numpy(object).tolist(), title)


def _write(output: Path, content: str | bytes) -> None:
    with writing(output, "output"):
        write_whole(output, content)
