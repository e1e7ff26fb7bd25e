"""``gpmpc report``: a tree of runs as one table with figures, and whether two groups of them differ."""

import argparse

from rich.console import Console

from gpmpc.cli._commands import Result
from gpmpc.cli._settings import write_files
from gpmpc.studies._document import terminal
from gpmpc.studies.report import compare, notes, read_report, report_document, sentences, terminal_table


def report(given: argparse.Namespace) -> Result:
    """Writes a tree of runs as one table with figures, and whether two groups of them differ."""
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
