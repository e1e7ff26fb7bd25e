"""``gpmpc tables``, ``figures`` and ``quality``: run the trials of a published result.

    settings -> study -> its trials -> those that are missing are run -> documents

The same command goes on where it stopped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from gpmpc._provenance import provenance
from gpmpc.cli._commands import Result
from gpmpc.cli._experiment import experiment_of
from gpmpc.cli._folders import folder_of, write_files, writing
from gpmpc.cli._plain_settings import plain_data, plain_settings
from gpmpc.cli._terminal import logging_console, progress_bar
from gpmpc.exceptions import SettingError
from gpmpc.studies._document import json_text, terminal
from gpmpc.studies.study import (
    Study,
    TrialSpec,
    TrialStore,
    is_failed,
    is_lost,
    run_study,
)

# Settings of which one option is chosen, and those of which several may be.
_ONE = ("data", "excited", "undithered", "model", "flying")
_SEVERAL = ("trajectory", "subsystem")
_SHOWN_ERRORS = 10


def study(config: DictConfig) -> Result:
    """Runs what is missing of a study, writes its documents and prints its tables."""
    settings = plain_data(config)
    console = logging_console()
    published = _study(config, settings)
    folder = folder_of(settings["folder"])
    trials, records = _run_trials(published, folder, console)
    meta = provenance() | {"settings": settings}
    data = {
        "meta": meta,
        published.trial_name: [_without_drawings(record) for record in records],
    }
    document = published.document(records)
    origin = {"Made by": json_text(meta).splitlines()}
    failures = []
    losses = []
    for trial, record in zip(trials, records, strict=True):
        if is_failed(record):
            failures.append(f"failed: {_line_of(trial, record)}")
        elif is_lost(record):
            losses.append(f"lost: {_line_of(trial, record)}")
    document = replace(
        document,
        code={**document.code, **origin},
        lists={**document.lists, "Failed, and no results": failures},
    )
    files = document.files(published.name)
    files[f"{published.name}.json"] = json_text(data)
    files["config.yaml"] = OmegaConf.to_yaml(config, resolve=True)
    written = write_files(folder, files)
    tables, notes = published.summary(records)
    console.print(terminal(tables, *notes))
    lines = [f"\n{written}", *_first_ends(failures, losses, folder)]
    if failures:
        lines.append(
            f"failed, and in no number: {len(failures)} of {len(records)} trials; "
            "the same command runs them again"
        )
    console.out(*lines, sep="\n", highlight=False)
    none_has_numbers = bool(records) and len(failures) + len(losses) == len(records)
    lacks_a_result = bool(losses) and not published.lost_is_result
    code = 1 if failures or lacks_a_result or none_has_numbers else 0
    return Result(data | {"folder": str(folder)}, code)


def _line_of(trial: TrialSpec, record: Mapping[str, Any]) -> str:
    """Returns why a trial has no numbers."""
    labels = ", ".join(f"{key} {value}" for key, value in trial.labels.items())
    return f"{labels}: {record['error']}"


def _first_ends(
    failures: Sequence[str], losses: Sequence[str], folder: Path
) -> list[str]:
    """Returns the first lines of trials without numbers, and how many more there are.

    Failures come first: they are no results, and losses, which are, may be many.
    """
    shown_failures = failures[:_SHOWN_ERRORS]
    shown_losses = losses[: _SHOWN_ERRORS - len(shown_failures)]
    lines = [*shown_failures, *shown_losses]
    if len(failures) > len(shown_failures):
        more = len(failures) - len(shown_failures)
        lines.append(f"failed: {more} more; see {folder}")
    if len(losses) > len(shown_losses):
        lines.append(f"lost: {len(losses) - len(shown_losses)} more; see {folder}")
    return lines


# ``_main`` calls the function of the command's name.
tables = figures = quality = study


def _study(config: DictConfig, settings: dict[str, Any]) -> Study:
    """Makes the study that the settings describe.

    What a user can get wrong is found here.
    """
    for key in _ONE:
        if key in config and not config[key]:
            raise SettingError(key, "choose one")
    for key in _SEVERAL:
        if key in config and not config[key]:
            raise SettingError(key, "choose at least one")

    def flight(words: str) -> tuple[Any, dict[str, Any]]:
        composed = hydra.compose("run", words.split())
        return experiment_of(composed), plain_settings(composed, {})

    conditions = {"trajectory": {}} | hydra.utils.instantiate(config, _convert_="all")
    module = import_module(f"gpmpc.experiments.{HydraConfig.get().job.name}")
    return module.from_settings(conditions, settings, flight)


def _run_trials(
    published: Study, folder: Path, console: Console
) -> tuple[Sequence[TrialSpec], list[dict]]:
    """Runs the trials whose records ``folder`` does not hold, under a progress bar.

    Returns:
        All trials, and their records in the same order.
    """
    with progress_bar(console) as progress:
        task = progress.add_task("preparing data and models", total=None)
        trials = published.trials(folder)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            progress.update(task, description=published.name, total=len(trials))
            with TrialStore.held(folder / "trials.jsonl") as store:
                records = run_study(
                    published.run_trial,
                    trials,
                    store,
                    workers=published.workers,
                    progress=lambda record: progress.advance(task),
                )
    return trials, records


def _without_drawings(record: dict) -> dict:
    return {key: value for key, value in record.items() if key != "drawn"}
