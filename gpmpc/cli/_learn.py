"""``gpmpc learn``: from log files and a mapping to a saved model, a report on held-out runs, and a model card."""

import argparse
import json
from pathlib import Path
from typing import Any

import pandas as pd
from rich.console import Console

from gpmpc import logs
from gpmpc._files import write_whole
from gpmpc._provenance import code_fingerprint, provenance
from gpmpc.cli._commands import Result
from gpmpc.cli._settings import write_files, writing
from gpmpc.logs import IdentifiedModel, Judgement, Log
from gpmpc.plotting import judgement_figure, png
from gpmpc.studies._document import Document, Table, number, terminal
from gpmpc.studies._run_folder import describe_code
from gpmpc.studies.study import fingerprint

_MODEL = "model.safetensors"
_HELD_NOISE = (
    "the noise of the outputs, which adds up, and that of the sensors, which does not, "
    "as fitted to held-out rollouts"
)


def learn(given: argparse.Namespace) -> Result:
    """Learns from logs, judges on held-out runs, and writes model, report and card; goes on where it stopped."""
    console = Console(soft_wrap=True, highlight=False, markup=False)
    folder = given.to or Path("learned")
    log = logs.read_log(given.files, given.mapping, given.partial)
    console.print(repr(log))
    for finding in log.findings:
        console.print(f"  {finding.run}: {finding.kind}: {finding.text}")
    train, held_out = _split(log, given.held_out)
    with writing(folder, "to"):
        folder.mkdir(parents=True, exist_ok=True)
        settings = repr(
            (train.mapping, given.points, given.steps, given.seed, given.for_control)
        )
        rows = [
            array for run in train for array in (run.states, run.inputs, run.context)
        ]
        memory = _FileMemory(folder / "progress.json", fingerprint(settings, rows))
        if memory.begun_anew:
            console.print(memory.begun_anew)
        with console.status("learning") as status:

            def show(stage: str) -> None:
                status.update(stage)
                console.print(f"  {stage}")

            learned = logs.learn(
                train,
                given.points,
                given.steps,
                given.seed,
                show,
                memory,
                given.for_control,
            )
            status.update("judging on held-out runs")
            steps = sorted(
                {step for step in (1, 10, 50) if step <= given.steps} | {given.steps}
            )
            judgement = logs.judge(learned, held_out, train, steps)
        logs.save_learned(learned, folder / _MODEL)
        document = _report(learned, judgement, train, held_out)
        card = _card(learned, judgement, train, held_out).markdown()
        write_files(
            folder,
            document.files("report")
            | {"report.html": document.html(), "card.md": card},
            "to",
        )
    Console().print(terminal(document.tables[:1]))
    for line in judgement.losses:
        console.print(f"loses: {line}")
    console.print(f"written to {folder}: {_MODEL}, report.html, report.md, card.md")
    return Result(
        {
            "folder": str(folder),
            "losses": judgement.losses,
            "rows": document.data.to_dict("records"),
        }
    )


