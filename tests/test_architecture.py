"""The house keeps its shape: layers look downwards, and importing a module loads no library it does not need."""

import subprocess
import sys
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).resolve().parents[1]


def test_every_import_contract_is_kept(monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    exit_code = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert exit_code == 0, capsys.readouterr().out


@pytest.mark.parametrize("module", ["gpmpc.qp"])
def test_the_qp_solvers_load_no_torch(module):
    forbidden = ["torch", "gpytorch", "hydra", "casadi", "matplotlib"]
    code = f"import sys, {module}; print([m for m in {forbidden} if m in sys.modules])"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()
    assert loaded == "[]"
