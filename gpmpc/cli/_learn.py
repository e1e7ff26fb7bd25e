"""``gpmpc learn``: from log files and a mapping to a model, a report and a model card.

logs -> training and held-out runs -> learned -> judged -> model, report, card
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from rich.console import Console

from gpmpc import logs
from gpmpc._dynamics import Array
from gpmpc._files import write_whole
from gpmpc._provenance import code_fingerprint, provenance
from gpmpc.cli._commands import Result
from gpmpc.cli._folders import find_modules_here, write_files, writing
from gpmpc.cli._terminal import print_error
from gpmpc.exceptions import DataError, SettingError
from gpmpc.logs import IdentifiedModel, Judgement, Log
from gpmpc.logs._control_fitness import unflown_disturbance
from gpmpc.logs._fitting import PAST
from gpmpc.logs._judging import (
    check_held_out,
    check_learned,
    check_train,
    most_steps,
    most_told_steps,
    short_pieces,
)
from gpmpc.logs._learning import fewest_rows
from gpmpc.logs._log import LogRun
from gpmpc.logs._structures import affordable_rows_back, past_rows_needed
from gpmpc.models._parametric import is_still
from gpmpc.plotting import judgement_figure, png
from gpmpc.studies._document import Document, Table, number, terminal
from gpmpc.studies._run_folder import describe_code
from gpmpc.studies.study import fingerprint

_MODEL = "model.safetensors"
#: what is written beside it
_DOCUMENTS = (
    "report.md",
    "report.csv",
    "report.tex",
    "report.html",
    "report.png",
    "card.md",
)
_JUDGED_STEPS = (1, 10, 50)  # ahead, besides the longest
_LONG_TO_READ = 10_000_000  # bytes
_EXIT_UNUSABLE = 3  # of a model that is written, and should not be used
_NOISE_IN_WORDS = (
    "the noise of the outputs, which adds up, and that of the sensors, which does not, "
    "as fitted to held-out rollouts"
)


def learn(arguments: argparse.Namespace) -> Result:
    """Learns from logs, judges on held-out runs, and writes model, report and card.

    The same command goes on where it stopped. The exit code is 3 where the model that
    was written should not be used.
    """
    console = Console(soft_wrap=True, highlight=False, markup=False)
    folder = arguments.to or Path("learned")
    _check_folder(folder)
    find_modules_here()  # which a mapping may name a system of
    _say_what_is_read(arguments.files, console)
    log = logs.read_log(arguments.files, arguments.mapping, arguments.partial)
    console.print(repr(log))
    for finding in log.findings:
        console.print(f"  {finding.run}: {finding.kind}: {finding.text}")
    split = _split(log, arguments.held_out)
    train = split.train
    check_train(train)
    check_held_out(split.held_out(PAST))
    doubt = _doubt_of_held_out(split, arguments.for_control)
    if doubt:
        console.print(doubt)
    with writing(folder, "to"):
        folder.mkdir(parents=True, exist_ok=True)
        learned, judgement = _learn_and_judge(
            arguments, split, folder=folder, console=console
        )
        held_out = split.held_out(learned.model.past)
        reasons = _reasons_against(learned, judgement)
        learned = replace(learned, reasons=reasons)
        report = _make_report(learned, judgement, train, held_out)
        card = _make_card(learned, judgement, train, held_out)
        files = report.files("report")
        files["report.html"] = report.html()
        files["card.md"] = card.markdown()
        _save_model(learned, folder)
        write_files(folder, files, "to")
    Console().print(terminal(report.tables[:1]))
    if judgement.steps_not_told and not _is_untold(judgement):
        console.print(_not_told(judgement))
    for line in judgement.losses:
        console.print(f"loses: {line}")
    for line in short_pieces(learned, judgement, held_out, train):
        console.print(line)
    console.print(f"written to {folder}: {_MODEL}, report.html, report.md, card.md")
    for reason in reasons:
        print_error(f"do not use this model: {reason}")
    for line in _advice(learned):
        console.print(line)
    data = {
        "folder": str(folder),
        "usable": not reasons,
        "reasons": reasons,
        "losses": judgement.losses,
        "rows": report.data.to_dict("records"),
    }
    return Result(data, _EXIT_UNUSABLE if reasons else 0)


def _check_folder(folder: Path) -> None:
    """Raises ``SettingError`` where documents in a folder are those of somebody else.

    They are without a model beside them, which ``gpmpc learn`` writes first.
    """
    if (folder / _MODEL).exists():
        return
    foreign = [name for name in _DOCUMENTS if (folder / name).exists()]
    if foreign:
        rule = f"would go over {foreign[0]}, beside which there is no {_MODEL}"
        raise SettingError("--to", f"{rule}: name another folder; got {folder}")


def _say_what_is_read(files: Sequence[Path], console: Console) -> None:
    """Prints how much is read, which may take minutes."""
    size = sum(Path(file).stat().st_size for file in files if Path(file).is_file())
    if size >= _LONG_TO_READ:
        console.print(f"reading {len(files)} files, {size / 1e6:.0f} MB")


def _reasons_against(learned: IdentifiedModel, judgement: Judgement) -> tuple[str, ...]:
    """Returns why a model should not be used; nothing where it may be.

    A model for a controller is not asked to beat the ridge regression, with which none
    can plan, but to know what the inputs do. A model of which nobody knows whether it
    loses to what costs nothing should not be used either.
    """
    untold = ()
    if _is_untold(judgement):
        untold = (f"{_not_told(judgement)}: hold out longer runs",)
    if learned.control is None:
        return (*judgement.losses, *untold)
    losses = judgement.losses_to(logs.PLANNABLE_BASELINES)
    return (*learned.control.faults, *losses, *untold)


def _is_untold(judgement: Judgement) -> bool:
    """Tells whether held-out rows are too few to tell a loss at any step ahead."""
    return judgement.steps_not_told == judgement.steps


def _save_model(learned: IdentifiedModel, folder: Path) -> None:
    """Saves a model, after the report and the card of an earlier one are gone."""
    for name in _DOCUMENTS:
        (folder / name).unlink(missing_ok=True)
    logs.save_learned(learned, folder / _MODEL)


def _advice(learned: IdentifiedModel) -> tuple[str, ...]:
    """Returns what else to know of a model for a controller, and what to fly."""
    control = learned.control
    if control is None:
        return ()
    warnings = tuple(f"for control: {warning}" for warning in control.warnings)
    return (*warnings, *control.advice)


def _learn_and_judge(
    arguments: argparse.Namespace,
    split: "_Split",
    folder: Path,
    console: Console,
) -> tuple[IdentifiedModel, Judgement]:
    """Learns, with the results of finished stages in a file, and judges the model."""
    train = split.train
    results = _StageResults(
        folder / "progress.json", _fingerprint_of_call(arguments, train)
    )
    if results.begun_anew:
        console.print(results.begun_anew)
    with console.status("learning") as status:

        def show(stage: str) -> None:
            status.update(stage)
            console.print(f"  {stage}")

        learned = logs.learn(
            train,
            points=arguments.points,
            steps=arguments.steps,
            seed=arguments.seed,
            progress=show,
            memory=results,
            for_control=arguments.for_control,
        )
        held_out = split.held_out(learned.model.past)
        try:
            check_learned(learned, held_out, train)
        except DataError as error:
            _save_model(replace(learned, reasons=(str(error),)), folder)
            text = f"{error} ({folder / _MODEL} is written, without a report)"
            raise DataError(text) from error
        longest = min(arguments.steps, most_steps(learned, held_out, train))
        told_steps = max(most_told_steps(learned, held_out), 1)
        reason = ""
        if told_steps < longest:
            longest = told_steps
            reason = f": {_of_more_than(longest)}"
        show(f"judging on held-out runs, at most {longest} steps ahead{reason}")
        steps = {step for step in _JUDGED_STEPS if step <= longest} | {longest}
        judgement = logs.judge(learned, held_out, train, sorted(steps))
    return learned, judgement


def _fingerprint_of_call(arguments: argparse.Namespace, train: Log) -> str:
    """Returns a text that differs where code, data or settings differ."""
    settings = (
        train.mapping,
        train.time_step,
        [run.begins for run in train],
        arguments.points,
        arguments.steps,
        arguments.seed,
        arguments.for_control,
    )
    content = {"settings": repr(settings)}
    if train.mapping.nominal is not None:  # whose code counts as well
        content["_target_"] = train.mapping.nominal.code.replace(":", ".")
    arrays = []
    for run in train:
        arrays += [run.time, run.states, run.inputs, run.context]
    return fingerprint(content, arrays)


def _of_more_than(steps: int) -> str:
    """Says why a model is judged so many steps ahead and no more."""
    return (
        f"of predictions more than {steps} {'steps' if steps > 1 else 'step'} ahead "
        "fewer than four follow each other in the held-out rows, too few to tell"
    )


class _Split(NamedTuple):
    """The rows of a log to learn from, and those to judge on."""

    train: Log
    held_out_rows: Log
    #: the run whose last rows are held out; none where whole runs are
    run: LogRun | None = None

    def held_out(self, past: int) -> Log:
        """Returns the rows to judge on, with the past from which predictions begin.

        Args:
            past: Rows that a model looks back on. What comes before the last rows of a
                run may be of those that were learned from, as may be the row from which
                the first of them is predicted.
        """
        if self.run is None:
            return self.held_out_rows
        first = len(self.run) - len(self.held_out_rows)
        first -= max(past, PAST) + 1
        rows = self.run.part(max(first, 0), len(self.run), "last part")
        return replace(self.held_out_rows, runs=(rows,))


def _split(log: Log, held_out: Sequence[str]) -> _Split:
    """Splits a log into the runs to learn from and those to judge on.

    Where nobody chose, a fifth of the runs is held out, of all lengths on which a model
    can be judged: the middle ones of as many groups. Where there is but one of these,
    it is the last fifth of it, or what is left of the rows that learning needs.
    """
    if held_out:
        return _Split(*log.split([*held_out]))
    runs = sorted(log.runs, key=len)
    names = [run.name for run in runs if _longest_piece(run) >= PAST + 2]
    if len(names) < 2:
        run = max(runs, key=_longest_piece)
        rows = max(round(0.8 * len(run)), min(fewest_rows(1), len(run) - 2))
        share = min(rows, len(run) - 1) / len(run)
        first, last = replace(log, runs=(run,)).split_by_time(share)
        others = [other for other in log.runs if other is not run]
        return _Split(replace(first, runs=(*others, *first.runs)), last, run)
    count = max(len(names) // 5, 1)
    groups = np.array_split(names, count)
    middle = [str(group[(len(group) - 1) // 2]) for group in groups]
    return _Split(*log.split(middle))


def _longest_piece(run: LogRun) -> int:
    """Returns the number of rows of a run's longest piece."""
    return max(end - begin for begin, end in run.pieces)