def _split(log: Log, held_out: list[str]) -> tuple[Log, Log]:
    if held_out:
        return log.split(held_out)
    names = [run.name for run in sorted(log.runs, key=len)]
    if len(names) == 1:
        return log.split_by_time(0.8)
    return log.split(
        names[:: max(len(names) // max(len(names) // 5, 1), 1)][
            : max(len(names) // 5, 1)
        ]
    )


class _FileMemory(dict[str, Any]):
    """Outcomes of stages, kept in a JSON file; other code, data or settings begin it anew.

    Args:
        path: The file.
        fingerprint: Of code, data and settings.
    """

    def __init__(self, path: Path, fingerprint: str):
        self._path = path
        self._fingerprint = fingerprint
        self._code = code_fingerprint()
        #: a line that says why the outcomes of an earlier call are not used; "" where
        #: they are, or where there are none
        self.begun_anew = ""
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            known = content["fingerprint"] == fingerprint
            stages = dict(content["stages"])
            code = content.get("code")
        except FileNotFoundError:
            return
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            self.begun_anew = f"{path}: is not whole; all is learned anew"
            return
        if known:
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


def _report(
    learned: IdentifiedModel, judgement: Judgement, train: Log, held_out: Log
) -> Document:
    """Makes the report: errors beside the baselines, coverage and width, and every candidate."""
    groups = [
        f"{group} [{unit}]"
        for group, unit in zip(judgement.groups, judgement.units, strict=True)
    ]
    errors = []
    intervals = []
    for k, step in enumerate(judgement.steps):
        for name, mean in judgement.mean.items():
            pairs = zip(mean[k], judgement.rmse[name][k], strict=True)
            errors.append(
                [step, name, *(f"{number(m)}\n[RMSE {number(r)}]" for m, r in pairs)]
            )
        each = zip(
            judgement.coverage[k],
            judgement.coverage_interval[k],
            judgement.width[k],
            strict=True,
        )
        texts = (
            f"{share:.1%}\n[{low:.1%}, {high:.1%}]\nwidth {width:.2f}"
            for share, (low, high), width in each
        )
        intervals.append([step, *texts])
    candidates = [
        [
            "chosen" if c.chosen else "",
            c.name,
            *(" / ".join(map(number, errors)) for errors in c.errors.T),
        ]
        for c in learned.candidates
    ]
    heading = "Candidates: mean error of held-out rollouts, 10 / 50 steps ahead"
    level = f"{judgement.level:.0%} intervals: coverage and width"
    return Document(
        "What was learned, judged on runs that it never saw",
        [
            Table(
                ["steps ahead", "predictor", *groups],
                errors,
                "Mean error",
                sections=True,
            ),
            Table(["steps ahead", *judgement.groups], intervals, level),
            Table(["", "model", *groups], candidates, heading),
        ],
        judgement.to_pandas(),
        lead=f"{judgement.windows} predictions on {', '.join(run.name for run in held_out)}; "
        f"learned from {len(train)} rows of {len(train.runs)} runs.",
        notes=[
            "A width of 1 claims the spread that the errors have; the interval in brackets is the exact one of Clopper "
            "and Pearson for windows that do not overlap.",
            f"Intervals hold {_HELD_NOISE}.",
            "The model loses to no baseline."
            if not judgement.losses
            else "The model loses to a baseline: see below.",
        ],
        lists={"Where the model loses": judgement.losses} if judgement.losses else {},
        images={"report.png": png(judgement_figure(judgement))},
    )


def _card(
    learned: IdentifiedModel, judgement: Judgement, train: Log, held_out: Log
) -> Document:
    """Makes the model card: data, ranges, what was left out, what is learned and why, and what must not be trusted."""
    names = [*train.space.names, *train.input_names]
    outputs = learned.model.kinematics.output_names
    left_out = [
        f"{f.run}: {f.kind}: {f.text}" for f in train.findings if f.run in learned.runs
    ]
    with_gp = {outputs[i] for gp in learned.model.gps for i in gp.outputs}
    without = "nominal only; a GP did not make held-out rollouts better"
    learns = [
        f"{name}: {'GP on the residual' if name in with_gp else without}"
        for name in outputs
    ]
    doubts = [f"Loses to a baseline: {loss}" for loss in judgement.losses]
    doubts += ["Outside the ranges below nothing was seen."]
    if getattr(learned.model.nominal, "feedback", False):
        doubts += [
            "The term feedback describes the controller that flew: it predicts such flights, and says nothing of what "
            "another controller would do. Do not control the attitude with this model."
        ]
    if getattr(learned.model.nominal, "torque", None) is False:
        doubts += [
            "The motors' torque was not found in the log: the model does not turn when the motors say so."
        ]
    made = provenance()
    facts = {
        "model": next(
            candidate.name for candidate in learned.candidates if candidate.chosen
        ),
        "rows": len(train),
        "runs": ", ".join(learned.runs),
        "rate": f"{1 / train.time_step:g} Hz",
        "judged on": ", ".join(run.name for run in held_out),
        "intervals hold": _HELD_NOISE,
        "made": made["created"],
        "made by": describe_code(made),
        "command": made["command"],
    }
    return Document(
        "Model card",
        [
            Table(["", ""], [*facts.items()], "What it is"),
            Table(
                ["parameter", "value", "standard error"],
                learned.fit.to_rows(),
                "Parameters",
            ),
            Table(
                ["channel", "lowest", "highest"],
                [*zip(names, *learned.ranges, strict=True)],
                "Ranges of the data",
            ),
        ],
        pd.DataFrame(),
        lists={
            "Outputs": learns,
            "What must not be trusted": doubts,
            "Left out of the data": left_out or ["nothing"],
        },
    )
