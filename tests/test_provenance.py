"""A result is named by its code's fingerprint, whatever that code's place and date.

Results of a changed kernel's old code are not shown as those of the new code.
"""

import json
import os
import runpy
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


#: computes one step of a learned model, or reads what was computed under its name
STUDY = """
import json
from pathlib import Path

import torch

torch.set_default_dtype(torch.float64)
torch.set_num_threads(1)

import gpmpc
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Transitions, train
from gpmpc.propagation import Linearization
from gpmpc.studies.study import TrialStore, fingerprint

times = torch.arange(8.0)[:, None]
rows = Transitions(times.sin(), times.cos(), 0.5 * times.sin())
store = TrialStore(Path("trials.jsonl"))
name = fingerprint("one step of a model", [rows.features, rows.next_states])
if name not in store.records:
    model = train(rows, restarts=0).posterior
    belief = Gaussian(torch.zeros(1), 0.01 * torch.eye(1))
    step = Linearization().propagate(model, belief, torch.zeros(1))
    store.append(name, {"variance": float(step.belief.covariance)})
print(json.dumps([gpmpc.__file__, store.records[name]["variance"]]))
"""


@pytest.fixture
def compiled_copy(tmp_path):
    """A copy of the checkout's code, compiled kernels included."""
    for name in ("gpmpc", "conf"):
        shutil.copytree(ROOT / name, tmp_path / "copy" / name)
    return tmp_path / "copy"


def change(path, right, wrong):
    """Replaces the one place of a file that is meant."""
    content = path.read_text()
    assert content.count(right) == 1
    path.write_text(content.replace(right, wrong))


def run_with(code, *arguments, cwd):
    """Runs Python with the package of a folder; returns what it prints."""
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env=os.environ | {"PYTHONPATH": str(code)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_changed_kernel_computes_old_results_again(
    compiled_copy, tmp_path, monkeypatch, capsys
):
    (tmp_path / "study.py").write_text(STUDY)
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        runpy.run_path("study.py")
    first, again = capsys.readouterr().out.splitlines()
    assert first == again
    kernel = compiled_copy / "gpmpc" / "_kernels" / "_gp_point.py"
    change(kernel, "(0.5 * D[d])", "(0.25 * D[d])")
    changed = run_with(compiled_copy, "study.py", cwd=tmp_path)
    (_, before), (file, after) = json.loads(first), json.loads(changed)
    assert Path(file).is_relative_to(compiled_copy)
    assert before != pytest.approx(after, rel=1e-2)
    # both are kept, each under the name of its code
    assert len((tmp_path / "trials.jsonl").read_text().splitlines()) == 2


@pytest.mark.slow
def test_a_wrong_factor_in_the_moments_is_seen_in_the_table(compiled_copy, tmp_path):
    main = "from gpmpc.cli import main; main()"
    settings = ["draws=1", "sizes=[10]", "subsystem=translational", "workers=1"]
    command = ["-c", main, "tables", *settings, "folder=A"]
    kernel = compiled_copy / "gpmpc" / "_kernels" / "_gp_moments.py"

    def errors():
        printed = run_with(compiled_copy, *command, cwd=tmp_path)
        assert "written to A" in printed
        written = json.loads((tmp_path / "A" / "tables.json").read_text())
        errors = [draw["test_mse"] for draw in written["draws"]]
        shown = [f"{error:.3g}"[:4] for error in errors]
        assert all(digits in printed for digits in shown), (shown, printed)
        return errors

    right = errors()
    change(kernel, "np.full(n, -0.5)", "np.full(n, -0.25)")
    wrong = errors()
    assert all(
        a != pytest.approx(b, rel=1e-2) for a, b in zip(right, wrong, strict=True)
    )
    assert errors() == wrong  # which are kept as well
    change(kernel, "np.full(n, -0.25)", "np.full(n, -0.5)")
    assert errors() == right
