"""``gpmpc learn``: from log files and a mapping to a saved model, a report on held-out runs, and a model card."""

import argparse
import json
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpmpc.cli._arguments import Command, Parser, Result, writing

if TYPE_CHECKING:
    from gpmpc.logs import Judgement, Learned, Log
    from gpmpc.studies.document import Document

MODEL, PROGRESS = "model.safetensors", "progress.json"


def _add_arguments(parser: Parser) -> None:
    parser.add_argument("mapping", type=Path, help="a YAML file that says what the columns mean")
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE", help="logs: CSV, Parquet, npz, MCAP, ULog")
    parser.add_argument("--held-out", nargs="+", metavar="RUN", default=[], help="runs to judge on (a fifth of them)")
    parser.add_argument("--to", type=Path, metavar="DIR", default=Path("learned"), help="where all goes (learned)")
    parser.add_argument("--points", type=int, default=300, help="rows of a GP (300)")
    parser.add_argument("--steps", type=int, default=50, help="length of the rollouts (50)")
    parser.add_argument("--seed", type=int, default=0, help="of every random number (0)")
    text = "only what a controller can plan with: no feedback of the controller that flew, no late inputs"
    parser.add_argument("--for-control", action="store_true", help=text)
    parser.add_argument("--partial", action="store_true", help="take what is whole of unfinished files")


def _learn(given: argparse.Namespace) -> Result:
    """Learns from logs, judges on held-out runs, and writes model, report and card; goes on where it stopped."""
    from rich.console import Console

    from gpmpc.files import write_whole
    from gpmpc.logs import judge, learn, read_log, save_learned
    from gpmpc.plotting import judgement_figure, png

    console, folder = Console(), given.to
    log = read_log(given.files, given.mapping, given.partial)
    console.print(repr(log), highlight=False, markup=False)
    for finding in log.findings:
        console.print(f"  {finding.run}: {finding.kind}: {finding.text}", soft_wrap=True, highlight=False, markup=False)
    train, held_out = _split(log, given.held_out)
    with writing(folder, "to"):
        folder.mkdir(parents=True, exist_ok=True)
        memory = _FileMemory(folder / PROGRESS, _fingerprint(train, given))
        with console.status("learning") as status:

            def show(stage: str) -> None:
                status.update(stage)
                console.print(f"  {stage}", soft_wrap=True, highlight=False, markup=False)

            learned = learn(train, given.points, given.steps, given.seed, show, memory, given.for_control)
            status.update("judging on held-out runs")
            steps = sorted({step for step in (1, 10, 50) if step <= given.steps} | {given.steps})
            judgement = judge(learned, held_out, train, steps)
        save_learned(learned, folder / MODEL)
        document = report(learned, judgement, train, held_out, {"report.png": png(judgement_figure(judgement))})
        for name, content in (document.files("report") | {"report.html": document.html()}).items():
            write_whole(folder / name, content)
        write_whole(folder / "card.md", card(learned, judgement, train, held_out).markdown())
    from gpmpc.studies.document import terminal

    console.print(terminal(document.tables[:1]))
    for line in judgement.losses:
        console.print(f"loses: {line}", soft_wrap=True, highlight=False, markup=False)
    console.print(f"written to {folder}: {MODEL}, report.html, report.md, card.md", soft_wrap=True, highlight=False)
    return Result({"folder": str(folder), "losses": judgement.losses, "rows": document.data.to_dict("records")})


