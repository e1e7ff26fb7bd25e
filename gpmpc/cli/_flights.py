"""``gpmpc plot``, ``calibrate`` and ``report``: what recorded flights look like, predict and sum up to."""

import argparse
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from gpmpc._provenance import is_of_this_code
from gpmpc._trust import trusted_packages
from gpmpc.cli._command import Result
from gpmpc.cli._log import condition
from gpmpc.cli._recorded_settings import read_settings
from gpmpc.cli._settings import find_modules_here, one_line, write_files, writing
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import DataError, RecordingError, check_number
from gpmpc.plotting import (
    animate,
    calibration_figure,
    film,
    inputs_figure,
    png,
    timing_figure,
    tracking_figure,
)
from gpmpc.recording import Run, read_run
from gpmpc.signals import Signals
from gpmpc.studies._document import Document, Table, terminal
from gpmpc.studies._run_folder import RECORDING

if TYPE_CHECKING:
    from gpmpc.studies.flight import Experiment

_LEVELS = (
    0.5,
    0.9,
    0.95,
)  # of the intervals that a calibration draws; the last is printed

_NO_SETTINGS = "holds no settings, which gpmpc run puts into its recordings"


def plot(given: argparse.Namespace) -> Result:
    """Draws figures and an animation of a recorded flight, or of every one below a folder."""
    paths = _recordings(given.run)
    if len(paths) == 1:
        return Result(_plot(given, paths[0], given.to or paths[0].parent / "figures"))
    plotted = []
    code = 0
    for path in paths:
        try:
            to = given.to and given.to / path.parent.relative_to(given.run)
            plotted.append(_plot(given, path, to or path.parent / "figures"))
        except (DataError, RecordingError) as error:
            print_error(str(error))
            code = 2
    return Result({"runs": plotted}, code)


def _recordings(run: Path) -> list[Path]:
    """Returns the recordings that are meant by a run's folder, by one above it, or by a file."""
    paths = [run / RECORDING if run.is_dir() else run]
    if run.is_dir() and not paths[0].exists():
        paths = sorted(run.rglob(RECORDING))
    if not paths:
        raise DataError(f"{run}: holds no {RECORDING}, nor does a folder below it")
    return paths


def _plot(given: argparse.Namespace, path: Path, folder: Path) -> dict[str, Any]:
    run = read_run(path)
    written = []
    if not len(run.times):
        raise DataError(f"{path}: holds no step")
    animated = given.film or (
        not given.no_animation and {"x", "y", "z"} <= run.pose.keys()
    )
    draw = (
        partial(film, system=_experiment_of(run, given.trust).flown)
        if given.film
        else animate
    )
    with writing(folder, "to"), Console().status("drawing"):
        folder.mkdir(parents=True, exist_ok=True)
        figures = {
            "tracking": tracking_figure(run),
            "inputs": inputs_figure(run),
            "timing": timing_figure(run),
        }
        for name, figure in figures.items():
            figure.savefig(folder / f"{name}.{given.format}", dpi=150)
            written.append(f"{name}.{given.format}")
        for ending in (
            ("gif", *["mp4"] * bool(shutil.which("ffmpeg"))) if animated else ()
        ):
            draw(run, path=folder / f"flight.{ending}")
            written.append(f"flight.{ending}")
    note = "" if run.finished else f"; {len(run.times)} steps: {condition(run)}"
    print(f"written to {folder}: {', '.join(written)}{note}")
    return {"folder": str(folder), "written": written, "finished": run.finished}


def _experiment_of(run: Run, trust: Sequence[str]) -> "Experiment":
    """Makes what the settings in a recording describe.

    They may call code of the packages in ``trust``, besides gpmpc's own.

    Raises:
        DataError: The recording holds no settings, or such that describe another
            flight, none, or call other code.
    """
    trusted = trusted_packages("--trust", trust)
    if not run.config.strip():
        raise DataError(f"{run.path}: {_NO_SETTINGS}")
    from gpmpc.cli._run import experiment_of_file  # loads torch; figures do without

    with _settings_of(run):
        settings = read_settings(run.config)
        if not {"system", "controller", "folder"} <= settings.keys():
            raise DataError(_NO_SETTINGS)
        if trusted:  # else nothing in the working folder may be imported
            find_modules_here()
        experiment = experiment_of_file(settings, trusted)
        system = experiment.system
        described = system.state_names, system.input_names
        if described != (run.state_names, run.input_names):
            raise DataError("its settings describe another system than it recorded")
    return experiment


@contextmanager
def _settings_of(run: Run) -> Iterator[None]:
    """Turns whatever settings that nobody has checked raise into one error."""
    try:
        yield
    except Exception as error:
        raise DataError(f"{run.path}: {one_line(error)}") from error


