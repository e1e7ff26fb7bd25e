"""Crafted models with right checksums import nothing; errors are one line."""

import copy
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError
from gpmpc.gp import Transitions
from gpmpc.gp.casadi_ import function_of_tape
from gpmpc.logs import load_flyable, load_learned
from gpmpc.models import DelayedModel, ResidualModel, load_model, save_model
from tests.cli.command import copied_process
from tests.gp.model_files import content_of, parts_of, write
from tests.gp.small_models import posterior, residual_model
from tests.models import hostile
from tests.models.hostile import with_code, with_operations

CANARY = "canary_of_the_models"


def code(kind, name, **parameters):
    return {"kind": kind, "path": name, "parameters": parameters}


def six_hostile_models(good, canary):
    """Contents of six files that would run something, inside none to two wrappers."""
    header, arrays = parts_of(good)
    for name in ("nominal/A", "nominal/B", "nominal/c"):
        del arrays[name]
    system = code("casadi", "subprocess:call", args=["touch", "fired"])

    def residual(nominal, **changed):
        return header | {"nominal": nominal} | changed

    def wrapped(inner, depth):
        for _ in range(depth):
            inner = {"kind": "DelayedModel", "model": inner, "delay": 1.5}
        return inner

    headers = {
        "command": residual(system),
        "module": residual(code("function", f"{canary}:write")),
        "geohash": wrapped(residual(code("function", "antigravity:geohash")), 1),
        "writes": wrapped(
            residual(
                code("partial", "gpmpc._files:write_whole", path="x", content="x")
            ),
            1,
        ),
        "alias": wrapped(
            residual(code("casadi", "gpmpc._files:os.system", command="x")), 2
        ),
        "dataclass": wrapped(
            residual(
                code("function", "gpmpc.systems:sin"),
                B=code("dataclass", f"{canary}:A"),
            ),
            2,
        ),
    }
    contents = {}
    for name, found in headers.items():
        prefix = ""
        inner = found
        while "model" in inner:
            prefix = f"{prefix}model/"
            inner = inner["model"]
        own = {f"{prefix}{key}": array for key, array in arrays.items()}
        whole = {
            key: header[key] for key in ("format", "format_version", "kernel")
        } | found
        whole["memory_order"] = {
            f"{prefix}{key}": order for key, order in header["memory_order"].items()
        }
        contents[name] = content_of(whole, own)
    return contents


@pytest.fixture
def saved(tmp_path):
    """Writes a model with a changed header and arrays, and the right checksum."""

    def save(model, change=lambda header, arrays: None):
        path = tmp_path / "model.safetensors"
        save_model(model, path)
        header, arrays = parts_of(path)
        change(header, arrays)
        write(path, header, arrays)
        return path

    return save


@pytest.mark.parametrize(
    "name", ["command", "module", "geohash", "writes", "alias", "dataclass"]
)
def test_foreign_code_is_refused_before_anything_is_imported(
    name, tmp_path, monkeypatch
):
    (tmp_path / f"{CANARY}.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    path = tmp_path / "model.safetensors"
    save_model(residual_model(), path)
    path.write_bytes(six_hostile_models(path, CANARY)[name])
    for trusted in ([], ["my_robot"]):
        modules = {*sys.modules}
        with pytest.raises(DataError, match="is the code '") as refusal:
            load_model(path, trusted=trusted)
        assert str(refusal.value).startswith(f"{path}: ")
        assert "\n" not in str(refusal.value)
        assert {*sys.modules} == modules
    with pytest.raises(DataError, match="is the code '"):
        load_flyable(path)
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"{CANARY}.py", path.name]


def test_code_of_a_trusted_package_is_loaded(saved):
    path = saved(with_code())
    with pytest.raises(
        DataError,
        match=r"nominal is the code "
        r"'tests.models.hostile:pull'.*trusted=\['tests'\].*model.trusted=\[tests\]",
    ):
        load_model(path)
    x = torch.ones(1, 2, dtype=torch.float64)
    u = torch.ones(1, 2, dtype=torch.float64)
    for trusted in (["tests"], ("other", "tests.models")):
        loaded = load_model(path, trusted=trusted)
        assert torch.equal(loaded.predict(x, u).mean, with_code().predict(x, u).mean)
        assert load_flyable(path, trusted).model.state_dim == 2
    for wrong in ("tests", ["os"], [3]):
        with pytest.raises(SettingError, match=r"^trusted: "):
            load_model(path, trusted=wrong)
        with pytest.raises(SettingError, match=r"^model\.trusted: "):
            load_flyable(path, wrong)


