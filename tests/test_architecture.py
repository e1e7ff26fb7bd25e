"""The house keeps its shape: layers look downwards, and importing a module loads no library it does not need."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_every_import_contract_is_kept():
    # In a process of its own: the linter's logging configuration silences every logger that exists.
    code = "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"
    linted = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert linted.returncode == 0, linted.stdout + linted.stderr


@pytest.mark.parametrize("module", ["gpmpc.qp"])
def test_the_qp_solvers_load_no_torch(module):
    forbidden = ["torch", "gpytorch", "hydra", "casadi", "matplotlib"]
    code = f"import sys, {module}; print([m for m in {forbidden} if m in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert loaded == "[]"


def test_the_gp_modules_load_neither_optimisation_nor_settings_nor_figures():
    forbidden = ["hydra", "cvxpy", "mcap", "casadi", "matplotlib", "rich"]
    code = f"import sys, gpmpc.gp, gpmpc.propagation; print([m for m in {forbidden} if m in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert loaded == "[]"


def test_the_writer_of_recordings_starts_without_torch_and_without_compilers():
    forbidden = ["torch", "numba", "scipy", "hydra", "matplotlib"]
    code = f"import sys, gpmpc.recording.writer; print([m for m in {forbidden} if m in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert loaded == "[]"


@pytest.mark.parametrize(
    ("library", "rooms"),
    [
        ("gpytorch", ["gp/model.py", "gp/gpytorch_posterior.py", "gp/gpytorch_training.py"]),
        ("hydra", ["cli"]),
        ("omegaconf", ["cli"]),
        ("matplotlib", ["plotting"]),
        ("casadi", ["mpc", "gp/casadi_.py"]),
        ("rich", ["cli", "experiments", "simulation/trials.py"]),
        ("mcap", ["recording"]),
        ("mcap_protobuf", ["recording"]),
        ("google.protobuf", ["recording"]),
        ("foxglove_schemas_protobuf", ["recording"]),
        ("pandas", ["recording", "cli"]),
    ],
)
def test_a_heavy_library_has_one_door(library, rooms):
    package = ROOT / "gpmpc"
    pattern = re.compile(rf"^\s*(import|from) {library}\b", re.MULTILINE)
    users = [path.relative_to(package) for path in package.rglob("*.py") if pattern.search(path.read_text())]
    assert users
    assert not [str(path) for path in users if not any(str(path).startswith(room) for room in rooms)]


def test_no_file_grows_past_400_lines():
    long = {
        str(p.relative_to(ROOT)): n for p in ROOT.glob("gpmpc/**/*.py") if (n := len(p.read_text().splitlines())) > 400
    }
    assert not long
