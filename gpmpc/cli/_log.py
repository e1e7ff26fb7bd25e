"""``gpmpc log``: what is in a recording, rescue an unfinished one, its steps as a table, a layout to look at it."""

import argparse
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpmpc.cli._arguments import Command, Parser, Result, writing
from gpmpc.exceptions import GpmpcError, SettingError

if TYPE_CHECKING:
    from gpmpc.recording import Run

ENDINGS = {"recover": (".mcap",), "export": (".csv", ".parquet"), "layout": (".json",), "inspect": (".html",)}
SUFFIXES = {"recover": ".recovered.mcap", "export": ".csv", "layout": ".layout.json", "inspect": ".inspection.html"}
CUT = "unfinished or damaged; this is what could be read"


def _add_arguments(parser: Parser) -> None:
    what = "info: channels, times, how the solves ended; recover: what is whole in an unfinished file, as a new one; "
    what += "export: the steps as a table, a row each; layout: for Foxglove or Lichtblick, fitting the recording; "
    what += "inspect: rates, gaps, repeated values, noise, delays and excitation of any log, on one page"
    parser.add_argument("action", choices=["info", *ENDINGS], help=what)
    parser.add_argument("file", type=Path, help="an MCAP file, finished or not; inspect: any log")
    endings = ".recovered.mcap, .csv (or .parquet), .layout.json, .inspection.html"
    parser.add_argument("output", type=Path, nargs="?", help=f"where it goes; FILE with {endings}")
    parser.add_argument("--mapping", type=Path, help="inspect: a YAML file that says what the columns mean")


def log(given: argparse.Namespace) -> Result:
    """Does what was asked for with a recording."""
    if given.action == "info":
        if given.output:
            raise GpmpcError(f"log info: writes nothing; got {given.output}")
        return _info(given.file)
    endings = ENDINGS[given.action]
    output = given.output or given.file.parent / f"{given.file.stem}{SUFFIXES[given.action]}"
    if given.output and given.action != "recover" and output.suffix not in endings:
        raise SettingError("output", f"must end in {' or '.join(endings)}; got {output.name!r}")
    if given.action == "inspect":
        return _inspect(given.file, output, given.mapping)
    note = {"recover": _recover, "export": _export, "layout": _layout}[given.action](given.file, output)
    print(f"written to {output}: {note}")
    return Result({"output": str(output)})


def _info(file: Path) -> Result:
    from rich.console import Console

    from gpmpc.recording import read_run
    from gpmpc.studies.document import Table, plain_text, terminal

    run, console = read_run(file), Console()
    facts = _facts(run)
    hint = "" if "recovered" in run.metadata else " (gpmpc log recover makes it readable for other tools)"
    state = "finished" if run.finished else f"{CUT}{hint}"
    console.print(f"{file}: {state}", soft_wrap=True, highlight=False, markup=False)
    metadata = [(n, k, v) for n, pairs in run.metadata.items() if n != "units" for k, v in pairs.items()]
    channels = [(topic, schema, str(count)) for topic, (count, schema) in run.channels.items()]
    tables: list[Any] = [(("topic", "schema", "messages"), channels), (("", ""), [*facts.items()])]
    tables += [(("metadata", "key", "value"), metadata)]
    console.print(terminal([Table(head, [[*map(plain_text, row)] for row in rows]) for head, rows in tables if rows]))
    counts = {topic: count for topic, (count, _) in run.channels.items()}
    return Result({"finished": run.finished, "channels": counts, **facts, "metadata": dict(run.metadata)})


def _facts(run: "Run") -> dict[str, str]:
    """The numbers of a run in words."""
    import numpy as np

    units = run.metadata.get("units", {})
    names = [("states", "state", run.state_names), ("inputs", "input", run.input_names)]
    facts = {title: ", ".join(f"{n} [{units.get(f'{g}.{n}', '?')}]" for n in group) for title, g, group in names}
    K = len(run.times)
    facts["steps"] = str(K)
    if K:
        facts["time"] = f"{run.times[0]:g} to {run.times[-1]:g} s"
        counts = {status: run.statuses.count(status) for status in dict.fromkeys(run.statuses)}
        facts["statuses"] = ", ".join(f"{status.name} {count}" for status, count in counts.items())
        facts["not applied"] = str(int(run.failed.sum()))
        median, worst = (1e3 * float(f(run.timings[:, -1])) for f in (np.median, np.max))
        facts["decision"] = f"median {median:.3g} ms, longest {worst:.3g} ms"
        facts["problems"] = f"{len(run.problems)} kept for replay"
    facts["configuration"] = f"{len(run.config.splitlines())} lines"
    return facts