def _split(log: "Log", held_out: list[str]) -> tuple["Log", "Log"]:
    if held_out:
        return log.split(held_out)
    names = [run.name for run in sorted(log.runs, key=len)]
    if len(names) == 1:
        return log.split_by_time(0.8)
    return log.split(names[:: max(len(names) // max(len(names) // 5, 1), 1)][: max(len(names) // 5, 1)])


def _fingerprint(log: "Log", given: argparse.Namespace) -> str:
    digest = sha256(repr((log.mapping, given.points, given.steps, given.seed, given.for_control)).encode())
    for run in log:
        for array in (run.states, run.inputs, run.context):
            digest.update(array.tobytes())
    return digest.hexdigest()


class _FileMemory(dict[str, Any]):
    """Outcomes of stages in a JSON file, which another log or other settings begin anew."""

    def __init__(self, path: Path, fingerprint: str):
        self._path, self._fingerprint = path, fingerprint
        with suppress(OSError, ValueError, KeyError, TypeError):  # nothing there, or nothing whole
            found = json.loads(path.read_text())
            if found["fingerprint"] == fingerprint:
                self.update(found["stages"])

    def __setitem__(self, key: str, value: Any) -> None:
        from gpmpc.files import write_whole

        super().__setitem__(key, value)
        write_whole(self._path, json.dumps({"fingerprint": self._fingerprint, "stages": self}))


def report(
    learned: "Learned", judgement: "Judgement", train: "Log", held_out: "Log", images: dict[str, bytes]
) -> "Document":
    """Makes the report: errors beside the baselines, coverage and width, and every candidate."""
    from gpmpc.studies.document import Document, Table, number

    groups = [f"{group} [{unit}]" for group, unit in zip(judgement.groups, judgement.units, strict=True)]
    errors, intervals = [], []
    for k, step in enumerate(judgement.steps):
        for name, mean in judgement.mean.items():
            rmse = judgement.rmse[name]
            cells = [f"{number(m)}\n[RMSE {number(r)}]" for m, r in zip(mean[k], rmse[k], strict=True)]
            errors.append([str(step), name, *cells])
        cells = []
        for g in range(len(groups)):
            low, high = judgement.coverage_interval[k, g]
            share = f"{judgement.coverage[k, g]:.1%}\n[{low:.1%}, {high:.1%}]"
            cells.append(f"{share}\nwidth {judgement.width[k, g]:.2f}")
        intervals.append([str(step), *cells])
    candidates = [
        [
            "chosen" if c.chosen else "",
            c.name,
            *(" / ".join(number(e) for e in c.errors[:, g]) for g in range(len(groups))),
        ]
        for c in learned.candidates
    ]
    return Document(
        "What was learned, judged on runs that it never saw",
        [
            Table(["steps ahead", "predictor", *groups], errors, "Mean error", sections=True),
            Table(
                ["steps ahead", *judgement.groups], intervals, f"{judgement.level:.0%} intervals: coverage and width"
            ),
            Table(
                ["", "model", *groups], candidates, "Candidates: mean error of held-out rollouts, 10 / 50 steps ahead"
            ),
        ],
        judgement.to_pandas(),
        lead=f"{judgement.windows} predictions on {', '.join(run.name for run in held_out)}; "
        f"learned from {len(train)} rows of {len(train.runs)} runs.",
        notes=[
            "A width of 1 claims the spread that the errors have; the interval in brackets is the exact one of Clopper "
            "and Pearson for windows that do not overlap.",
            "The model loses to no baseline." if not judgement.losses else "The model loses to a baseline: see below.",
        ],
        lists={"Where the model loses": judgement.losses} if judgement.losses else {},
        images=images,
    )


def card(learned: "Learned", judgement: "Judgement", train: "Log", held_out: "Log") -> "Document":
    """Makes the model card: data, ranges, what was left out, what is learned and why, and what must not be trusted."""
    import pandas as pd

    from gpmpc.provenance import provenance
    from gpmpc.studies.document import Document, Table, number

    names = [*train.space.names, *train.input_names]
    ranges = [[n, number(low), number(high)] for n, low, high in zip(names, *learned.ranges, strict=True)]
    # An affine map has many parameters, and no standard errors.
    parameters = [[name, number(v), number(error)] for name, v, error in learned.fit.to_rows() if error == error]
    (chosen,) = [candidate for candidate in learned.candidates if candidate.chosen]
    left_out = [f"{f.run}: {f.kind}: {f.text}" for f in train.findings if f.run in learned.runs]
    with_gp = {
        name for gp in learned.model.gps for name in (learned.model.kinematics.output_names[i] for i in gp.outputs)
    }
    without = "nominal only; a GP did not make held-out rollouts better"
    learns = [
        f"{name}: {'GP on the residual' if name in with_gp else without}"
        for name in learned.model.kinematics.output_names
    ]
    doubts = [f"Loses to a baseline: {loss}" for loss in judgement.losses]
    doubts += ["Outside the ranges below nothing was seen."]
    if getattr(learned.model.nominal, "feedback", False):
        doubts += [
            "The term feedback describes the controller that flew: it predicts such flights, and says nothing of what "
            "another controller would do. Do not control the attitude with this model."
        ]
    if getattr(learned.model.nominal, "torque", None) is False:
        doubts += ["The motors' torque was not found in the log: the model does not turn when the motors say so."]
    made = provenance()
    facts = {
        "model": chosen.name,
        "rows": len(train),
        "runs": ", ".join(learned.runs),
        "rate": f"{1 / train.time_step:g} Hz",
    }
    facts |= {"judged on": ", ".join(run.name for run in held_out), "made": made["created"], "command": made["command"]}
    return Document(
        "Model card",
        [
            Table(["", ""], [[key, str(value)] for key, value in facts.items()], "What it is"),
            Table(["parameter", "value", "standard error"], parameters, "Parameters"),
            Table(["channel", "lowest", "highest"], ranges, "Ranges of the data"),
        ],
        pd.DataFrame(),
        lists={"Outputs": learns, "What must not be trusted": doubts, "Left out of the data": left_out or ["nothing"]},
    )


COMMAND = Command(
    "Learns a model from logs, judges it on held-out runs, and writes it with a report and a card",
    _learn,
    add_arguments=_add_arguments,
)
