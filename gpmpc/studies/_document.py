"""Writes results as text for a terminal, Markdown, CSV, LaTeX, HTML and JSON.

What a user chose is text in every format: no HTML or link in Markdown, no command in
LaTeX, no formula in a spreadsheet, no control sequence in a terminal.
"""

import json
import math
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from html import escape
from itertools import zip_longest
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import pandas as pd
from rich import box
from rich.console import Console, Group, JustifyMethod
from rich.table import Table as TerminalTable
from rich.text import Text

MISSING = "—"
_LATEX = str.maketrans(
    {
        "&": r"\&",
        "%": r"\%",
        "$": r"\$",
        "#": r"\#",
        "_": r"\_",
        "{": r"\{",
        "}": r"\}",
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "—": "--",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "●": r"$\in$",
        "▼": "$<$",
        "▲": "$>$",
    }
)
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)
_POWER = re.compile(r"(?<![\w.])(-?\d(?:\.\d+)?)e(-?\d+)(?![\w.])")
_WIDEST = 10**6  # of a terminal that holds every table [characters]
_FOLDED = 10  # lines that a page shows without being asked
_STYLE = Path(__file__).with_name("document.css")


class Table(NamedTuple):
    """A table of texts and numbers."""

    #: names of the columns
    header: Sequence[str]
    #: cells; of a text of several lines, those below the first are details
    rows: Sequence[Sequence[Any]]
    #: stands above the table
    title: str = ""
    #: whether rows of one first cell form a section
    sections: bool = False

    def texts(self) -> list[list[str]]:
        """Returns the rows as texts, numbers by ``number``."""
        return [[_text(cell) for cell in row] for row in self.rows]


@dataclass(frozen=True)
class Document:
    """Everything that is said about one result."""

    #: heading
    title: str
    #: in their order
    tables: Sequence[Table]
    #: one row a row of the tables, as numbers, for CSV
    data: pd.DataFrame
    #: paragraph above the tables
    lead: str = ""
    #: paragraphs below the tables
    notes: Sequence[str] = ()
    #: items by their heading; empty ones are left out
    lists: Mapping[str, Sequence[str]] = field(default_factory=dict)
    #: lines that are typed or data, by their heading
    code: Mapping[str, Sequence[str]] = field(default_factory=dict)
    #: PNG files by name
    images: Mapping[str, bytes] = field(default_factory=dict)
    #: addresses by their text, for HTML, folded
    links: Mapping[str, str] = field(default_factory=dict)
    #: tables for LaTeX; by default the same
    latex: Sequence[Table] | None = None

    def files(self, name: str) -> dict[str, str | bytes]:
        """Returns Markdown, CSV, LaTeX and the images, by file name."""
        documents = {
            f"{name}.md": self.markdown(),
            f"{name}.csv": self.csv(),
            f"{name}.tex": self.tex(),
        }
        return documents | dict(self.images)

    def markdown(self) -> str:
        """Returns Markdown, which refers to the images by their names."""
        lines = [f"# {_markdown(self.title)}", ""]
        if self.lead:
            lines += [_markdown(self.lead), ""]
        for table in self.tables:
            lines += _markdown_table(table)
        for note in self.notes:
            lines += [_markdown(note), ""]
        for name in self.images:
            lines += [f"![{name}]({name})", ""]
        for heading, items in _not_empty(self.lists):
            bullets = [f"- {_markdown(item)}" for item in items]
            lines += [f"## {heading}", "", *bullets, ""]
        for heading, code in _not_empty(self.code):
            lines += [f"## {heading}", "", "```", *code, "```", ""]
        return "\n".join(lines)

    def csv(self) -> str:
        """Returns CSV that a spreadsheet takes for numbers and texts only."""
        data = self.data.rename(columns=_csv)
        quoted = data.apply(lambda column: column.map(_csv))
        return quoted.to_csv(index=False, lineterminator="\n")

    def tex(self) -> str:
        """Returns the tables as LaTeX with the rules of the booktabs package."""
        lines = ["% needs \\usepackage{booktabs}"]
        for table in self.tables if self.latex is None else self.latex:
            lines += _latex_table(table)
        return "\n".join(lines)

    def html(self) -> str:
        """Returns one page with the images inside, which opens without a server."""
        body = [
            f"<h1>{escape(self.title)}</h1>",
            f"<p>{escape(self.lead)}</p>",
            _html_images(self.images),
        ]
        for table in self.tables:
            body += _html_table(table)
        body += [f"<p>{escape(note)}</p>" for note in self.notes]
        for heading, items in _not_empty(self.lists):
            bullets = "".join(f"<li>{escape(item)}</li>" for item in items)
            body.append(f"<h2>{heading}</h2><ul>{bullets}</ul>")
        for heading, lines in _not_empty(self.code):
            body.append(f"<h2>{heading}</h2>{_html_code(lines)}")
        if self.links:
            body.append(f"<h2>Runs</h2>{_html_links(self.links)}")
        return _html_page(self.title, body)


