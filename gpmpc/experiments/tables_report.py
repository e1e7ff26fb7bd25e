"""How Tables 1 and 2 are shown: our draws beside the paper's figures, as text, Markdown, CSV, LaTeX and JSON."""

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from importlib.resources import files
from statistics import median

from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from gpmpc.experiments.escapes import in_csv, in_latex, in_markdown
from gpmpc.plotting import Panel, error_over_size, png

MEASURES = {"training_mse": "training MSE", "test_mse": "test MSE", "average_variance": "average variance"}
CALIBRATION = {
    "plain_training_mse": "training MSE",
    "plain_test_mse": "test MSE",
    "nlpd": "NLPD",
    "coverage_95": "95 % coverage, all rows",
    "held_out_coverage_95": "95 % coverage, held-out",
}
SYMBOLS = {"within": "●", "below": "▼", "above": "▲"}
LEGEND = "The paper's figure lies: ● within that range, ▼ below it, ▲ above it."
PAPER_SECONDS = "The paper's training times: 1.12 s with 10 points, 4.01 s with 189."
STYLE = {"box": box.SIMPLE_HEAD, "padding": (0, 1, 0, 0), "title_justify": "left", "title_style": "bold"}


@dataclass(frozen=True)
class Statistic:
    """Median and range of one measure over the draws of a row, beside the paper's figure where there is one."""

    values: tuple[float, ...]
    paper: Decimal | None = None

    @property
    def median(self) -> float:
        """Over the draws."""
        return median(self.values)

    @property
    def low(self) -> float:
        """Smallest draw."""
        return min(self.values)

    @property
    def high(self) -> float:
        """Largest draw."""
        return max(self.values)

    @property
    def position(self) -> str | None:
        """Where the paper's figure lies: "within" our range, "below" or "above"; its last digit may be rounded."""
        if self.paper is None:
            return None
        half_a_digit = float(Decimal(5).scaleb(int(self.paper.as_tuple().exponent) - 1))
        if float(self.paper) + half_a_digit < self.low:
            return "below"
        return "above" if float(self.paper) - half_a_digit > self.high else "within"


@dataclass(frozen=True)
class Row:
    """One row: a trajectory, a subsystem and a size, over all draws that did not fail."""

    trajectory: str
    subsystem: str
    size: int
    statistics: dict[str, Statistic]
    seconds: float | None
    failed: int

    @property
    def title(self) -> str:
        """As the user names it."""
        return f"{self.trajectory} {self.subsystem} {self.size}"


@cache
def paper_figures() -> dict[tuple[str, str, int], dict[str, Decimal]]:
    """The figures printed in the paper's Tables 1 and 2, digit by digit."""
    text = files("gpmpc.experiments").joinpath("paper_tables.csv").read_text(encoding="utf-8")
    return {
        (line["trajectory"], line["subsystem"], int(line["size"])): {name: Decimal(line[name]) for name in MEASURES}
        for line in csv.DictReader(io.StringIO(text))
    }


def summarise(draws: Sequence[dict]) -> list[Row]:
    """One row a trajectory, subsystem and size, in the order in which they come."""
    groups: dict[tuple[str, str, int], list[dict]] = {}
    for draw in draws:
        groups.setdefault((draw["trajectory"], draw["subsystem"], draw["size"]), []).append(draw)
    rows = []
    for key, group in groups.items():
        good = [draw for draw in group if "error" not in draw]
        printed = paper_figures().get(key, {})
        statistics = {}
        for name in [*MEASURES, *CALIBRATION]:
            values = tuple(draw[name] for draw in good if draw[name] is not None)
            if values:
                statistics[name] = Statistic(values, printed.get(name))
        seconds = median(draw["training_seconds"] for draw in good) if good else None
        rows.append(Row(*key, statistics, seconds, len(group) - len(good)))
    return rows


def differences(rows: Sequence[Row]) -> list[str]:
    """One line for every figure of the paper that lies outside our range."""
    lines = []
    for row in rows:
        for name, label in MEASURES.items():
            statistic = row.statistics.get(name)
            if statistic and statistic.position in ("below", "above"):
                end, nearest = ("low", statistic.low) if statistic.position == "below" else ("high", statistic.high)
                ratio = float(statistic.paper) / nearest
                distance = (
                    f"{100 * abs(ratio - 1):.2g} %"
                    if 0.9 < ratio < 1.1
                    else f"a factor {number(max(ratio, 1 / ratio))}"
                )
                lines.append(
                    f"{row.title}, {label}: the paper prints {_paper(statistic)}, "
                    f"{distance} {statistic.position} the {end} end of our range, {number(nearest)}"
                )
    return lines