def _doubt_of_held_out(split: _Split, for_control: bool) -> str:
    """Says, before hours of learning, that a model may not be judged afterwards."""
    most = past_rows_needed(affordable_rows_back(split.train, for_control))
    longest = split.held_out(most).longest_piece
    if longest >= most + 2:
        return ""
    return (
        f"the longest piece that is held out has {longest} rows: a model may look back "
        f"on {most}, and could not be judged on it; hold out longer runs"
    )


class _StageResults(dict[str, Any]):
    """Results of the stages of learning, kept in a JSON file.

    Other code, data or settings begin it anew.

    Args:
        path: The file.
        fingerprint: Of code, data and settings.
    """

    def __init__(self, path: Path, fingerprint: str):
        self._path = path
        self._fingerprint = fingerprint
        self._code = code_fingerprint()
        #: a line that says why the results of an earlier call are not used; "" where
        #: they are, or where there are none
        self.begun_anew = ""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            is_of_this_call = content["fingerprint"] == fingerprint
            stages = dict(content["stages"])
            code = content.get("code")
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            self.begun_anew = f"{path}: is not whole; all is learned anew"
            return
        if is_of_this_call:
            super().__init__(stages)
        elif code != self._code:
            self.begun_anew = (
                f"{path}: is of other code of gpmpc than this; all is learned anew"
            )
        else:
            self.begun_anew = (
                f"{path}: is of other data or settings; all is learned anew"
            )

    def __setitem__(self, key: str, value: Any) -> None:
        super().__setitem__(key, value)
        content = {
            "fingerprint": self._fingerprint,
            "code": self._code,
            "stages": self,
        }
        write_whole(self._path, json.dumps(content))


