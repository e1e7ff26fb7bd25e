"""``gpmpc plot``: draws recorded flights, a run's or every one below a folder."""

import argparse
import shutil
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf
from rich.console import Console

from gpmpc.cli._commands import Result
from gpmpc.cli._log import CUT
from gpmpc.cli._settings import settings, writing
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import DataError, RecordingError
from gpmpc.plotting import animate, film, inputs_figure, timing_figure, tracking_figure
from gpmpc.recording import Run, read_run
from gpmpc.studies._run_folder import RECORDING

if TYPE_CHECKING:
    from gpmpc.studies.flight import Experiment


def recordings(run: Path) -> list[Path]:
    """Returns the recordings that are meant by a run's folder, by one above it, or by a file."""
    paths = [run / RECORDING if run.is_dir() else run]
    if run.is_dir() and not paths[0].exists():
        paths = sorted(run.rglob(RECORDING))
    if not paths:
        raise DataError(f"{run}: holds no {RECORDING}, nor does a folder below it")
    return paths


def plot(given: argparse.Namespace) -> Result:
    """Draws figures and an animation of a recorded flight, or of every one below a folder."""
    paths = recordings(given.run)
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
    run, written = read_run(path), []
    if not len(run.times):
        raise DataError(f"{path}: holds no step")
    animated = given.film or (not given.no_animation and {"x", "y", "z"} <= run.pose.keys())
    draw = partial(film, system=experiment_of_run(run).flown) if given.film else animate
    with writing(folder, "to"), Console().status("drawing"):
        folder.mkdir(parents=True, exist_ok=True)
        figures = {"tracking": tracking_figure(run), "inputs": inputs_figure(run), "timing": timing_figure(run)}
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.{given.format}", dpi=150)
            written.append(f"{name}.{given.format}")
        for ending in ("gif", *["mp4"] * bool(shutil.which("ffmpeg"))) if animated else ():
            draw(run, path=folder / f"flight.{ending}")
            written.append(f"flight.{ending}")
    note = "" if run.finished else f"; {len(run.times)} steps: the recording is {CUT}"
    print(f"written to {folder}: {', '.join(written)}{note}")
    return {"folder": str(folder), "written": written, "finished": run.finished}


def experiment_of_run(run: Run) -> "Experiment":
    """Makes what the settings in a recording describe."""
    config: Any = OmegaConf.create(run.config)
    if not {"system", "controller", "folder"} <= config.keys():
        raise DataError(f"{run.path}: holds no settings, which gpmpc run puts into its recordings")
    from gpmpc.cli._run import experiment_of  # loads torch, which figures do without

    with settings():
        return experiment_of(config)
