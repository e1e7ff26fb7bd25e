"""Writes results as text for a terminal, Markdown, CSV, LaTeX, HTML and JSON.

What a user chose is text in every format: no HTML or link in Markdown, no command in LaTeX, no formula in a
spreadsheet, no control sequence in a terminal.
"""

import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence, Sized
from dataclasses import dataclass, field
from html import escape
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
from rich import box
from rich.console import Group
from rich.table import Table as TerminalTable
from rich.text import Text

MISSING = "—"
_LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "—": "--",
    }
    | {"<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}"}
    | {"●": r"$\in$", "▼": "$<$", "▲": "$>$"}
)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
_POWER = re.compile(r"(?<![\w.])(-?\d(?:\.\d+)?)e(-?\d+)(?![\w.])")
_FOLDED = 10  # lines that a page shows without being asked
_STYLE = Path(__file__).with_name("document.css")


class Table(NamedTuple):
    """A table of texts and numbers."""

    header: Sequence[str]  # names of the columns
    rows: Sequence[
        Sequence[Any]
    ]  # cells; of a text of several lines, those below the first are details
    title: str = ""  # stands above the table
    sections: bool = False  # whether rows of one first cell form a section

    def texts(self) -> list[list[str]]:
        """Returns the rows as texts, numbers by ``number``."""
        return [
            [number(cell) if isinstance(cell, float) else str(cell) for cell in row]
            for row in self.rows
        ]


@dataclass(frozen=True)
class Document:
    """Everything that is said about one result."""

    title: str  # heading
    tables: Sequence[Table]  # in their order
    data: pd.DataFrame  # one row a row of the tables, as numbers, for CSV
    lead: str = ""  # paragraph above the tables
    notes: Sequence[str] = ()  # paragraphs below the tables
    lists: Mapping[str, Sequence[str]] = field(
        default_factory=dict
    )  # items by their heading; empty ones are left out
    code: Mapping[str, Sequence[str]] = field(
        default_factory=dict
    )  # lines that are typed or data, by their heading
    images: Mapping[str, bytes] = field(default_factory=dict)  # PNG files by name
    links: Mapping[str, str] = field(
        default_factory=dict
    )  # addresses by their text, for HTML, folded
    latex: Sequence[Table] | None = None  # tables for LaTeX; by default the same

    def files(self, name: str) -> dict[str, str | bytes]:
        """Returns the document as Markdown, CSV and LaTeX, and its images, by file name."""
        written = {
            f"{name}.md": self.markdown(),
            f"{name}.csv": self.csv(),
            f"{name}.tex": self.tex(),
        }
        return written | dict(self.images)

    def markdown(self) -> str:
        """Returns the document as Markdown, which refers to the images by their names."""
        out = [f"# {_markdown(self.title)}", ""]
        out += [_markdown(self.lead), ""] if self.lead else []
        for table in self.tables:
            head, *rows = (
                f"| {' | '.join(_markdown(cell.replace(chr(10) + '[', ' [').replace(chr(10), ', ')) for cell in row)} |"
                for row in [table.header, *table.texts()]
            )
            out += [f"## {_markdown(table.title)}", ""] if table.title else []
            out += [head, f"|{' --- |' * len(table.header)}", *rows, ""]
        out += [line for note in self.notes for line in (_markdown(note), "")]
        out += [line for name in self.images for line in (f"![{name}]({name})", "")]
        for heading, items in _filled(self.lists):
            out += [
                f"## {heading}",
                "",
                *(f"- {_markdown(item)}" for item in items),
                "",
            ]
        for heading, lines in _filled(self.code):
            out += [f"## {heading}", "", "```", *lines, "```", ""]
        return "\n".join(out)

    def csv(self) -> str:
        """Returns the data as CSV that a spreadsheet takes for numbers and texts only."""
        data = self.data.rename(columns=_csv)
        return data.apply(lambda column: column.map(_csv)).to_csv(
            index=False, lineterminator="\n"
        )

    def tex(self) -> str:
        """Returns the tables as LaTeX with the rules of the booktabs package."""
        out = ["% needs \\usepackage{booktabs}"]
        for table in self.tables if self.latex is None else self.latex:
            header = [
                name.replace(", ", "\n").replace(" [", "\n[") for name in table.header
            ]
            out += [
                f"\\begin{{tabular}}{{{'r' * len(header)}}}",
                "\\toprule",
                *_latex_lines(header),
                "\\midrule",
            ]
            before = None
            for first, *others in table.texts():
                out += (
                    ["\\midrule"]
                    if table.sections and before not in (None, first)
                    else []
                )
                out += _latex_lines(
                    ["" if table.sections and first == before else first, *others]
                )
                before = first
            out += [
                "\\bottomrule",
                "\\end{tabular}",
                *([f"% {_latex(table.title)}"] if table.title else []),
                "",
            ]
        return "\n".join(out)

    def html(self) -> str:
        """Returns one HTML page with the images inside, which opens without a server."""
        parts = [f"<h1>{escape(self.title)}</h1>", f"<p>{escape(self.lead)}</p>"]
        images = (
            f'<img alt="{escape(name.removesuffix(".png"))}" src="data:image/png;base64,{b64encode(image).decode()}">'
            for name, image in self.images.items()
        )
        parts.append(f'<div class="figures">{"".join(images)}</div>')
        for table in self.tables:
            head = "".join(f"<th>{escape(name)}</th>" for name in table.header)
            body = "\n".join(
                f"<tr>{''.join(f'<td>{_html(cell)}</td>' for cell in row)}</tr>"
                for row in table.texts()
            )
            whole = f"<table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>"
            parts += [f"<h2>{escape(table.title)}</h2>"] * bool(table.title) + [
                f'<div class="wide">{whole}</div>'
            ]
        parts += [f"<p>{escape(note)}</p>" for note in self.notes]
        for heading, items in _filled(self.lists):
            parts.append(
                f"<h2>{heading}</h2><ul>{''.join(f'<li>{escape(item)}</li>' for item in items)}</ul>"
            )
        for heading, lines in _filled(self.code):
            text = f"<pre>{escape(chr(10).join(lines))}</pre>"
            parts.append(
                f"<h2>{heading}</h2>{_folded('lines', lines, text) if len(lines) > _FOLDED else text}"
            )
        if self.links:
            quoted = (
                (quote(to, errors="surrogateescape"), escape(text))
                for text, to in self.links.items()
            )
            items = "".join(
                f'<li><a href="{to}/">{text}</a></li>' for to, text in quoted
            )
            parts.append(
                f"<h2>Runs</h2>{_folded('folders', self.links, f'<ul>{items}</ul>')}"
            )
        head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        head += f"<title>{escape(self.title)}</title><style>\n{_STYLE.read_text(encoding='utf-8')}</style>"
        return (
            f"<!doctype html>\n<html lang=en><head>{head}</head><body>\n"
            + "\n".join(parts)
            + "\n</body></html>\n"
        )


