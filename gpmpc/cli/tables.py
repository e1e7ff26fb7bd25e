"""``gpmpc tables``: computes Tables 1 and 2 and writes them as Markdown, CSV, LaTeX, JSON and a figure."""

import sys
from concurrent.futures.process import BrokenProcessPool

from omegaconf import DictConfig, OmegaConf

from gpmpc.cli.folder import folder_of, writing
from gpmpc.cli.screen import progress_bar, told_console
from gpmpc.exceptions import GpmpcError, SettingError


def tables(config: DictConfig) -> None:
    """The task behind ``conf/tables.yaml``."""
    from hydra.utils import instantiate

    from gpmpc.experiments.tables import FitStore, Tables
    from gpmpc.experiments.tables_report import documents, render, summarise
    from gpmpc.files import write_whole
    from gpmpc.provenance import provenance

    settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    console = told_console()

    # Everything that a user can get wrong is found out before anything is written.
    groups = ("data", "trajectory", "subsystem", "model")
    for key in groups:
        if not config.get(key):
            raise SettingError(key, "choose at least one" if key in ("trajectory", "subsystem") else "choose one")
    parts = {key: instantiate(config[key], _convert_="all") for key in groups}
    experiment = Tables(
        data=parts["data"],
        trajectories=parts["trajectory"],
        subsystems=parts["subsystem"],
        model=parts["model"],
        model_settings=settings["model"],
        **{key: settings[key] for key in ("sizes", "draws", "seed", "state_std", "workers")},
    )
    with console.status("generating or reading the data"):
        fits = experiment.fits()

    folder, meta = folder_of(settings), provenance() | {"settings": settings}
    try:
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
            store = FitStore(folder / "fits.jsonl")
            with progress_bar(console) as progress:
                task = progress.add_task("training GPs", total=len(fits))
                draws = experiment.run(store, fits, progress=lambda _: progress.advance(task))
            rows = summarise(draws)
            written = documents(rows, draws, meta, experiment.data.note) | {
                "config.yaml": OmegaConf.to_yaml(config, resolve=True)
            }
            for name, content in written.items():
                write_whole(folder / name, content)
    except BrokenProcessPool as error:
        raise GpmpcError("a worker process died (out of memory?); the same command goes on where it stopped") from error

    console.print(render(rows, experiment.data.note))
    console.print(f"\nwritten to {folder}: {', '.join(sorted(written))}", soft_wrap=True)
    failed = [draw for draw in draws if "error" in draw]
    for draw in failed:
        row = f"{draw['trajectory']} {draw['subsystem']} {draw['size']}, draw {draw['draw']}"
        console.print(f"failed: {row}: {draw['error']}", soft_wrap=True)
    if failed:
        sys.exit(1)
