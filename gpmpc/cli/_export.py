"""``gpmpc export c``: writes the controller of a recorded run as C.

    run -> its experiment -> its model, learned again -> the controller -> C, replay
                                                              |_ points by a budget

A model that was trained before the run is taken as it is.
"""

import argparse
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from gpmpc._files import write_whole
from gpmpc.cli._commands import Result
from gpmpc.cli._export_points import KeptPoints, budget_of, kept_points
from gpmpc.cli._folders import writing
from gpmpc.cli._recorded import (
    changes_since,
    errors_of_settings,
    experiment_of_run,
    recordings,
)
from gpmpc.exceptions import DataError, SettingError
from gpmpc.export import (
    Answer,
    CompiledController,
    CompiledLoop,
    Question,
    answers,
    export_c,
    write_replay,
)
from gpmpc.export._checks import check_exportable
from gpmpc.export._write import (
    check_name,
    check_unwritten,
    exported_files,
    is_exported,
)
from gpmpc.mpc import GPMPC, Reference
from gpmpc.recording import Run, read_run
from gpmpc.studies.flight import Experiment
from gpmpc.studies.study import one_thread


def export(arguments: argparse.Namespace) -> Result:
    """Writes a controller as C, and replays its flight by it."""
    console = Console()
    budget = budget_of(arguments)
    check_name(arguments.name)
    path = _only_recording(arguments.run)
    run = read_run(path)
    experiment = experiment_of_run(run, arguments.trust)
    folder = arguments.to or path.parent / "c"
    replay = folder / "replay.txt"
    points = folder / "points.md"
    written = [*exported_files(folder, arguments.name), replay]
    if budget is not None or arguments.points is not None:
        written.append(points)
    check_unwritten(written, "--to")
    with console.status("learning"):
        controller = _controller_of(run, experiment)
    selection = kept_points(console, controller, experiment, budget, arguments)
    policy: Any = experiment.on_failure
    precision = arguments.precision
    questions = list(_questions(run, experiment, controller))
    with writing(folder, "to"):
        export = export_c(
            controller,
            folder,
            precision,
            policy,
            points=selection.points,
            name=arguments.name,
        )
        steps = write_replay(selection.controller, questions, replay, policy)
        _write_points(points, selection, arguments.budget)
    header, source = (f"src/{file.name}" for file in export)
    lines = [f"written to {folder}: {header}, {source}, and a replay of {steps} steps"]
    lines += selection.lines
    lines += [
        f"{change}: what is exported is what this code makes of the same settings"
        for change in changes_since(run)
    ]
    from_flight = _largest_difference(
        run, answers(selection.controller, questions, policy)
    )
    lines.append(f"beside the flight inputs within {from_flight:.2g}")
    data = {
        "folder": str(folder),
        "steps": steps,
        "difference_from_flight": from_flight,
        **selection.data,
    }
    if shutil.which("cc"):
        with console.status("compiling"):
            data |= _measure(selection.controller, questions, precision, policy)
        lines += [
            f"memory            {data['memory_bytes'] / 1024:.0f} kB of one controller",
            f"a step, here      median {data['median_us']:.0f} us, "
            f"longest {data['longest_us']:.0f} us",
            f"beside Python     inputs within {data['largest_difference']:.2g}, "
            f"{data['other_statuses']} other statuses",
        ]
    else:
        lines.append("not compiled: there is no cc on this machine")
    console.out(*lines, sep="\n", highlight=False)
    return Result(data)


def _write_points(path: Path, selection: KeptPoints, budget: str) -> None:
    """Writes how many points are kept; where all are, an older export's page goes."""
    if selection.points is None:
        if is_exported(path):
            path.unlink()
    else:
        write_whole(path, selection.document(budget))


def _only_recording(path: Path) -> Path:
    """Returns the recording of a run, which must be one."""
    paths = recordings(path)
    if len(paths) > 1:
        raise DataError(f"{path}: holds {len(paths)} runs; name the one to export")
    return paths[0]


def _controller_of(run: Run, experiment: Experiment) -> GPMPC:
    """Returns the controller of a run, around a model that is learned again.

    Raises:
        SettingError: It is none that can be exported.
    """
    if experiment.learning is not None:
        rule = "an exported controller does not learn; fly without"
        got = type(experiment.learning).__name__
        raise SettingError("learning", f"{rule}; got {got}")
    model: Any = experiment.plant_in_loop
    if experiment.learns:
        model = experiment.model
        if model is None:
            with one_thread(), errors_of_settings(run):
                rows = experiment.training_rows()
                model = experiment.learn(rows, experiment.seed).posterior
    controller: Any = experiment.controller(model)
    if isinstance(controller, CompiledController):  # the run was flown as C
        controller = controller.source
    check_exportable(controller, experiment.on_failure)
    return controller


def _questions(
    run: Run, experiment: Experiment, controller: GPMPC
) -> Iterator[Question]:
    """Yields what the controller was asked in the flight."""
    H = controller.horizon
    path = experiment.references(int(run.steps.max(initial=0)) + H + 2)
    inputs = np.tile(controller.initial_input, (H, 1))
    for k, measured in zip(run.steps.tolist(), run.measured, strict=True):
        yield Question(measured, Reference(path[k : k + H + 1], inputs))


def _largest_difference(run: Run, flown_again: Iterable[Answer]) -> float:
    """Returns how far answers lie at most from the inputs that were recorded.

    A controller whose model is learned again by the same code decides the same.
    """
    differences = [
        float(np.abs(answer.input - recorded).max())
        for answer, recorded in zip(flown_again, run.inputs, strict=True)
    ]
    return max(differences, default=0.0)


def _measure(
    controller: GPMPC, questions: list[Question], precision: Any, policy: Any
) -> dict[str, Any]:
    """Returns memory and times of the compiled code, and how it differs."""
    compiled = CompiledLoop(controller, precision, policy)
    differences = []
    other_statuses = 0
    seconds = []
    for answer in answers(controller, questions, policy):
        question = answer.question
        input = compiled.input(question.measured, question.reference)
        differences.append(float(np.abs(input - answer.input).max()))
        other_statuses += compiled.status is not answer.status
        seconds.append(compiled.seconds)
    return {
        "memory_bytes": compiled.memory_bytes,
        "median_us": 1e6 * float(np.median(seconds or [0.0])),
        "longest_us": 1e6 * max(seconds, default=0.0),
        "largest_difference": max(differences, default=0.0),
        "other_statuses": int(other_statuses),
    }
