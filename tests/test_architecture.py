"""The house keeps its shape: layers look downwards, and importing a module loads no library it does not need."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.size import House

ROOT = Path(__file__).resolve().parents[1]


def test_every_import_contract_is_kept():
    # In a process of its own: the linter's logging configuration silences every logger that exists.
    code = "from importlinter.cli import lint_imports; raise SystemExit(lint_imports(no_cache=True))"
    linted = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert linted.returncode == 0, linted.stdout + linted.stderr


@pytest.mark.parametrize("module", ["gpmpc.qp"])
def test_the_qp_solvers_load_no_torch(module):
    forbidden = ["torch", "gpytorch", "hydra", "casadi", "matplotlib"]
    code = f"import sys, {module}; print([m for m in {forbidden} if m in sys.modules])"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert loaded == "[]"


def test_the_gp_modules_load_neither_optimisation_nor_settings_nor_figures():
    forbidden = ["hydra", "cvxpy", "mcap", "casadi", "matplotlib", "rich"]
    code = f"import sys, gpmpc.gp, gpmpc.models, gpmpc.propagation; print([m for m in {forbidden} if m in sys.modules])"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert loaded == "[]"


def test_recordings_are_written_and_read_without_torch_and_without_compilers():
    forbidden = ["torch", "numba", "scipy", "hydra", "matplotlib", "pandas"]
    code = f"import sys, gpmpc.recording; print([m for m in {forbidden} if m in sys.modules])"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert loaded == "[]"


@pytest.mark.parametrize(
    ("library", "rooms"),
    [
        ("gpytorch", ["gp/_gpytorch.py", "gp/_gpytorch_posteriors.py"]),
        ("hydra", ["cli"]),
        ("omegaconf", ["cli"]),
        ("matplotlib", ["plotting", "experiments"]),
        ("casadi", ["mpc", "gp/casadi_.py"]),
        ("rich", ["cli", "studies"]),
        ("mcap", ["recording", "logs/_bags.py", "logs/_encodings.py"]),
        ("google.protobuf", ["recording"]),
        ("foxglove", ["recording"]),
        ("pandas", ["recording", "calibration.py", "cli", "studies", "logs"]),
    ],
)
def test_a_heavy_library_has_one_door(library, rooms):
    package = ROOT / "gpmpc"
    pattern = re.compile(rf"^\s*(import|from) {library}\b", re.MULTILINE)
    users = [
        path.relative_to(package)
        for path in package.rglob("*.py")
        if pattern.search(path.read_text())
    ]
    assert users
    assert not [
        str(path)
        for path in users
        if not any(str(path).startswith(room) for room in rooms)
    ]


def test_no_private_interface_of_hydra_omegaconf_or_argparse_is_used():
    private = re.compile(r"hydra\._internal|omegaconf\._|\._get_node\(|\._actions\b")
    sources = ROOT.glob("gpmpc/**/*.py")
    assert not [
        str(path.relative_to(ROOT))
        for path in sources
        if private.search(path.read_text())
    ]


def test_published_results_stand_below_the_command_line_and_above_everything_else():
    above = re.compile(
        r"^\s*(?:from|import) gpmpc\.(?:cli|experiments)\b", re.MULTILINE
    )
    lower = [
        path
        for path in ROOT.glob("gpmpc/**/*.py")
        if path.parts[-2] not in ("cli", "experiments")
    ]
    assert not [
        str(path.relative_to(ROOT)) for path in lower if above.search(path.read_text())
    ]
    assert not [
        path.name
        for path in ROOT.glob("gpmpc/experiments/*.py")
        if "gpmpc.cli" in path.read_text()
    ]


HOUSE = House(ROOT)


@pytest.mark.parametrize(
    ("what", "count", "most"),
    [
        ("functions with more than 10 arguments", len(HOUSE.functions_above(10)), 0),
        ("circles of rooms", len(HOUSE.room_circles), 0),
        ("circles of modules", len(HOUSE.module_circles), 0),
    ],
)
def test_the_house_keeps_its_order(what, count, most):
    assert count <= most, (
        f"{what}: {count}, at most {most}; python -m benchmarks.size prints them"
    )


def test_the_count_of_the_house_finds_what_it_is_made_for(tmp_path):
    room = tmp_path / "gpmpc" / "room"
    room.mkdir(parents=True)
    (room / "__init__.py").write_text(
        'from gpmpc.room._hidden import h, k\n__all__ = ["h"]\n'
    )
    (room / "a.py").write_text(
        "from gpmpc.room import b\nX, _Y = 1, 2\ndef f(a, *, b): ...\ndef _g(): ...\n"
    )
    (room / "b.py").write_text(
        "class C:\n    def m(self, x, *y, z, **w):\n        import gpmpc.room.a\n"
    )
    (room / "_hidden.py").write_text("def h(): ...\ndef k(): ...\n")
    (tmp_path / "gpmpc" / "other.py").write_text("from gpmpc.room.b import C\n")
    house = House(tmp_path)
    assert house.lines == 12
    assert house.public_names == ["gpmpc.room.a.f", "gpmpc.room.b.C"]
    assert house.exported_names == ["gpmpc.room.h"]
    assert house.public_constants == ["gpmpc.room.a.X"]
    assert list(house.functions_above(3).values()) == [4]
    assert house.module_circles == [["gpmpc.room.a", "gpmpc.room.b"]]
    assert house.room_circles == []
