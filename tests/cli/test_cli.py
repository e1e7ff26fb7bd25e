"""The command line as a user meets it: help, results, one clear line for a mistake."""

import json
import logging
from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest
from omegaconf import OmegaConf

from gpmpc.cli import _study
from gpmpc.studies.study import Document, TrialSpec
from tests.cli.command import forked, gpmpc

ROW = " ".join(str(i / 7) for i in range(15))
RESULTS = Path(
    "outputs/tables/nmpc-seed0/"
    "data.samples=12,model.restarts=0,sizes=[5],trajectory=elliptical"
)
FILES = [
    f"ds_nmpc_{t}_{s}.txt"
    for t in ("Elliptical", "Lorenz")
    for s in ("trans", "rotate")
]


def authors_folder(folder, text=f"{ROW}\n" * 20, broken=None):
    folder.mkdir()
    for name in FILES:
        (folder / name).write_text(text)
    if broken:
        (folder / FILES[0]).write_text(broken)
    return folder


def test_help_lists_the_commands_and_a_commands_settings(tmp_path):
    usage = gpmpc("--help", cwd=tmp_path)
    assert usage.returncode == 0
    assert "tables" in usage.stdout
    settings = forked("tables", "--help", cwd=tmp_path)
    assert settings.returncode == 0
    for setting in ("draws", "sizes", "trajectory", "subsystem", "seed", "data"):
        assert setting in settings.stdout
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["table"], "unknown command 'table' (did you mean 'tables'?)"),
        (["tables", "drawz=7"], "unknown setting 'drawz' (did you mean 'draws'?)"),
        (
            ["tables", "model.restart=3"],
            "unknown setting 'model.restart' (did you mean 'model.restarts'?)",
        ),
        (
            ["tables", "trajectory=lorens"],
            "trajectory: no such option 'lorens'; available are elliptical, goal, "
            "hover, lorenz",
        ),
        (["tables", "data=paper"], "data.folder: this setting has no default"),
        (["tables", "data=paper", "data.folder=nowhere"], "nowhere: no such folder"),
        (["tables", "draws=0"], "draws: must be a whole number, 1 or more; got 0"),
        (
            ["tables", "draws=five"],
            "draws: must be a whole number, 1 or more; got 'five'",
        ),
        (["tables", "sizes=[0]"], "sizes: must be a whole number, 1 or more; got 0"),
        (
            ["tables", "sizes=10,50"],
            "sizes: a list is written in brackets, sizes=[10,50]",
        ),
        (
            ["tables", "sizes=[500]"],
            "sizes: must be at most 189, the rows of elliptical translational; got 500",
        ),
        (
            ["quality", "only=lqr", "steps=0"],
            "steps: must be a whole number, 1 or more; got 0",
        ),
        (
            ["tables", "data.samples=0"],
            "data.samples: must be a whole number, 1 or more; got 0",
        ),
        (
            ["tables", "data.attitude=exakt"],
            "data.attitude: must be one of paper, exact; got 'exakt'",
        ),
        (
            ["tables", "model.restarts=-1"],
            "restarts: must be a whole number, 0 or more; got -1",
        ),
        (["tables", "model.penalty.power=3"], "power: must be even; got 3"),
        (["tables", "trajectory=[]"], "trajectory: choose at least one"),
        (
            ["tables", "trajectory.elliptical.rate=fast"],
            "rate: must be a number; got 'fast'",
        ),
        (
            ["tables", "data.horizon=1.5"],
            "data.horizon: must be a whole number, 1 or more; got 1.5",
        ),
        (
            ["tables", "data.translational.Q=[1,2]"],
            "Q: must be a list of 6 numbers; got [1, 2]",
        ),
        (
            ["tables", "data.translational.plant.dynamics.dynamics.mass=heavy"],
            "mass: must be a number above 0 [kg]; got 'heavy'",
        ),
        (["tables", "folder=null"], "folder: must be the path of a folder; got None"),
        (
            ["tables", "data.rotational.Q=null"],
            "Q: must be a list of 6 numbers; got None",
        ),
        (
            ["tables", "draws"],
            "'draws': cannot be read; a setting is written SETTING=VALUE",
        ),
        (["tables", "folder="], "folder: must be the path of a folder; got ''"),
        (["tables", "seed="], "seed: must be a whole number"),
        (
            ["export", "c", "run", "--budget", "flash=64kg"],
            "budget: flash must be a number with k or M, such as flash=64kB; got "
            "'flash=64kg'",
        ),
        (
            ["export", "c", "run", "--points", "9", "--budget", "ram=9kB"],
            "--points: is chosen by --budget; leave one of them out",
        ),
        (
            ["export", "c", "run", "--name", "math"],
            "name: math is the name of another file or target",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_clear_line_and_leaves_nothing_behind(
    arguments, message, tmp_path
):
    result = forked(*arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith("gpmpc: ")
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments", [["tables", "draws=0"], ["run", "--help"], ["table"]], ids=" ".join
)
def test_a_copy_of_a_process_answers_as_the_command_does(arguments, tmp_path):
    copy = forked(*arguments, cwd=tmp_path)
    command = gpmpc(*arguments, cwd=tmp_path)
    assert (copy.returncode, copy.stdout, copy.stderr) == (
        command.returncode,
        command.stdout,
        command.stderr,
    )
    assert copy.stdout or copy.stderr


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (
            f"{ROW}\n{ROW.rsplit(' ', 1)[0]}\n",
            "ds_nmpc_Elliptical_trans.txt: row 2 has 14 columns; expected 15",
        ),
        (
            f"{ROW}\n{ROW.replace('0.0', 'nan', 1)}\n",
            "ds_nmpc_Elliptical_trans.txt: row 2, column 1 is 'nan'",
        ),
        (
            ROW.replace("0.0", "inf", 1),
            "ds_nmpc_Elliptical_trans.txt: row 1, column 1 is 'inf'",
        ),
        (
            f"{ROW}\n" * 3,
            "ds_nmpc_Elliptical_trans.txt: the file holds 3 rows; data.samples asks "
            "for 20",
        ),
    ],
    ids=["14 columns", "NaN", "infinite", "too few rows"],
)
def test_a_broken_data_file_is_named_with_row_and_column(broken, message, tmp_path):
    folder = authors_folder(tmp_path / "data", broken=broken)
    result = forked(
        "tables",
        "data=paper",
        f"data.folder={folder}",
        "data.samples=20",
        "sizes=[5]",
        cwd=tmp_path,
    )
    assert result.returncode == 2
    assert message in result.stderr
    assert result.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["data"]


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    """A small run on our own data."""
    cwd = tmp_path_factory.mktemp("run")
    arguments = [
        "tables",
        "draws=1",
        "sizes=[5]",
        "data.samples=12",
        "trajectory=elliptical",
        "model.restarts=0",
        "workers=1",
    ]
    return cwd, arguments, forked(*arguments, cwd=cwd)


