"""``gpmpc bench``: measures what everything costs on this machine, or compares two measurements."""

from collections.abc import Callable, Iterable, Sequence

from omegaconf import DictConfig, OmegaConf

from gpmpc.cli.folder import folder_of, writing
from gpmpc.cli.screen import progress_bar, told_console
from gpmpc.exceptions import SettingError

FIGURE_SIZE, FIGURE_HORIZON = 189, 10  # of the figure, where they were measured


def bench(config: DictConfig) -> None:
    """The task behind ``conf/bench.yaml``."""
    settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    if settings["compare"] is not None:
        _compare(settings["compare"])
        return
    from gpmpc.bench.documents import described, markdown, write_json
    from gpmpc.bench.machine import machine, one_thread
    from gpmpc.files import write_whole
    from gpmpc.provenance import provenance

    parts = settings["parts"] if isinstance(settings["parts"], list) else [settings["parts"]]
    if not parts or not all(isinstance(part, str) and part in PARTS for part in parts):
        raise SettingError("parts", f"must be one or more of {', '.join(PARTS)}; got {settings['parts']!r}")
    for part in ("peers", "quality"):
        if not isinstance(settings[part], dict):
            raise SettingError(part, f"has settings of its own, such as {part}.seconds; got {settings[part]!r}")
    folder, console = folder_of(settings), told_console()
    one_thread()
    planned = {part: PARTS[part](settings) for part in parts}  # finds out what a user can get wrong
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    here, rows = machine(), []
    console.print(described(here))
    for part, (rounds, measured) in planned.items():
        with progress_bar(console) as progress:
            task = progress.add_task(f"measuring {part}", total=rounds)
            for found in measured:
                rows += found
                progress.advance(task)
    written = {
        "bench.json": write_json(rows, here, settings, provenance()),
        "bench.md": markdown(rows, here),
    } | _figures(rows)
    with writing(folder):
        for name, content in written.items():
            write_whole(folder / name, content)
    console.print(written["bench.md"], soft_wrap=True, highlight=False, markup=False)
    console.print(f"written to {folder}: {', '.join(sorted(written))}", soft_wrap=True)


def _steps(settings: dict) -> tuple[int, Iterable[Sequence[dict]]]:
    from gpmpc.bench.steps import Grid, measure_steps

    grid = Grid(**{key: settings[key] for key in ("states", "sizes", "horizons", "caches", "seconds", "seed")})
    return len(grid), measure_steps(grid)


def _peers(settings: dict) -> tuple[int, Iterable[Sequence[dict]]]:
    from gpmpc.bench.peers import Comparison, measure_peers

    comparison = Comparison(**settings["peers"])
    return len(comparison), measure_peers(comparison)


def _quality(settings: dict) -> tuple[int, Iterable[Sequence[dict]]]:
    from gpmpc.bench.contenders import contenders
    from gpmpc.bench.quality import Field, measure_quality

    field = Field(contenders(), **settings["quality"])
    return len(field), measure_quality(field)


PARTS: dict[str, Callable[[dict], tuple[int, Iterable[Sequence[dict]]]]] = {
    "steps": _steps,
    "peers": _peers,
    "quality": _quality,
}


def _figures(rows: Sequence[dict]) -> dict[str, bytes]:
    from gpmpc.plotting import png, quality, speed

    found = {}
    if steps := [row for row in rows if row["part"] == "step"]:
        sizes, horizons = ({row[key] for row in steps} for key in ("N", "H"))
        size = min(sizes, key=lambda N: abs(N - FIGURE_SIZE))
        horizon = min(horizons, key=lambda H: abs(H - FIGURE_HORIZON))
        found["steps.png"] = png(speed(steps, size, horizon))
    if flown := [row for row in rows if row["part"] == "quality"]:
        found["quality.png"] = png(quality(flown), dpi=130)
    return found


def _compare(paths: object) -> None:
    from rich.console import Console

    from gpmpc.bench.documents import compared_markdown, read_json

    if not isinstance(paths, list) or len(paths) != 2:
        raise SettingError("compare", f"takes two documents, compare=[OLD.json,NEW.json]; got {paths!r}")
    old, new = (read_json(path) for path in paths)
    Console().print(compared_markdown(old, new), soft_wrap=True, highlight=False, markup=False)