def documents(rows: Sequence[Row], draws: Sequence[dict], meta: dict, note: str) -> dict[str, str | bytes]:
    """Everything that is written of a run, by file name."""
    return {
        "tables.md": markdown(rows, meta, note),
        "tables.csv": comma_separated(rows),
        "tables.tex": latex(rows),
        "tables.json": json.dumps({"meta": meta, "draws": list(draws)}, indent=1),
        "tables.png": _figure(draws),
    }


def render(rows: Sequence[Row], note: str) -> Group:
    """The tables for a terminal of 80 columns."""
    parts = []
    for trajectory in dict.fromkeys(row.trajectory for row in rows):
        table = Table(title=Text(f"\n{title(trajectory)}", style="bold"), **STYLE)
        table.add_column("\nN", justify="right")
        for label in MEASURES.values():
            table.add_column(f"{label}\nours     paper")
        table.add_column("time\n\\[s]", justify="right")
        _in_sections(
            table, [row for row in rows if row.trajectory == trajectory], lambda row: row.subsystem, _two_lines
        )
        parts.append(table)
    parts.append(Text(f"\nours: median\n[min, max] over the draws. {LEGEND}\n{PAPER_SECONDS}\n{note}"))

    table = Table(title="\nplain predictions (no input covariance): medians over the draws", **STYLE)
    table.add_column("\nN", justify="right")
    for label in CALIBRATION.values():
        table.add_column(label.replace(", ", "\n"), justify="right")
    _in_sections(table, rows, lambda row: f"{row.trajectory} {row.subsystem}", _medians)
    return Group(*parts, table)


def title(trajectory: str) -> str:
    """The heading of a trajectory's table."""
    in_paper = {"elliptical": "Table 1: elliptical", "lorenz": "Table 2: Lorenz"}
    return f"{in_paper.get(trajectory, trajectory)} trajectory"


def markdown(rows: Sequence[Row], meta: dict, note: str) -> str:
    """The tables as Markdown, with what differs and what made them."""
    out = ["# Tables 1 and 2", ""]
    for trajectory in dict.fromkeys(row.trajectory for row in rows):
        header = ["subsystem", "N"] + [h for label in MEASURES.values() for h in (label, "paper")] + ["time [s]"]
        lines = []
        for row in (row for row in rows if row.trajectory == trajectory):
            cells = [cell for name in MEASURES for cell in _with_paper(row.statistics.get(name), " ")]
            lines.append([row.subsystem, str(row.size), *cells, _seconds(row)])
        out += [f"## {title(trajectory)}", "", *markdown_table(header, lines), ""]
    out += ["Ours: median [min, max] over the draws. " + LEGEND, "", PAPER_SECONDS, "", note, ""]
    out += ["## Plain predictions and calibration", ""]
    lines = [
        [f"{row.trajectory} {row.subsystem}", str(row.size)]
        + [_range(row.statistics.get(name), " ") for name in CALIBRATION]
        for row in rows
    ]
    out += [*markdown_table(["", "N", *CALIBRATION.values()], lines), ""]
    outside = differences(rows)
    out += ["## Outside our range", "", *([f"- {line}" for line in outside] or ["Nothing."]), ""]
    out += ["## Made by", "", "```json", json.dumps(meta, indent=2), "```", ""]
    return "\n".join(out)


