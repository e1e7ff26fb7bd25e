"""One flight and many, as a user meets them: results, resumption, clear mistakes."""

import importlib.util
import json
import os
import shutil
import signal
import time

import numpy as np
import pytest

from gpmpc.recording import read_run, replay
from tests.cli.command import begun, forked, gpmpc, start

TINY = ["data.samples=25", "model.restarts=0", "steps=3", "horizon=1"]
SWEPT = ["run", "-m", *TINY, "data.size=10,20", "seed=range(2)"]


def results(tree):
    """Every finished run's metrics by folder, without times and what made them."""
    metrics = {}
    for path in tree.glob("*/metrics.json"):
        metrics[path.parent.name] = content = json.loads(path.read_text())
        assert content.pop("times")
        assert content.pop("provenance")
    return metrics


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    cwd = tmp_path_factory.mktemp("single")
    disturbances = (
        "disturbances=[{_target_: gpmpc.simulation.Dropout, start: 2, stop: 3}]"
    )
    return cwd, forked(
        "run", *TINY, "steps=4", "seed=7", disturbances, "folder=tree", cwd=cwd
    )


def test_a_run_leaves_a_folder_that_says_everything(single):
    cwd, done = single
    assert done.returncode == 0, done.stderr
    for text in (
        "4 steps of translational along elliptical",
        "RMSE [m]",
        "INVALID_MEASUREMENT 1",
        "25 rows",
    ):
        assert text in done.stdout
    (folder,) = (cwd / "tree").iterdir()
    assert sorted(path.name for path in folder.iterdir()) == [
        ".lock",
        "config.yaml",
        "metrics.json",
        "run.mcap",
    ]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert set(metrics["rmse"]) == {"x", "y", "z", "total"}
    assert metrics["rmse"]["total"] < 1
    assert metrics["failures"] == {"INVALID_MEASUREMENT": 1}
    assert metrics["violations"]["inputs"]["steps"] == 4
    assert metrics["settings"]["options"]["controller"] == "convex"
    assert metrics["seed"] == 7
    decision = {"model", "build", "solve", "total"}
    assert set(metrics["times"]) == {"training", "run", *decision}
    assert metrics["provenance"]["command"].startswith("gpmpc run data.samples=25")
    assert metrics["provenance"]["versions"]["torch"]


def test_the_recording_holds_the_flight_and_its_decisions(single):
    cwd, _ = single
    (path,) = (cwd / "tree").glob("*/run.mcap")
    run = read_run(path)
    metrics = json.loads((path.parent / "metrics.json").read_text())
    assert run.finished
    assert run.failed.tolist() == [False, False, True, False]
    assert np.isnan(run.measured[2]).all()
    assert np.isnan(run.innovations[0]).all()
    assert np.allclose(
        run.innovations[1], run.measured[1] - run.plan_means[0, 1], atol=1e-14
    )
    assert run.input_bounds.tolist() == [[0.0, -0.7, -0.7], [100.0, 0.7, 0.7]]
    assert np.allclose(replay(run, 1).x, run.problems[1].x, atol=1e-9)
    assert run.metadata["run"]["seed"] == "7"
    errors = np.square(
        (run.states - run.references)[1:, ::2]
    )  # x[K] is in the metrics, not in the recording
    assert metrics["rmse"]["total"] ** 2 * 4 >= errors.sum()


