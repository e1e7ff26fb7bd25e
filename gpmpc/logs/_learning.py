"""Learns a model from a log; what is learned is decided by rollouts on runs that it was not fitted to.

Nominal models of growing size are fitted on rollouts and compared; then a GP on each group of outputs, with targets
averaged over 1, 5 or 10 rows, stays only where the rollouts of held-out runs get better. The noise comes from those
rollouts as well.
"""

import warnings
from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from gpmpc.exceptions import DataError, check_number
from gpmpc.gp import Trainer, standardize
from gpmpc.logs._fitting import NominalFit, OutputNoise, fit_least_squares, fit_noise, fit_nominal
from gpmpc.logs._kinematics import Array, Increments, Kinematics, RigidBody
from gpmpc.logs._log import Log
from gpmpc.logs._rollouts import (
    PAST,
    STEPS,
    AffineNominal,
    LogModel,
    MultirotorNominal,
    Nominal,
    OutputGP,
    Still,
    choose_stride,
    finite_errors,
)

AVERAGES = (1, 5, 10)  # rows over which the targets of a GP are averaged
LATE = 3  # rows by which motors may act late
FEEDBACK, LATE_INPUTS = "feedback", f"inputs {LATE} rows late"  # structures
JUDGED = (10, 50)  # steps whose errors decide
GAIN = 0.01  # least relative improvement for which a model may grow
LOSS = 0.05  # most relative loss in any group at any step
WINDOWS = 200  # of a fold
Progress = Callable[[str], None]
Grow = Callable[[Any], LogModel | None]
Memory = MutableMapping[str, Any]  # from a stage's name to plain data; for example of a file


@dataclass(frozen=True)
class Candidate:
    """One model structure and how its rollouts on held-out runs went."""

    name: str
    errors: Array  # (len(JUDGED), groups) mean Euclidean or geodesic error
    chosen: bool = False


@dataclass(frozen=True)
class Learned:
    """What was learned from a log."""

    model: LogModel  #: fitted to all runs
    noise: OutputNoise  #: of its outputs
    fit: NominalFit  #: of the nominal part, to all runs
    candidates: tuple[Candidate, ...]  #: every structure that was tried, in order
    ranges: Array  #: smallest and largest value (2, n + m) of the states and inputs in the log
    rows: int  #: of the log
    runs: tuple[str, ...]  #: names of the runs
    state_names: tuple[str, ...]  #: as the file's columns are called (n,)
    input_names: tuple[str, ...]  #: likewise (m,)
    context_names: tuple[str, ...]  #: likewise
    time_step: float  #: [s]


class _Folds:
    """Splits of a log by run, with held-out windows."""

    def __init__(self, parts: list[tuple[Log, Log]], steps: int):
        self.parts, self._at, past = parts, [min(step, steps) for step in JUDGED], PAST + LATE
        logs = [held_out for _, held_out in parts]
        self._windows = [log.windows(steps, past, choose_stride(log, steps + past, WINDOWS)) for log in logs]

    def judge(self, name: str, models: Sequence[LogModel]) -> Candidate:
        """Mean error of each group at the steps that decide."""
        pairs = zip(self._windows, models, strict=True)
        errors = np.concatenate([finite_errors(cut, model, self._at) for cut, model in pairs])
        return Candidate(name, self._windows[0].space.distances(errors).mean(axis=0))


