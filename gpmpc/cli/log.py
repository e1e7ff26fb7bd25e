"""``gpmpc log``: what is in a recording, rescue an unfinished one, its steps as a table, a layout to look at it."""

import argparse
import csv
import io
from pathlib import Path
from typing import TYPE_CHECKING

from gpmpc.cli.arguments import Parser
from gpmpc.exceptions import GpmpcError, SettingError

if TYPE_CHECKING:
    from gpmpc.recording import Run

FORMATS = (".csv", ".parquet")
CUT = "unfinished or damaged; this is what could be read"


def log(arguments: list[str]) -> None:
    """The command line after ``gpmpc log``.

    Raises:
        GpmpcError: A mistake in the arguments, or a file that cannot be read or written.
    """
    parser = Parser(prog="gpmpc log", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True, metavar="info|recover|export|layout")
    info_parser = commands.add_parser("info", help="channels, duration, metadata and how the solves ended")
    recover_parser = commands.add_parser("recover", help="write what is whole in an unfinished file to a new one")
    export_parser = commands.add_parser("export", help="write the steps as a table, one row each")
    layout_parser = commands.add_parser(
        "layout", help="write a layout for Foxglove or Lichtblick that fits the recording"
    )
    for each in (info_parser, recover_parser, export_parser, layout_parser):
        each.add_argument("file", type=Path, help="an MCAP file, finished or not")
    recover_parser.add_argument("output", type=Path, nargs="?", help="default: FILE with .recovered.mcap")
    export_parser.add_argument("output", type=Path, nargs="?", help="ends in .csv or .parquet; default: FILE with .csv")
    layout_parser.add_argument("output", type=Path, nargs="?", help="ends in .json; default: FILE with .layout.json")
    given = parser.parse_args(arguments)
    {"info": _info, "recover": _recover, "export": _export, "layout": _layout}[given.command](given)


def _info(given: argparse.Namespace) -> None:
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from gpmpc.recording import read_run

    run, console = read_run(given.file), Console()

    def plain(text: str) -> str:  # nothing that a terminal, or rich, would obey
        return escape("".join(sign if sign.isprintable() or sign == "\n" else "\ufffd" for sign in text))

    hint = "" if "recovered" in run.metadata else " (gpmpc log recover makes it readable for other tools)"
    state = "finished" if run.finished else f"{CUT}{hint}"
    console.print(f"{given.file}: {state}", soft_wrap=True, highlight=False, markup=False)
    channels = Table("topic", "schema", "messages")
    for topic, (count, schema) in run.channels.items():
        channels.add_row(plain(topic), plain(schema), str(count))
    console.print(channels)
    facts = Table(show_header=False)
    for name, value in _facts(run).items():
        facts.add_row(name, plain(value))
    console.print(facts)
    metadata = Table("metadata", "key", "value")
    for name, pairs in run.metadata.items():
        if name != "units":
            for key, value in pairs.items():
                metadata.add_row(*map(plain, (name, key, value)))
    console.print(metadata)


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


def _recover(given: argparse.Namespace) -> None:
    from gpmpc.recording import recover

    output = given.output or _beside(given.file, ".recovered.mcap")
    found = recover(given.file, output)
    note = "; the recording was finished, nothing was missing" if found.finished else ""
    print(f"written to {output}: {found.messages} messages over {found.seconds:g} s{note}")


def _export(given: argparse.Namespace) -> None:
    from gpmpc.recording import read_run

    output: Path = given.output or _beside(given.file, ".csv")
    if given.output and output.suffix not in FORMATS:
        raise SettingError("output", f"must end in {' or '.join(FORMATS)}; got {output.name!r}")
    run = read_run(given.file)
    _write(output, _csv(run) if output.suffix == ".csv" else _parquet(run))
    note = "" if run.finished else f"; the recording is {CUT}"
    print(f"written to {output}: {len(run.times)} rows, {len(run.columns)} columns{note}")


def _layout(given: argparse.Namespace) -> None:
    from gpmpc.recording import layout, read_run

    output: Path = given.output or _beside(given.file, ".layout.json")
    if given.output and output.suffix != ".json":
        raise SettingError("output", f"must end in .json; got {output.name!r}")
    _write(output, layout(read_run(given.file)))
    print(f"written to {output}: open {given.file} in Foxglove or Lichtblick, then import it as a layout")


def _beside(file: Path, ending: str) -> Path:
    return file.parent / f"{file.stem}{ending}"  # of a folder too, which the reader refuses


def _write(output: Path, content: str | bytes) -> None:
    from gpmpc.files import write_whole

    try:
        write_whole(output, content)
    except OSError as error:
        raise SettingError("output", f"cannot write to {output}: {error.strerror}") from error


def _csv(run: "Run") -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = run.columns
    writer.writerow(columns)
    writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))
    return text.getvalue()


def _parquet(run: "Run") -> bytes:
    frame = run.to_pandas()
    frame.attrs = {}  # pandas would store them, as text that others do not read
    data = io.BytesIO()
    try:
        frame.to_parquet(data, index=False)
    except ImportError as error:
        raise GpmpcError("Parquet needs pyarrow: pip install 'gpmpc[report]'") from error
    return data.getvalue()
