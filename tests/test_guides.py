"""What the guides show runs as it stands: files are written, Python runs in order, commands succeed."""

import re
import shlex
import sys
from pathlib import Path

import pytest

from tests.cli.command import forked

DOCS = Path(__file__).resolve().parents[1] / "docs"
BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def follow(page, folder, monkeypatch):
    """Does what a page says in a folder; returns the names that its Python leaves and the commands' outputs."""
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(str(folder))
    names, printed = {}, []
    for language, text in BLOCK.findall((DOCS / page).read_text()):
        path = re.match(r"(?:# @package _global_\n)?(?:#|<!--) ([\w/]+\.(?:py|yaml|xml))(?: -->)?\n", text)
        if path:
            (folder / path[1]).parent.mkdir(exist_ok=True)
            (folder / path[1]).write_text(text)
        elif language == "python":
            exec(compile(text, page, "exec"), names)
        else:
            for line in text.splitlines():
                command, *arguments = shlex.split(line)
                assert command == "gpmpc"
                done = forked(*arguments, cwd=folder)
                assert done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
                printed.append(done.stdout)
    return names, printed


@pytest.fixture(autouse=True)
def _forget_modules():
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        if name in ("arm", "fly"):
            del sys.modules[name]


def test_a_system_of_ones_own_is_flown_learned_swept_reported_recorded_and_calibrated(tmp_path, monkeypatch):
    names, (flown, *_, heavier, swept, report) = follow("guide_system.md", tmp_path, monkeypatch)
    assert abs(names["flown"].rollout.states[-20:] - [1.0, 0.0]).max() < 0.05
    assert "100 steps of arm with convex" in flown
    assert "200 rows of random data" in flown
    assert "RMSE [rad]" in flown
    assert "mass 1.2 (learned: 1.0)" in heavier
    assert "4 flown" in swept
    assert "RMSE" in report
    figures = {path.name for path in (tmp_path / "outputs/run/system=arm/figures").iterdir()}
    assert figures == {"tracking.png", "inputs.png", "timing.png"}
    assert "state.angle" in (tmp_path / "outputs/run/system=arm/run.layout.json").read_text()


def test_simulators_are_systems(tmp_path, monkeypatch):
    pytest.importorskip("gymnasium")
    pytest.importorskip("mujoco")
    names, (flown,) = follow("guide_simulator.md", tmp_path, monkeypatch)
    assert abs(names["flown"].rollout.states[-20:] - [1.0, 0.0, 0.0]).max() < 0.05
    assert "5 steps of gymnasium with convex" in flown
    assert names["cart"].state_names == ("slider", "hinge", "slider_rate", "hinge_rate", "push_activation")
    assert names["seen"].state_names == ("position", "angle")


def test_a_new_project_runs_at_once(tmp_path, monkeypatch):
    done = forked("new", "arm", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    project = tmp_path / "arm"
    assert {str(path.relative_to(project)) for path in project.rglob("*.*")} == {
        "arm.py",
        "fly.py",
        "test_arm.py",
        "system/arm.yaml",
    }
    command = next(line for line in done.stdout.splitlines() if line.startswith("gpmpc run"))
    run = forked(*shlex.split(command)[1:], cwd=project)
    assert run.returncode == 0, run.stderr
    assert "100 steps of arm with convex" in run.stdout
    monkeypatch.chdir(project)
    monkeypatch.syspath_prepend(str(project))
    names = {}
    exec(compile((project / "test_arm.py").read_text(), "test_arm.py", "exec"), names)
    names["test_it_is_held_at_its_goal"]()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["new", "2arms"], "NAME: must be letters, digits and _, a letter first; got '2arms'"),
        (["new", "class"], "NAME: must be letters"),
        (["new", "arm", "--to", "."], "to: . is not an empty folder; nothing was written"),
        (["run", "--config-dir", ".", "system=hand"], "system: no such option 'hand'"),
        (["run", "--config-dir", ".", "system=short"], "derivative must give 2 entries, one for each of state_names"),
        (["run", "--config-dir", ".", "system=hollow"], "must be finite at state [0.0, 0.0]"),
        (["run", "--config-dir", ".", "system=weights"], "controller.problem: weighs 3 states and 1 inputs; nan has 2"),
        (["run", "system=gymnasium"], "system.environment: this setting has no default"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_clear_line(arguments, message, tmp_path):
    (tmp_path / "system").mkdir()
    for name, rates in (("short", "[x[1]]"), ("hollow", "[x[1], 0 * float('nan')]"), ("weights", "[x[1], u[0]]")):
        text = f"state_names, input_names = ('a', 'b'), ('u',)\n    def derivative(self, x, u): return {rates}\n"
        limits = "name='nan', input_lower=[-1], input_upper=[1], region=[[-1, -1], [1, 1]]"
        made = (
            f"from gpmpc.systems import System\nclass D:\n    {text}\ndef make(): return System(D(), 0.1, {limits})\n"
        )
        (tmp_path / f"{name}_module.py").write_text(made)
        weights = "[1, 1, 1]" if name == "weights" else "[1, 1]"
        (tmp_path / "system" / f"{name}.yaml").write_text(
            "# @package _global_\ndefaults: [override /trajectory: goal, override /data: random, _self_]\n"
            f"system: {{_target_: {name}_module.make}}\ncontroller: {{problem: {{cost: {{Q: {weights}, R: [1]}}}}}}\n"
        )
    before = sorted(tmp_path.rglob("*.*"))
    done = forked(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert message in done.stderr
    assert [path for path in sorted(tmp_path.rglob("*.*")) if "__pycache__" not in str(path)] == before