def terminal(tables: Sequence[Table], *notes: str) -> Group:
    """Returns tables and paragraphs for ``rich``.

    The name of a section stands on a line of its own.
    """
    paragraphs = [Text(f"\n{note}") for note in notes]
    return Group(*(_terminal_table(table) for table in tables), *paragraphs)


def least_width(table: Table) -> int:
    """Returns how wide a terminal must be that breaks no word of a table."""
    console = Console(width=_WIDEST)
    return console.measure(_terminal_table(table)).minimum


def json_text(content: Any) -> str:
    """Returns plain data as JSON, which knows no number but finite ones.

    What is not finite, such as the mean of nothing, is null.
    """
    return json.dumps(_finite_or_null(content), indent=1, allow_nan=False) + "\n"


def _finite_or_null(content: Any) -> Any:
    """Returns plain data with None in the place of numbers that are not finite."""
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, Mapping):
        return {key: _finite_or_null(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite_or_null(value) for value in content]
    return content


def number(value: float) -> str:
    """Returns three significant digits: 1.01e-7, 0.0123, 1.46, 1.23e3."""
    text = f"{value:.3g}"
    if "e" not in text and not 0 < abs(value) < 1e-3:
        return text
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def with_range(low: float, middle: float, high: float) -> str:
    """Returns a number and, on a second line, the range around it if there is one."""
    if low == high:
        return number(middle)
    return f"{number(middle)}\n[{number(low)}, {number(high)}]"


def plain_text(text: object) -> str:
    """Returns a text on one line, with unprintable characters as their escapes."""
    if not isinstance(text, str):
        raise TypeError(f"must be a text; got {text!r:.80}")
    if text.isprintable():
        return text
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode() for c in text
    )


def _text(cell: Any) -> str:
    return number(cell) if isinstance(cell, float) else str(cell)


def _not_empty(
    parts: Mapping[str, Sequence[str]],
) -> list[tuple[str, Sequence[str]]]:
    """Returns the headings below which there is something, and what it is."""
    return [(heading, lines) for heading, lines in parts.items() if lines]


def _terminal_table(table: Table) -> TerminalTable:
    """Returns a table whose columns of numbers are flush right."""
    shown = TerminalTable(
        title=Text(f"\n{table.title}") if table.title else None,
        title_justify="left",
        title_style="bold",
        show_header=any(table.header),
        padding=(0, 1, 0, 0),
        box=box.SIMPLE_HEAD,
    )
    rows = table.texts()
    first_column = 1 if table.sections else 0  # a section's name has no column
    for i, name in enumerate(table.header[first_column:], start=first_column):
        cells = [row[i] for row in rows]
        has_words = any("\n" in cell or cell[:1].isalpha() for cell in cells)
        justify: JustifyMethod = "left" if has_words else "right"
        shown.add_column(Text(name), justify=justify, overflow="fold")
    section = None
    for row in rows:
        if table.sections and row[0] != section:
            section = row[0]
            shown.add_section()
            shown.add_row("", Text(section, style="italic"))
        shown.add_row(*map(Text, row[first_column:]))
    return shown


def _markdown_table(table: Table) -> list[str]:
    """Returns the lines of a table; details stand behind what they are of."""
    lines = [f"## {_markdown(table.title)}", ""] if table.title else []
    lines.append(_markdown_row(table.header))
    lines.append(f"|{' --- |' * len(table.header)}")
    lines += [_markdown_row(row) for row in table.texts()]
    return [*lines, ""]


def _markdown_row(cells: Iterable[str]) -> str:
    on_one_line = (cell.replace("\n[", " [").replace("\n", ", ") for cell in cells)
    return f"| {' | '.join(map(_markdown, on_one_line))} |"