def _recover(file: Path, output: Path) -> str:
    from gpmpc.recording import recover

    found = recover(file, output)
    note = "; the recording was finished, nothing was missing" if found.finished else ""
    return f"{found.messages} messages over {found.seconds:g} s{note}"


def _export(file: Path, output: Path) -> str:
    from gpmpc.recording import read_run

    run = read_run(file)
    frame = run.to_pandas()
    frame.attrs = {}  # pandas would store them, as text that others do not read
    data: Any = io.BytesIO()
    if output.suffix == ".csv":
        frame.to_csv(data, index=False, lineterminator="\n", na_rep="nan")
    else:
        try:
            frame.to_parquet(data, index=False)
        except ImportError as error:
            raise GpmpcError("Parquet needs pyarrow: pip install 'gpmpc[report]'") from error
    _write(output, data.getvalue())
    note = "" if run.finished else f"; the recording is {CUT}"
    return f"{len(run.times)} rows, {len(run.columns)} columns{note}"


def _layout(file: Path, output: Path) -> str:
    from gpmpc.recording import layout, read_run

    _write(output, layout(read_run(file)))
    return f"open {file} in Foxglove or Lichtblick, then import it as a layout"


def _inspect(file: Path, output: Path, mapping_file: Path | None) -> Result:
    import pandas as pd
    from rich.console import Console

    from gpmpc.logs import LogMapping, inspect_log
    from gpmpc.plotting import inspection_figure, png
    from gpmpc.studies.document import Document, Table, number, terminal

    mapping = LogMapping.load(mapping_file) if mapping_file else None
    found = inspect_log(file, mapping)
    head = ["stream", "rows", "rate [Hz]", "jitter", "gaps", "longest gap [s]", "repeated stamps", "backward stamps"]
    streams = [[name, str(rows), *map(number, rest)] for name, rows, *rest in found.streams]
    head_of_channels = [
        "channel",
        "lowest",
        "highest",
        "std",
        "white noise",
        "repeated",
        "longest [rows]",
        "smoothness",
    ]
    channels = [
        [
            c.name,
            *map(number, (c.low, c.high, c.std, c.noise)),
            f"{c.repeated:.0%}",
            str(c.longest),
            number(c.smoothness),
        ]
        for c in found.channels
    ]
    delays = [
        [d.first, d.second, *map(number, (d.rows, *d.range)), f"{d.agreement:.0%}", number(d.correlation)]
        for d in found.delays
    ]
    head_of_delays = ["channel", "later channel", "rows", "lowest", "highest", "agreement", "correlation"]
    tables = [Table(head, streams, "Streams"), Table(head_of_channels, channels, "Channels")]
    tables += [Table(head_of_delays, delays, "Delays between correlated channels")] if delays else []
    if found.follows:
        shares = [[name, f"{share:.0%}"] for name, share in found.follows.items()]
        tables.append(Table(["input", "explained by the states"], shares, "Excitation"))
    warnings = found.warnings
    page = Document(
        found.title,
        tables,
        pd.DataFrame([vars(channel) for channel in found.channels]).drop(columns=["time", "values"]),
        lists={"Beware": warnings or ["nothing was found"]},
        images={"inspection.png": png(inspection_figure(found), dpi=100)},
    )
    _write(output, page.html())
    console = Console()
    console.print(terminal(tables[:2]))
    for line in [*warnings, f"written to {output}"]:
        console.print(line, soft_wrap=True, highlight=False, markup=False)
    return Result({"output": str(output), "warnings": list(warnings), "channels": page.data.to_dict("records")})


def _write(output: Path, content: str | bytes) -> None:
    from gpmpc.files import write_whole

    with writing(output, "output"):
        write_whole(output, content)


COMMAND = Command(
    "Shows, rescues or exports a recording, or writes a Foxglove layout for it", log, add_arguments=_add_arguments
)
