"""``gpmpc report`` and ``gpmpc plot``: what is in a tree of runs, and in a recorded flight."""

from pathlib import Path

from gpmpc.cli.arguments import Parser, writing
from gpmpc.cli.log import CUT
from gpmpc.exceptions import DataError

FORMATS = ("png", "pdf", "svg")


def report(arguments: list[str]) -> None:
    """Writes a tree of runs as one table with figures, and whether two groups of them differ.

    Raises:
        GpmpcError: A mistake in the arguments, no runs, or a folder that cannot be written.
    """
    text = "gpmpc report: a tree of runs as one table, with figures, and whether two groups of them differ."
    parser = Parser(prog="gpmpc report", description=text)
    parser.add_argument("tree", type=Path, metavar="OUTPUTS", help="a folder with runs anywhere below it")
    parser.add_argument("--to", type=Path, metavar="DIR", help="where the documents go (OUTPUTS/report)")
    parser.add_argument(
        "--compare",
        nargs=2,
        metavar=("A", "B"),
        help="choices that make two groups, such as controller=lqr controller=convex: a paired test over the seeds",
    )
    given = parser.parse_args(arguments)

    from rich.console import Console

    from gpmpc.files import write_whole
    from gpmpc.studies.comparison import compare, sentences
    from gpmpc.studies.document import terminal
    from gpmpc.studies.report import read_report
    from gpmpc.studies.report_document import notes, report_document, terminal_table

    found = read_report(given.tree)
    lines = sentences(found, compare(found, *given.compare), *given.compare) if given.compare else []
    folder, document = given.to or given.tree / "report", report_document(found, lines)
    written = document.files("report") | {"report.html": document.html()}
    with writing(folder, "to"):
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in written.items():
            write_whole(folder / name, content)
    console = Console()
    console.print(terminal([terminal_table(found)]))
    for kind, items in notes(found).items():
        lines += [f"{kind.lower()}: {item}" for item in items]
    lines += [f"to fill: {command}" for command in found.commands()]
    for line in [*lines, f"written to {folder}: {', '.join(sorted(written))}"]:
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def plot(arguments: list[str]) -> None:
    """Draws figures and an animation of a recorded flight.

    Raises:
        GpmpcError: A mistake in the arguments, no recording, or a folder that cannot be written.
    """
    parser = Parser(prog="gpmpc plot", description="gpmpc plot: figures and an animation of a recorded flight.")
    parser.add_argument("run", type=Path, metavar="RUN", help="a run's folder, or a recording (.mcap)")
    parser.add_argument("--to", type=Path, metavar="DIR", help="where the figures go (RUN/figures)")
    parser.add_argument("--format", choices=FORMATS, default="png", help="of the figures (png)")
    parser.add_argument("--no-animation", action="store_true", help="figures only: they take a second")
    given = parser.parse_args(arguments)

    from gpmpc.plotting import animate, ffmpeg_exists, inputs_figure, timing_figure, tracking_figure
    from gpmpc.recording import read_run
    from gpmpc.studies.run_folder import RECORDING

    path = given.run / RECORDING if given.run.is_dir() else given.run
    run = read_run(path)
    if not len(run.times):
        raise DataError(f"{path}: holds no step")
    folder, written = given.to or path.parent / "figures", []
    with writing(folder, "to"):
        folder.mkdir(parents=True, exist_ok=True)
        figures = {"tracking": tracking_figure(run), "inputs": inputs_figure(run), "timing": timing_figure(run)}
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.{given.format}", dpi=150)
            written.append(f"{name}.{given.format}")
        if not given.no_animation and {"x", "y", "z"} <= set(run.state_names):
            for ending in ("gif", "mp4") if ffmpeg_exists() else ("gif",):
                animate(run, folder / f"flight.{ending}")
                written.append(f"flight.{ending}")
    note = "" if run.finished else f"; {len(run.times)} steps: the recording is {CUT}"
    print(f"written to {folder}: {', '.join(written)}{note}")
