"""Settings in a recording are data: what is not listed is not called nor imported."""

import json
import os
import sys
import time
from functools import cache
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from gpmpc.cli._plain_settings import plain_data
from gpmpc.cli._recorded import errors_of_settings, experiment_of_run
from gpmpc.cli._recorded_settings import checked_settings, read_settings
from gpmpc.cli._settings import compose, settings_folders
from gpmpc.exceptions import DataError, SettingError
from gpmpc.recording import read_run
from tests.cli.command import copied_process, forked
from tests.recording import runs

CANARY = "canary_of_the_tests"
TEXT = """
from pathlib import Path
Path(__file__).with_name("fired").touch()
from gpmpc.systems import translational
def vehicle(mass=0.74): return translational(mass=mass)
def write(*given, **named): Path(__file__).with_name("fired").touch()
import numpy as np
"""


@cache
def _flight(*words):
    with settings_folders():
        return json.dumps(plain_data(compose("run", ["data.samples=12", *words])))


def flight(*words):
    """Settings of a flight as it records them."""
    return json.loads(_flight(*words))


def put(document, place, value):
    """Settings with a value at a dotted place."""
    *parents, last = place.split(".")
    node = document
    for key in parents:
        node = node[key]
    node[last] = value
    return document


def write(text):
    return {"_target_": "pathlib.Path.write_text", "_args_": [text, "x"]}


def environment(name, **more):
    target = "gpmpc.systems.gymnasium_.gymnasium_system"
    return {"_target_": target, "environment": name, **more}


def six_hostile_settings():
    """Settings that would write or run something: at the top, inside, and deep."""
    canary = {"_target_": f"{CANARY}.write"}
    deep = [[{"a": [{"b": {"_target_": "numpy.save", "file": "x", "arr": [1]}}]}]]
    whole = {"_target_": "gpmpc._files.write_whole", "path": "x", "content": "x"}
    alias = {"_target_": "gpmpc._files.os.system", "_args_": ["touch fired"]}
    copied = {"_target_": "shutil.copyfile", "src": "/etc/hostname", "dst": "fired"}
    return {
        "system": put(flight(), "system", write("fired")),
        "module": put(flight(), "model.scaling", canary | {"_partial_": True}),
        "arguments": put(
            flight(), "controller.problem.cost.Q", {"_args_": [whole], "x": dict(whole)}
        ),
        "plant": put(
            put(flight(), "system", environment("CartPole-v1")),
            "plant",
            {"environment": f"{CANARY}:Env"},
        ),
        "lists": put(flight(), "disturbances", deep),
        "unused": put(
            flight(), "hydra", [{"_recursive_": False, "z": [alias, copied]}]
        ),
    }


def record(path, document):
    """A recording with settings, given as data or as text."""
    text = (
        document
        if isinstance(document, str)
        else OmegaConf.to_yaml(OmegaConf.create(document))
    )
    runs.record_run(path, steps=3, config=text)
    return path


@pytest.fixture
def folder(tmp_path):
    """A working folder with a module that tells when it is imported."""
    (tmp_path / f"{CANARY}.py").write_text(TEXT)
    return tmp_path


@pytest.mark.parametrize("words", [["calibrate"], ["plot", "--film"]], ids=" ".join)
def test_a_hostile_recording_is_refused_and_nothing_happens(words, folder):
    record(folder / "run.mcap", six_hostile_settings()["module"])
    before = sorted(path.name for path in folder.iterdir())
    done = forked(*words, "run.mcap", cwd=folder)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert f"--trust {CANARY}" in done.stderr
    assert "model.scaling._target_" in done.stderr
    assert sorted(path.name for path in folder.iterdir()) == before


@pytest.mark.parametrize("name", [*six_hostile_settings()])
def test_settings_that_call_other_code_are_refused_at_any_depth(name):
    document = six_hostile_settings()[name]
    with pytest.raises(DataError, match=r"its settings (call|import) '") as refusal:
        experiment_of_run(run_of(document), [])
    assert "\n" not in str(refusal.value)
    assert str(refusal.value).startswith("run.mcap: ")


def run_of(document):
    """What ``read_run`` would return of a recording with these settings, in part."""

    class Run:
        path = Path("run.mcap")
        config = document if isinstance(document, str) else yaml.safe_dump(document)
        state_names = runs.STATES
        input_names = runs.INPUTS

    return Run


