"""Benchmarks that no test runs ask the package for what it has."""

import ast
from importlib import import_module
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    "path", sorted(ROOT.glob("benchmarks/*.py")), ids=lambda path: path.stem
)
def test_what_a_benchmark_imports_from_the_package_is_there(path):
    for part in ast.walk(ast.parse(path.read_text())):
        if (
            isinstance(part, ast.ImportFrom)
            and part.module
            and part.module.split(".")[0] == "gpmpc"
        ):
            module = import_module(part.module)
            for name in (alias.name for alias in part.names):
                assert hasattr(module, name) or import_module(f"{part.module}.{name}")