def comma_separated(rows: Sequence[Row]) -> str:
    """One line a row: median, min, max, the paper's figure and its position for every measure."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    header = ["trajectory", "subsystem", "size", "draws", "failed", "training_seconds_median"]
    for name in [*MEASURES, *CALIBRATION]:
        header += [f"{name}_median", f"{name}_min", f"{name}_max"]
        header += [f"{name}_paper", f"{name}_paper_is"] if name in MEASURES else []
    writer.writerow(header)
    for row in rows:
        done = len(next(iter(row.statistics.values())).values) if row.statistics else 0
        line = [in_csv(row.trajectory), row.subsystem, row.size, done, row.failed, row.seconds]
        for name in [*MEASURES, *CALIBRATION]:
            s = row.statistics.get(name)
            line += [s.median, s.low, s.high] if s else ["", "", ""]
            if name in MEASURES:
                line += [s.paper, s.position] if s and s.paper is not None else ["", ""]
        writer.writerow(line)
    return buffer.getvalue()


def latex(rows: Sequence[Row]) -> str:
    """The tables as LaTeX with the rules of the booktabs package."""
    out = ["% needs \\usepackage{booktabs}"]
    for trajectory in dict.fromkeys(row.trajectory for row in rows):
        out += ["\\begin{tabular}{llllllllr}", "\\toprule"]
        out += [
            " & ".join(["", "$N$"] + [h for label in MEASURES.values() for h in (label, "paper")]) + " & time [s] \\\\"
        ]
        out += ["\\midrule"]
        previous = None
        for row in (row for row in rows if row.trajectory == trajectory):
            if previous not in (None, row.subsystem):
                out += ["\\midrule"]
            cells = []
            for name in MEASURES:
                s = row.statistics.get(name)
                if s is None:
                    cells += ["--", "--"]
                    continue
                cells.append(f"{_latex(s.median)} [{_latex(s.low)}, {_latex(s.high)}]")
                sign = {"within": "$\\in$", "below": "$<$", "above": "$>$", None: ""}[s.position]
                cells.append("--" if s.paper is None else f"{_latex(s.paper)} {sign}")
            first = "" if row.subsystem == previous else row.subsystem
            out += [" & ".join([first, str(row.size), *cells, _seconds(row)]) + " \\\\"]
            previous = row.subsystem
        out += ["\\bottomrule", "\\end{tabular}", f"% {in_latex(title(trajectory))}; $\\in$, $<$, $>$: the"]
        out += ["% paper's figure is in, below or above our range", ""]
    return "\n".join(out)


def number(value: float) -> str:
    """Three significant digits: 1.01e-7, 0.0123, 1.46."""
    if value == 0 or 1e-3 <= abs(value) < 1e4:
        return f"{value:.3g}"
    mantissa, exponent = f"{value:.2e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def _figure(draws: Sequence[dict]) -> bytes:
    """Test MSE over the training size, one panel a trajectory and subsystem (PNG)."""
    panels: dict[tuple[str, str], Panel] = {}
    for draw in draws:
        name = draw["trajectory"], draw["subsystem"]
        panel = panels.setdefault(name, Panel(f"{draw['trajectory']}, {draw['subsystem']}", {}, {}))
        if "error" not in draw:
            panel.draws.setdefault(draw["size"], []).append(draw["test_mse"])
        printed = paper_figures().get((*name, draw["size"]))
        if printed:
            panel.paper[draw["size"]] = float(printed["test_mse"])
    return png(error_over_size(list(panels.values()), "test MSE"))


def _in_sections(
    table: Table, rows: Sequence[Row], section: Callable[[Row], str], cells: Callable[[Row], list[str]]
) -> None:
    """Adds rows under a line of their own for every section."""
    previous = None
    for row in rows:
        if section(row) != previous:
            previous = section(row)
            table.add_section()
            table.add_row("", Text(previous, style="italic"))
        table.add_row(str(row.size), *cells(row))


def _two_lines(row: Row) -> list[str]:
    """Median and the paper's figure above the range, for every measure; then the time."""
    cells = []
    for name in MEASURES:
        s = row.statistics.get(name)
        if s is None:
            cells.append("—")
            continue
        paper = "" if s.paper is None else f" {_paper(s)} {SYMBOLS[s.position]}"
        cells.append(f"{number(s.median):8}{paper}\n[{number(s.low)}, {number(s.high)}]")
    return [*cells, _seconds(row)]


def _medians(row: Row) -> list[str]:
    return [number(row.statistics[name].median) if name in row.statistics else "—" for name in CALIBRATION]


def _paper(statistic: Statistic) -> str:
    """The paper's figure with the digits that it prints."""
    value = statistic.paper
    if value >= Decimal("1e-3"):
        return f"{value:f}"
    mantissa, exponent = f"{value:e}".lower().split("e")
    return f"{mantissa}e{int(exponent)}"


def _with_paper(statistic: Statistic | None, separator: str = "\n") -> tuple[str, str]:
    if statistic is None:
        return "—", "—"
    if statistic.paper is None:
        return _range(statistic, separator), "—"
    return _range(statistic, separator), f"{_paper(statistic)} {SYMBOLS[statistic.position]}"


def _range(statistic: Statistic | None, separator: str = "\n") -> str:
    if statistic is None:
        return "—"
    if len(statistic.values) == 1:
        return number(statistic.median)
    return f"{number(statistic.median)}{separator}[{number(statistic.low)}, {number(statistic.high)}]"


def _seconds(row: Row) -> str:
    text = "—" if row.seconds is None else f"{row.seconds:.2f}"
    return text if not row.failed else f"{text} ({row.failed} failed)"


def _latex(value: float | Decimal) -> str:
    text = number(float(value)) if isinstance(value, float) else _paper(Statistic((), value))
    if "e" not in text:
        return f"${text}$"
    mantissa, exponent = text.split("e")
    return f"${mantissa} \\cdot 10^{{{exponent}}}$"


def markdown_table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> list[str]:
    """Header and lines as a Markdown table."""
    head, *rows = (f"| {' | '.join(map(in_markdown, row))} |" for row in [header, *lines])
    return [head, f"|{' --- |' * len(header)}", *rows]
