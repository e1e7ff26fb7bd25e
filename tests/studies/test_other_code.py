"""Results of a changed kernel's old code are not shown as those of the new code."""

import json
import os
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
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
def copy(tmp_path):
    """A copy of the checkout's code, compiled kernels included."""
    for name in ("gpmpc", "conf"):
        shutil.copytree(ROOT / name, tmp_path / "copy" / name)
    return tmp_path / "copy"


def change(path, right, wrong):
    """Replaces the one place of a file that is meant."""
    content = path.read_text()
    assert content.count(right) == 1
    path.write_text(content.replace(right, wrong))


def run(code, *arguments, cwd):
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
    copy, tmp_path, monkeypatch, capsys
):
    (tmp_path / "study.py").write_text(STUDY)
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        runpy.run_path("study.py")
    first, again = capsys.readouterr().out.splitlines()
    assert first == again
    kernel = copy / "gpmpc" / "_kernels" / "_gp_point.py"
    change(kernel, "(0.5 * D[d])", "(0.25 * D[d])")
    changed = run(copy, "study.py", cwd=tmp_path)
    (_, before), (file, after) = json.loads(first), json.loads(changed)
    assert Path(file).is_relative_to(copy)
    assert before != pytest.approx(after, rel=1e-2)
    # both are kept, each under the name of its code
    assert len((tmp_path / "trials.jsonl").read_text().splitlines()) == 2


@pytest.mark.slow
def test_a_wrong_factor_in_the_moments_is_seen_in_the_table(copy, tmp_path):
    main = "from gpmpc.cli import main; main()"
    settings = ["draws=1", "sizes=[10]", "subsystem=translational", "workers=1"]
    command = ["-c", main, "tables", *settings, "folder=A"]
    kernel = copy / "gpmpc" / "_kernels" / "_gp_moments.py"

    def errors():
        printed = run(copy, *command, cwd=tmp_path)
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
