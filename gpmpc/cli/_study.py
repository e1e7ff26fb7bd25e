"""``gpmpc tables``, ``figures`` and ``quality`` run a result's trials; ``gpmpc warmup`` compiles numerical kernels."""

import argparse
import time
from dataclasses import replace
from importlib import import_module
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from gpmpc._compiling import report_compilation
from gpmpc._provenance import provenance
from gpmpc.cli._command import Result
from gpmpc.cli._run import experiment_of, plain_data, plain_settings
from gpmpc.cli._settings import compose, folder_of, settings, write_files, writing
from gpmpc.cli._terminal import logging_console, progress_bar
from gpmpc.exceptions import SettingError
from gpmpc.studies._document import json_text, terminal
from gpmpc.studies.flight import run_trial
from gpmpc.studies.study import Study, TrialStore, run_study

_ONE = ("data", "excited", "undithered", "model", "flying")
_SEVERAL = ("trajectory", "subsystem")
_SHOWN_ERRORS = 10
_FLOWN = (
    "controller=convex",
    "controller=paper",
    "controller=nonlinear",
    "controller=lqr",
)
_SHORT = ("data.samples=12", "model.restarts=0", "steps=2", "horizon=3")


def study(config: DictConfig) -> Result:
    """Runs what is missing of a study, writes its documents and prints its tables."""
    settings = plain_data(config)
    console = logging_console()
    study = _study(config, settings)
    folder = folder_of(settings["folder"])
    with progress_bar(console) as progress:
        task = progress.add_task("preparing data and models", total=None)
        trials = study.trials(folder)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            store = TrialStore(folder / "trials.jsonl")
            progress.update(task, description=study.name, total=len(trials))
            records = run_study(
                study.run_trial,
                trials,
                store,
                study.workers,
                lambda _: progress.advance(task),
            )
    meta = provenance() | {"settings": settings}
    found = study.document(records)
    found = replace(found, code={**found.code, "Made by": json_text(meta).splitlines()})
    plain = [
        {key: value for key, value in record.items() if key != "drawn"}
        for record in records
    ]
    data = {"meta": meta, study.trial_name: plain}
    written = found.files(study.name) | {f"{study.name}.json": json_text(data)}
    written["config.yaml"] = OmegaConf.to_yaml(config, resolve=True)
    where = write_files(folder, written)
    shown, notes = study.summary(records)
    console.print(terminal(shown, *notes))
    failed = [
        (trial, record)
        for trial, record in zip(trials, records, strict=True)
        if "error" in record
    ]
    lines = [f"\n{where}"]
    for trial, record in failed[:_SHOWN_ERRORS]:
        which = ", ".join(f"{key} {value}" for key, value in trial.labels.items())
        lines.append(
            f"{'lost' if study.lost_is_result else 'failed'}: {which}: {record['error']}"
        )
    console.out(*lines, sep="\n", highlight=False)
    wrong = len(failed) == len(records) or not study.lost_is_result
    return Result(data | {"folder": str(folder)}, 1 if failed and wrong else 0)


tables = figures = quality = study


def _study(config: DictConfig, settings: dict[str, Any]) -> Study:
    """Makes the study that the settings describe; what a user can get wrong is found here."""
    for key in (*_ONE, *_SEVERAL):
        if key in config and not config[key]:
            raise SettingError(
                key, "choose at least one" if key in _SEVERAL else "choose one"
            )

    def flight(words: str) -> tuple[Any, dict[str, Any]]:
        composed = hydra.compose("run", words.split())
        return experiment_of(composed), plain_settings(composed, {})

    made = hydra.utils.instantiate(config, _convert_="all")
    module = import_module(f"gpmpc.experiments.{HydraConfig.get().job.name}")
    return module.from_settings({"trajectory": {}} | made, settings, flight)


def warmup(given: argparse.Namespace) -> Result:
    """Flies two steps with every controller on a learned model, and prints how long that took."""
    console = Console()
    began = time.perf_counter()
    with progress_bar(console) as bar, report_compilation(), settings():
        task = bar.add_task("", total=len(_FLOWN))
        for words in _FLOWN:
            bar.update(task, description=f"compiling what {words} needs")
            run_trial(experiment_of(compose("run", [words, *_SHORT])))
            bar.advance(task)
    seconds = round(time.perf_counter() - began, 3)
    console.print(f"ready after {seconds:.1f} s")
    return Result({"seconds": seconds})