def _make_report(
    learned: IdentifiedModel, judgement: Judgement, train: Log, held_out: Log
) -> Document:
    """Returns errors beside the baselines, coverage and width, and every candidate."""
    notes = [
        "In brackets under a mean error stands the root mean square. A width of 1 "
        "claims the spread that the errors have; the interval in brackets is the exact "
        "one of Clopper and Pearson, for as many independent predictions as the "
        "autocorrelation of the errors leaves.",
        f"Intervals hold {_NOISE_IN_WORDS}.",
        f"Candidates were compared on held-out rows: {learned.folds}.",
    ]
    lists: dict[str, Sequence[str]] = {}
    title = "What was learned, judged on runs that it never saw"
    reasons = _reasons_against(learned, judgement)
    if reasons:
        title = f"This model should not be used: {reasons[0]}"
        lists["Why the model should not be used"] = reasons
    longest = judgement.steps[-1]
    if longest < learned.judged_steps[-1]:
        reason = _of_more_than(longest)
        if longest == most_steps(learned, held_out, train):
            reason = "no piece to judge on, or to learn from, is long enough for more"
        notes.append(f"Judged {longest} ahead: {reason}.")
    if judgement.losses:
        lists["Where the model loses to what costs nothing"] = judgement.losses
    elif not _is_untold(judgement):
        notes.append(
            "The model loses to no baseline, by more than 2 % and more than chance."
        )
    if judgement.steps_not_told:
        notes.append(_not_told(judgement))
    if learned.control is not None:
        lists["For control"] = [*learned.control.warnings, *learned.control.advice]
    notes += [f"{one}." for one in short_pieces(learned, judgement, held_out, train)]
    return Document(
        title=title,
        tables=[
            _table_of_errors(judgement),
            _table_of_intervals(judgement),
            *_tables_of_effects(learned),
            _table_of_comparisons(learned, judgement),
            _table_of_candidates(learned, judgement),
        ],
        data=judgement.to_pandas(),
        lead=(
            f"{_predictions(judgement)} on {', '.join(judgement.runs)}; "
            f"learned from {len(train)} rows of {len(train.runs)} runs."
        ),
        notes=notes,
        lists=lists,
        images={"report.png": png(judgement_figure(judgement))},
    )