def test_a_recorded_flight_is_drawn(single):
    cwd, _ = single
    (folder,) = (cwd / "tree").iterdir()
    done = forked("plot", str(folder), "--to", "figures", cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert {"tracking.png", "inputs.png", "timing.png", "flight.gif"} <= {
        p.name for p in (cwd / "figures").iterdir()
    }
    assert (cwd / "figures" / "flight.gif").read_bytes().startswith(b"GIF89a")
    assert "Ignoring" not in done.stderr


def test_the_attitude_alone_is_flown_and_reported_in_radians(tmp_path):
    settings = [
        "system=rotational",
        "trajectory=lorenz",
        *TINY,
        "steps=70",
        "horizon=3",
        "folder=tree",
    ]
    done = forked("run", *settings, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "70 steps of rotational along lorenz with convex" in done.stdout
    assert "RMSE [rad]" in done.stdout
    (folder,) = (tmp_path / "tree").iterdir()
    run = read_run(folder / "run.mcap")
    assert run.state_names == ("phi", "p", "theta", "q", "psi", "r")
    assert run.metadata["units"]["state.phi"] == "rad"
    assert run.times[1] == 0.05
    assert (
        np.abs(run.states - run.references)[:, ::2].max()
        < 0.02
        < np.ptp(run.references[:, 0])
    )
    assert forked("plot", str(folder), "--to", "figures", cwd=tmp_path).returncode == 0
    assert {path.name for path in (tmp_path / "figures").iterdir()} == {
        "tracking.png",
        "inputs.png",
        "timing.png",
    }
    assert forked("report", "tree", cwd=tmp_path).returncode == 0
    assert "RMSE [rad]" in (tmp_path / "tree" / "report" / "report.md").read_text()


def change_code(folder, code):
    """Makes a finished run one that other code has flown."""
    path = folder / "metrics.json"
    content = json.loads(path.read_text())
    content["provenance"] |= code
    path.write_text(json.dumps(content))
    return content


def test_a_finished_run_of_other_code_stays_and_is_named(single, tmp_path):
    shutil.copytree(single[0] / "tree", tmp_path / "tree")
    (folder,) = (tmp_path / "tree").iterdir()
    original = json.loads((folder / "metrics.json").read_text())
    arguments = ["run", *original["choices"], "folder=tree", "--json"]

    def run_again():
        again = forked(*arguments, cwd=tmp_path)
        assert again.returncode == 0, again.stderr
        assert "finished before" in again.stderr
        said = (
            "these are the numbers of other code (gpmpc 0.0.9); remove the folder to "
            "fly it with this code"
        )
        of_other_code = json.loads(again.stdout)["of_other_code"]
        assert (said in again.stderr) == of_other_code
        return of_other_code

    assert not run_again()
    version = {"git": None, "versions": {"gpmpc": "0.0.9"}}
    for code in (
        {"code": "0" * 32},
        {"code": None},  # of a version that did not say
        {"code": original["provenance"]["code"], "own_code": {"my_robot": "1"}},
    ):
        content = change_code(folder, version | code)
        assert run_again()
        assert json.loads((folder / "metrics.json").read_text()) == content


def test_finished_runs_are_kept_and_other_settings_refused(single):
    cwd, _ = single
    (folder,) = (cwd / "tree").iterdir()
    metrics = json.loads((folder / "metrics.json").read_text())
    arguments = ["run", *metrics["choices"], "folder=tree"]
    again = forked(*arguments, cwd=cwd)
    assert again.returncode == 0, again.stderr
    assert "finished before" in again.stdout
    metrics["settings"]["controller"]["tolerance"] = 1
    (folder / "metrics.json").write_text(json.dumps(metrics))
    other = forked(*arguments, cwd=cwd)
    assert other.returncode == 2
    assert (
        "holds a finished run of other settings (controller.tolerance: 1 then, None "
        "now)" in other.stderr
    )


def test_a_run_says_where_the_users_own_code_has_changed(tmp_path):
    (tmp_path / "my_plant.py").write_text(
        "from gpmpc.systems import pendulum\nMASS = 1.0\n"
        "def make(**settings):\n    return pendulum(mass=MASS)\n"
    )
    own = ["system=pendulum", "system._target_=my_plant.make", "folder=tree"]
    command = ["run", *TINY, *own]
    first = forked(*command, cwd=tmp_path)
    assert first.returncode == 0, first.stderr
    assert "written to" in first.stdout
    again = forked(*command, cwd=tmp_path).stdout
    assert "finished before" in again
    assert "other code" not in again
    (tmp_path / "my_plant.py").write_text(
        (tmp_path / "my_plant.py").read_text().replace("1.0", "1.5")
    )
    changed = forked(*command, cwd=tmp_path).stdout
    assert "finished before" in changed
    assert "these are the numbers of other code" in changed


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["horizn=5"], "unknown setting 'horizn' (did you mean 'horizon'?)"),
        (["-m", "horizn=5,6"], "unknown setting 'horizn' (did you mean 'horizon'?)"),
        (
            ["controller=convx"],
            "controller: no such option 'convx'; available are compiled, convex",
        ),
        (
            ["-m", "controller=lqr,convx"],
            "controller: no such option 'convx'; available are compiled, convex",
        ),
        (["data=paper"], "data.folder: this setting has no default"),
        (["data=paper", "data.folder=nowhere"], "nowhere: no such folder"),
        (
            ["controller=lqr", "propagation=unscented"],
            "propagation: this controller has none to choose",
        ),
        (["recorder=mpac"], "recorder: must be 'mcap' or 'none'; got 'mpac'"),
        (
            ["horizon=1,2"],
            "horizon: a list is written in brackets, horizon=[1,2]; a sweep takes -m",
        ),
        (
            ["system=pendulum", "data=excited"],
            "data: these data are of translational and rotational alone",
        ),
        (
            ["system=pendulum", "trajectory=lorenz"],
            "trajectory: must prescribe angle of pendulum; got positions of 3",
        ),
        (
            ["system=pendulum", "controller.problem.cost.Q=[1,1,1]"],
            "controller.problem: weighs 3 states and 1 inputs",
        ),
        (["system=pendulm"], "system: no such option 'pendulm'"),
        (
            ["system._target_=builtins.dict"],
            "system: _target_ must name a function that returns",
        ),
        (["folder=null"], "folder: must be the path of a folder; got None"),
        (["folder="], "folder: must be the path of a folder; got ''"),
        (["horizon=0"], "horizon: must be a whole number, 1 or more; got 0"),
        (["-m", "horizon=1,0"], "horizon: must be a whole number, 1 or more; got 0"),
        (
            ["-m", "data.size=[]"],
            "data.size: must be a whole number, 1 or more; got []",
        ),
        (["-m", "seed=range(0)"], "seed: holds no value to sweep over"),
        (
            ["seed=range(3"],
            "'seed=range(3': cannot be read; a setting is written SETTING=VALUE",
        ),
        (["controller=papre"], "state_form (did you mean 'paper'?)"),
        (
            ["--hlep"],
            "unknown option '--hlep' (did you mean '--help'?); gpmpc run --help lists "
            "what there is",
        ),
        (
            ["noise.process=0.1"],
            "noise.process: must be a list of standard deviations, one for every "
            "state; got 0.1",
        ),
        (
            ["noise.process=[0.1]"],
            "noise.process must have 6 standard deviations; got 1",
        ),
        (["disturbances=gust"], "disturbances: must be a list; got 'gust'"),
        (
            ["disturbances=[{rates: {vx: 1}}]"],
            "disturbances: must each name what it is",
        ),
        (
            ["disturbances=[{_target_: gpmpc.simulation.Gst}]"],
            "no such class or function 'gpmpc.simulation.Gst'",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_clear_line_and_leaves_nothing_behind(
    arguments, message, tmp_path
):
    done = forked("run", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_mistake_found_in_flight_is_kept_with_its_traceback(tmp_path):
    done = forked("run", *TINY, "data.size=26", cwd=tmp_path)
    assert done.returncode == 2
    assert "data.size: must be at most 25, the rows of the data; got 26" in done.stderr
    assert done.stderr.count("\n") == 1
    (path,) = tmp_path.glob("outputs/run/*/error.json")
    assert "Traceback" in json.loads(path.read_text())["traceback"]
    assert not (path.parent / "metrics.json").exists()


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    """Four runs, one after another."""
    cwd = tmp_path_factory.mktemp("sweep")
    done = forked(*SWEPT, "folder=tree", cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert "4 runs: 4 flown, 0 finished before, 0 failed" in done.stdout
    assert "4/4" in done.stdout
    return cwd / "tree", results(cwd / "tree")


def test_a_sweep_flies_every_combination(sweep):
    tree, metrics = sweep
    assert len(metrics) == 4
    assert len({tuple(content["choices"]) for content in metrics.values()}) == 4
    assert len({content["rmse"]["total"] for content in metrics.values()}) == 4
    assert "data.size=10,data.samples=25" not in metrics
    (plan,) = tree.glob("sweep-*.json")
    assert sorted(json.loads(plan.read_text())["runs"]) == sorted(
        c["choices"] for c in metrics.values()
    )


def test_status_says_in_a_line_how_far_a_sweep_is(sweep, tmp_path):
    tree = tmp_path / "tree"
    shutil.copytree(sweep[0], tree)
    (path, *_) = sorted(tree.glob("*/metrics.json"))
    path.with_name("error.json").write_text('{"error": "no such data"}')
    path.unlink()
    done = forked("status", "tree", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "4 runs: 3 finished, 1 failed; 1 failed: no such data\n"
    data = json.loads(forked("status", "tree", "--json", cwd=tmp_path).stdout)
    assert (data["runs"], data["finished"], data["failed"]) == (4, 3, 1)
    assert data["failures"] == {"no such data": 1}
    nothing = forked("status", "nowhere", cwd=tmp_path)
    assert nothing.returncode == 2
    assert nothing.stderr == "gpmpc: nowhere: no such folder\n"


def needs(module):
    """A launcher that an extra brings; tried out by hand."""
    missing = pytest.mark.skipif(
        importlib.util.find_spec(module) is None, reason=f"{module} is not installed"
    )
    return [pytest.mark.slow, missing]


@pytest.mark.parametrize(
    "launcher",
    [
        "joblib",
        pytest.param("ray", marks=needs("ray")),
    ],
)
def test_every_launcher_gives_the_same_numbers(launcher, sweep, tmp_path):
    words = [f"launcher={launcher}", "chunk=1"]
    if launcher == "joblib":
        words.append("hydra.launcher.n_jobs=2")
    done = gpmpc(*SWEPT, "folder=tree", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "4/4" in done.stdout
    # Both runs of ten rows would say it.
    assert done.stderr.count("fewer than a plane needs") == 1
    assert results(tmp_path / "tree") == sweep[1]


def test_a_killed_sweep_goes_on_as_if_nothing_had_happened(sweep, tmp_path):
    tree = tmp_path / "tree"
    killed = start(*SWEPT, "folder=tree", cwd=tmp_path)
    deadline = time.monotonic() + 120
    while not list(tree.glob("*/metrics.json")) and time.monotonic() < deadline:
        time.sleep(0.01)
    time.sleep(np.random.default_rng().uniform(0, 0.4))
    os.killpg(killed.pid, signal.SIGKILL)
    killed.wait()
    assert 0 < len(results(tree)) < 4
    done = forked(*SWEPT, "folder=tree", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert results(tree) == sweep[1]


def test_a_sweep_refuses_a_finished_run_of_other_settings(sweep, tmp_path):
    tree = tmp_path / "tree"
    shutil.copytree(sweep[0], tree)
    again = forked(*SWEPT, "folder=tree", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert "4 runs: 0 flown, 4 finished before, 0 failed" in again.stdout
    path = sorted(tree.glob("*/metrics.json"))[2]
    metrics = json.loads(path.read_text())
    metrics["settings"]["controller"]["problem"]["cost"]["Q"][0] = 7.0
    metrics["settings"]["gone"] = 1
    path.write_text(json.dumps(metrics))
    (tree / path.parent.name.replace("seed=0", "seed=1") / "metrics.json").unlink()
    refused = forked(*SWEPT, "folder=tree", cwd=tmp_path)
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1
    assert (
        f"folder: tree/{path.parent.name} holds a finished run of other settings"
        in refused.stderr
    )
    assert (
        "controller.problem.cost.Q: [7.0, 1.0, 1.0, 1.0, 1.0, 1.0] then, [1.0, 1.0"
        in refused.stderr
    )
    assert "gone: 1 then, None now" in refused.stderr
    assert "choose another folder, or remove that one to fly it again" in refused.stderr
    assert (
        json.loads(path.read_text()) == metrics
    )  # nothing was overwritten, nothing else flown
    assert len(list(tree.glob("*/metrics.json"))) == 3


def test_a_sweep_and_a_report_count_the_runs_of_other_code(sweep, tmp_path):
    tree = tmp_path / "tree"
    shutil.copytree(sweep[0], tree)
    first, second, *_ = sorted(path.parent for path in tree.glob("*/metrics.json"))
    for folder in (first, second):
        change_code(
            folder,
            {
                "code": "0" * 32,
                "git": {"commit": "0123456789abcdef"},
                "versions": {"gpmpc": "0.0.9"},
                "created": "2020-02-02T02:02:02+00:00",
            },
        )
    said = (
        "2 of the runs that were finished before were flown by other code "
        "(gpmpc 0.0.9, commit 0123456789): remove their folders"
    )
    again = forked(*SWEPT, "folder=tree", cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert "4 runs: 0 flown, 4 finished before, 0 failed" in again.stdout
    assert said in again.stdout
    counted = json.loads(forked(*SWEPT, "folder=tree", "--json", cwd=tmp_path).stdout)
    assert counted["of_other_code"] == [f"tree/{first.name}", f"tree/{second.name}"]
    reported = forked("report", "tree", cwd=tmp_path)
    assert reported.returncode == 0, reported.stderr
    mixed = "mixed code: the finished runs are of different code, and may differ for"
    assert mixed in reported.stdout
    assert "2 of 0123456789 (last 2020-02-02); 2 of " in reported.stdout
    assert "Mixed code" in (tree / "report" / "report.md").read_text()
    shutil.rmtree(first)
    shutil.rmtree(second)
    flown = forked(*SWEPT, "folder=tree", cwd=tmp_path)
    assert "4 runs: 2 flown, 2 finished before, 0 failed" in flown.stdout
    assert "other code" not in flown.stdout
    assert "mixed code" not in forked("report", "tree", cwd=tmp_path).stdout


def test_two_sweeps_share_a_tree(sweep, tmp_path):
    both = [begun(*SWEPT, "folder=tree", cwd=tmp_path) for _ in range(2)]
    try:
        for process in both:
            process.join(240)
        assert [process.exitcode for process in both] == [0, 0]
    finally:
        for process in both:
            process.kill()  # where they wait for each other
    assert results(tmp_path / "tree") == sweep[1]


def test_failed_runs_are_named_and_stop_nothing(tmp_path):
    swept = ["steps=1", "recorder=none", "data.size=12,16,99", "seed=0,1", "folder=t"]
    done = forked("run", "-m", *TINY, *swept, cwd=tmp_path)
    assert done.returncode == 1
    assert "6 runs: 4 flown, 0 finished before, 2 failed" in done.stdout
    lines = done.stderr.splitlines()
    assert len(lines) == 2
    assert all(
        "data.size=99" in line and "must be at most 25" in line for line in lines
    )
    assert len(results(tmp_path / "t")) == 4
    reported = forked("report", "t", cwd=tmp_path)
    assert reported.returncode == 0, reported.stderr
    assert "4 finished in 3 cells, 2 failed, 0 missing" in reported.stdout
    assert reported.stdout.count("failed: ") == 2
    assert "to fill: gpmpc run -m" in reported.stdout
    assert "data.size=99 seed=0,1 folder=t" in reported.stdout
