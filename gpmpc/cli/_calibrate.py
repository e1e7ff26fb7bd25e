"""``gpmpc calibrate``: predicts recorded flights with a run's model, and judges it.

    run -> its experiment -> its model, learned again -> predictions -> document

A model that was trained before the run is taken as it is.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from gpmpc import calibration
from gpmpc._dynamics import DynamicsModel
from gpmpc.cli._commands import Result
from gpmpc.cli._folders import write_files
from gpmpc.cli._log import condition
from gpmpc.cli._recorded import (
    changes_since,
    errors_of_settings,
    experiment_of_run,
    recordings,
)
from gpmpc.exceptions import DataError, check_number
from gpmpc.plotting import calibration_figure, png
from gpmpc.recording import Run, read_run
from gpmpc.signals import Signals
from gpmpc.studies._document import Document, Table, terminal
from gpmpc.studies.flight import Experiment
from gpmpc.studies.study import one_thread
from gpmpc.systems import System

_LEVELS = (0.5, 0.9, 0.95)  # of the intervals that are drawn; the last is printed
_STEPS_IN_TABLE = (1, 10, 50)


def calibrate(arguments: argparse.Namespace) -> Result:
    """Predicts flights from each of their steps: errors, and whether intervals hold."""
    check_number("--steps", arguments.steps, least=1, whole=True)
    console = Console()
    path = _only_recording(arguments.run)
    run = read_run(path)
    experiment = experiment_of_run(run, arguments.trust)
    flights = _read_flights(arguments.flights or [path])
    for flight in flights:
        _check_flight(flight, experiment.system, path)
        if condition(flight):
            console.out(f"{flight.path}: {condition(flight)}", highlight=False)
    if not experiment.learns or hasattr(experiment.learning, "episodes"):
        raise DataError(
            f"{path}: its controller learned no model, or learned it from whole flights"
        )
    model = experiment.model
    consequence = "the model that is judged is the one in the file now"
    if model is None:
        consequence = (
            "the model that is judged is what this code learns from the same settings"
        )
    notes = [f"{change}: {consequence}" for change in changes_since(run)]
    if model is None:
        with console.status("learning"):
            model = _learn_again(run, experiment)
    with console.status("predicting"):
        result = _predict(model, flights, experiment.system, arguments.steps)
    notes.append(f"Intervals hold {result.noise}.")
    document = _document(result, path, flights, notes)
    folder = arguments.to or path.parent / "calibration"
    written = write_files(folder, document.files("calibration"), "to")
    console.print(terminal(document.tables))
    console.out(*notes, written, sep="\n", highlight=False)
    return Result({"folder": str(folder), "rows": document.data.to_dict("records")})


def _read_flights(trees: Sequence[Path]) -> list[Run]:
    """Reads every recording below some folders."""
    return [read_run(path) for tree in trees for path in recordings(tree)]


def _document(
    result: calibration.Calibration,
    path: Path,
    flights: Sequence[Run],
    notes: Sequence[str],
) -> Document:
    """Returns what is written of a calibration.

    Args:
        result: Of the predictions.
        path: Recording of the run whose model it is.
        flights: That were predicted.
        notes: What a reader has to know.
    """
    paths = ", ".join(str(flight.path) for flight in flights)
    return Document(
        title=f"How well the model of {path} predicts",
        tables=[_table(result)],
        data=result.to_pandas(),
        lead=f"{result.samples[0]} predictions of {paths}",
        notes=notes,
        images={"calibration.png": png(calibration_figure(result))},
    )


def _only_recording(run: Path) -> Path:
    """Returns the recording of a run, which must be one."""
    paths = recordings(run)
    if len(paths) > 1:
        raise DataError(
            f"{run}: holds {len(paths)} runs; name the one whose model it is"
        )
    return paths[0]


def _check_flight(flight: Run, system: System, path: Path) -> None:
    """Raises ``DataError`` where a flight is of another system or is not whole."""
    names = (flight.state_names, flight.input_names)
    if names != (system.state_names, system.input_names):
        raise DataError(f"{flight.path}: has other states or inputs than {path}")
    steps = flight.steps
    if len(flight.times) < 2 or (steps[1:] != steps[:-1] + 1).any():
        raise DataError(f"{flight.path}: has fewer than two steps, or one is missing")


def _learn_again(run: Run, experiment: Experiment) -> DynamicsModel:
    """Learns the model of a run from its settings."""
    with one_thread(), errors_of_settings(run):
        rows = experiment.training_rows()
        return experiment.learn(rows, experiment.seed).posterior


def _predict(
    model: DynamicsModel, flights: Sequence[Run], system: System, steps: int
) -> calibration.Calibration:
    """Predicts flights up to ``steps`` ahead, or as far as the longest of them goes."""
    flown = [
        calibration.Recording(flight.states, flight.inputs[:-1], _signals_of(flight))
        for flight in flights
    ]
    return calibration.calibrate(
        model,
        flown,
        horizon=min(steps, max(map(len, flown))),
        levels=_LEVELS,
        names=[
            f"{name} [{system.units.get(name, '?')}]" for name in system.state_names
        ],
        angles=system.angle_indices,
    )


def _signals_of(run: Run) -> Signals:
    """Returns names and time step of a recorded flight of two steps or more."""
    time_step = float(run.times[-1] - run.times[0]) / (len(run.times) - 1)
    return Signals(run.state_names, run.input_names, time_step)


def _table(result: calibration.Calibration) -> Table:
    """Returns errors and coverage of the widest interval, some steps ahead."""
    horizon = result.horizon
    steps = {step for step in _STEPS_IN_TABLE if step <= horizon} | {horizon}
    rows = []
    for step in sorted(steps):
        k = step - 1
        for i, name in enumerate(result.names):
            low, high = result.coverage_interval(k, i, -1)
            rows.append(
                [
                    f"{step} ahead",
                    name,
                    float(result.rmse[k, i]),
                    f"{result.coverage[k, i, -1]:.1%}",
                    f"{low:.1%} to {high:.1%}",
                    float(result.width[k, i]),
                ]
            )
    header = ["steps", "state", "RMSE", "in 95 %", "exact interval", "width"]
    return Table(header, rows, sections=True)
