"""``gpmpc report`` and ``gpmpc plot``: what is in a tree of runs, and in a recorded flight."""

import argparse
from pathlib import Path
from typing import Any

from gpmpc.cli._log import CUT
from gpmpc.cli._settings import Command, Parser, Result, write_files, writing
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import DataError, RecordingError

_FORMATS = ("png", "pdf", "svg")


def _add_report_arguments(parser: Parser) -> None:
    parser.add_argument("tree", type=Path, metavar="OUTPUTS", help="a folder with runs anywhere below it")
    parser.add_argument("--to", type=Path, metavar="DIR", help="where the documents go (OUTPUTS/report)")
    groups = "choices that make two groups, such as controller=lqr controller=convex: a paired test over the seeds"
    parser.add_argument("--compare", nargs=2, metavar=("A", "B"), help=groups)


def _report(given: argparse.Namespace) -> Result:
    """Writes a tree of runs as one table with figures, and whether two groups of them differ."""
    from rich.console import Console

    from gpmpc.studies.document import terminal
    from gpmpc.studies.report import compare, notes, read_report, report_document, sentences, terminal_table

    console, folder = Console(), given.to or given.tree / "report"
    with console.status("reading runs and drawing"):
        found = read_report(given.tree)
        lines = sentences(found, compare(found, *given.compare), *given.compare) if given.compare else []
        document = report_document(found, lines, folder)
        where = write_files(folder, document.files("report") | {"report.html": document.html()}, "to")
    console.print(terminal([terminal_table(found)]))
    for kind, items in notes(found).items():
        lines += [f"{kind.lower()}: {item}" for item in items]
    lines += [f"to fill: {command}" for command in found.commands()]
    console.out(*lines, where, sep="\n", highlight=False)
    return Result({"folder": str(folder), "cells": document.data.to_dict("records"), "lines": lines})


def _add_plot_arguments(parser: Parser) -> None:
    parser.add_argument(
        "run", type=Path, metavar="RUN", help="a run's folder, one with runs below it, or a recording (.mcap)"
    )
    parser.add_argument("--to", type=Path, metavar="DIR", help="where the figures go (RUN/figures)")
    parser.add_argument("--format", choices=_FORMATS, default="png", help="of the figures (png)")
    parser.add_argument("--no-animation", action="store_true", help="figures only: they take a second")


def _draw(given: argparse.Namespace) -> Result:
    """Draws figures and an animation of a recorded flight, or of every one below a folder."""
    from gpmpc.studies.run_folder import RECORDING

    paths = [given.run / RECORDING if given.run.is_dir() else given.run]
    if given.run.is_dir() and not paths[0].exists():
        paths = sorted(given.run.rglob(RECORDING))
    if not paths:
        raise DataError(f"{given.run}: holds no {RECORDING}, nor does a folder below it")
    if len(paths) == 1:
        return Result(_plot(given, paths[0], given.to or paths[0].parent / "figures"))
    plotted, code = [], 0
    for path in paths:
        try:
            to = given.to and given.to / path.parent.relative_to(given.run)
            plotted.append(_plot(given, path, to or path.parent / "figures"))
        except (DataError, RecordingError) as error:
            print_error(str(error))
            code = 2
    return Result({"runs": plotted}, code)


def _plot(given: argparse.Namespace, path: Path, folder: Path) -> dict[str, Any]:
    from rich.console import Console

    from gpmpc.plotting import animate, ffmpeg_exists, inputs_figure, timing_figure, tracking_figure
    from gpmpc.recording import read_run

    run, written = read_run(path), []
    if not len(run.times):
        raise DataError(f"{path}: holds no step")
    with writing(folder, "to"), Console().status("drawing"):
        folder.mkdir(parents=True, exist_ok=True)
        figures = {"tracking": tracking_figure(run), "inputs": inputs_figure(run), "timing": timing_figure(run)}
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.{given.format}", dpi=150)
            written.append(f"{name}.{given.format}")
        if not given.no_animation and {"x", "y", "z"} <= run.pose.keys():
            for ending in ("gif", "mp4") if ffmpeg_exists() else ("gif",):
                animate(run, folder / f"flight.{ending}")
                written.append(f"flight.{ending}")
    note = "" if run.finished else f"; {len(run.times)} steps: the recording is {CUT}"
    print(f"written to {folder}: {', '.join(written)}{note}")
    return {"folder": str(folder), "written": written, "finished": run.finished}


REPORT = Command(
    "Tabulates all runs below a folder, with figures; compares two groups of them",
    _report,
    add_arguments=_add_report_arguments,
)
PLOT = Command("Draws recorded flights as figures and an animation", _draw, add_arguments=_add_plot_arguments)