@pytest.mark.parametrize(
    "path",
    [
        "tests.models.hostile:subprocess.call",
        "tests.models.hostile:np.save",
        "tests:nothing",
        "tests.models.hostile:copy.deepcopy",
        "tests.models.hostile:load_model",
    ],
)
def test_what_a_trusted_package_imports_is_not_its_code(path, saved):
    path = saved(with_code(), lambda h, _: h["nominal"].update(path=path))
    with pytest.raises(DataError, match="only imports|cannot be imported here"):
        load_model(path, trusted=["tests"])


def test_a_function_that_gpmpc_lists_needs_no_trust(saved):
    def sine(header, arrays):
        header["B"] = code("function", "gpmpc.systems._system:sin")
        arrays["noise"] = np.eye(2)
        del arrays["B"]
        header["memory_order"]["noise"] = [0, 1]

    model = load_model(saved(residual_model(), sine))
    x = torch.ones(1, 2, dtype=torch.float64)
    u = torch.ones(1, 2, dtype=torch.float64)
    assert model.predict(x, u).mean.shape == (1, 2)


def change(**fields):
    return lambda header, arrays: header.update(copy.deepcopy(fields))


def sizes(**said):
    return lambda header, arrays: header["nominal"].update(said)


def cells(name, values):
    return lambda header, arrays: arrays.update({name: np.array(values, dtype=float)})


def one_cell(name, row, column, value):
    def changed(header, arrays):
        arrays[name][row, column] = value

    return changed


