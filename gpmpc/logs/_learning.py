"""Learns a model from a log: its structure, its parameters, its GPs and its noise.

Structures are compared by the rollouts of rows that they were not fitted to, beside
baselines that cost nothing, which are structures like any other. Nominal models grow
and shrink by one term at a time; groups of outputs may come from different ones; GPs on
some groups of outputs, or on all, with targets averaged over 1, 5 or 10 rows, join
where they help; and the past may correct the rollouts. What is best is the model. The
noise comes from those rollouts as well.
"""

import hashlib
from collections.abc import Callable, MutableMapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array
from gpmpc.exceptions import DataError, SettingError, check_kind, check_number
from gpmpc.gp._wrapped import warn_of_turns
from gpmpc.logs._comparison import Comparison
from gpmpc.logs._control_fitness import ControlFitness, judge_for_control
from gpmpc.logs._fitting import STEPS, NominalFit
from gpmpc.logs._folds import MANY_RUNS, Folds, split_folds
from gpmpc.logs._log import Log
from gpmpc.logs._ranges import ranges_of
from gpmpc.logs._search import Search
from gpmpc.logs._structures import (
    Candidate,
    affordable_rows_back,
    likely_delay_rows,
    past_rows_needed,
)
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._log_model import LogModel
from gpmpc.models._namings import NO_NAMINGS, Namings

_FEWEST_STEPS = 2  # of the rollouts that decide
_ARGUMENTS = "arguments"  # key of a memory: what it holds results of


@dataclass(frozen=True)
class IdentifiedModel:
    """A model identified from a log, and the record of its identification.

    See Also:
        ``learn``, which returns it; ``save_learned``.
    """

    model: LogModel  #: fitted to all runs
    noise: OutputNoise  #: of its outputs
    fit: NominalFit  #: of the nominal part, to all runs
    candidates: tuple[Candidate, ...]  #: every structure that was tried, in order
    #: smallest and largest value (2, n + m) of the states and inputs in the log; those
    #: of an angle are the shortest arc that holds it
    ranges: Array
    runs: tuple[str, ...]  #: names of the runs
    state_names: tuple[str, ...]  #: as the file's columns are called (n,)
    input_names: tuple[str, ...]  #: likewise (m,)
    context_names: tuple[str, ...]  #: likewise
    time_step: float  #: [s]
    #: steps ahead at which the candidates were compared
    judged_steps: tuple[int, ...] = (10, 50)
    folds: str = ""  #: how the log was split to compare them
    #: errors of the model over those of others, on the held-out rows of the folds
    comparisons: tuple[Comparison, ...] = ()
    #: whether a controller can plan with it, where that was asked; no file keeps it
    control: ControlFitness | None = None
    #: why it should not be used, as far as it was judged; none is no promise
    reasons: tuple[str, ...] = ()
    #: what a system that it flies may call its states and inputs
    namings: Namings = NO_NAMINGS


@explains_arguments
def learn(
    log: Log,
    points: int = 300,
    steps: int = STEPS,
    seed: int = 0,
    progress: Callable[[str], None] = lambda text: None,
    memory: MutableMapping[str, Any] | None = None,
    for_control: bool = False,
) -> IdentifiedModel:
    """Learns a model of the outputs behind a log.

    Args:
        log: Of one run at least. Four runs or more are dealt to folds; the blocks of
            fewer, or of runs that are too unlike each other, take turns.
        points: Rows that a GP is trained on, chosen by k-means.
        steps: Of the rollouts; fewer where the log is too short to be halved for them.
        seed: Of every random number but those that deal runs to folds, which are the
            same for all seeds.
        progress: Called with a line at each stage.
        memory: Holds results of the stages, as plain data: those of an earlier call
            with equal arguments are not computed again. It begins empty.
        for_control: Leaves out what predicts such runs and misleads a controller: the
            feedback of the controller that flew, a memory of past rows, and the
            correction by the past. Judges what the inputs do.

    Raises:
        SettingError: ``log`` is no log, or a setting is out of range, or a model for
            control has no input, or ``memory`` is of other data or settings.
        DataError: No piece of the log is long enough for windows in every fold, even
            of fewer steps.
        TrainingError: A GP could not be trained.

    See Also:
        ``read_log``, whose runs it takes; ``judge``; ``save_learned``.
    """
    check_kind("log", log, Log, "a Log of read_log")
    check_number("points", points, least=10, whole=True)
    check_number("steps", steps, least=2, whole=True)
    check_number("seed", seed, least=0, whole=True)
    if for_control and not log.input_names:
        rule = "needs inputs that a controller can set; the mapping names none"
        raise SettingError("for_control", rule)
    if memory is None:
        memory = {}
    check_kind("memory", memory, MutableMapping, "a dictionary")
    _check_memory(memory, log, (points, steps, seed, for_control))
    advice = "Say kind: angle of it in the mapping"
    warn_of_turns(log.transitions(), log.space.angles, advice)
    plan = _plan_folds(log, steps, for_control)
    if plan.steps < steps:
        progress(f"short log: rollouts of {plan.steps} steps decide, not of {steps}")
    progress(plan.folds.sentence)
    search = Search(
        log=log,
        folds=plan.folds.parts,
        most_rows_back=plan.most_rows_back,
        delay_rows=plan.delay_rows,
        points=points,
        steps=plan.steps,
        seed=seed,
        progress=progress,
        results=memory,
        for_control=for_control,
    )
    search.run()
    return _identify(search, log, plan.folds.sentence, progress, for_control)