def _markdown(text: str) -> str:
    """Escapes HTML, links, emphasis, formulas and the end of a table's cell."""
    text = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return re.sub(r"[\\`*|~$]|(?<!\w)_|_(?!\w)|(?<=\])[(\[]", r"\\\g<0>", text)


def _csv(value: Any) -> Any:
    """Quotes a text that a spreadsheet takes for a formula.

    That is what begins like one and is no number.
    """
    if not isinstance(value, str):
        return value
    begins_like_a_formula = value.startswith(("=", "+", "-", "@", "\t", "\r"))
    if begins_like_a_formula and not _NUMBER.fullmatch(value):
        return f"'{value}"
    return value


def _latex_table(table: Table) -> list[str]:
    """Returns the lines of a table; a rule separates its sections."""
    header = [name.replace(", ", "\n").replace(" [", "\n[") for name in table.header]
    lines = [
        f"\\begin{{tabular}}{{{'r' * len(header)}}}",
        "\\toprule",
        *_latex_row(header),
        "\\midrule",
    ]
    section = None
    for row in table.texts():
        if table.sections and row[0] == section:
            lines += _latex_row(["", *row[1:]])
            continue
        if table.sections and section is not None:
            lines.append("\\midrule")
        lines += _latex_row(row)
        section = row[0]
    lines += ["\\bottomrule", "\\end{tabular}"]
    if table.title:
        lines.append(f"% {_latex(table.title)}")
    return [*lines, ""]


def _latex_row(cells: Sequence[str]) -> list[str]:
    """Returns the lines of a row whose cells may have several lines, details small."""
    lines = []
    by_line = zip_longest(*(cell.split("\n") for cell in cells), fillvalue="")
    for i, texts in enumerate(by_line):
        line = " & ".join(
            f"\\footnotesize {_latex(text)}" if i > 0 and text else _latex(text)
            for text in texts
        )
        if line.startswith(("[", "*")):
            line = "{}" + line  # else an argument of the line break before
        lines.append(line + " \\\\")
    return lines


def _latex(text: str) -> str:
    """Escapes commands and sets powers of ten."""
    return _POWER.sub(r"$\1 \\cdot 10^{\2}$", text.translate(_LATEX))


def _html_page(title: str, body: Sequence[str]) -> str:
    style = _STYLE.read_text(encoding="utf-8")
    head = (
        '<meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>\n{style}</style>"
    )
    content = "\n".join(body)
    return (
        f"<!doctype html>\n<html lang=en><head>{head}</head><body>\n"
        f"{content}\n</body></html>\n"
    )


def _html_images(images: Mapping[str, bytes]) -> str:
    tags = []
    for name, image in images.items():
        alt = escape(name.removesuffix(".png"))
        data = b64encode(image).decode()
        tags.append(f'<img alt="{alt}" src="data:image/png;base64,{data}">')
    return f'<div class="figures">{"".join(tags)}</div>'


def _html_table(table: Table) -> list[str]:
    head = "".join(f"<th>{escape(name)}</th>" for name in table.header)
    rows = []
    for row in table.texts():
        cells = "".join(f"<td>{_html_cell(cell)}</td>" for cell in row)
        rows.append(f"<tr>{cells}</tr>")
    body = "\n".join(rows)
    tag = f"<table><thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>"
    title = [f"<h2>{escape(table.title)}</h2>"] if table.title else []
    return [*title, f'<div class="wide">{tag}</div>']


def _html_cell(text: str) -> str:
    """Escapes a cell; lines below its first are small."""
    first, *details = map(escape, text.split("\n"))
    return first + "".join(f"<small>{line}</small>" for line in details)


def _html_code(lines: Sequence[str]) -> str:
    text = f"<pre>{escape(chr(10).join(lines))}</pre>"
    return _html_folded("lines", lines, text) if len(lines) > _FOLDED else text


def _html_links(links: Mapping[str, str]) -> str:
    items = []
    for text, address in links.items():
        target = quote(address, errors="surrogateescape")
        items.append(f'<li><a href="{target}/">{escape(text)}</a></li>')
    return _html_folded("folders", links, f"<ul>{''.join(items)}</ul>")


def _html_folded(noun: str, items: Sized, text: str) -> str:
    """Returns HTML that a page shows on demand."""
    return f"<details><summary>{len(items)} {noun}</summary>{text}</details>"
