"""Layers look downwards, and importing a module loads no library it does not need."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_every_import_contract_is_kept():
    # In a process of its own: the linter's logging configuration silences every logger
    # that exists.
    code = (
        "from importlinter.cli import lint_imports; raise "
        "SystemExit(lint_imports(no_cache=True))"
    )
    linted = subprocess.run(
        [sys.executable, "-c", code],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert linted.returncode == 0, linted.stdout + linted.stderr


#: groups of modules that one process imports after another, with what none may load
LIGHT_IMPORTS = {
    "solvers and controllers": [
        ("gpmpc.qp", ["torch", "gpytorch", "hydra", "casadi", "matplotlib"]),
        (
            "gpmpc.gp, gpmpc.models, gpmpc.propagation",
            ["hydra", "cvxpy", "mcap", "casadi", "matplotlib", "rich"],
        ),
        (
            "gpmpc.mpc, gpmpc.mpc.gp_mpc, gpmpc.mpc.baselines, gpmpc.testing",
            ["cvxpy", "hydra", "matplotlib"],
        ),
    ],
    "runs that are read": [
        (
            "gpmpc.recording",
            ["torch", "numba", "scipy", "hydra", "matplotlib", "pandas"],
        ),
        (
            "gpmpc.cli._report, gpmpc.cli._status, gpmpc.cli._sweep",
            ["torch", "numba", "casadi"],
        ),
    ],
}


@pytest.mark.parametrize("process", LIGHT_IMPORTS)
def test_importing_a_room_loads_no_library_it_does_not_need(process):
    lines = ["import sys"]
    for modules, forbidden in LIGHT_IMPORTS[process]:
        lines.append(f"import {modules}")
        loaded = f"[name for name in {forbidden} if name in sys.modules]"
        lines.append(f"print({modules!r}, {loaded})")
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines() == [
        f"{modules} []" for modules, _ in LIGHT_IMPORTS[process]
    ]


@pytest.mark.parametrize(
    ("library", "rooms"),
    [
        ("gpytorch", ["gp/_gpytorch"]),
        ("hydra", ["cli"]),
        ("omegaconf", ["cli"]),
        ("matplotlib", ["plotting", "experiments"]),
        ("casadi", ["mpc", "gp/casadi_.py", "systems/_elementary.py"]),
        ("rich", ["cli", "studies"]),
        ("mcap", ["recording", "logs/_bag.py", "logs/_encodings.py"]),
        ("google.protobuf", ["recording"]),
        ("foxglove", ["recording"]),
        (
            "pandas",
            ["recording", "calibration.py", "cli", "studies", "logs", "experiments"],
        ),
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


def test_nothing_private_of_hydra_omegaconf_or_argparse_is_used():
    private = re.compile(r"hydra\._internal|omegaconf\._|\._get_node\(|\._actions\b")
    sources = ROOT.glob("gpmpc/**/*.py")
    assert not [
        str(path.relative_to(ROOT))
        for path in sources
        if private.search(path.read_text())
    ]


def test_published_results_stand_just_below_the_command_line():
    above = re.compile(
        r"^\s*(?:from|import) gpmpc\.(?:cli|experiments)\b", re.MULTILINE
    )
    lower = [
        path
        for path in ROOT.glob("gpmpc/**/*.py")
        if path.parts[-2] not in ("cli", "experiments") and path.name != "__main__.py"
    ]
    assert not [
        str(path.relative_to(ROOT)) for path in lower if above.search(path.read_text())
    ]
    assert not [
        path.name
        for path in ROOT.glob("gpmpc/experiments/*.py")
        if "gpmpc.cli" in path.read_text()
    ]
