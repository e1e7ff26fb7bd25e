"""A result is named by its code's fingerprint, whatever that code's place and date."""

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gpmpc import _provenance
from gpmpc._provenance import (
    code_fingerprint,
    is_of_this_code,
    own_code,
    provenance,
    source_fingerprint,
)
from gpmpc.exceptions import GpmpcError
from gpmpc.studies._run_record import read_record

ROOT = Path(__file__).resolve().parents[1]
#: files that no number depends on: how documents look, texts of the command line
SHOWN_ONLY = {
    ".css",
    ".ld",
    ".mplstyle",
    ".txt",
    ".typed",
    ".cpp",
    ".ino",
    ".properties",
    "",
}


@pytest.fixture
def checkout(tmp_path):
    """A copy of the source, as a checkout has it."""
    shutil.copytree(
        ROOT / "gpmpc",
        tmp_path / "gpmpc",
        ignore=shutil.ignore_patterns("__pycache__"),
    )
    return tmp_path


@pytest.mark.parametrize(
    ("program", "name"),
    [
        ("/a/gpmpc/__main__.py", "gpmpc"),
        ("/bin/gpmpc", "gpmpc"),
        ("a/fly.py", "fly.py"),
    ],
)
def test_a_command_begins_with_the_programs_name(program, name, monkeypatch):
    monkeypatch.setattr("sys.argv", [program, "learn", "map.yaml"])
    assert provenance()["command"] == f"{name} learn map.yaml"


def test_the_fingerprint_ignores_the_codes_place_and_date(checkout):
    assert source_fingerprint(checkout / "gpmpc") == code_fingerprint()
    for path in checkout.rglob("*.py"):
        path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
        os.utime(path, (0, 0))
    (checkout / "gpmpc" / "__pycache__").mkdir()
    (checkout / "gpmpc" / "__pycache__" / "gaussian.cpython-311.py").write_text("1")
    (checkout / "gpmpc" / "notes.txt").write_text("not code")
    (checkout / "gpmpc" / "conf").mkdir()
    (checkout / "gpmpc" / "conf" / "own.py").write_text("not code")
    assert source_fingerprint(checkout / "gpmpc") == code_fingerprint()


def test_files_beside_the_package_are_not_its_code(checkout):
    (checkout / "experiments").mkdir()
    (checkout / "experiments" / "other.py").write_text("x = 1\n")
    assert source_fingerprint(checkout / "gpmpc") == code_fingerprint()


@pytest.mark.parametrize(
    "name",
    [
        "gpmpc/_kernels/_gp_moments.py",
        "gpmpc/_dynamics.py",
        "gpmpc/_compiled.py",
        "gpmpc/trajectories.py",
        "gpmpc/learning/_step.py",
        "gpmpc/estimation/_kalman.py",
        "gpmpc/cli/_study.py",
        "gpmpc/systems/quadrotor.xml",
        "gpmpc/experiments/tables.py",
        "gpmpc/experiments/subsystems.py",
        "gpmpc/experiments/paper_tables.csv",
    ],
)
def test_any_file_that_changes_moves_or_goes_makes_it_other_code(name, checkout):
    path = checkout / name
    content = path.read_bytes()
    middle = len(content) // 2
    path.write_bytes(content[:middle] + b"1" + content[middle:])
    changed = source_fingerprint(checkout / "gpmpc")
    path.write_bytes(content)
    moved_to = path.with_name(f"other{path.suffix}")
    path.rename(moved_to)
    moved_fingerprint = source_fingerprint(checkout / "gpmpc")
    moved_to.unlink()
    try:
        removed = source_fingerprint(checkout / "gpmpc")
    except GpmpcError:  # it was the only one of its kind
        removed = "refused"
    assert len({code_fingerprint(), changed, moved_fingerprint, removed}) == 4


def test_every_file_is_code_or_known_to_change_no_number():
    listed = ["git", "ls-files", "gpmpc"]
    tracked = subprocess.run(listed, cwd=ROOT, capture_output=True, text=True)
    names = tracked.stdout.split()
    if not names:
        pytest.skip("no checkout")
    endings = {Path(name).suffix for name in names}
    assert endings - SHOWN_ONLY == {*_provenance._SOURCES}