NOT_CALLED = [
    "os.system",
    "builtins.eval",
    "builtins.exec",
    "subprocess.run",
    "pickle.loads",
    "numpy.load",
    "torch.load",
    "gpmpc._files.write_whole",
    "gpmpc._files.os.system",
    "gpmpc.gp.Transitions.load",
    "gpmpc.gp.save_posterior",
    "gpmpc.models.save_model",
    "gpmpc.recording.recover",
    "gpmpc.systems._simulators.library",
    "gpmpc.systems._simulators.import_module",
    "gpmpc.cli._run.run_one",
    "gpmpc.cli._experiment.instantiate",
    "gpmpc.systems.gymnasium_.register_environments",
    "gpmpc.systems.gymnasium_.make_environment",
    "gpmpc.systems.pendulum.__globals__",
    "gpmpc.systems.System.__init__",
    "gpmpc",
    "hydra.utils.instantiate",
    "hydra.utils.call",
    "omegaconf.OmegaConf.load",
    "functools.partial",
    "importlib.import_module",
    "gpmpc.systems .pendulum",
    "gpmpc.systems.pendulum\n",
    "",
    "gpmpc.systems:pendulum",
    "GPMPC.systems.pendulum",
    "_frozen_importlib.__import__",
    "antigravity",
    "webbrowser.open",
]


@pytest.mark.parametrize("target", NOT_CALLED)
@pytest.mark.parametrize(
    "place",
    [lambda t: t, lambda t: {"x": [{"y": t}]}, lambda t: {"_args_": [[t]]}],
    ids=["here", "in a list", "in arguments"],
)
def test_what_is_not_on_the_list_is_not_called(target, place):
    modules = {*sys.modules}
    with pytest.raises(DataError, match=r"its settings (call|name)") as refusal:
        checked_settings({"a": place({"_target_": target})}, ["my_robot"])
    assert "\n" not in str(refusal.value)
    assert {*sys.modules} == modules


@pytest.mark.parametrize(
    ("call", "rule"),
    [
        ({"_target_": 3}, "name nothing at a._target_"),
        ({"_target_": ["gpmpc.systems.pendulum"]}, "name nothing"),
        ({"_target_": None}, "name nothing"),
        ({"_target_": "gpmpc.systems.pendulum", "_partial_": "yes"}, "true or false"),
        ({"_target_": "gpmpc.systems.pendulum", "_recursive_": 0}, "true or false"),
        ({"_target_": "gpmpc.systems.pendulum", "_convert_": "x"}, "a word of Hydra's"),
        ({"_target_": "gpmpc.systems.pendulum", "_args_": {"a": 1}}, "must be a list"),
        ({"_target_": "gpmpc.systems.pendulum", "_call_": 1}, "a._call_, which means"),
        ({"x": [{"__class__": "os.system"}]}, r"a.x\[0\].__class__, which means"),
        (
            {"_target_": "hydra.utils.get_method", "path": "os.system"},
            "call 'os.system'",
        ),
        (
            {"_target_": "hydra.utils.get_method", "_args_": ["os.system"]},
            "name nothing",
        ),
        (
            {
                "_target_": "hydra.utils.get_class",
                "path": "my_robot.A",
                "_args_": ["os.b"],
            },
            "look code up in another way",
        ),
        ({"_target_": "hydra.utils.get_object", "path": "canary.x"}, "--trust canary"),
        (environment("canary:Env-v0"), "import 'canary' .*--trust canary"),
        (environment("os:Env"), "import 'os'"),
        (environment("Ant-v5", make={"xml_file": "x.xml"}), "--trust gymnasium"),
        (environment("Ant-v5", _args_=["canary:Env"]), "arguments by their names"),
        (
            {
                "_target_": "gpmpc.qp.CvxpySolver",
                "options": {"write_data_filename": "x"},
            },
            "--trust cvxpy",
        ),
        (
            {"_target_": "gpmpc.mpc.baselines.StateFormMPC", "options": {"a": 1}},
            "--trust cvxpy",
        ),
        ({"_target_": "gpmpc.qp.CvxpySolver", "_args_": ["SCS", {"a": 1}]}, "by their"),
    ],
    ids=lambda value: str(value)[:60],
)
def test_a_call_that_is_written_in_another_way_is_refused(call, rule):
    with pytest.raises(DataError, match=rule):
        checked_settings({"a": call}, [])


