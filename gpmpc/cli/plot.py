"""``gpmpc plot``: figures and an animation of a recorded flight."""

from pathlib import Path

from gpmpc.cli.arguments import Parser
from gpmpc.cli.log import CUT
from gpmpc.exceptions import DataError, SettingError

FORMATS = ("png", "pdf", "svg")


def plot(arguments: list[str]) -> None:
    """The command line after ``gpmpc plot``.

    Raises:
        GpmpcError: A mistake in the arguments, no recording, or a folder that cannot be written.
    """
    parser = Parser(prog="gpmpc plot", description=__doc__)
    parser.add_argument("run", type=Path, metavar="RUN", help="a run's folder, or a recording (.mcap)")
    parser.add_argument("--to", type=Path, metavar="DIR", help="where the figures go (RUN/figures)")
    parser.add_argument("--format", choices=FORMATS, default="png", help="of the figures (png)")
    parser.add_argument("--no-animation", action="store_true", help="figures only: they take a second")
    given = parser.parse_args(arguments)

    from gpmpc.experiments.run_folder import RECORDING
    from gpmpc.plotting import animate, ffmpeg_exists, inputs_figure, timing_figure, tracking_figure
    from gpmpc.recording import read_run

    path = given.run / RECORDING if given.run.is_dir() else given.run
    run = read_run(path)
    if not len(run.times):
        raise DataError(f"{path}: holds no step")
    folder = given.to or path.parent / "figures"
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        figures = {"tracking": tracking_figure(run), "inputs": inputs_figure(run), "timing": timing_figure(run)}
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.{given.format}", dpi=150)
            written.append(f"{name}.{given.format}")
        if not given.no_animation and {"x", "y", "z"} <= set(run.state_names):
            for ending in ("gif", "mp4") if ffmpeg_exists() else ("gif",):
                animate(run, folder / f"flight.{ending}")
                written.append(f"flight.{ending}")
    except OSError as error:
        raise SettingError("to", f"cannot write to {folder}: {error.strerror or error}") from error
    note = "" if run.finished else f"; {len(run.times)} steps: the recording is {CUT}"
    print(f"written to {folder}: {', '.join(written)}{note}")