def _predictions(judgement: Judgement) -> str:
    """Says how many predictions were judged, by the steps ahead where they differ."""
    if len(set(judgement.windows)) == 1:
        return f"{judgement.windows[0]} predictions"
    numbers = " / ".join(map(str, judgement.windows))
    steps = " / ".join(map(str, judgement.steps))
    return f"{numbers} predictions {steps} steps ahead"


def _not_told(judgement: Judgement) -> str:
    """Says at which steps ahead nobody knows whether a model loses."""
    steps = ", ".join(map(str, judgement.steps_not_told))
    return (
        f"{steps} steps ahead: too few held-out rows to tell whether the model loses "
        "to what costs nothing"
    )


def _groups(judgement: Judgement) -> list[str]:
    """Returns the headers of the groups of states with their units."""
    named = zip(judgement.groups, judgement.units, strict=True)
    return [f"{group} [{unit}]" for group, unit in named]


def _table_of_errors(judgement: Judgement) -> Table:
    rows = []
    for k, step in enumerate(judgement.steps):
        for name, mean in judgement.mean.items():
            errors = zip(mean[k], judgement.rmse[name][k], strict=True)
            texts = [
                f"{number(error)}\n[RMSE {number(rmse)}]" for error, rmse in errors
            ]
            rows.append([step, name, *texts])
    header = ["steps ahead", "predictor", *_groups(judgement)]
    return Table(header, rows, "Mean error", sections=True)


def _table_of_intervals(judgement: Judgement) -> Table:
    rows = []
    for k, step in enumerate(judgement.steps):
        texts = []
        for g in range(len(judgement.groups)):
            low, high = judgement.coverage_interval[k][g]
            coverage = f"{judgement.coverage[k][g]:.1%}\n[{low:.1%}, {high:.1%}]"
            texts.append(f"{coverage}\nwidth {judgement.width[k][g]:.2f}")
        rows.append([step, *texts])
    title = f"{judgement.level:.0%} intervals: coverage and width"
    return Table(["steps ahead", *judgement.groups], rows, title)