@pytest.mark.parametrize(
    ("change", "rule"),
    [
        (sizes(shape=[2147483648, 2147483648]), "must map vectors"),
        (sizes(sizes=[10000000, 1]), "must map vectors"),
        (sizes(sizes=[]), "must map vectors"),
        (sizes(sizes=None), "must map vectors"),
        (sizes(shape=[-1, -2]), "must map vectors"),
        (change(input_dim=10**9), "more than 2048"),
        (change(input_dim=-1), "input_dim"),
        (change(input_dim="1"), "input_dim is neither numbers nor"),
        (
            change(nominal=None),
            "nominal is neither numbers nor a part of a model: None",
        ),
        (change(nominal=[1.0]), "nominal: must be a function"),
        (change(B=2.0), "B must be a list"),
        (change(angles=""), "angles is neither"),
        (change(states={}), "states is of an unknown kind"),
        (change(states=[0.5]), "states: must be a list of different indices"),
        (change(residual=None), "residual is neither"),
        (change(residual={"kind": []}), "residual is of an unknown kind"),
        (change(kind=["ResidualModel"]), "holds a"),
        (change(kind="two\nlines"), "holds a two lines"),
        (change(memory_order=3), "damaged"),
        (change(memory_order={"noise": [10**9]}), "damaged"),
        (one_cell("nominal/code", 0, 0, np.nan), "must be finite"),
        (one_cell("nominal/code", 0, 0, 0.5), "whole numbers"),
        (one_cell("nominal/code", 0, 0, 10**6), "no operation 1000000"),
        (one_cell("nominal/code", 0, 2, -1), "whole numbers"),
        (one_cell("nominal/code", 0, 2, 10**9), "do not follow"),
        (one_cell("nominal/code", -1, 1, 99), "has none at 99"),
        (cells("nominal/code", np.zeros((3, 3))), "damaged|of equal length"),
        (cells("noise", np.full((2, 2), np.inf)), "must be finite"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_crafted_model_is_refused_at_once_in_one_line(change, rule, saved):
    path = saved(with_operations(), change)
    began = time.process_time()
    with pytest.raises(DataError, match=rule) as refusal:
        load_model(path)
    assert time.process_time() - began < 2.0
    assert str(refusal.value).startswith(f"{path}: ")
    assert "\n" not in str(refusal.value)


def test_models_inside_each_other_without_end_are_refused(saved):
    for depth in (20, 300, 900):

        def deep(header, arrays, depth=depth):
            inner = {
                key: value for key, value in header.items() if key != "memory_order"
            }
            for _ in range(depth):
                inner = {"kind": "DelayedModel", "model": inner, "delay": 1.0}
            header.update(inner)
            for name in list(arrays):
                arrays["model/" * depth + name] = arrays.pop(name)

        with pytest.raises(DataError, match="inside each other|damaged") as refusal:
            load_model(saved(residual_model(), deep))
        assert "\n" not in str(refusal.value)


def test_a_model_of_too_many_states_is_neither_loaded_nor_saved(saved, tmp_path):
    path = saved(DelayedModel(residual_model(), 1.5), change(delay=1e9))
    with pytest.raises(DataError, match="more than 2048 states"):
        load_model(path)
    with pytest.raises(DataError, match="more than 2048 states"):
        save_model(DelayedModel(residual_model(), 1e9), tmp_path / "m.safetensors")


def test_a_nominal_model_of_nothing_is_refused_where_it_is_made():
    good = residual_model()
    for wrong in (None, 3.0, "x"):
        with pytest.raises(SettingError, match="nominal: must be a function"):
            ResidualModel(wrong, good.residual, good.B, [1], [0], 2)


@pytest.mark.parametrize(
    "metadata",
    [
        ["x"],
        {"states": "ab"},
        {"states": [1, 2]},
        {"states": {"a": 1}},
        {"inputs": 3},
        {"time_step": "0.1"},
        {"time_step": float("nan")},
        {"time_step": 0},
        {"time_step": [1]},
    ],
    ids=str,
)
def test_metadata_that_describe_no_model_cannot_fly(metadata, saved):
    path = saved(posterior(), change(metadata=metadata))
    with pytest.raises(DataError, match=r"model\.safetensors: its metadata do not"):
        load_flyable(path)


def test_an_array_that_overstates_its_size_takes_no_memory(tmp_path):
    import zipfile

    path = tmp_path / "data.npz"
    for shape in ((10**9, 3), (2**31, 2**31), (10**12, 0), (0, 10**12), (-1, 3)):
        header = (
            f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
        )
        array = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header
        with zipfile.ZipFile(path, "w") as archive:
            for name in ("states", "inputs", "next_states"):
                archive.writestr(f"{name}.npy", array)
        with pytest.raises(DataError, match=r"data\.npz: (not a readable|holds no)"):
            Transitions.load(path)


def test_a_long_tape_becomes_a_function_in_linear_time():
    count = 20_000
    code = np.zeros((count, 4))
    code[0] = 45, 0, 0, 0
    code[1:] = 46, 0, 0, 0
    code[1:, 1] = np.random.default_rng(0).permutation(count - 1)
    began = time.process_time()
    function = function_of_tape(code, np.zeros(count), [1], [count - 1, 1])
    assert time.process_time() - began < 3.0
    assert function(2.0).shape == (count - 1, 1)


def test_a_log_model_that_does_not_fit_together_is_refused(tmp_path):
    from gpmpc.logs import save_learned
    from tests.logs.made_models import of_a_quadrotor_log

    path = tmp_path / "m.safetensors"
    save_learned(of_a_quadrotor_log(), path)
    good = parts_of(path)
    load_learned(path)
    for changed in (
        {"lag": 2**63},
        {"lag": 0.5},
        {"history": [1]},
        {"time_step": -1},
        {"time_step": 1e308},
        {"nominal": ["MultirotorNominal", {"motors": 10**9}]},
        {"nominal": None},
        {"gps": [[[9], {}]]},
        {"names": [["a"], [], [], []]},
        {"groups": []},
        {"kinematics": "RigidBody", "groups": good[0]["groups"][:2]},
    ):
        write(path, good[0] | changed, good[1])
        with pytest.raises(DataError, match=r"^[^\n]*m\.safetensors: [^\n]*$"):
            load_learned(path)


def test_outputs_without_a_nominal_model_need_no_memory(tmp_path):
    from gpmpc.logs import save_learned
    from tests.logs.made_models import of_a_pendulum_log

    learned = of_a_pendulum_log()
    path = tmp_path / "m.safetensors"
    model = replace(learned.model, without_nominal=(1,))
    save_learned(replace(learned, model=model), path)
    loaded = load_learned(path).model
    assert loaded.without_nominal == (1,)
    arguments = (np.array([[0.3, 0.2]]), np.array([[0.1]]), np.empty((1, 0)))
    outputs = [each.outputs(*arguments) for each in (loaded, model, learned.model)]
    assert np.array_equal(outputs[0], outputs[1])
    assert not np.array_equal(outputs[0], outputs[2])


@pytest.mark.parametrize("field", ["nominal", "kinematics"])
def test_an_unknown_name_in_a_log_model_is_refused(tmp_path, field):
    from gpmpc.logs import save_learned
    from tests.logs.made_models import of_a_quadrotor_log

    path = tmp_path / "m.safetensors"
    save_learned(of_a_quadrotor_log(), path)
    header, arrays = parts_of(path)
    changed = {"nominal": ["RocketNominal", {}], "kinematics": "Rocket"}
    write(path, header | {field: changed[field]}, arrays)
    with pytest.raises(DataError, match=rf"unknown {field}[^\n]*'Rocket.*known are"):
        load_learned(path)


def assert_survived(count, seed):
    process = copied_process(target=hostile.main, args=(count, seed))
    process.start()
    process.join()
    assert process.exitcode == 0


def test_crafted_models_are_refused_in_one_line_or_predict():
    assert_survived(400, seed=1)


@pytest.mark.slow
def test_many_crafted_models_are_refused_in_one_line_or_predict():
    assert_survived(30_000, seed=2)