def calibrate(given: argparse.Namespace) -> Result:
    """Predicts flights from each of their steps with a run's model: errors, and how often 95 % intervals hold."""
    from gpmpc import calibration
    from gpmpc.studies.study import one_thread

    check_number("--steps", given.steps, least=1, whole=True)
    console, (first, *others) = Console(), _recordings(given.run)
    if others:
        raise DataError(
            f"{given.run}: holds {1 + len(others)} runs; name the one whose model it is"
        )
    recorded = read_run(first)
    experiment = _experiment_of(recorded, given.trust)
    folder = given.to or first.parent / "calibration"
    system = experiment.system
    model = experiment.model
    notes = []
    learned_again = model is None
    if learned_again and not is_of_this_code(recorded.metadata.get("run", {})):
        notes.append(
            f"{first} was flown by other code: the model that is judged is what this "
            "code learns from the same settings"
        )
    flights = [
        read_run(path)
        for tree in given.flights or [first]
        for path in _recordings(tree)
    ]
    for run in flights:
        if (run.state_names, run.input_names) != (
            system.state_names,
            system.input_names,
        ):
            raise DataError(f"{run.path}: has other states or inputs than {first}")
        if len(run.times) < 2 or (run.steps[1:] != run.steps[:-1] + 1).any():
            raise DataError(f"{run.path}: has fewer than two steps, or one is missing")
        if not run.finished:
            console.out(f"{run.path}: {condition(run)}", highlight=False)
    if not experiment.learns or hasattr(experiment.learning, "episodes"):
        raise DataError(
            f"{first}: its controller learned no model, or learned it from whole flights"
        )
    if model is None:
        with (
            one_thread(),
            console.status("learning"),
            _settings_of(recorded),
        ):
            model = experiment.learn(
                experiment.training_rows(), experiment.seed
            ).posterior
    flown = [
        calibration.Recording(run.states, run.inputs[:-1], _signals_of(run))
        for run in flights
    ]
    horizon = min(given.steps, max(map(len, flown)))
    names = [f"{name} [{system.units.get(name, '?')}]" for name in system.state_names]
    with console.status("predicting"):
        found = calibration.calibrate(
            model,
            flown,
            horizon=horizon,
            levels=_LEVELS,
            names=names,
            angles=system.angle_indices,
        )
    notes.append(f"Intervals hold {found.noise}.")
    rows = []
    for k in sorted({step for step in (1, 10, 50) if step <= horizon} | {horizon}):
        for i, name in enumerate(names):
            low, high = found.coverage_interval(k - 1, i, -1)
            held = f"{found.coverage[k - 1, i, -1]:.1%}", f"{low:.1%} to {high:.1%}"
            rows.append(
                [
                    f"{k} ahead",
                    name,
                    float(found.rmse[k - 1, i]),
                    *held,
                    float(found.width[k - 1, i]),
                ]
            )
    table = Table(
        ["steps", "state", "RMSE", "in 95 %", "exact interval", "width"],
        rows,
        sections=True,
    )
    lead = f"{found.samples[0]} predictions of {', '.join(str(run.path) for run in flights)}"
    images = {"calibration.png": png(calibration_figure(found))}
    document = Document(
        f"How well the model of {first} predicts",
        [table],
        found.to_pandas(),
        lead,
        notes=notes,
        images=images,
    )
    where = write_files(folder, document.files("calibration"), "to")
    console.print(terminal([table]))
    console.out(*notes, where, sep="\n", highlight=False)
    return Result({"folder": str(folder), "rows": document.data.to_dict("records")})


def _signals_of(run: Run) -> Signals:
    """Names and time step of a recorded flight of two steps or more."""
    time_step = float(run.times[-1] - run.times[0]) / (len(run.times) - 1)
    return Signals(run.state_names, run.input_names, time_step)


def report(given: argparse.Namespace) -> Result:
    """Writes a tree of runs as one table with figures, and whether two groups of them differ."""
    from gpmpc.studies.report import (
        compare,
        notes,
        read_report,
        report_document,
        sentences,
        terminal_table,
    )

    console = Console()
    folder = given.to or given.tree / "report"
    with console.status("reading runs and drawing"):
        found = read_report(given.tree)
        lines = (
            sentences(found, compare(found, *given.compare), *given.compare)
            if given.compare
            else []
        )
        document = report_document(found, lines, folder)
        where = write_files(
            folder, document.files("report") | {"report.html": document.html()}, "to"
        )
    console.print(terminal([terminal_table(found)]))
    for kind, items in notes(found).items():
        lines += [f"{kind.lower()}: {item}" for item in items]
    lines += [f"to fill: {command}" for command in found.commands()]
    console.out(*lines, where, sep="\n", highlight=False)
    return Result(
        {
            "folder": str(folder),
            "cells": document.data.to_dict("records"),
            "lines": lines,
        }
    )
