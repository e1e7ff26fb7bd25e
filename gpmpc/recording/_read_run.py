"""Reads a recorded run: its records, then its messages, then their arrays."""

from collections.abc import Sequence
from pathlib import Path

from gpmpc._calls import explains_arguments
from gpmpc._files import as_path
from gpmpc.exceptions import RecordingError
from gpmpc.recording._content import (
    FileContent,
    Names,
    names_in_metadata,
    names_in_schema,
    read_content,
)
from gpmpc.recording._decoding import (
    STATUSES,
    DecodedMessages,
    belief_covariances,
    column,
    columns,
    decode_messages,
    input_bounds,
    plan_arrays,
)
from gpmpc.recording._flaws import DAMAGE_KINDS, DAMAGED_RECORDS, RECOVERED, Flaw
from gpmpc.recording._lost_steps import step_flaws
from gpmpc.recording._run import TIMINGS, Run
from gpmpc.recording._schema import RECOVERY_METADATA


@explains_arguments
def read_run(path: str | Path) -> Run:
    """Reads a recording, finished or not.

    What is damaged is left out, and ``Run.flaws`` say what is missing.

    Raises:
        RecordingError: There is no such file, it is no recording of a run, or damage
            has left no step of it.

    See Also:
        ``replay``, which solves the program of a step again; ``McapRecorder``.
    """
    path = as_path(path)
    content = read_content(path)
    flaws = list(content.flaws)
    described = names_in_metadata(path, content)
    # Those in the schema count, which has a checksum where metadata have none.
    names = names_in_schema(path, content) or described
    if names != described:
        text = "its metadata name other states or inputs than its messages"
        flaws.append(Flaw(DAMAGED_RECORDS, 1, text))
    messages = decode_messages(path, content, names)
    flaws += step_flaws(content, messages.steps, flaws)
    if not messages.steps and any(flaw.kind in DAMAGE_KINDS for flaw in flaws):
        reasons = "; ".join(flaw.text for flaw in flaws)
        raise RecordingError(f"{path}: no step of it can be read: {reasons}")
    flaws += _recovery_flaw(content)
    return _make_run(path, content, names, messages, flaws)


def _recovery_flaw(content: FileContent) -> list[Flaw]:
    """Says that a file holds what was left of another; nothing of other files."""
    if RECOVERY_METADATA not in content.metadata:
        return []
    text = "it was recovered, and holds what was left of another file"
    reasons = content.metadata[RECOVERY_METADATA].get("flaws")
    if reasons:
        text += f" ({reasons})"
    return [Flaw(RECOVERED, 1, text)]


def _make_run(
    path: Path,
    content: FileContent,
    names: Names,
    messages: DecodedMessages,
    flaws: Sequence[Flaw],
) -> Run:
    steps = messages.steps
    plans = plan_arrays(path, messages.plans, steps, names)
    return Run(
        path=path,
        finished=not flaws,
        state_names=names.states,
        input_names=names.inputs,
        steps=column(steps, "k", "int64"),
        times=column(steps, "time", "double"),
        references=columns(steps, "reference", names.states),
        states=columns(steps, "state", names.states),
        measured=columns(steps, "measured", names.states),
        inputs=columns(steps, "input", names.inputs),
        input_bounds=input_bounds(steps, names.inputs),
        innovations=columns(steps, "innovation", names.states),
        belief_covariances=belief_covariances(steps, len(names.states)),
        plan_inputs=plans.inputs,
        plan_means=plans.means,
        plan_covariances=plans.covariances,
        statuses=tuple(STATUSES[step.status] for step in steps),
        iterations=column(steps, "iterations", "int64"),
        active_set_sizes=column(steps, "active_set_size", "int64"),
        timings=columns(steps, "timing", TIMINGS),
        gp_sizes=column(steps, "gp_size", "int64"),
        gp_versions=column(steps, "gp_version", "int64"),
        failed=column(steps, "failed", "bool"),
        novelties=column(steps, "novelty", "double"),
        judgements=column(steps, "judgement", object),
        reasons=column(steps, "reason", object),
        channels=content.channel_table(),
        metadata=content.metadata,
        config=content.config,
        problems=messages.problems,
        flaws=tuple(flaws),
    )
