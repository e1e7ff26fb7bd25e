"""``gpmpc plot``: draws recorded flights as figures and an animation."""

import argparse
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from gpmpc._files import whole_file
from gpmpc.cli._commands import Result
from gpmpc.cli._folders import writing
from gpmpc.cli._log import condition
from gpmpc.cli._mistakes import one_line
from gpmpc.cli._recorded import experiment_of_run, recordings
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import GpmpcError
from gpmpc.plotting import (
    animate,
    film,
    inputs_figure,
    timing_figure,
    tracking_figure,
)
from gpmpc.recording import Run, read_run


def plot(arguments: argparse.Namespace) -> Result:
    """Draws a recorded flight, or every one below a folder."""
    paths = recordings(arguments.run)
    if len(paths) == 1:
        return Result(_plot(arguments, paths[0], _folder_of(arguments, paths[0])))
    plotted = []
    code = 0
    for path in paths:
        try:
            plotted.append(_plot(arguments, path, _folder_of(arguments, path)))
        except Exception as error:  # the others are drawn all the same
            if isinstance(error, GpmpcError | OSError):
                print_error(one_line(error))
                code = 2
                continue
            print_error(f"{path}: {one_line(error)}")
            code = max(code, 1)
    return Result({"runs": plotted}, code)


def _folder_of(arguments: argparse.Namespace, path: Path) -> Path:
    """Returns where a recording's figures go: beside it, or as deep below ``--to``."""
    if arguments.to is None:
        return path.parent / "figures"
    if not arguments.run.is_dir():
        return arguments.to
    return arguments.to / path.parent.relative_to(arguments.run)


def _plot(arguments: argparse.Namespace, path: Path, folder: Path) -> dict[str, Any]:
    """Draws one flight; returns where it is drawn."""
    run = read_run(path)
    animation = _animation(arguments, run)
    written = []
    with writing(folder, "to"), Console().status("drawing"):
        figures = {
            "tracking": tracking_figure(run),
            "inputs": inputs_figure(run),
            "timing": timing_figure(run),
        }
        folder.mkdir(parents=True, exist_ok=True)
        for name, figure in figures.items():
            file = f"{name}.{arguments.format}"
            with whole_file(folder / file) as opened:
                figure.savefig(opened, format=arguments.format, dpi=150)
            written.append(file)
        if animation is not None:
            for file in _animation_files():
                animation(run, path=folder / file)
                written.append(file)
    note = f"; {len(run.times)} steps: {condition(run)}" if condition(run) else ""
    print(f"written to {folder}: {', '.join(written)}{note}")
    return {"folder": str(folder), "written": written, "finished": run.finished}


def _animation(arguments: argparse.Namespace, run: Run) -> Callable[..., None] | None:
    """Returns what animates a flight; None where it is not asked for or cannot be."""
    if arguments.film:
        return partial(
            film, system=experiment_of_run(run, arguments.trust).plant_in_loop
        )
    has_position = {"x", "y", "z"} <= run.pose.keys()
    if arguments.no_animation or not has_position:
        return None
    return animate


def _animation_files() -> list[str]:
    """Returns the animation's files: MP4 where there is ffmpeg."""
    if shutil.which("ffmpeg"):
        return ["flight.gif", "flight.mp4"]
    return ["flight.gif"]
