"""Learns a model from a log; what is learned is decided by rollouts on runs that it was not fitted to.

Nominal models of growing size are fitted on rollouts and compared; then a GP on each group of outputs, with targets
averaged over 1, 5 or 10 rows, stays only where the rollouts of held-out runs get better. The noise comes from those
rollouts as well.
"""

import warnings
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from gpmpc.exceptions import DataError, check_number
from gpmpc.gp import Trainer, standardize
from gpmpc.gp._data_checks import Columns
from gpmpc.gp._wrapped import warn_of_turns
from gpmpc.logs._fitting import (
    NominalFit,
    OutputNoise,
    fit_least_squares,
    fit_noise,
    fit_nominal,
)
from gpmpc.logs._kinematics import Array, Increments, RigidBody
from gpmpc.logs._log import Log
from gpmpc.logs._rollouts import (
    PAST,
    STEPS,
    AffineNominal,
    LogModel,
    MultirotorNominal,
    OutputGP,
    finite_errors,
)

AVERAGES = (1, 5, 10)  # rows over which the targets of a GP are averaged
LATE = 3  # rows by which motors may act late
# structures
FEEDBACK = "feedback"
LATE_INPUTS = f"inputs {LATE} rows late"
JUDGED = (10, 50)  # steps whose errors decide
GAIN = 0.01  # least relative improvement for which a model may grow
LOSS = 0.05  # most relative loss in any group at any step
WINDOWS = 200  # of a fold
Grow = Callable[[Any], LogModel | None]


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
    runs: tuple[str, ...]  #: names of the runs
    state_names: tuple[str, ...]  #: as the file's columns are called (n,)
    input_names: tuple[str, ...]  #: likewise (m,)
    context_names: tuple[str, ...]  #: likewise
    time_step: float  #: [s]


def learn(
    log: Log,
    points: int = 300,
    steps: int = STEPS,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
    memory: MutableMapping[str, Any] | None = None,
    for_control: bool = False,
) -> Learned:
    """Learns a model of the outputs behind a log.

    Args:
        log: Of one run at least; several are split by run, one by time.
        points: Rows that a GP is trained on, chosen by k-means.
        steps: Of the rollouts.
        seed: Of every random number.
        progress: Called with a line at each stage.
        memory: Holds what the stages came to, as plain data: those of an earlier call with equal arguments are not
            computed again.
        for_control: Leaves out what predicts such runs and no controller can plan with: the feedback of the controller
            that flew, and inputs that act late.

    Raises:
        DataError: The log is too short for rollouts of that many steps.
        TrainingError: A GP could not be trained.
    """
    check_number("points", points, least=10, whole=True)
    check_number("steps", steps, least=2, whole=True)
    warn_of_turns(
        log.transitions(), log.space.angles, "Say kind: angle of it in the mapping"
    )
    folds = _split(log)
    cuts = [held_out.windows(steps, PAST + LATE, most=WINDOWS) for _, held_out in folds]
    memory = {} if memory is None else memory
    candidates: list[Candidate] = []
    best = 0  # the number of the best candidate
    models: list[LogModel] = []  # of it, one a fold

    def errors(trained: list[LogModel]) -> Array:
        at = [min(step, steps) for step in JUDGED]
        found = np.concatenate(
            [
                finite_errors(cut, model, at)
                for cut, model in zip(cuts, trained, strict=True)
            ]
        )
        return log.space.distances(found).mean(axis=0)

    def is_best(name: str, errors: Array) -> bool:
        nonlocal best
        candidates.append(Candidate(name, errors))
        better = len(candidates) == 1 or _is_better(candidates[-1], candidates[best])
        best = len(candidates) - 1 if better else best
        return better

    name, structure, options = _structures(log)
    for words, grow in options.items():
        trial = grow(structure)
        if trial is None or (for_control and words in (FEEDBACK, LATE_INPUTS)):
            continue
        trial_name = f"{name}, {words}" if words else name
        progress(f"{trial_name}: fitted on rollouts of {steps} steps")
        if trial_name not in memory:
            starts = zip(models or [structure] * len(folds), folds, strict=True)
            memory[trial_name] = [
                _fit(trial, model, train, steps).model.theta.tolist()
                for model, (train, _) in starts
            ]
        fitted = [
            replace(trial, theta=np.array(theta, dtype=float))
            for theta in memory[trial_name]
        ]
        if is_best(trial_name, errors(fitted)):
            models = fitted
            name = trial_name
            structure = trial
    choice: dict[str, int] = {}
    groups = structure.kinematics.output_groups
    for group, outputs in groups.items():
        base = [(model, train) for model, (train, _) in zip(models, folds, strict=True)]
        for average in AVERAGES:
            averages = {**choice, group: average}.items()
            words = f"{name}, GP on {' and '.join(f'{of} (averaged over {rows})' for of, rows in averages)}"
            progress(words)
            trained = []
            learning = (outputs, average, points, seed)
            if words not in memory:
                trained = [_with_gp(model, train, *learning) for model, train in base]
                memory[words] = errors(trained).tolist()
            if is_best(words, np.array(memory[words])):
                models = trained or [
                    _with_gp(model, train, *learning) for model, train in base
                ]
                choice[group] = average
    progress(f"chosen: {candidates[best].name}")
    candidates[best] = replace(candidates[best], chosen=True)
    progress("noise from the errors of held-out rollouts")
    noise = fit_noise(models, [held_out for _, held_out in folds], steps)
    progress("the chosen structure, fitted to all runs")
    fit = _fit(structure, models[0], log, steps)
    gps = tuple(
        _train(fit.model, log, groups[group], average, points, seed)
        for group, average in choice.items()
    )
    values = np.concatenate([np.hstack([run.states, run.inputs]) for run in log])
    return Learned(
        model=replace(fit.model, gps=gps),
        noise=noise,
        fit=fit,
        candidates=tuple(candidates),
        ranges=np.stack([values.min(axis=0), values.max(axis=0)]),
        runs=tuple(run.name for run in log),
        state_names=log.mapping.column_names("states"),
        input_names=log.mapping.column_names("inputs"),
        context_names=log.mapping.column_names("context"),
        time_step=log.time_step,
    )