def learn(
    log: Log,
    points: int = 300,
    steps: int = STEPS,
    seed: int = 0,
    progress: Progress = lambda text: None,
    memory: Memory | None = None,
    for_control: bool = False,
) -> Learned:
    """Learns a model of the outputs behind a log.

    Args:
        log: Of one run at least; several are split by run, one by time.
        points: Rows that a GP is trained on, chosen by k-means.
        steps: Of the rollouts.
        seed: Of every random number.
        progress: Called with a line at each stage.
        memory: Holds the outcome of stages that an earlier call with equal arguments went through.
        for_control: Leaves out what predicts such runs and no controller can plan with: the feedback of the controller
            that flew, and inputs that act late.

    Raises:
        DataError: The log is too short for rollouts of that many steps.
        TrainingError: A GP could not be trained.
    """
    check_number("points", points, least=10, whole=True)
    check_number("steps", steps, least=2, whole=True)
    kinematics: Kinematics = RigidBody(log.space) if log.mapping.model == "rigid_body" else Increments(log.space)
    folds = _Folds(_split(log, 2), steps)
    memory = {} if memory is None else memory
    name, structure, options = _structures(kinematics, log)
    if for_control:
        options = {words: grow for words, grow in options.items() if words not in (FEEDBACK, LATE_INPUTS)}
    candidates: list[Candidate] = []
    models: list[LogModel] = []
    best = 0
    for words, grow in [("", lambda model: model), *options.items()]:
        trial = grow(structure)
        if trial is None:
            continue
        trial_name = f"{name}, {words}" if words else name
        progress(f"{trial_name}: fitted on rollouts of {steps} steps")
        if trial_name not in memory:
            starts = models or [structure] * len(folds.parts)
            pairs = zip(starts, folds.parts, strict=True)
            memory[trial_name] = [_fit(trial, m, train, steps).model.theta.tolist() for m, (train, _) in pairs]
        fitted = [_with_parameters(trial, theta) for theta in memory[trial_name]]
        candidates.append(folds.judge(trial_name, fitted))
        if not models or _is_better(candidates[-1], candidates[best]):
            best, models, name, structure = len(candidates) - 1, fitted, trial_name, trial
    choice: dict[str, int] = {}
    for group, outputs in kinematics.output_groups.items():
        base = [(model, train) for model, (train, _) in zip(models, folds.parts, strict=True)]
        for average in AVERAGES:
            averages = {**choice, group: average}.items()
            words = f"{name}, GP on {' and '.join(f'{of} (averaged over {rows})' for of, rows in averages)}"
            progress(words)
            trained: list[LogModel] = []
            if words not in memory:
                trained = _with_gps(base, outputs, average, points, seed)
                memory[words] = folds.judge(words, trained).errors.tolist()
            candidates.append(Candidate(words, np.array(memory[words])))
            if _is_better(candidates[-1], candidates[best]):
                models = trained or _with_gps(base, outputs, average, points, seed)
                best, choice[group] = len(candidates) - 1, average
    progress(f"chosen: {candidates[best].name}")
    candidates[best] = replace(candidates[best], chosen=True)
    progress("noise from the errors of held-out rollouts")
    noise = fit_noise(models, [held_out for _, held_out in folds.parts], steps)
    progress("the chosen structure, fitted to all runs")
    fit = _fit(structure, models[0], log, steps)
    groups = kinematics.output_groups
    gps = tuple(_train(fit.model, log, groups[group], average, points, seed) for group, average in choice.items())
    values = np.concatenate([np.hstack([run.states, run.inputs]) for run in log])
    return Learned(
        model=replace(fit.model, gps=gps),
        noise=noise,
        fit=fit,
        candidates=tuple(candidates),
        ranges=np.stack([values.min(axis=0), values.max(axis=0)]),
        rows=len(log),
        runs=tuple(run.name for run in log),
        state_names=log.mapping.column_names("states"),
        input_names=log.mapping.column_names("inputs"),
        context_names=log.mapping.column_names("context"),
        time_step=log.time_step,
    )


def _is_better(candidate: Candidate, incumbent: Candidate) -> bool:
    """Whether a candidate's errors are smaller on the whole, and in no group at no step much larger."""
    ratio = np.log(np.maximum(candidate.errors, 1e-12) / np.maximum(incumbent.errors, 1e-12))
    return bool(ratio.mean() < -GAIN and ratio.max() < LOSS)


def _structures(kinematics: Kinematics, log: Log) -> tuple[str, LogModel, dict[str, Grow]]:
    """The simplest model, and what may be added to it one after the other; None where an addition makes no sense."""
    o = len(kinematics.output_names)

    def simplest(nominal: Nominal) -> LogModel:
        return LogModel(kinematics, nominal, np.empty(0), (0,) * o)

    options: dict[str, Grow]
    if log.mapping.model != "rigid_body":
        options = {
            "least squares": lambda model: replace(model, nominal=AffineNominal(kinematics, o)),
            "disturbance": lambda model: replace(model, history=(PAST,) * o),
        }
        return "increments", simplest(Still(o)), options
    options = {
        "force disturbance": lambda model: replace(model, history=(PAST,) * 3 + (0,) * 3),
        "motor torque": lambda model: replace(model, nominal=replace(model.nominal, torque=True)),
        FEEDBACK: lambda model: replace(model, nominal=replace(model.nominal, feedback=True)),
        LATE_INPUTS: lambda model: replace(model, lag=LATE) if model.nominal.torque else None,
        "torque disturbance": lambda model: (
            replace(model, history=model.history[:3] + (PAST,) * 3) if model.nominal.torque else None
        ),
    }
    volts = bool(log.context_names) and log.mapping.of("context")[0].unit in ("V", "mV")
    voltage = float(np.median(np.concatenate([run.context[:, 0] for run in log]))) if volts else 0.0
    thrusts = all(signal.unit == "N" for signal in log.mapping.of("inputs"))
    return "rigid body", simplest(MultirotorNominal(len(log.input_names), voltage=voltage, thrusts=thrusts)), options