def terminal(tables: Sequence[Table], *notes: str) -> Group:
    """Returns tables and paragraphs for ``rich``; a section's name stands on a line of its own."""
    return Group(*map(_terminal_table, tables), *(Text(f"\n{note}") for note in notes))


def json_text(content: Any) -> str:
    """Returns plain data as JSON."""
    return json.dumps(content, indent=1) + "\n"


def number(value: float) -> str:
    """Returns three significant digits: 1.01e-7, 0.0123, 1.46, 1.23e3."""
    if "e" not in (text := f"{value:.3g}") and not 0 < abs(value) < 1e-3:
        return text
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def with_range(low: float, middle: float, high: float) -> str:
    """Returns a number and, on a second line, the range around it unless it is empty."""
    return (
        number(middle)
        if low == high
        else f"{number(middle)}\n[{number(low)}, {number(high)}]"
    )


def plain_text(text: object) -> str:
    """Returns a text on one line in which unprintable characters stand as their escapes."""
    if not isinstance(text, str):
        raise TypeError(f"must be a text; got {text!r:.80}")
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in text
    )


def figure_label(text: str) -> str:
    """Returns a text that is no formula in a figure."""
    return text.replace("$", r"\$")


def _terminal_table(table: Table) -> TerminalTable:
    style: Any = {
        "title_justify": "left",
        "title_style": "bold",
        "padding": (0, 1, 0, 0),
        "box": box.SIMPLE_HEAD,
    }
    title = Text(f"\n{table.title}") if table.title else None
    shown = TerminalTable(title=title, show_header=any(table.header), **style)
    rows = table.texts()
    columns = list(zip(*rows, strict=True)) or [()] * len(table.header)
    for name, cells in list(zip(table.header, columns, strict=True))[table.sections :]:
        right = not any("\n" in cell or cell[:1].isalpha() for cell in cells)
        shown.add_column(
            Text(name), justify="right" if right else "left", overflow="fold"
        )
    section = None
    for row in rows:
        if table.sections and row[0] != section:
            section = row[0]
            shown.add_section()
            shown.add_row("", Text(section, style="italic"))
        shown.add_row(*map(Text, row[table.sections :]))
    return shown


def _markdown(text: str) -> str:
    """Escapes HTML, links, emphasis, formulas and the end of a table's cell."""
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"[\\`*|~$]|(?<!\w)_|_(?!\w)|(?<=\])[(\[]", r"\\\g<0>", text)


def _latex(text: str) -> str:
    """Escapes commands and sets powers of ten."""
    return _POWER.sub(r"$\1 \\cdot 10^{\2}$", text.translate(_LATEX))


def _latex_lines(row: Sequence[str]) -> list[str]:
    """Returns the lines of a row whose cells may have several lines."""
    out = []
    for i, texts in enumerate(
        zip_longest(*(text.split("\n") for text in row), fillvalue="")
    ):
        line = " & ".join(
            f"\\footnotesize {_latex(text)}" if i and text else _latex(text)
            for text in texts
        )
        out.append(
            ("{}" if line.startswith(("[", "*")) else "") + line + " \\\\"
        )  # the line before would take these
    return out


def _csv(value: Any) -> Any:
    """Quotes a text that a spreadsheet takes for a formula: what begins like one and is no number."""
    if (
        isinstance(value, str)
        and value.startswith(("=", "+", "-", "@", "\t", "\r"))
        and not _NUMBER.fullmatch(value)
    ):
        return f"'{value}"
    return value


def _html(text: str) -> str:
    """Escapes a cell; lines below its first are small."""
    first, *below = map(escape, text.split("\n"))
    return first + "".join(f"<small>{line}</small>" for line in below)


def _filled(parts: Mapping[str, Sequence[str]]) -> list[tuple[str, Sequence[str]]]:
    """Returns headings and what is below them, where there is something."""
    return [(heading, lines) for heading, lines in parts.items() if lines]


def _folded(what: str, items: Sized, text: str) -> str:
    """Returns HTML that a page shows on demand."""
    return f"<details><summary>{len(items)} {what}</summary>{text}</details>"