def test_a_run_writes_every_document_and_prints_the_tables(small_run):
    cwd, _, result = small_run
    assert result.returncode == 0, result.stderr
    folder = cwd / RESULTS
    expected = [
        "config.yaml",
        "tables.csv",
        "tables.json",
        "tables.md",
        "tables.png",
        "tables.tex",
        "trials.jsonl",
    ]
    assert sorted(path.name for path in folder.iterdir()) == expected
    assert "Table 1: elliptical trajectory" in result.stdout
    assert "psi" in result.stdout  # the note on constant columns
    data = json.loads((folder / "tables.json").read_text())
    assert data["meta"]["command"].startswith("gpmpc tables draws=1")
    assert data["meta"]["settings"]["seed"] == 0
    assert data["meta"]["versions"]["torch"]
    assert [draw["subsystem"] for draw in data["draws"]] == [
        "translational",
        "rotational",
    ]
    for key in (
        "table",
        "trajectory",
        "size",
        "draw",
        "seed",
        "training_mse",
        "test_mse",
        "average_variance",
        "training_seconds",
    ):
        assert key in data["draws"][0]
    assert [path.name for path in cwd.iterdir()] == ["outputs"]


def test_the_same_command_again_computes_nothing_anew(small_run):
    cwd, arguments, _ = small_run
    before = json.loads((cwd / RESULTS / "tables.json").read_text())["draws"]
    assert forked(*arguments, cwd=cwd).returncode == 0
    assert json.loads((cwd / RESULTS / "tables.json").read_text())["draws"] == before


def test_a_folder_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "taken").write_text("a file, not a folder")
    result = forked(
        "tables",
        "draws=1",
        "sizes=[5]",
        "data.samples=12",
        "folder=taken",
        cwd=tmp_path,
    )
    assert result.returncode == 2
    assert "folder: cannot write to taken" in result.stderr
    assert result.stderr.count("\n") == 1


def test_the_traceback_is_there_for_who_asks(tmp_path):
    result = forked("tables", "draws=0", "--debug", cwd=tmp_path)
    assert result.returncode != 0
    assert "Traceback" in result.stderr


@pytest.mark.parametrize(
    ("failed", "lost", "shown", "more"),
    [
        (1, 2, ["failed"] + 2 * ["lost"], []),
        (12, 3, 10 * ["failed"], ["failed: 2 more", "lost: 3 more"]),
        (8, 3, 8 * ["failed"] + 2 * ["lost"], ["lost: 1 more"]),
    ],
)
def test_a_study_tells_failures_from_losses(
    failed, lost, shown, more, tmp_path, monkeypatch, capsys
):
    records = [{"error": "Diverged"} for _ in range(lost)]
    records += [{"error": "disk full", "is_result": False} for _ in range(failed)]
    trials = [TrialSpec({"draw": i}, None, i, "") for i in range(len(records))]
    published = SimpleNamespace(
        name="tables",
        trial_name="draws",
        lost_is_result=False,
        document=lambda records: Document("Tables", [], pd.DataFrame()),
        summary=lambda records: ([], []),
    )
    monkeypatch.setattr(_study, "_study", lambda *_: published)
    monkeypatch.setattr(_study, "_run_trials", lambda *_: (trials, records))
    # A command gives the package's log a handler, and its process ends.
    log = logging.getLogger("gpmpc")
    for attribute in ("handlers", "propagate", "level"):
        monkeypatch.setattr(log, attribute, getattr(log, attribute))
    result = _study.study(OmegaConf.create({"folder": str(tmp_path)}))
    said = capsys.readouterr().out.splitlines()
    ends = [line for line in said if ": draw " in line]
    assert [line.partition(":")[0] for line in ends] == shown
    assert [line.partition(";")[0] for line in said if " more; " in line] == more
    count = f"failed, and in no number: {failed} of {failed + lost} trials; "
    assert said[-1].startswith(count)
    document = (tmp_path / "tables.md").read_text()
    assert document.count("failed: draw ") == failed
    assert result.code == 1
