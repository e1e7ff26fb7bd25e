"""``gpmpc tables``, ``gpmpc figures`` and ``gpmpc quality``: run a result's trials and write its documents."""

import sys
from dataclasses import replace
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gpmpc.cli.arguments import folder_of, writing
from gpmpc.cli.run import experiment_of, plain_data, plain_settings
from gpmpc.cli.terminal import logging_console, progress_bar
from gpmpc.exceptions import SettingError

SHOWN_ERRORS = 10


def tables(config: DictConfig) -> None:
    """Computes Tables 1 and 2; the task behind ``conf/tables.yaml``."""
    from gpmpc.experiments.tables import Tables  # pyright: ignore[reportMissingImports] stands in experiments/

    parts = _parts(config, "data", "trajectory", "model")
    numbers = {key: config[key] for key in ("draws", "seed", "state_std", "workers")}
    settings = plain_data(config)
    _run(
        Tables(
            data=parts["data"],
            trajectories=parts["trajectory"],
            subsystems=settings["subsystem"],
            model=parts["model"],
            model_settings=settings["model"],
            sizes=settings["sizes"],
            **numbers,
        ),
        config,
    )


def figures(config: DictConfig) -> None:
    """Flies the paper's figures; the task behind ``conf/figures.yaml``."""
    from gpmpc.experiments.figures import LOOPS, Figures, Row  # pyright: ignore[reportMissingImports]

    sources = ("data", "excited", "undithered")
    parts = _parts(config, *sources, "trajectory", "model", "flying")
    settings, rows = plain_data(config), {}
    loops = settings["loop"] if isinstance(settings["loop"], list) else [settings["loop"]]
    for loop in loops:
        if loop not in LOOPS:
            raise SettingError("loop", f"must be among {', '.join(LOOPS)}; got {loop!r}")
    for name, row in settings["rows"].items():
        if row is None:  # left out on the command line
            continue
        try:
            rows[name] = Row(**row)
        except TypeError as error:
            raise SettingError(f"rows.{name}", str(error).removeprefix("Row.__init__() ")) from error
    numbers = ("bounds", "state_bounds", "steps", "samples", "noise", "seed", "workers")
    _run(
        Figures(
            rows={name: row for name, row in rows.items() if row.loop in loops},
            data={key: parts[key] for key in sources},
            trajectories=parts["trajectory"],
            subsystems=settings["subsystem"],
            models={"model": parts["model"], "plant": parts["flying"]},
            model_settings={"model": settings["model"], "plant": settings["flying"]},
            number=settings["trials"],
            **{key: settings[key] for key in numbers},
        ),
        config,
    )


def quality(config: DictConfig) -> None:
    """Measures cost over time; the task behind ``conf/quality.yaml``."""
    from hydra import compose

    from gpmpc.experiments.quality import FAMILIES, TRUTH, Quality  # pyright: ignore[reportMissingImports]

    parts, settings, experiments, flown = _parts(config, "trajectory"), plain_data(config), {}, {}
    for family in FAMILIES:
        if family is TRUTH or settings["only"] is None or str(settings["only"]) in family.words:
            composed = compose("run", [*family.words.split(), f"noise.process={[settings['noise']] * 6}"])
            experiments[family] = experiment_of(composed)
            flown[family.words] = plain_settings(composed, {})
    numbers = {key: settings[key] for key in ("horizons", "steps", "seeds", "workers")}
    _run(Quality(experiments, parts["trajectory"], flown, **numbers), config)


def _run(study: Any, config: DictConfig) -> None:
    """Runs what is missing of a study, writes its documents, prints its tables; exits with 1 where a trial failed."""
    from gpmpc.files import write_whole
    from gpmpc.provenance import provenance
    from gpmpc.studies.document import json_text, terminal
    from gpmpc.studies.study import TrialStore, run_study

    settings, console = plain_data(config), logging_console()
    folder = folder_of(settings["folder"])
    with progress_bar(console) as progress:
        task = progress.add_task("preparing data and models", total=None)
        trials = study.trials(folder)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            store = TrialStore(folder / "trials.jsonl")
            progress.update(task, description=study.name, total=len(trials))
            records = run_study(study.run_trial, trials, store, study.workers, lambda _: progress.advance(task))
    meta = provenance() | {"settings": settings}
    found = study.document(records)
    found = replace(found, code={**found.code, "Made by": json_text(meta).splitlines()})
    plain = [{key: value for key, value in record.items() if key != "drawn"} for record in records]
    written = found.files(study.name) | {f"{study.name}.json": json_text({"meta": meta, study.trial_name: plain})}
    written["config.yaml"] = OmegaConf.to_yaml(config, resolve=True)
    with writing(folder):
        for name, content in written.items():
            write_whole(folder / name, content)
    shown, notes = study.summary(records)
    console.print(terminal(shown, *notes))
    console.print(f"\nwritten to {folder}: {', '.join(sorted(written))}", soft_wrap=True)
    failed = [record for record in records if "error" in record]
    kind = "lost" if study.lost_is_result else "failed"
    for record in failed[:SHOWN_ERRORS]:
        which = ", ".join(f"{key} {value}" for key, value in trials[records.index(record)].labels.items())
        console.print(
            f"{kind}: {which}: {record['error']}",
            soft_wrap=True,
            highlight=False,
            markup=False,
        )
    if failed and (len(failed) == len(records) or not study.lost_is_result):
        sys.exit(1)


def _parts(config: DictConfig, *groups: str) -> dict[str, Any]:
    """Makes the objects of the chosen options; what a user can get wrong is found out here."""
    from hydra.utils import instantiate

    for key in groups:
        if not config.get(key):
            raise SettingError(key, "choose at least one" if key == "trajectory" else "choose one")
    return {key: instantiate(config[key], _convert_="all") for key in groups}
