"""``gpmpc report``: a tree of runs as one table, with figures, and whether two groups of them differ."""

from pathlib import Path

from gpmpc.cli.arguments import Parser
from gpmpc.cli.folder import writing


def report(arguments: list[str]) -> None:
    """The command line after ``gpmpc report``.

    Raises:
        GpmpcError: A mistake in the arguments, no runs, or a folder that cannot be written.
    """
    parser = Parser(prog="gpmpc report", description=__doc__)
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

    from gpmpc.experiments.comparison import compare, sentences
    from gpmpc.experiments.report import report as put_together
    from gpmpc.experiments.report_documents import documents, notes, render
    from gpmpc.files import write_whole

    found = put_together(given.tree)
    lines = sentences(found, compare(found, *given.compare), *given.compare) if given.compare else []
    folder = given.to or given.tree / "report"
    written = documents(found, lines)
    with writing(folder, "to"):
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in written.items():
            write_whole(folder / name, content)

    console = Console()
    console.print(render(found))

    def say(text: str) -> None:
        console.print(text, soft_wrap=True, highlight=False, markup=False)

    for line in lines:
        say(line)
    for kind, runs in notes(found).items():
        for name, reason in runs:
            say(f"{kind.lower()}: {f'{name}: ' * bool(name)}{reason}")
    for command in found.commands():
        say(f"to fill: {command}")
    say(f"written to {folder}: {', '.join(sorted(written))}")