def _is_better(candidate: Candidate, incumbent: Candidate) -> bool:
    """Whether a candidate's errors are smaller on the whole, and in no group at no step much larger."""
    ratio = np.log(
        np.maximum(candidate.errors, 1e-12) / np.maximum(incumbent.errors, 1e-12)
    )
    return bool(ratio.mean() < -GAIN and ratio.max() < LOSS)


def _structures(log: Log) -> tuple[str, LogModel, dict[str, Grow]]:
    """A name, the simplest model, and what is added to it one after the other; None where an addition has no sense."""
    if log.mapping.model != "rigid_body":
        kinematics = Increments(log.space)
        o = log.space.error_dim
        options: dict[str, Grow] = {
            "": lambda model: model,
            "least squares": lambda model: replace(
                model, nominal=AffineNominal(kinematics)
            ),
            "disturbance": lambda model: replace(model, history=(PAST,) * o),
        }
        zero = AffineNominal(kinematics, fitted=False)
        return "increments", LogModel(kinematics, zero, np.empty(0), (0,) * o), options
    options = {
        "": lambda model: model,
        "force disturbance": lambda model: replace(
            model, history=(PAST,) * 3 + (0,) * 3
        ),
        "motor torque": lambda model: replace(
            model, nominal=replace(model.nominal, torque=True)
        ),
        FEEDBACK: lambda model: replace(
            model, nominal=replace(model.nominal, feedback=True)
        ),
        LATE_INPUTS: lambda model: (
            replace(model, lag=LATE) if model.nominal.torque else None
        ),
        "torque disturbance": lambda model: (
            replace(model, history=model.history[:3] + (PAST,) * 3)
            if model.nominal.torque
            else None
        ),
    }
    volts = [signal.unit for signal in log.mapping.of("context")][:1] in (["V"], ["mV"])
    voltage = (
        float(np.median(np.concatenate([run.context[:, 0] for run in log])))
        if volts
        else 0.0
    )
    thrusts = all(signal.unit == "N" for signal in log.mapping.of("inputs"))
    nominal = MultirotorNominal(len(log.input_names), voltage=voltage, thrusts=thrusts)
    return (
        "rigid body",
        LogModel(RigidBody(log.space), nominal, np.empty(0), (0,) * 6),
        options,
    )