def aliases(levels):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    for i in range(1, levels):
        inner = ", ".join([f"*a{i - 1}"] * 9)
        lines.append(f"a{i}: &a{i} [{inner}]")
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        (aliases(7), "a YAML alias"),
        ("a: &x 1\nb: *x", "a YAML alias"),
        ("a: !!python/object/apply:pathlib.Path [x]", "a YAML tag"),
        ("a: !!binary aGVsbG8=", "a YAML tag"),
        ("a: ${oc.env:HOME}", "an interpolation"),
        ("a: 'x ${b} y'", "an interpolation"),
        ("'${a}': 1", "an interpolation"),
        ("a: \"\\x24{oc.decode:'1'}\"", "an interpolation"),
        ("a: \\${b}", "an interpolation"),
        ("[" * 5000, "nested deeper"),
        ("a: " + "[" * 100 + "]" * 100, "nested deeper"),
        ("a: 1\n" * 20000, "longer than"),
        ("a: [" + "1," * 30000 + "]", "more than 4000 entries"),
        (f"a: {'9' * 4900}", "cannot be read"),
        (f"a: {'9' * 6000}", "an entry of more than"),
        ("a: 1\na: 2", "cannot be read .*duplicate key"),
        ("a: 1\n--- \nb: 2", "cannot be read"),
        ("- 1", "no names with values"),
        ("a: [", "cannot be read"),
        ("a: \x00", "cannot be read"),
        ("? [1, 2]\n: 3", "cannot be read"),
    ],
    ids=lambda value: value[:40],
)
def test_settings_other_than_plain_names_and_values_are_refused(text, rule):
    began = time.process_time()
    with pytest.raises(DataError, match=rule) as refusal:
        read_settings(text)
    assert "\n" not in str(refusal.value)
    assert time.process_time() - began < 2.0


@pytest.mark.parametrize(
    "text",
    [
        "a: [" + "1," * 1990 + "1]",
        "a:\n" + "- -\n" * 1900,
        "a: [" + "[1]," * 900 + "]",
        "a:\n" + ("- " + "[" * 18 + "1" + "]" * 18 + "\n") * 200,
    ],
    ids=["numbers", "lists", "flow", "deep"],
)
def test_the_largest_settings_are_read_in_a_second_or_two(text):
    began = time.process_time()
    assert read_settings(text)["a"]
    assert time.process_time() - began < 4.0


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["system=pendulum", "controller=lqr", "plant.mass=1.1"],
        ["controller=state_form", "trajectory=lorenz"],
        ["nominal={mass: 0.8}", "solver=clarabel", "learning=online"],
        [
            "system=translational",
            "data=nmpc",
            "controller=nonlinear",
            "propagation=unscented",
        ],
        [
            "disturbances=[{_target_: gpmpc.simulation.Gust, rates: {vx: 0.5}, start: "
            "2}]"
        ],
    ],
    ids=" ".join,
)
def test_an_ordinary_flights_settings_describe_the_same_flight(words):
    from gpmpc.cli._experiment import experiment_of, experiment_of_file

    document = flight(*words)
    with settings_folders():
        expected = experiment_of(OmegaConf.create(document))
    text = OmegaConf.to_yaml(OmegaConf.create(document))
    experiment = experiment_of_file(read_settings(text), [])
    for key in ("data", "trajectory", "train", "steps", "learning", "disturbances"):
        assert repr(getattr(experiment, key)) == repr(getattr(expected, key))
    for ours, theirs in (
        (experiment.system, expected.system),
        (experiment.plant_in_loop, expected.plant_in_loop),
    ):
        assert vars(ours.dynamics) == vars(theirs.dynamics)
        assert (ours.time_step, ours.nominal is None) == (
            theirs.time_step,
            theirs.nominal is None,
        )
    assert {*experiment.controller.keywords} == {*expected.controller.keywords}


def test_a_trusted_package_may_call_only_its_own_code(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, CANARY, raising=False)
    own = put(flight(), "system", {"_target_": f"{CANARY}.vehicle", "mass": 0.8})
    with pytest.raises(DataError, match=f"--trust {CANARY}"):
        experiment_of_run(run_of(own), [])
    assert str(folder) not in sys.path
    assert not (folder / "fired").exists()
    system = experiment_of_run(run_of(own), [CANARY]).system
    assert system.dynamics.mass == 0.8
    (folder / "fired").unlink()
    for name in ("np.save", "Path.write_text", "Path"):
        hostile = put(flight(), "model.scaling", {"_target_": f"{CANARY}.{name}"})
        with pytest.raises(DataError, match=f"which {CANARY} only imports"):
            experiment_of_run(run_of(hostile), [CANARY])
    with pytest.raises(DataError, match="cannot be imported here"):
        experiment_of_run(
            run_of(put(flight(), "model", {"_target_": f"{CANARY}.nothing"})), [CANARY]
        )
    with pytest.raises(SettingError, match="--trust: os is no package to trust"):
        experiment_of_run(run_of(own), ["os"])
    hostile = put(own, "model.scaling", {"_target_": "shutil.rmtree", "path": "x"})
    monkeypatch.delitem(sys.modules, CANARY)
    with pytest.raises(DataError, match=r"shutil.rmtree.*which no settings"):
        experiment_of_run(run_of(hostile), [CANARY])
    assert not (folder / "fired").exists()  # names are compared before any import