def _check_memory(
    memory: MutableMapping[str, Any], log: Log, settings: tuple[int, ...]
) -> None:
    """Raises ``SettingError`` of a memory of other data or settings; marks a new one.

    The keys of its results are those of structures alone.
    """
    mapping = repr((log.mapping, log.time_step, settings))
    digest = hashlib.sha256(mapping.encode())
    for run in log:
        digest.update(repr((len(run), run.begins)).encode())
        for values in (run.time, run.states, run.inputs, run.context):
            digest.update(np.ascontiguousarray(values).tobytes())
    arguments = digest.hexdigest()
    if not memory:
        memory[_ARGUMENTS] = arguments
    elif memory.get(_ARGUMENTS) != arguments:
        raise SettingError(
            "memory", "holds results of other data or settings; pass an empty one"
        )


def fewest_rows(runs: int) -> int:
    """Returns the rows without a gap that learning needs at least, of so many runs.

    They are those of windows of two steps; a run is halved where there are few.
    """
    window = past_rows_needed(0) + _FEWEST_STEPS + 1
    return window if runs >= MANY_RUNS else 2 * window


class _Plan(NamedTuple):
    """How a log is split to compare structures, and what these may be."""

    folds: Folds
    most_rows_back: int  # that a structure may look back on
    delay_rows: int  # by which inputs are likely to act late
    steps: int  # of the rollouts


def _plan_folds(log: Log, steps: int, for_control: bool) -> _Plan:
    """Splits a log for rollouts of so many steps, or of fewer where it is short.

    Where not even two steps are possible, structures look back on fewer rows.

    Raises:
        DataError: No piece of the log is long enough.
    """
    most_rows_back = affordable_rows_back(log, for_control)
    has_few_parameters = for_control or log.mapping.model != "none"
    most_folds = 2 if has_few_parameters else 4
    while True:
        delay_rows = likely_delay_rows(log, most_rows_back)
        past_rows = past_rows_needed(most_rows_back, delay_rows)
        fewer = min(steps, _most_steps(log, past_rows))
        while fewer >= _FEWEST_STEPS:
            try:
                folds = split_folds(log, past_rows, fewer, most=most_folds)
                return _Plan(folds, most_rows_back, delay_rows, fewer)
            except DataError:
                fewer -= max(fewer // 8, 1)
        if most_rows_back == 0:
            runs = len(log.runs)
            raise DataError(
                f"learning needs {fewest_rows(runs)} rows without a gap in "
                f"{'two runs' if runs >= MANY_RUNS else 'a run'}; the longest piece "
                f"has {log.longest_piece}"
            )
        most_rows_back = 0


def _most_steps(log: Log, past_rows: int) -> int:
    """Returns the most steps of which a fold of a log may have windows.

    A window has the past, the start and the steps.
    """
    longest = log.longest_piece
    if len(log.runs) < MANY_RUNS:
        longest //= 2  # runs are halved where nothing else is possible
    return longest - past_rows - 1


def _identify(
    search: Search,
    log: Log,
    folds: str,
    progress: Callable[[str], None],
    for_control: bool,
) -> IdentifiedModel:
    """Fits the best structure of a search to all runs, and its noise; see ``learn``."""
    progress(f"chosen: {search.best.name}")
    comparisons = search.comparisons()
    progress("noise from the errors of held-out rollouts")
    noise = search.fit_noise()
    progress("the chosen structure, fitted to all runs")
    fit = search.fit_to_all_runs()
    control = None
    if for_control:
        progress("what the inputs do, by the model and by the rows")
        control = judge_for_control(fit.model, log, search.rivals())
    return IdentifiedModel(
        model=fit.model,
        noise=noise,
        fit=fit,
        candidates=search.candidates,
        ranges=ranges_of(log),
        runs=tuple(run.name for run in log),
        state_names=log.mapping.column_names("states"),
        input_names=log.mapping.column_names("inputs"),
        context_names=log.mapping.column_names("context"),
        time_step=log.time_step,
        judged_steps=search.judged_steps,
        folds=folds,
        comparisons=comparisons,
        control=control,
        reasons=control.faults if control is not None else (),
        namings=log.mapping.namings,
    )