def _table_of_candidates(learned: IdentifiedModel, judgement: Judgement) -> Table:
    rows = []
    for candidate in learned.candidates:
        errors = [" / ".join(map(number, column)) for column in candidate.errors.T]
        mark = "chosen" if candidate.chosen else ""
        rows.append([mark, candidate.name, *errors])
    steps = " / ".join(map(str, learned.judged_steps))
    title = f"Candidates: mean error of held-out rollouts, {steps} steps ahead"
    return Table(["", "model", *_groups(judgement)], rows, title)


def _table_of_comparisons(learned: IdentifiedModel, judgement: Judgement) -> Table:
    """Returns by how much the model won over the baselines and the second best."""
    rows = []
    for one in learned.comparisons:
        for k, step in enumerate(learned.judged_steps):
            texts = [
                f"{one.ratio[k, g]:.3f}\n[{one.low[k, g]:.3f}, {one.high[k, g]:.3f}]"
                for g in range(len(judgement.groups))
            ]
            rows.append([one.name, step, *texts])
    title = (
        "What won, by how much: its mean error over that of others, on held-out rows "
        "of the training runs, with 95 % intervals over windows"
    )
    header = ["over that of", "steps ahead", *judgement.groups]
    return Table(header, rows, title, sections=True)


def _tables_of_effects(learned: IdentifiedModel) -> list[Table]:
    """Returns a table of what the inputs do, where that was asked."""
    if learned.control is None:
        return []
    rows = [
        [
            effect.input,
            effect.output,
            f"{number(effect.gain)}\n[{number(effect.low)}, {number(effect.high)}]",
            effect.model,
        ]
        for effect in learned.control.effects
    ]
    header = ["input", "output that it moves most", "by the rows", "by the model"]
    return [Table(header, rows, "What the inputs do: derivatives of the outputs")]


def _make_card(
    learned: IdentifiedModel, judgement: Judgement, train: Log, held_out: Log
) -> Document:
    """Returns the model card.

    It says what the data were, their ranges, what was left out of them, what is learned
    and why, and what must not be trusted.
    """
    columns = [*train.space.names, *train.input_names]
    left_out = [
        f"{finding.run}: {finding.kind}: {finding.text}" for finding in train.findings
    ]
    reasons = _reasons_against(learned, judgement)
    title = "Model card"
    if reasons:
        title = f"This model should not be used: {reasons[0]}"
    return Document(
        title=title,
        tables=[
            Table(["", ""], _facts(learned, judgement, train), "What it is"),
            _table_of_comparisons(learned, judgement),
            Table(
                ["parameter", "value", "standard error"],
                learned.fit.to_rows(),
                "Parameters",
            ),
            Table(
                ["channel", "lowest", "highest"],
                [*zip(columns, *learned.ranges, strict=True)],
                "Ranges of the data",
            ),
        ],
        data=pd.DataFrame(),
        lists={
            "Outputs": _outputs(learned),
            "What must not be trusted": _doubts(learned, judgement, held_out, train),
            "Left out of the data": left_out or ["nothing"],
        },
    )


def _facts(
    learned: IdentifiedModel, judgement: Judgement, train: Log
) -> list[tuple[str, Any]]:
    """Returns what a model is, and what made it."""
    origin = provenance()
    chosen = [candidate.name for candidate in learned.candidates if candidate.chosen]
    return [
        ("model", chosen[0]),
        ("rows", len(train)),
        ("runs", ", ".join(learned.runs)),
        ("rate", f"{1 / train.time_step:g} Hz"),
        ("candidates compared on", learned.folds),
        ("judged on", ", ".join(judgement.runs)),
        ("intervals hold", _NOISE_IN_WORDS),
        ("made", origin["created"]),
        ("made by", describe_code(origin)),
        ("command", origin["command"]),
    ]