def test_the_caller_says_whom_a_saved_model_may_trust():
    model = {"_target_": "gpmpc.logs.load_flyable", "path": "x", "trusted": ["evil"]}
    for trusted in ([], ["my_robot"]):
        assert checked_settings(model, trusted)["trusted"] == trusted
        assert checked_settings([{"a": model}], trusted)[0]["a"]["trusted"] == trusted


@pytest.mark.parametrize(
    "change",
    [
        lambda f: put(f, "system", 5),
        lambda f: put(f, "system", None),
        lambda f: put(f, "controller", "x"),
        lambda f: put(f, "trajectory", {"a": 1, "b": 2}),
        lambda f: put(f, "disturbances", {"a": 1}),
        lambda f: put(f, "data", {"size": None}),
        lambda f: put(f, "data", {"_target_": "gpmpc.trajectories.Hover", "size": 3}),
        lambda f: put(f, "plant", [1]),
        lambda f: put(f, "nominal", 3),
        lambda f: put(f, "noise", 3),
        lambda f: put(f, "horizon", "many"),
        lambda f: put(f, "controller.problem", 3),
        lambda f: put(f, "system", {"_target_": "gpmpc.systems.pendulum", "mass": "x"}),
        lambda f: put(f, "system", {"_target_": "gpmpc.systems.pendulum", "weight": 1}),
        lambda f: put(f, "system", {"_target_": "gpmpc.systems.pendulum"}),
        lambda f: put(f, "data.samples", "???"),
        lambda f: put(f, "model", {"_target_": "gpmpc.qp.DualActiveSet"}),
        lambda f: {key: f[key] for key in ("system", "controller", "folder")},
        lambda f: put(
            f,
            "controller.problem.cost",
            {"_target_": "gpmpc.systems.pendulum", "Q": [1], "R": [1]},
        ),
        lambda f: put(f, "seed", [1]),
        lambda f: put(f, "steps", 1.5),
        lambda f: put(f, "loop", {}),
    ],
)
def test_settings_of_no_flight_get_one_line_with_the_files_name(change):
    def learn():
        experiment = experiment_of_run(run_of(change(flight())), [])
        with errors_of_settings(run_of("")):
            experiment.learn(experiment.training_rows(), 0)

    with pytest.raises(DataError, match=r"^run\.mcap: [^\n]+$"):
        learn()


def test_a_recording_and_its_settings_must_be_of_one_system():
    document = flight("system=pendulum", "controller=lqr")
    with pytest.raises(DataError, match="describe another system than it recorded"):
        experiment_of_run(run_of(document), [])


# The twelve hostile files: six recordings of above, six models of
# tests/models/test_hostile_models.py.

WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
ACTING = (
    "import",
    "subprocess.",
    "socket.",
    "shutil.",
    "os.system",
    "os.exec",
    "os.fork",
    "os.spawn",
    "os.posix_spawn",
    "os.rename",
    "os.remove",
    "os.mkdir",
    "os.rmdir",
    "os.link",
    "os.symlink",
    "os.truncate",
    "os.chmod",
    "os.chown",
    "os.utime",
    "os.putenv",
    "ctypes.",
    "webbrowser.",
    "urllib.",
    "pickle.find_class",
    "pty.",
    "signal.",
    "sqlite3.",
)


class Watch:
    """Notes, and stops, whatever a file may not lead to while it is read."""

    def __init__(self):
        self.on = False
        self.seen = []
        sys.addaudithook(self)

    def __call__(self, event, arguments):
        if not self.on:
            return
        acts = event.startswith(ACTING)
        if event == "open":
            mode = arguments[1] or ""
            flags = arguments[2] or 0
            acts = bool({*"wax+"} & {*str(mode)}) or bool(flags & WRITING)
        if acts:
            self.seen.append(f"{event} {arguments!r:.200}")
            raise PermissionError(f"{event} while a file is read")


