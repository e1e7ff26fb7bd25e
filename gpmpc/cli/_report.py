"""``gpmpc report``: writes a tree of runs as one table with figures."""

import argparse

from rich.console import Console

from gpmpc.cli._commands import Result
from gpmpc.cli._folders import write_files
from gpmpc.studies._document import terminal
from gpmpc.studies.report import (
    compare,
    notes,
    read_report,
    report_document,
    sentences,
    terminal_table,
)


def report(arguments: argparse.Namespace) -> Result:
    """Writes the report, and whether two groups of runs differ."""
    console = Console()
    folder = arguments.to or arguments.tree / "report"
    lines: list[str] = []
    with console.status("reading runs and drawing"):
        runs = read_report(arguments.tree)
        if arguments.compare:
            a, b = arguments.compare
            lines += sentences(runs, compare(runs, a, b), a, b)
        document = report_document(runs, [*lines], folder)
        files = document.files("report") | {"report.html": document.html()}
        written = write_files(folder, files, "to")
    console.print(terminal([terminal_table(runs, console.width)]))
    for kind, reasons in notes(runs).items():
        lines += [f"{kind.lower()}: {reason}" for reason in reasons]
    lines += [f"to fill: {command}" for command in runs.commands()]
    console.out(*lines, written, sep="\n", highlight=False)
    data = {
        "folder": str(folder),
        "cells": document.data.to_dict("records"),
        "lines": lines,
    }
    return Result(data)