def _tube_in_words(learned: IdentifiedModel, judgement: Judgement) -> str:
    """Says how far a controller's tube may be trusted, by the steps ahead."""
    text = (
        "A controller's tube is of white noise and an uncertain first row, both fitted "
        "to held-out rollouts; the intervals that were judged follow the errors of the "
        "run"
    )
    noise = learned.noise
    correlated = noise.outputs[np.array(noise.time_constants) > 0]
    if correlated.any():
        text += " and hold errors that are alike for several rows"
    by_step = []
    for step, coverage, width in zip(
        judgement.steps, judgement.tube_coverage, judgement.tube_width, strict=True
    ):
        steps = "1 step" if step == 1 else f"{step} steps"
        form = ".2f" if width.max() < 100 else ".0f"
        by_step.append(
            f"{_range(coverage, '.0%')} of the errors {steps} ahead, and is "
            f"{_range(width, form)} times as wide as they are"
        )
    groups = " (smallest to largest of the groups)" if len(judgement.groups) > 1 else ""
    return (
        f"{text}. On these rows, a tube of {judgement.level:.0%} holds "
        f"{'; '.join(by_step)}{groups}."
    )


def _range(values: Array, form: str) -> str:
    """Writes the smallest and the largest of some numbers, one if they are alike."""
    low, high = (format(value, form) for value in (values.min(), values.max()))
    return low if low == high else f"{low} to {high}"


def _outputs(learned: IdentifiedModel) -> list[str]:
    """Returns what the model of every output is made of."""
    model = learned.model
    with_gp = {i for gp in model.gps for i in gp.outputs}
    lines = []
    for i, name in enumerate(model.kinematics.output_names):
        parts = []
        if not is_still(model.nominal) and i not in model.without_nominal:
            parts.append("nominal model")
        if model.weights.size:
            parts.append("linear term of past rows")
        if i in with_gp:
            parts.append("GP on the residual")
        lines.append(f"{name}: {', '.join(parts) or 'zero'}")
    return lines


def _doubts(
    learned: IdentifiedModel, judgement: Judgement, held_out: Log, train: Log
) -> list[str]:
    """Returns what must not be trusted."""
    nominal = learned.model.nominal
    doubts = [*_reasons_against(learned, judgement)]
    if judgement.steps_not_told and not _is_untold(judgement):
        doubts.append(_not_told(judgement))
    doubts += [
        f"Loses to a baseline: {loss}"
        for loss in judgement.losses
        if loss not in doubts
    ]
    doubts += [f"{one}." for one in short_pieces(learned, judgement, held_out, train)]
    if learned.control is not None:
        doubts += learned.control.warnings
    else:
        doubts += [f"For control: {one}." for one in unflown_disturbance(learned.model)]
    if learned.model.correction is not None or learned.model.start_filter is not None:
        doubts.append(
            "Predictions begin at a state estimated from the rows before, and what the "
            "past says may correct them: a controller plans with the movement alone, "
            "from its own estimate."
        )
    if learned.model.correction is not None:
        doubts.append(
            "The correction, as the ridge regression beside it, knows the inputs to "
            "come: where a controller chose them by the states, they tell of these, "
            "and errors are smaller than those of a forecast made before."
        )
    if judgement.tube_width.size and not learned.model.feedback_outputs:
        doubts.append(_tube_in_words(learned, judgement))
    doubts.append("Outside the ranges of the data (table above) nothing was seen.")
    doubts += _doubts_of_what_stays(learned, train)
    if learned.model.feedback_outputs:
        doubts.append(
            "The term feedback describes the controller that flew: it predicts such "
            "flights, and says nothing of what another controller would do. Do not "
            "control the attitude with this model."
        )
    if getattr(nominal, "torque", None) is False:
        doubts.append(
            "The motors' torque was not found in the log: the model does not turn when "
            "the motors say so."
        )
    return doubts


def _doubts_of_what_stays(learned: IdentifiedModel, train: Log) -> list[str]:
    """Returns what rows do not tell since something in them never changes."""
    doubts = []
    low, high = learned.ranges
    columns = [*train.space.names, *train.input_names]
    constant = [
        name for name, moves in zip(columns, low < high, strict=True) if not moves
    ]
    if constant:
        names = ", ".join(constant)
        doubts.append(
            f"Never changed in the data, so that nothing is known of it: {names}."
        )
    untold = [name for name, _, error in learned.fit.to_rows() if np.isinf(error)]
    if untold:
        names = ", ".join(untold)
        doubts.append(f"Parameters that the rows do not tell: {names}.")
    return doubts
