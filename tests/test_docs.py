"""The documentation's blocks run, its links lead somewhere, its pages are short.

``tests/test_guides.py`` and ``tests/logs`` follow the guides.
"""

import doctest
import importlib
import inspect
import pkgutil
import re
from pydoc import locate

import numpy as np
import pytest
import torch
import yaml

import gpmpc
from tests.cli.command import called
from tests.pages import BLOCK, ROOT, read

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob("docs/*.md"))]


def test_a_newcomers_tasks_work_from_an_empty_folder(page, tmp_path):
    fewer_seeds = [("seed=range(6)", "seed=range(3)")]
    names, printed = page("docs/how_to.md", shortened=fewer_seeds)
    assert read("docs/how_to.md").count("\n## ") == 15
    assert "(docs/how_to.md)" in read("README.md")
    (
        weights,
        waypoints,
        own_path,
        _,
        own_system,
        _,
        _,
        bounded,
        swept,
        report,
        compared,
        calibrated,
    ) = printed
    assert "20 steps of translational along elliptical with convex" in weights
    assert "along waypoints" in waypoints
    assert "along figure_eight" in own_path
    assert "100 steps of arm" in own_system
    assert "failed solves     none" in bounded
    assert "6 runs: 6 flown" in swept
    assert "6 finished in 2 cells, 0 failed, 0 missing" in report
    assert "n = 3" in compared
    assert "50 ahead" in calibrated
    from gpmpc.recording import read_run

    (recording,) = tmp_path.glob("bounded/*/run.mcap")
    run = read_run(recording)
    assert run.references[:, 0].max() > 14
    assert 10 < run.states[:, 0].max() < 12.5
    (recording,) = tmp_path.glob("outputs/run/*figure_eight*/run.mcap")
    assert (
        np.abs(read_run(recording).states[10:, :3:2]).max() < 3.5
    )  # of width 3, not 4
    assert (tmp_path / "c_code/src/gpmpc.c").exists()
    assert len(read_run(tmp_path / "moving.mcap").times) >= 20
    assert names["flight"].states[-1, 0] > 1.0  # of the 1.67 m that were asked
    (recording,) = tmp_path.glob("arm/outputs/run/*/run.mcap")
    assert abs(read_run(recording).states[-1, 0] - 1) < 0.1
    assert float(names["errors"].abs().max()) < 0.2
    assert names["table"].shape[0] == 60
    assert np.allclose(names["decision"].x, names["run"].problems[17].x, atol=1e-6)
    predictions = [
        names[key].predict(names["data"].states, names["data"].inputs).mean
        for key in ("gp", "model")
    ]
    assert torch.equal(*predictions)


def test_the_first_five_minutes_print_what_the_readme_shows(page):
    names, (flown, drawn, info, _) = page("docs/start.md")
    (shown,) = [
        text
        for _, text in BLOCK.findall(read("README.md"))
        if text.startswith(" flight ")
    ]
    times = re.compile(
        r"(?<=, in )[\d.]+(?= s)|(?<=decision \[ms\]).*(?=written "
        r"to)|compil.*(?=flight  )",
        re.DOTALL,
    )
    assert times.sub("", shown).split() == times.sub("", flown).split()
    assert "tracking.png" in drawn
    assert "/step" in info
    assert np.abs(names["flight"].states[-1] - [1.0, 0.0]).max() < 0.02


def test_the_recording_of_the_gallery_is_replayed(page):
    names, printed = page(
        "docs/gallery.md", section="## A recording, read and replayed"
    )
    assert len(printed) == 2
    assert len(names["run"].times) == 100


@pytest.mark.slow
def test_the_whole_gallery_runs(page, tmp_path):
    page("docs/gallery.md")
    assert (tmp_path / "outputs/sweep/report/report.html").exists()


@pytest.mark.parametrize(
    "path", ["docs/gp.md", "docs/simulation.md", "docs/recording.md"]
)
def test_the_python_of_a_page_runs_in_its_order(path, page):
    text = read(path)
    assert text.count("```python") > 0
    page(path)


EXAMPLES = [
    path for path in sorted(ROOT.glob("gpmpc/**/*.py")) if ">>> " in path.read_text()
]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_the_examples_in_docstrings_print_what_they_show(path):
    module = importlib.import_module(
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
    )
    done = doctest.testmod(module, optionflags=doctest.IGNORE_EXCEPTION_DETAIL)
    assert done.attempted
    assert not done.failed


ROOMS = ("models", "mpc", "systems", "simulation", "logs", "gp", "propagation")
PUBLIC = [
    (room, name)
    for room in (*ROOMS, "estimation")
    for name in importlib.import_module(f"gpmpc.{room}").__all__
    if callable(getattr(importlib.import_module(f"gpmpc.{room}"), name))
]


def page_of(room, name):
    """The docstring of a public object, and what stands under its See Also."""
    text = inspect.getdoc(getattr(importlib.import_module(f"gpmpc.{room}"), name))
    assert text, name
    return text, text.partition("See Also:")[2]


