"""``gpmpc calibrate``: how well a run's model predicts recorded flights."""

import argparse

import torch
from rich.console import Console

from gpmpc import calibration
from gpmpc.cli._commands import Result
from gpmpc.cli._flights import experiment_of_run, recordings
from gpmpc.cli._settings import write_files
from gpmpc.exceptions import DataError, check_number
from gpmpc.plotting import calibration_figure, png
from gpmpc.recording import read_run
from gpmpc.studies._document import Document, Table, terminal
from gpmpc.studies.study import one_thread

_LEVELS = 0.5, 0.9, 0.95  # of the intervals that are drawn; the last is printed


def calibrate(given: argparse.Namespace) -> Result:
    """Predicts flights from each of their steps with a run's model: errors, and how often 95 % intervals hold."""
    check_number("--steps", given.steps, least=1, whole=True)
    console, (first, *others) = Console(), recordings(given.run)
    if others:
        raise DataError(f"{given.run}: holds {1 + len(others)} runs; name the one whose model it is")
    experiment, folder = experiment_of_run(read_run(first)), given.to or first.parent / "calibration"
    system, model = experiment.system, experiment.model
    flights = [read_run(path) for tree in given.flights or [first] for path in recordings(tree)]
    for run in flights:
        if (run.state_names, run.input_names) != (system.state_names, system.input_names):
            raise DataError(f"{run.path}: has other states or inputs than {first}")
        if len(run.times) < 2 or (run.steps[1:] != run.steps[:-1] + 1).any():
            raise DataError(f"{run.path}: has fewer than two steps, or one is missing")
    if not experiment.learns or hasattr(experiment.learning, "episodes"):
        raise DataError(f"{first}: its controller learned no model, or learned it from whole flights")
    if model is None:
        with one_thread(), console.status("learning"):
            model = experiment.learn(experiment.training_rows(), experiment.seed).posterior
    flown = [calibration.Recording(torch.tensor(run.states), torch.tensor(run.inputs[:-1])) for run in flights]
    horizon = min(given.steps, max(map(len, flown)))
    names = [f"{name} [{system.units.get(name, '?')}]" for name in system.state_names]
    with console.status("predicting"):
        found = calibration.calibrate(model, flown, horizon=horizon, levels=_LEVELS, names=names)
    rows = []
    for k in sorted({step for step in (1, 10, 50) if step <= horizon} | {horizon}):
        for i, name in enumerate(names):
            low, high = found.coverage_interval(k - 1, i, -1)
            held = f"{found.coverage[k - 1, i, -1]:.1%}", f"{low:.1%} to {high:.1%}"
            rows.append([f"{k} ahead", name, float(found.rmse[k - 1, i]), *held, float(found.width[k - 1, i])])
    table = Table(["steps", "state", "RMSE", "in 95 %", "exact interval", "width"], rows, sections=True)
    lead = f"{found.samples[0]} predictions of {', '.join(str(run.path) for run in flights)}"
    images = {"calibration.png": png(calibration_figure(found))}
    document = Document(f"How well the model of {first} predicts", [table], found.to_pandas(), lead, images=images)
    where = write_files(folder, document.files("calibration"), "to")
    console.print(terminal([table]))
    console.out(where, highlight=False)
    return Result({"folder": str(folder), "rows": document.data.to_dict("records")})
