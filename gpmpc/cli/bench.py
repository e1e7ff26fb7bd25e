"""``gpmpc bench``: measures what everything costs on this machine, or compares two measurements."""

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from gpmpc.cli.folder import folder_of, writing
from gpmpc.cli.screen import progress_bar, told_console
from gpmpc.exceptions import SettingError

if TYPE_CHECKING:
    from gpmpc.bench.groups import Kept, Part

FIGURE_SIZE, FIGURE_HORIZON = 189, 10  # of the figure, where they were measured
ASIDE = ("folder", "compare")  # settings that no figure depends on
WIDTH = 36  # of a group's name beside a bar; some are sentences


def bench(config: DictConfig) -> None:
    """The task behind ``conf/bench.yaml``."""
    settings = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    if settings["compare"] is not None:
        _compare(settings["compare"])
        return
    from gpmpc.bench.documents import described
    from gpmpc.bench.groups import Kept, identity
    from gpmpc.bench.machine import machine, one_thread
    from gpmpc.experiments.run_folder import RunFolder
    from gpmpc.provenance import now

    parts = settings["parts"] if isinstance(settings["parts"], list) else [settings["parts"]]
    if not parts or not all(isinstance(part, str) and part in PARTS for part in parts):
        raise SettingError("parts", f"must be one or more of {', '.join(PARTS)}; got {settings['parts']!r}")
    for part in ("peers", "quality"):
        if not isinstance(settings[part], dict):
            raise SettingError(part, f"has settings of its own, such as {part}.seconds; got {settings[part]!r}")
    folder, console = folder_of(settings), told_console()
    one_thread()
    planned = {part: PARTS[part](settings) for part in parts}  # finds out what a user can get wrong
    with ExitStack() as stack:
        with writing(folder):
            stack.enter_context(RunFolder(folder).claimed(wait=False))
        here = machine()
        asked = identity({key: value for key, value in settings.items() if key not in ASIDE}, here)
        with writing(folder):
            kept = Kept(folder, asked, {"created": now(), "machine": here})
        console.print(described(here))
        _tell_kept(folder, kept, planned, console)
        _measure(folder, kept, planned, settings, console)


def _tell_kept(folder: Path, kept: "Kept", planned: "dict[str, Part]", console: Any) -> None:
    """What becomes of what is in the folder."""
    lines = []
    if kept.differs:
        lines.append(f"starting anew: what is kept in {folder} was measured otherwise ({kept.differs})")
    elif len(kept):
        there = ", ".join(f"{part} {done} of {all_}" for part, (done, all_) in kept.counts(planned).items())
        lines.append(f"going on: kept are the groups measured since {kept.sittings[0]['created']}: {there}")
    if (folder / "bench.json").exists():
        lines.append(f"the measurement in {folder} is replaced when this one is complete")
    for line in lines:
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def _measure(folder: Path, kept: "Kept", planned: "dict[str, Part]", settings: dict, console: Any) -> None:
    """Measures what is not kept yet; every group is on the disk before the next one begins."""
    from gpmpc.bench.documents import as_json, document, markdown
    from gpmpc.bench.groups import incomplete
    from gpmpc.files import write_whole
    from gpmpc.provenance import provenance

    made_by, rows, found = provenance(), [], {}

    def put_together() -> None:
        nonlocal rows, found
        rows = kept.rows(planned)
        found = document(rows, kept.counts(planned), kept.sittings, settings, made_by)

    def write(contents: dict[str, str | bytes], named: Callable[[str], str] = incomplete) -> None:
        with writing(folder):
            for name, content in contents.items():
                write_whole(folder / named(name), content)

    for part, plan in planned.items():
        groups = plan.groups()
        with progress_bar(console) as progress:
            task = progress.add_task(part, total=len(groups), completed=sum((part, g.name) in kept for g in groups))
            for group in groups:
                if (part, group.name) in kept:
                    continue
                progress.update(task, description=f"{part} {group.name}"[:WIDTH])
                result = group.measure()
                with writing(folder):
                    kept.add((part, group.name), result)
                put_together()
                write({"bench.md": markdown(found), "bench.json": as_json(found)})
                progress.advance(task)
            progress.update(task, description=part)
        put_together()
        if "incomplete" in found:
            write(_figures(rows))
    final = _figures(rows) | {"bench.md": markdown(found), "bench.json": as_json(found)}
    write(final, named=str)
    with writing(folder):
        kept.forget()
    console.print(final["bench.md"], soft_wrap=True, highlight=False, markup=False)
    console.print(f"written to {folder}: {', '.join(sorted(final))}", soft_wrap=True)


def _steps(settings: dict) -> "Part":
    from gpmpc.bench.steps import Grid

    return Grid(**{key: settings[key] for key in ("states", "sizes", "horizons", "caches", "seconds", "seed")})


def _peers(settings: dict) -> "Part":
    from gpmpc.bench.peers import Comparison

    return Comparison(**settings["peers"])


def _quality(settings: dict) -> "Part":
    from gpmpc.bench.contenders import contenders
    from gpmpc.bench.quality import Field

    return Field(contenders(), **settings["quality"])


PARTS: dict[str, Callable[[dict], "Part"]] = {"steps": _steps, "peers": _peers, "quality": _quality}


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