def _split(log: Log, count: int) -> list[tuple[Log, Log]]:
    """Folds by run; of a single run by time."""
    if len(log.runs) == 1:
        halves = log.split_by_time(0.5)
        log = replace(log, runs=tuple(half.runs[0] for half in halves))
    names = [run.name for run in sorted(log.runs, key=len)]
    return [log.split(names[i::count]) for i in range(count)]


def _fit(structure: LogModel, simpler: LogModel, log: Log, steps: int) -> NominalFit:
    """Fits a structure's nominal part, from the parameters that a simpler model has in common with it."""
    if not isinstance(structure.nominal, AffineNominal):
        known = dict(zip(simpler.nominal.parameter_names, simpler.theta, strict=False))
        pairs = zip(structure.nominal.parameter_names, structure.nominal.start, strict=True)
        return fit_nominal(structure, np.array([known.get(name, start) for name, start in pairs]), log, steps)
    affine = fit_least_squares(structure.kinematics, log)  # linear in its many parameters
    unknown = np.full(len(affine.theta), np.nan)
    return NominalFit(replace(affine, history=structure.history), unknown, np.nan, np.nan, 1)


def _with_parameters(structure: LogModel, theta: Sequence[float]) -> LogModel:
    nominal = structure.nominal
    if isinstance(nominal, AffineNominal):
        structure = replace(structure, nominal=replace(nominal, feature_dim=len(theta) // nominal.output_dim - 1))
    return replace(structure, theta=np.array(theta, dtype=float))


def _with_gps(
    base: Sequence[tuple[LogModel, Log]], outputs: tuple[int, ...], average: int, points: int, seed: int
) -> list[LogModel]:
    return [replace(m, gps=(*m.gps, _train(m, log, outputs, average, points, seed))) for m, log in base]


def _train(model: LogModel, log: Log, outputs: tuple[int, ...], average: int, points: int, seed: int) -> OutputGP:
    """Trains a GP on what the nominal part leaves of some outputs, averaged over some rows."""
    cut = log.windows(average, model.lag)
    at = slice(cut.past, cut.past + average)
    x, u = cut.states[:, at], cut.inputs[:, cut.past - model.lag : cut.past - model.lag + average]
    c = np.broadcast_to(cut.context[:, -1:], (*x.shape[:-1], cut.context.shape[-1]))
    seen = model.kinematics.outputs(x[:, 0], cut.states[:, cut.past + average], cut.time_step * average)
    y = seen - model.nominal.outputs(model.theta, x, u, c).mean(axis=1)
    middle = average // 2
    z = model.kinematics.features(x[:, middle], u[:, middle], c[:, middle])
    rows = choose_rows(z, points, seed)
    trainer = Trainer(predicts="value", scaling=standardize, restarts=1, tolerance=1e-6)
    y = np.ascontiguousarray(y[rows][:, list(outputs)])
    return OutputGP(outputs, trainer.fit(torch.from_numpy(z[rows]), torch.from_numpy(y), 0, "value", seed).posterior)


def choose_rows(features: Array, count: int, seed: int = 0) -> np.ndarray:
    """Chooses rows nearest to the centres of k-means that begins with farthest points, so that rare states count.

    Features (N, d) are standardised here; where there are no more than ``count``, all rows are chosen.
    """
    if not len(features):
        raise DataError("no row to choose from")
    if len(features) <= count:
        return np.arange(len(features))
    z = (features - features.mean(axis=0)) / np.maximum(features.std(axis=0), 1e-12)
    sample = z[np.random.default_rng(seed).permutation(len(z))[: 10 * count]]
    chosen, distance = [0], np.full(len(sample), np.inf)
    while len(chosen) < count:  # farthest points (Gonzalez, 1985)
        distance = np.minimum(distance, np.square(sample - sample[chosen[-1]]).sum(axis=1))
        chosen.append(int(distance.argmax()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a centre that loses its members stays
        centres = kmeans2(sample, sample[chosen], iter=5, minit="matrix")[0]
    return np.unique(cKDTree(z).query(centres)[1])