def _split(log: Log) -> list[tuple[Log, Log]]:
    """Two folds by run; of a single run by time."""
    if len(log.runs) == 1:
        halves = log.split_by_time(0.5)
        log = replace(log, runs=tuple(half.runs[0] for half in halves))
    names = [run.name for run in sorted(log.runs, key=len)]
    return [log.split(names[i::2]) for i in range(2)]


def _fit(structure: LogModel, simpler: LogModel, log: Log, steps: int) -> NominalFit:
    """Fits a structure's nominal part, from the parameters that a simpler model has in common with it."""
    nominal = structure.nominal
    if (
        isinstance(nominal, AffineNominal) and nominal.fitted
    ):  # linear in its many parameters
        return NominalFit(
            replace(
                fit_least_squares(nominal.kinematics, log), history=structure.history
            ),
            np.empty(0),
        )
    known = dict(zip(simpler.nominal.parameter_names, simpler.theta, strict=False))
    pairs = zip(nominal.parameter_names, nominal.start, strict=True)
    return fit_nominal(
        structure,
        np.array([known.get(name, start) for name, start in pairs]),
        log,
        steps,
    )


def _with_gp(model: LogModel, log: Log, *learning: Any) -> LogModel:
    return replace(model, gps=(*model.gps, _train(model, log, *learning)))


def _train(
    model: LogModel,
    log: Log,
    outputs: tuple[int, ...],
    average: int,
    points: int,
    seed: int,
) -> OutputGP:
    """Trains a GP on what the nominal part leaves of some outputs, averaged over some rows."""
    cut = log.windows(average, model.lag)
    at = slice(cut.past, cut.past + average)
    x = cut.states[:, at]
    u = cut.inputs[:, cut.past - model.lag : cut.past - model.lag + average]
    c = np.broadcast_to(cut.context[:, -1:], (*x.shape[:-1], cut.context.shape[-1]))
    after = cut.states[:, cut.past + 1 : cut.past + average + 1]
    if model.kinematics.space.angles:  # may go round by more than half a turn
        seen = model.kinematics.outputs(x, after, cut.time_step).mean(axis=1)
    else:
        seen = model.kinematics.outputs(x[:, 0], after[:, -1], cut.time_step * average)
    y = seen - model.nominal.outputs(model.theta, x, u, c).mean(axis=1)
    middle = average // 2
    z = model.kinematics.features(x[:, middle], u[:, middle], c[:, middle])
    rows = choose_rows(z, points, seed)
    trainer = Trainer(predicts="value", scaling=standardize, restarts=1, tolerance=1e-6)
    y = np.ascontiguousarray(y[rows][:, list(outputs)])
    inputs = log.mapping.column_names("inputs")
    context = log.mapping.column_names("context")
    columns = Columns(
        features=model.kinematics.feature_names(inputs, context),
        outputs=[model.kinematics.output_names[a] for a in outputs],
    )
    training = trainer.fit(
        torch.from_numpy(z[rows]),
        torch.from_numpy(y),
        0,
        "value",
        seed,
        columns=columns,
    )
    return OutputGP(outputs, training.posterior)


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
    chosen = [0]
    distance = np.full(len(sample), np.inf)
    while len(chosen) < count:  # farthest points (Gonzalez, 1985)
        distance = np.minimum(
            distance, np.square(sample - sample[chosen[-1]]).sum(axis=1)
        )
        chosen.append(int(distance.argmax()))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a centre that loses its members stays
        centres = kmeans2(sample, sample[chosen], iter=5, minit="matrix")[0]
    return np.unique(cKDTree(z).query(centres)[1])