def test_a_package_without_its_sources_is_refused(tmp_path, monkeypatch):
    (tmp_path / "gaussian.py").write_text("x = 1\n")
    with pytest.raises(GpmpcError, match=r"holds no \*\.xml"):
        source_fingerprint(tmp_path)
    with pytest.raises(GpmpcError, match=r"holds no \*\.py"):
        source_fingerprint(tmp_path / "gone")

    def refuse():
        raise GpmpcError("no source")

    monkeypatch.setattr(_provenance, "code_fingerprint", refuse)
    assert provenance()["code"] is None
    assert not is_of_this_code(provenance())


def test_a_result_that_names_no_code_is_of_other_code():
    assert is_of_this_code(provenance())
    assert not is_of_this_code({})
    assert not is_of_this_code(provenance() | {"code": "0" * 32})


def test_the_fingerprint_is_read_once_a_process_and_is_quick():
    code_fingerprint()
    began = time.perf_counter()
    code_fingerprint()
    assert time.perf_counter() - began < 1e-3
    assert code_fingerprint.cache_info().misses <= 1


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Code of a user's own in a folder on the path, each file by its name."""
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in [name for name in sys.modules if name.startswith("my_")]:
        monkeypatch.delitem(sys.modules, name)  # of another test, in its own folder
    (tmp_path / "my_robot").mkdir()
    files = {
        "my_robot/__init__.py": "",
        "my_robot/plant.py": "from my_constants import MASS\n",
        "my_robot/robot.xml": "<mujoco/>",
        "my_robot/log.csv": "t\n0\n",
        "my_constants.py": "import numpy\nMASS = 1.0\n",
        "my_notes.py": "x = 1\n",
        "my_script.py": "import my_constants\n",
    }
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    _provenance._own_fingerprint.cache_clear()
    yield tmp_path
    _provenance._own_fingerprint.cache_clear()


SETTINGS = {
    "system": {"_target_": "my_robot.plant.make"},
    "list": [
        {"parts": ({"_target_": "my_script.f"}, {"_target_": "scipy.stats.norm"})}
    ],
    "model": {"_target_": "gpmpc.gp.train", "value": 1},
    "nothing": {"_target_": "no_such_module.f"},
    "builtin": {"_target_": "builtins.dict"},
    "number": {"_target_": 3},
}


def test_the_users_code_counts_with_its_uninstalled_imports(own):
    before = own_code(SETTINGS)
    assert sorted(before) == ["my_robot", "my_script"]

    def changed(name, text):
        (own / name).write_text(text)
        _provenance._own_fingerprint.cache_clear()
        after = own_code(SETTINGS)
        return {key for key in before if after[key] != before[key]}

    assert changed("my_notes.py", "x = 2\n") == set()
    assert changed("my_robot/log.csv", "t\n1\n") == set()
    assert changed("my_robot/robot.xml", "<mujoco model='a'/>") == {"my_robot"}
    assert changed("my_constants.py", "MASS = 2.0\n") == {"my_robot", "my_script"}


def test_a_result_of_own_code_changed_since_is_of_other_code(own):
    about = provenance() | {"own_code": own_code(SETTINGS)}
    assert is_of_this_code(about, SETTINGS)
    assert not is_of_this_code(provenance(), SETTINGS)
    (own / "my_constants.py").write_text("MASS = 2.0\n")
    _provenance._own_fingerprint.cache_clear()
    assert not is_of_this_code(about, SETTINGS)


def test_own_code_that_cannot_be_parsed_counts_as_it_stands(own):
    before = own_code(SETTINGS)
    (own / "my_script.py").write_text("import (\n")
    _provenance._own_fingerprint.cache_clear()
    assert own_code(SETTINGS)["my_script"] != before["my_script"]


@pytest.mark.parametrize(
    "naming",
    [
        {"_target_": "hydra.utils.get_method", "path": "my_robot.plant.make"},
        {"_target_": "gpmpc.systems.gymnasium_", "environment": "my_robot:Arm-v0"},
        {"_target_": "gpmpc.logs.load_flyable", "path": "m", "trusted": ["my_robot"]},
    ],
)
def test_own_code_counts_however_settings_name_it(own, naming):
    settings = {"controller": {"limit": naming, "constraints": [{"h": naming}]}}
    assert sorted(own_code(settings)) == ["my_robot"]
    # as a report and a sweep have them, dotted
    run = {"choices": [], "error": "", "settings": {"system": naming}}
    run["provenance"] = provenance() | {"own_code": own_code(naming)}
    assert read_record(Path("error.json"), run).is_of_this_code()
