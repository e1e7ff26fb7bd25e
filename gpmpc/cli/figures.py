"""``gpmpc figures``: flies the figures of the paper and writes tables, figures and data."""

import sys
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gpmpc.cli.folder import folder_of, writing
from gpmpc.cli.screen import progress_bar, told_console
from gpmpc.exceptions import GpmpcError, SettingError

NUMBERS = ("bounds", "state_bounds", "steps", "samples", "trials", "noise", "seed", "workers")


def figures(config: DictConfig) -> None:
    """The task behind ``conf/figures.yaml``."""
    from gpmpc.experiments.flights_report import documents, render, summarise
    from gpmpc.experiments.tables import FitStore
    from gpmpc.files import write_whole
    from gpmpc.provenance import provenance

    settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    console = told_console()

    experiment = _experiment(config, settings)
    folder, meta = folder_of(settings), provenance() | {"settings": settings}
    try:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            with progress_bar(console) as progress:
                task = progress.add_task("training GPs", total=None)
                flights = experiment.flights(folder)
                store = FitStore(folder / "flights.jsonl")
                progress.update(task, description="flying", total=len(flights))
                records = experiment.run(store, flights, progress=lambda _: progress.advance(task))
            rows = summarise(records)
            note = experiment.data["data"].note
            written = documents(rows, records, meta, note) | {"config.yaml": OmegaConf.to_yaml(config, resolve=True)}
            for name, content in written.items():
                write_whole(folder / name, content)
    except BrokenProcessPool as error:
        raise GpmpcError("a worker process died (out of memory?); the same command goes on where it stopped") from error

    console.print(render(rows, note))
    console.print(f"\nwritten to {folder}: {', '.join(sorted(written))}", soft_wrap=True)
    lost = [record for record in records if "error" in record]
    for record in lost[:10]:
        name = f"{record['name']}, H = {record['horizon']}, {record['trajectory']}, trial {record['trial']}"
        console.print(f"lost: {name}: {record['error']}", soft_wrap=True)
    if lost and len(lost) == len(records):
        sys.exit(1)


def _experiment(config: DictConfig, settings: dict) -> Any:
    """The experiment that the settings describe; everything that a user can get wrong is found out here."""
    from hydra.utils import instantiate

    from gpmpc.experiments.flight import LOOPS, Row
    from gpmpc.experiments.flights import Flights

    groups = ("data", "excited", "undithered", "trajectory", "subsystem", "model", "flying", "plant")
    for key in groups:
        if not config.get(key):
            raise SettingError(key, "choose at least one" if key in ("trajectory", "subsystem") else "choose one")
    parts = {key: instantiate(config[key], _convert_="all") for key in groups}
    rows, loops = {}, settings["loop"] if isinstance(settings["loop"], list) else [settings["loop"]]
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
    rows = {name: row for name, row in rows.items() if row.loop in loops}
    return Flights(
        rows=rows,
        data={key: parts[key] for key in ("data", "excited", "undithered")},
        trajectories=parts["trajectory"],
        subsystems=parts["subsystem"],
        models={"model": parts["model"], "plant": parts["flying"]},
        model_settings={"model": settings["model"], "plant": settings["flying"]},
        plant=parts["plant"],
        **{key: settings[key] for key in NUMBERS},
    )