def test_every_public_object_has_an_example_or_leads_to_one():
    texts = {(room, name): page_of(room, name)[0] for room, name in PUBLIC}
    assert len(texts) > 170
    assert not [
        key
        for key, text in texts.items()
        if ">>>" not in text and "See Also:" not in text
    ]


def test_what_pages_of_objects_lead_to_is_there():
    missing = []
    for room, name in PUBLIC:
        for named in re.findall(r"``([\w.]+)[`(]", page_of(room, name)[1]):
            places = [named, f"gpmpc.{room}.{named}", f"gpmpc.{room}.{name}.{named}"]
            if not any(map(locate, places)):
                missing.append((room, name, named))
    assert not missing


def test_every_page_with_python_is_followed_by_a_test():
    tests = [path.read_text() for path in ROOT.glob("tests/**/*.py")]
    followed = {
        path.name for path in PAGES if any(f'{path.name}"' in text for text in tests)
    }
    assert {path.name for path in PAGES if "```python" in path.read_text()} <= followed


def dotted(node, prefix=""):
    """The names of nested settings."""
    for key, value in node.items():
        yield f"{prefix}{key}"
        if isinstance(value, dict):
            yield from dotted(value, f"{prefix}{key}.")


def test_the_settings_that_pages_name_are_there(tmp_path):
    composed = called("run", "--cfg", cwd=tmp_path).stdout
    settings_of_run = {*dotted(yaml.safe_load(composed))}
    named = {
        (path.name, name)
        for path in PAGES
        for name in re.findall(r"`(controller\.[\w.]+)=", path.read_text())
    }
    assert named
    assert not {entry for entry in named if entry[1] not in settings_of_run}


def anchors(path):
    """The anchors of a page's headings, as GitHub and MyST make them."""
    text = BLOCK.sub("", path.read_text())
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles
    }


def test_every_link_leads_to_a_file_and_a_heading():
    broken = []
    for path in PAGES:
        for file, anchor in re.findall(
            r"\]\(([^)#:\s]*)(?:#([^)\s]*))?\)", BLOCK.sub("", path.read_text())
        ):
            target = path.parent / file if file else path
            if not target.exists() or (
                anchor and target.suffix == ".md" and anchor not in anchors(target)
            ):
                broken.append(f"{path.name}: {file}#{anchor}")
    assert not broken


def test_no_page_is_long_and_every_page_is_in_the_site():
    word = re.compile(r"\S*[^\W_]\S*")
    counts = {
        path.name: len(word.findall(BLOCK.sub("", path.read_text()))) for path in PAGES
    }
    counts.pop("mathematics.md")
    counts.pop("reliability.md")  # tables of promises, to look things up in
    assert max(counts.values()) <= 1500, sorted(
        counts.items(), key=lambda item: -item[1]
    )[:3]
    assert len(word.findall(read("README.md"))) <= 900
    listed = re.findall(r"^[\w]+$", read("docs/index.md"), re.MULTILINE)
    assert sorted(listed) == sorted(
        {path.stem for path in ROOT.glob("docs/*.md")} - {"index"}
    )


def public(module):
    """Returns the names of ``__all__``, else the classes and functions of a module."""
    names = getattr(module, "__all__", None)
    if names is None:
        names = [
            key
            for key, value in vars(module).items()
            if getattr(value, "__module__", None) == module.__name__
        ]
    return {key: getattr(module, key) for key in names if not key.startswith("_")}


def test_every_name_that_is_offered_or_used_is_documented():
    """Offered by a room, or used by settings, pages and examples."""
    listed = [
        importlib.import_module(name)
        for name in re.findall(r"^   (gpmpc[\w.]*)$", read("docs/api.md"), re.MULTILINE)
    ]
    documented = {id(value) for module in listed for value in public(module).values()}
    rooms = [
        module.name
        for module in pkgutil.iter_modules(gpmpc.__path__, "gpmpc.")
        if module.ispkg
    ]
    public_rooms = [room for room in rooms if not room.startswith("gpmpc._")]
    offered = {
        (room, key)
        for room in public_rooms
        for key in getattr(importlib.import_module(room), "__all__", [])
    }
    texts = [
        path.read_text()
        for path in (*PAGES, *ROOT.glob("examples/*.py"), *ROOT.glob("conf/**/*.yaml"))
    ]
    for text in texts:
        for module, names in re.findall(
            r"^from (gpmpc[\w.]*) import (\([^)]*\)|.*)", text, re.MULTILINE
        ):
            offered |= {(module, name) for name in re.findall(r"\w+", names)}
        offered |= set(re.findall(r"_target_: (gpmpc[\w.]*)\.(\w+)", text))
    missing = [
        f"{module}.{name}"
        for module, name in sorted(offered)
        if id(getattr(importlib.import_module(module), name)) not in documented
    ]
    assert not missing
