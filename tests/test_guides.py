"""The guides run as they stand: files are written, Python runs, commands succeed."""

import shlex

import numpy as np
import pandas
import pytest

from tests.cli.command import called, forked
from tests.pages import BLOCK, read


def test_the_guide_of_a_custom_system_runs_from_start_to_end(page, tmp_path):
    names, (flown, *_, calibrated, heavier, swept, report) = page(
        "docs/guide_system.md"
    )
    assert abs(names["flown"].rollout.states[-20:] - [1.0, 0.0]).max() < 0.05
    recorded = names["run"]
    assert (
        recorded.finished,
        recorded.metadata["units"]["state.angle"],
        len(recorded.states),
    ) == (True, "rad", 60)
    assert (recorded.metadata["frames"]["z axis"], recorded.input_bounds.tolist()) == (
        "up",
        [[-8.0], [8.0]],
    )
    assert "100 steps of arm with convex" in flown
    assert "200 rows of random data" in flown
    assert "RMSE [rad]" in flown
    assert "10 ahead" in calibrated
    assert "rate [rad/s]" in calibrated
    frame = pandas.read_csv(
        tmp_path / "outputs/run/system=arm/calibration/calibration.csv"
    )
    assert frame["samples"].tolist()[:2] == [99, 99]
    assert frame["rmse"].max() < 0.01
    assert "mass 1.2 (learned: 1.0)" in heavier
    assert "4 flown" in swept
    assert "RMSE" in report
    figures = {
        path.name for path in (tmp_path / "outputs/run/system=arm/figures").iterdir()
    }
    assert figures == {"tracking.png", "inputs.png", "timing.png"}
    assert (
        "state.angle"
        in (tmp_path / "outputs/run/system=arm/run.layout.json").read_text()
    )


def test_simulators_are_systems(page):
    pytest.importorskip("gymnasium")
    pytest.importorskip("mujoco")
    names, (flown, quadrotor, filmed) = page(
        "docs/guide_simulator.md", shortened=[("steps=100", "steps=5")]
    )
    assert "5 steps of mujoco_quadrotor with convex" in quadrotor
    assert "flight.gif" in filmed
    assert abs(names["flown"].rollout.states[-20:] - [1.0, 0.0, 0.0]).max() < 0.05
    assert "5 steps of gymnasium with convex" in flown
    assert names["cart"].state_names == (
        "slider",
        "hinge",
        "slider_rate",
        "hinge_rate",
        "push_activation",
    )
    assert names["seen"].state_names == ("position", "angle")


@pytest.mark.parametrize("path", ["docs/guide_models.md", "docs/guide_estimation.md"])
def test_the_blocks_of_a_guide_run(path, page, monkeypatch):
    monkeypatch.setattr("matplotlib.pyplot.show", lambda: None)
    assert len(BLOCK.findall(read(path))) >= 4
    page(path)


def test_the_loops_of_the_guide_of_constraints_reach_their_goals(page):
    names, _ = page("docs/guide_constraints.md")
    assert names["reached"] < 0.05
    assert names["closest"] > 0.3 - 0.02
    assert abs(names["away"] - 0.5) < 0.02


def test_the_loops_of_the_guide_of_the_loop_reach_their_goals(page):
    names, _ = page("docs/guide_loop.md")
    assert names["reached"] < 0.05
    angle = names["state"][2]  # of a cart pole that many starts swing up
    assert abs(angle - 2 * np.pi * np.round(angle / (2 * np.pi))) < 0.2


def test_a_boat_crosses_behind_a_ferry_told_anew_each_step(page):
    names, _ = page("docs/guide_together.md")
    assert names["reached"] < 0.1
    assert 0.97 < names["nearest"] < 1.1
    assert names["loop"].failures == 0


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
    command = next(
        line for line in done.stdout.splitlines() if line.startswith("gpmpc run")
    )
    run = forked(*shlex.split(command)[1:], cwd=project)
    assert run.returncode == 0, run.stderr
    assert "100 steps of arm with convex" in run.stdout
    monkeypatch.chdir(project)
    monkeypatch.syspath_prepend(str(project))
    names = {}
    exec(compile((project / "test_arm.py").read_text(), "test_arm.py", "exec"), names)
    names["test_it_is_held_at_its_goal"]()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("pendulum", "pendulum is the name of a system of gpmpc"),
        ("fly", "fly is the name of a file of the project"),
        ("random", "random is the name of a module that Python finds already"),
    ],
)
def test_a_project_takes_no_name_that_means_something_else(name, message, tmp_path):
    done = called("new", name, "--to", "project", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith(f"gpmpc: NAME: {message}")
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["new", "2arms"],
            "NAME: must be letters, digits and _, a letter first; got '2arms'",
        ),
        (["new", "class"], "NAME: class is the name of a keyword of Python; choose"),
        (
            ["new", "arm", "--to", "."],
            "to: . is not an empty folder; nothing was written",
        ),
        (["run", "--config-dir", ".", "system=hand"], "system: no such option 'hand'"),
        (
            ["run", "--config-dir", ".", "system=short"],
            "derivative must give 2 entries, one for each of state_names",
        ),
        (
            ["run", "--config-dir", ".", "system=hollow"],
            "must be finite at state [0.0, 0.0]",
        ),
        (
            ["run", "--config-dir", ".", "system=weights"],
            "controller.problem: weighs 3 states and 1 inputs; nan has 2",
        ),
        (
            ["run", "--config-dir", ".", "system=root"],
            "h or its gradient is not finite at x = [0. 0.], u = [0.]",
        ),
        (
            ["run", "system=pendulum", "nominal={mass: 0.8}", "model=exact_gp"],
            "nominal: needs model=difference_gp",
        ),
        (
            ["run", "system=gymnasium"],
            "system.environment: this setting has no default",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_clear_line(arguments, message, tmp_path):
    (tmp_path / "system").mkdir()
    rows = {
        "short": "[x[1]]",
        "hollow": "[x[1], 0 * float('nan')]",
        "weights": "[x[1], u[0]]",
        "root": "[x[1], u[0]]",
    }
    for name, rates in rows.items():
        text = (
            f"state_names, input_names = ('a', 'b'), ('u',)\n"
            f"    def derivative(self, x, u): return {rates}\n"
        )
        limits = (
            "name='nan', input_lower=[-1], input_upper=[1], region=[[-1, -1], [1, 1]]"
        )
        factory = (
            f"from gpmpc.systems import System\nclass D:\n    {text}\n"
            f"def make(): return System(D(), 0.1, {limits})\n"
            "def h(x): return (x[:, 0] - 1).sqrt()\n"
        )
        (tmp_path / f"{name}_module.py").write_text(factory)
        h = "{_target_: hydra.utils.get_method, path: root_module.h}"
        kept = (
            f"[{{_target_: gpmpc.mpc.Inequality, h: {h}}}]" if name == "root" else "[]"
        )
        weights = "[1, 1, 1]" if name == "weights" else "[1, 1]"
        problem = f"{{cost: {{Q: {weights}, R: [1]}}, constraints: {kept}}}"
        (tmp_path / "system" / f"{name}.yaml").write_text(
            "# @package _global_\ndefaults: [override /trajectory: goal, override "
            "/data: random, _self_]\n"
            f"system: {{_target_: {name}_module.make}}\n"
            f"controller: {{problem: {problem}}}\n"
        )
    before = sorted(tmp_path.rglob("*.*"))
    done = forked(*arguments, cwd=tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert message in done.stderr
    assert [
        path for path in sorted(tmp_path.rglob("*.*")) if "__pycache__" not in str(path)
    ] == before
