"""How a tree of runs is shown: one table as text, Markdown, CSV and LaTeX, figures, and a page that holds them all."""

import base64
import csv
import io
import re
from collections.abc import Sequence
from html import escape
from itertools import groupby, zip_longest
from typing import NamedTuple

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text

from gpmpc.experiments.escapes import in_csv, in_figure, in_latex, in_markdown, in_plain_text
from gpmpc.experiments.report import MEASURES, Cell, Report, in_order
from gpmpc.experiments.run_folder import LONGEST_NAME
from gpmpc.experiments.tables_report import markdown_table, number
from gpmpc.plotting import Series, over_variable, png

DRAWN = ("rmse", "failed", "decision")  # a figure each
SHOWN = {"rmse": "RMSE", "outside": "outside", "failed": "failed", "decision": "decision"}  # in a terminal
MOST_LINES = 8  # in a figure; what is varied besides is pooled
LEGEND = "Median [first to third quartile] over the seeds"
STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, sans-serif; color: #222; background: #fff; max-width: 75rem; margin: 2rem auto;
  padding: 0 1rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .3rem .7rem; text-align: right; vertical-align: top; border-bottom: 1px solid #e4e4e4; }
th { border-bottom: 2px solid #1f4e79; vertical-align: bottom; } td:first-child, th:first-child { text-align: left; }
td, td small { white-space: nowrap; } td small { display: block; color: #666; }
.wide { overflow-x: auto; margin: 1rem 0; }
.figures { display: flex; flex-wrap: wrap; gap: 1rem; align-items: flex-start; margin-bottom: 1rem; }
.figures img { flex: 1 1 20rem; min-width: 0; max-width: min(32rem, 100%); }
code, pre { background: #f5f5f5; padding: .1rem .3rem; overflow-wrap: anywhere; white-space: pre-wrap; }
pre { padding: .6rem; } .bad { color: #b03a2e; } li { overflow-wrap: anywhere; }
@media (max-width: 40rem) { th, td { padding: .3rem .4rem; } ul { padding-left: 1.2rem; } }
"""


class Spread(NamedTuple):
    """Of one measure over the runs of a cell."""

    low: float
    median: float
    high: float


def spread(values: Sequence[float]) -> Spread | None:
    """Median and quartiles; None where there is nothing."""
    return Spread(*np.quantile(values, [0.25, 0.5, 0.75]).tolist()) if values else None


def documents(report: Report, comparison: Sequence[str] = ()) -> dict[str, str | bytes]:
    """Everything that is written of a report, by file name."""
    drawn = figures(report)
    return {
        "report.md": markdown(report, list(drawn), comparison),
        "report.csv": comma_separated(report),
        "report.tex": latex(report),
        "report.html": page(report, drawn, comparison),
        **drawn,
    }


def title(report: Report) -> str:
    """How much there is of it."""
    finished, lost, failed, missing, _ = (
        sum(map(len, group)) for group in zip(*map(_counts, report.cells), strict=True)
    )
    text = f"{finished} finished in {len(report.cells)} cells, {failed} failed, {missing} missing"
    text += f", {len(report.skipped)} skipped" if report.skipped else ""
    return text + (f"; of those finished, {lost} lost" if lost else "")


def render(report: Report) -> Table:
    """The table for a terminal: median, and the quartiles below it; what is zero everywhere is left out."""
    shown = [name for name in SHOWN if name in _telling(report)]
    table = Table(
        box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), title=Text(title(report), style="italic"), title_justify="left"
    )
    for name in report.variables or ("runs",):
        table.add_column(Text(name.replace(".", ".\n")), justify="right", overflow="fold")
    for head in ("seeds", *(f"{SHOWN[name]}\n[{_unit(report, name)}]" for name in shown)):
        table.add_column(Text(head), justify="right", no_wrap=True)
    for row in _rows(report, shown, "\n"):
        table.add_row(*map(Text, row))
    return table


def notes(report: Report) -> dict[str, list[tuple[str, str]]]:
    """What has to be known of single runs, by kind: their folders and the reasons."""
    each = {
        "Failed": [(run.folder.name, run.error or "") for cell in report.cells for run in cell.failed.values()],
        "Lost": [(run.folder.name, run.lost or "") for cell in report.cells for run in cell.lost],
        "Skipped": [("", line) for line in report.skipped],
    }
    return {kind: [(in_plain_text(folder), reason) for folder, reason in runs] for kind, runs in each.items() if runs}


def markdown(report: Report, drawn: Sequence[str] = (), comparison: Sequence[str] = ()) -> str:
    """The table as Markdown, with what failed, what is missing and how to get it."""
    out = [f"# {in_markdown(_name(report))}", "", in_markdown(f"{title(report)}.{_constants(report)}"), ""]
    out += markdown_table(_header(report), _rows(report, report.measures()))
    out += ["", f"{LEGEND}.", ""]
    out += [line for name in drawn for line in (f"![{name}]({name})", "")]
    if comparison:
        out += ["## Comparison", "", *(f"- {in_markdown(line)}" for line in comparison), ""]
    for kind, runs in notes(report).items():
        out += [f"## {kind}", "", *(f"- {in_markdown(f'{folder}: ' * bool(folder) + why)}" for folder, why in runs), ""]
    if report.commands():
        out += ["## To fill the gaps", "", "```", *report.commands(), "```", ""]
    return "\n".join(out)


def comma_separated(report: Report) -> str:
    """One line a cell."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    parts = ("q25", "median", "q75")
    measured = [f"{name}_{part} [{_unit(report, name)}]" for name in report.measures() for part in parts]
    counted = ["finished", "lost", "failed", "missing", "skipped"]
    writer.writerow(map(in_csv, [*report.variables, *counted, *measured]))
    for cell in report.cells:
        numbers = [value for name in report.measures() for value in spread(cell.numbers(name)) or [""] * len(parts)]
        writer.writerow(map(in_csv, [*cell.values, *map(len, _counts(cell)), *numbers]))
    return buffer.getvalue()


def latex(report: Report) -> str:
    """The table as LaTeX with the rules of the booktabs package; what is zero everywhere is left out."""
    shown = _telling(report)
    names = [*(report.variables or ("runs",)), "seeds", *(report.label(name) for name in shown)]
    names = [name.replace(", ", "\n").replace(" [", "\n[") for name in names]
    out = ["% needs \\usepackage{booktabs}; median, and below it the quartiles over the seeds"]
    out += [f"\\begin{{tabular}}{{{'r' * len(names)}}}", "\\toprule", *_latex_lines(names), "\\midrule"]
    for row in _rows(report, shown, "\n"):
        out += _latex_lines(row)
    return "\n".join([*out, "\\bottomrule", "\\end{tabular}", ""])


def _latex_lines(row: Sequence[str]) -> list[str]:
    """A row whose cells may have several lines."""
    out = []
    for i, texts in enumerate(zip_longest(*(text.split("\n") for text in row), fillvalue="")):
        marked = map(in_latex, texts)
        line = " & ".join(f"\\footnotesize {text}" if i and text else text for text in marked)
        out.append(("{}" if line.startswith(("[", "*")) else "") + line + " \\\\")  # the line before would take these
    return out


def figures(report: Report) -> dict[str, bytes]:
    """One figure (PNG) a varied setting and measure, by file name."""
    drawn = {}
    measures = [name for name in DRAWN if name in _telling(report)]
    for index, variable in enumerate(report.variables):
        positions = sorted({cell.values[index] for cell in report.cells}, key=in_order)
        lines, numbers = _lines(report, index), all(in_order(position)[0] == 0 for position in positions)
        for name in measures:
            series = []
            for label, cells in lines.items():
                values: dict[str, list[float]] = {position: [] for position in positions}
                for cell in cells:
                    values[cell.values[index]] += cell.numbers(name)
                series.append(Series(in_figure(label), list(values.values())))
            names = map(in_figure, (variable, *positions, report.label(name)))
            title, *ticks, label = names
            figure = over_variable(title, ticks, label, series, MEASURES[name].logarithmic, connected=numbers)
            file = re.sub(r"[^\w.+-]", "-", f"{name}-over-{variable}"[:LONGEST_NAME], flags=re.ASCII)
            drawn[f"{file}.png" if f"{file}.png" not in drawn else f"{file}-{index}.png"] = png(figure, dpi=150)
    return drawn


def page(report: Report, drawn: dict[str, bytes], comparison: Sequence[str] = ()) -> str:
    """One HTML file with its figures inside, which opens without a server."""
    row = "".join(f"<th>{escape(name)}</th>" for name in _header(report))
    rows = _rows(report, report.measures(), "\n")
    body = "\n".join("<tr>" + "".join(f"<td>{_html(text)}</td>" for text in row) + "</tr>" for row in rows)
    parts = [f"<h1>{escape(_name(report))}</h1>", f"<p>{escape(title(report))}.{escape(_constants(report))}</p>"]
    for _, names in groupby(drawn, lambda name: name.partition("-over-")[2]):
        parts.append(f'<div class="figures">{"".join(_image(name, drawn[name]) for name in names)}</div>')
    parts.append(f'<div class="wide"><table><thead><tr>{row}</tr></thead><tbody>\n{body}\n</tbody></table></div>')
    parts.append(f"<p>{LEGEND}. Figures: the same, and every run a dot.</p>")
    if comparison:
        lines = "".join(f"<li>{escape(line)}</li>" for line in comparison)
        parts += ["<h2>Comparison</h2>", f"<ul>{lines}</ul>"]
    for kind, runs in notes(report).items():
        lines = ((f"<code>{escape(f)}</code> " if f else "", escape(why)) for f, why in runs)
        items = "".join(f"<li>{folder}<span class=bad>{why}</span></li>" for folder, why in lines)
        parts += [f"<h2>{kind}</h2>", f"<ul>{items}</ul>"]
    if report.commands():
        commands = escape("\n".join(report.commands()))
        parts += ["<h2>To fill the gaps</h2>", f"<pre>{commands}</pre>"]
    head = '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    head += f"<title>{escape(_name(report))}</title><style>{STYLE}</style>"
    return f"<!doctype html>\n<html lang=en><head>{head}</head><body>\n" + "\n".join(parts) + "\n</body></html>\n"


def _image(name: str, png: bytes) -> str:
    data = base64.b64encode(png).decode()
    return f'<img alt="{escape(name.removesuffix(".png"))}" src="data:image/png;base64,{data}">'


def _html(text: str) -> str:
    """A cell of the table; what stands below its first line is small."""
    first, *below = map(escape, text.split("\n"))
    return first + "".join(f"<small>{line}</small>" for line in below)


def _telling(report: Report) -> list[str]:
    """Measures that are not zero everywhere."""
    return [name for name in report.measures() if any(any(cell.numbers(name)) for cell in report.cells)]


def _lines(report: Report, index: int) -> dict[str, list[Cell]]:
    """Cells by what else was varied; by one setting only where all together were too many lines."""
    others = [i for i in range(len(report.variables)) if i != index]
    distinct = {i: {cell.values[i] for cell in report.cells} for i in others}
    while len({tuple(cell.values[i] for i in others) for cell in report.cells}) > MOST_LINES:
        others.remove(max(others, key=lambda i: len(distinct[i])))
    lines: dict[tuple[str, ...], list[Cell]] = {}
    for cell in report.cells:
        lines.setdefault(tuple(cell.values[i] for i in others), []).append(cell)
    names = [report.variables[i] for i in others]
    return {
        ", ".join(f"{name}={value}" for name, value in zip(names, key, strict=True)) or "all": cells
        for key, cells in lines.items()
    }


def _unit(report: Report, measure: str) -> str:
    return report.label(measure).rpartition(" [")[2].removesuffix("]")


def _header(report: Report) -> list[str]:
    return [*(report.variables or ("runs",)), "seeds", *(report.label(name) for name in report.measures())]


def _rows(report: Report, measures: Sequence[str], *separator: str) -> list[list[str]]:
    """The cells' texts, with ``separator`` between the lines of one."""
    return [
        [*_named(report, cell), _seeds(cell, *separator), *(_text(cell, name, *separator) for name in measures)]
        for cell in report.cells
    ]


def _named(report: Report, cell: Cell) -> Sequence[str]:
    return cell.values if report.variables else ("all",)


def _name(report: Report) -> str:
    return in_plain_text(report.tree.resolve().name)


def _counts(cell: Cell) -> tuple:
    return cell.runs, cell.lost, cell.failed, cell.missing, cell.skipped


def _seeds(cell: Cell, separator: str = ", ") -> str:
    """How many finished, how many of these were lost, and where not all did, how many did not."""
    named = {"lost": cell.lost, "failed": cell.failed, "missing": cell.missing, "skipped": cell.skipped}
    return separator.join([str(len(cell.runs)), *(f"{len(group)} {word}" for word, group in named.items() if group)])


def _text(cell: Cell, measure: str, separator: str = " ") -> str:
    found = spread(cell.numbers(measure))
    if found is None:
        return "—"
    if found.low == found.high:
        return number(found.median)
    return f"{number(found.median)}{separator}[{number(found.low)}, {number(found.high)}]"


def _constants(report: Report) -> str:
    text = ", ".join(f"{key}={value}" for key, value in report.constants.items())
    return f" All of them: {text}." if text else ""