def read_hostile(folder, outcome_file):
    """Reads every file of a folder under a watch and writes what happened."""
    os.chdir(folder)
    sys.path.insert(0, str(folder))  # the worst case: what a file names can be imported
    from gpmpc.logs import load_flyable
    from gpmpc.models import load_model

    def calibrate(path):
        experiment_of_run(read_run(path), [])

    for road in (load_model, load_flyable):
        road(folder / "good.safetensors")
    calibrate(folder / "good.mcap")
    watch = Watch()
    outcomes = {}
    for path in sorted(folder.glob("hostile*")):
        roads = (calibrate,) if path.suffix == ".mcap" else (load_model, load_flyable)
        for road in roads:
            try:
                watch.on = True
                road(path)
                outcome = "read"
            except DataError as error:
                outcome = str(error)
            except Exception as error:
                outcome = f"escaped: {error!r}"
            finally:
                watch.on = False
            outcomes[f"{path.name} by {road.__name__}"] = outcome
    outcome_file.write_text(json.dumps({"outcomes": outcomes, "seen": watch.seen}))


def test_twelve_hostile_files_are_refused_and_none_acts(folder, tmp_path_factory):
    """Nothing is imported, called or written."""
    from gpmpc.models import save_model
    from tests.gp.small_models import residual_model
    from tests.models.test_hostile_models import six_hostile_models

    save_model(residual_model(), folder / "good.safetensors")
    for name, content in six_hostile_models(
        folder / "good.safetensors", CANARY
    ).items():
        (folder / f"hostile_{name}.safetensors").write_bytes(content)
    record(folder / "good.mcap", flight())
    for name, document in six_hostile_settings().items():
        record(folder / f"hostile_{name}.mcap", document)
    before = sorted(path.name for path in folder.iterdir())
    outcome_file = tmp_path_factory.mktemp("outcome") / "outcome.json"
    process = copied_process(target=read_hostile, args=(folder, outcome_file))
    process.start()
    process.join(120)
    assert process.exitcode == 0
    observed = json.loads(outcome_file.read_text())
    assert observed["seen"] == []
    assert len(observed["outcomes"]) == 6 + 2 * 6
    for name, outcome in observed["outcomes"].items():
        assert outcome.startswith(str(folder / name.partition(" by ")[0])), (
            name,
            outcome,
        )
        assert "\n" not in outcome
    after = sorted(path.name for path in folder.iterdir())
    assert [name for name in after if name != "__pycache__"] == before


@pytest.mark.parametrize(
    "words",
    [
        ["completion", "--line", "gpmpc run sys"],
        ["run", "--help"],
        ["run", "--cfg"],
        ["run", "data.samples=12", "horizon=-1"],
    ],
    ids=" ".join,
)
def test_a_folder_of_somebody_else_brings_no_plugin(words, tmp_path):
    plugin = tmp_path / "hydra_plugins" / "plugin.py"
    plugin.parent.mkdir()
    plugin.write_text(
        "from pathlib import Path\nPath(__file__).with_name('fired').touch()\n"
    )
    forked(*words, cwd=tmp_path)
    assert not plugin.with_name("fired").exists()


def test_a_saved_model_flies_by_ones_own_trusted_code(tmp_path, monkeypatch):
    import torch

    from gpmpc.models import ResidualModel, save_model
    from tests.gp.small_models import posterior

    (tmp_path / "mass_of_mine.py").write_text(
        "import torch\ndef moved(x, u):\n"
        "    return x + 0.1 * torch.cat([x[..., 1:], u], dim=-1)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    from mass_of_mine import moved  # pyright: ignore[reportMissingImports]

    effect = torch.tensor([[0.0], [1e-3]], dtype=torch.float64)
    gp = posterior(n=1, m=1, predicts="value")
    model = ResidualModel(moved, gp, effect, [1], [0], 1)
    save_model(model, tmp_path / "mass.safetensors")
    words = ["run", "system=double_integrator", "steps=3", "folder=tree"]
    words += ["model=mass.safetensors", "controller=lqr"]
    refused = forked(*words, cwd=tmp_path)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "gpmpc run model.trusted=[mass_of_mine]" in refused.stderr
    wrong = forked(*words, "model.trusted=mass_of_mine", cwd=tmp_path)
    assert "model.trusted: must be a list of packages" in wrong.stderr
    done = forked(*words, "model.trusted=[mass_of_mine]", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
