"""Vehicles, and systems of the user, are structures whose parameters a log tells."""

import importlib.util
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas
import pytest
import torch
import yaml

from gpmpc.exceptions import DataError, SettingError
from gpmpc.gp._storage import read_model, write_model
from gpmpc.logs import (
    LogMapping,
    fit_nominal,
    learn,
    load_flyable,
    load_learned,
    read_log,
    save_learned,
)
from gpmpc.logs._structures import bases
from gpmpc.models import MultirotorNominal
from gpmpc.models._actuators import FirstOrderLags
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._stored_log_model import (
    LOG_MODEL,
    NamedLogModel,
    log_model_parts,
)
from gpmpc.models._system_nominal import FittedParameter, SystemNominal
from gpmpc.systems import (
    KinematicBicycle,
    System,
    cart_pole,
    differential_drive,
    dynamic_bicycle,
    kinematic_bicycle,
    pendulum,
    step,
)
from gpmpc.testing import check_model

sys.path.append(str(Path(__file__).resolve().parents[2]))
from tests.cli.command import forked
from tests.logs.test_reading import BODY, body_table, written

ROOT = Path(__file__).resolve().parents[2]
HEADING = {"columns": ["heading"], "kind": "angle", "unit": "rad"}
POSITION = {"columns": ["x", "y"], "unit": "m"}
CAR = {
    "time": "t",
    "rest": "use",
    "model": "bicycle",
    "states": {
        "position": POSITION,
        "heading": HEADING,
        "speed": {"columns": ["speed"], "unit": "m/s"},
    },
    "inputs": {
        "steering": {"columns": ["steering"], "unit": "rad"},
        "drive": ["drive"],
    },
}
PENDULUM = {
    "time": "t",
    "rest": "use",
    "states": {"angle": ["angle"], "rate": ["rate"]},
    "inputs": {"torque": ["torque"]},
}


def flight(plant, inputs, noise=0.0, seed=0):
    """A table of what a plant does under inputs (K, m)."""
    rng = np.random.default_rng(seed)
    states = [np.array(plant.start)]
    for u in inputs[:-1]:
        states.append(step(plant, states[-1], u))
    rows = np.array(states) + noise * rng.normal(size=(len(inputs), len(states[0])))
    table = pandas.DataFrame(rows, columns=plant.state_names)
    table.insert(0, "t", plant.time_step * np.arange(len(inputs)))
    return table.assign(**dict(zip(plant.input_names, inputs.T, strict=True)))


def excitation(rows, *waves, time_step=0.02):
    """Inputs (K, m): each a mean, and two sines of an amplitude."""
    time = time_step * np.arange(rows)
    columns = [
        mean + high * np.sin((1.3 + i) * time) + high / 3 * np.sin((3.7 - i) * time)
        for i, (mean, high) in enumerate(waves)
    ]
    return np.column_stack(columns)


def log_of(folder, table, mapping):
    path = folder / "log.csv"
    table.to_csv(path, index=False)
    return read_log(path, mapping)


def fitted_values(log, steps=15):
    """The fitted parameters of the first structure, and the structure."""
    structure = bases(log, 40)[0]
    fit = fit_nominal(structure.model, None, log, steps)
    return {name: value for name, value, _ in fit.to_rows()}, structure


@pytest.mark.parametrize("sign", [1, -1])
def test_a_kinematic_bicycle_is_found_for_any_kind_of_steering(tmp_path, sign):
    plant = kinematic_bicycle(
        0.02,
        curvature=3,
        rear_length=0.16,
        steering_offset=0.03,
        drive_gain=4,
        drag=0.8,
    )
    inputs = excitation(600, (0, 0.3), (0.4, 0.3))
    table = flight(plant, inputs, noise=0.003)
    table["steering"] *= sign
    table["heading"] = np.arctan2(np.sin(table["heading"]), np.cos(table["heading"]))
    values, structure = fitted_values(log_of(tmp_path, table, CAR))
    assert structure.name == "KinematicBicycle"
    assert values["curvature"] == pytest.approx(3 * sign, rel=0.02)
    assert values["steering_offset"] == pytest.approx(0.03 * sign, abs=0.003)
    assert values["rear_length"] == pytest.approx(0.16, abs=0.02)
    assert values["drive_gain"] == pytest.approx(4, rel=0.03)
    assert values["drag"] == pytest.approx(0.8, rel=0.05)


def test_steering_without_a_unit_is_one_that_turns_by_its_share(tmp_path):
    plant = kinematic_bicycle(0.02, curvature=3)
    inputs = excitation(400, (0, 0.15), (0.1, 0.3))
    table = flight(plant, inputs).assign(steering=5 * inputs[:, 0])
    mapping = {**CAR, "inputs": {"wheel": ["steering"], "drive": ["drive"]}}
    values, structure = fitted_values(log_of(tmp_path, table, mapping))
    scale = structure.model.nominal.fixed["steering_scale"]
    assert scale * table["steering"].abs().max() == pytest.approx(0.4)
    assert values["curvature"] == pytest.approx(3 / 5, rel=0.05)


def test_lags_and_a_disturbance_join_named_parameters(tmp_path):
    plant = kinematic_bicycle(0.02, curvature=3)
    inputs = excitation(400, (0, 0.3), (0.2, 0.5))
    acting, _ = FirstOrderLags.of([0.1, 0.1], 0.02).filter(inputs)
    table = flight(plant, acting).assign(steering=inputs[:, 0], drive=inputs[:, 1])
    log = log_of(tmp_path, table, CAR)
    model = bases(log, 40)[0].model
    model = replace(model, history=(0, 0, 0, 20), time_constants=np.zeros(2))
    for fitted in (model.nominal.fitted[:1], ()):
        nominal = replace(model.nominal, fitted=fitted)
        if not fitted:
            nominal = replace(nominal, fixed={**nominal.fixed, "curvature": 3.0})
        fit = fit_nominal(replace(model, nominal=nominal), None, log, 10)
        assert fit.model.time_constants == pytest.approx(0.1, rel=0.1)
        assert fit.model.theta == pytest.approx([3.0] * len(fitted), rel=0.02)


@pytest.mark.parametrize("dead", ["drive", "speed"])
def test_a_channel_that_never_moves_leaves_others_told(tmp_path, dead):
    plant = replace(kinematic_bicycle(0.02, curvature=3), start=(0, 0, 0, 0.5))
    inputs = excitation(300, (0, 0.3), (0.2, 0.1)) * [1.0, dead == "speed"]
    table = flight(plant, inputs, noise=0.002)
    if dead == "speed":
        table["speed"] = 0.5
    log = log_of(tmp_path, table, CAR)
    model = bases(log, 40)[0].model
    rows = fit_nominal(model, None, log, 10).to_rows()
    value, error = {name: row for name, *row in rows}["curvature"]
    assert 0 < error < 1
    assert value == pytest.approx(3, abs=4 * error)
    if dead == "drive":
        assert ("drive_gain", 1.0, np.inf) in rows


@pytest.mark.parametrize(("unit", "largest"), [("rad", 0.0), ("", 0.4)])
def test_the_scale_of_the_steering_is_its_own_in_any_order(tmp_path, unit, largest):
    inputs = excitation(200, (0, 0.15), (1.1, 0.3))
    table = flight(kinematic_bicycle(0.02), inputs)
    steering = {"columns": ["steering"], "unit": unit}
    mapping = {**CAR, "inputs": {"drive": ["drive"], "steering": steering}}
    structure = bases(log_of(tmp_path, table, mapping), 40)[0]
    scale = structure.model.nominal.fixed["steering_scale"]
    expected = largest / table["steering"].abs().max() if largest else 1.0
    assert scale == pytest.approx(expected)


def test_a_dynamic_bicycle_predicts_what_its_tyres_do(tmp_path):
    plant = dynamic_bicycle(
        0.02, front_stiffness=45, rear_stiffness=60, drive_gain=4, drag=0.8
    )
    table = flight(plant, excitation(300, (0, 0.25), (0.5, 0.2)))
    mapping = {
        **CAR,
        "states": {
            "position": POSITION,
            "heading": HEADING,
            "velocity": ["forward_speed", "lateral_speed"],
            "rate": ["yaw_rate"],
        },
    }
    log = log_of(tmp_path, table, mapping)
    structure = bases(log, 40)[0]
    fit = fit_nominal(structure.model, None, log, steps=8)
    windows = log.windows(15, past=0, most=30)
    errors = fit.model.rollout_errors(windows, [15])
    still = windows.errors(
        np.repeat(windows.states[:, :1], windows.ahead, axis=1), [15]
    )
    assert np.abs(errors).mean() < 0.01 * np.abs(still).mean()


@pytest.mark.parametrize("wheels", [False, True])
def test_a_differential_drive_is_found_by_speeds_or_by_wheels(tmp_path, wheels):
    plant = differential_drive(0.05, forward_by_first=0.8, turn_by_second=1.5)
    told = excitation(300, (0.4, 0.3), (0.1, 0.8), time_step=0.05)
    table = flight(plant, told)
    if wheels:
        left = told[:, 0] - 0.2 * told[:, 1]
        table = table.assign(first=left, second=told[:, 0] + 0.2 * told[:, 1])
    mapping = {
        "time": "t",
        "model": "differential_drive",
        "states": {"position": POSITION, "heading": HEADING},
        "inputs": {"told": ["first", "second"]},
    }
    values, _ = fitted_values(log_of(tmp_path, table, mapping))
    expected = [0.4, 0.4, -3.75, 3.75] if wheels else [0.8, 0, 0, 1.5]
    assert [*values.values()][:4] == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"inputs": {"drive": ["drive"]}}, "needs the states x, y, heading, speed; or"),
        (
            {"states": {"position": POSITION, "rest": ["heading", "speed"]}},
            "kind: angle",
        ),
        ({"frame": "enu"}, "needs model: rigid_body"),
        ({"nominal": "my_robot:Arm"}, "nominal: must stand alone"),
    ],
)
def test_a_log_that_is_no_bicycles_is_refused(tmp_path, change, text):
    table = flight(kinematic_bicycle(), excitation(50, (0, 0.1), (0, 0.1)))
    with pytest.raises(SettingError, match=text):
        bases(log_of(tmp_path, table, {**CAR, **change}), 40)


ARM = '''
from dataclasses import dataclass

from gpmpc.systems import GRAVITY, sin


@dataclass(frozen=True)
class Arm:
    """A pendulum whose inertia is made of its parameters when it is made."""

    mass: float = 0.7
    length: float = 0.8
    damping: float = 0.2
    name: str = "arm"

    state_names = ("angle", "rate")
    input_names = ("torque",)

    def __post_init__(self):
        if min(self.mass, self.length, self.damping) < 0:
            raise ValueError("must be positive")
        object.__setattr__(self, "inertia", self.mass * self.length**2 / 3)

    def derivative(self, x, u):
        weight = self.mass * GRAVITY * self.length / 2 * sin(x[0])
        return [x[1], (weight - self.damping * x[1] + u[0]) / self.inertia]


def make_arm(mass=0.7, length=0.8, damping=0.2):
    return Arm(mass, length, damping)
'''


@pytest.fixture
def arm(tmp_path, monkeypatch):
    """A folder with a module of a user and a log of a pendulum."""
    (tmp_path / "my_robot.py").write_text(ARM)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_robot", raising=False)
    plant = pendulum(damping=0.1)
    inputs = excitation(300, (0, 4.0), time_step=0.05)
    flight(plant, inputs, noise=0.002).to_csv(tmp_path / "log.csv", index=False)
    return tmp_path


@pytest.mark.parametrize("nominal", ["my_robot:Arm", "my_robot.make_arm"])
def test_a_users_own_system_is_fitted_with_what_it_derives(arm, nominal):
    log = read_log(arm / "log.csv", {**PENDULUM, "nominal": nominal})
    values, structure = fitted_values(log, steps=10)
    truth = {"mass": 1.0, "length": 1.0, "damping": 0.1}
    assert values == pytest.approx(truth, rel=0.1)
    assert not structure.model.nominal._takes_arrays
    low, _ = structure.model.nominal.bounds
    assert (low > 0).all()  # negative ones are refused


ROD = """
from gpmpc.systems.mujoco_ import mujoco_system

XML = '''<mujoco><option timestep="0.01"/><worldbody><body>
<joint name="hinge" type="hinge" axis="0 1 0" damping="{damping}"/>
<geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="{mass}"/>
</body></worldbody>
<actuator><motor name="motor" joint="hinge"/></actuator></mujoco>'''


def make_rod(folder, mass=0.5, damping=0.02):
    path = f"{folder}/rod.xml"
    with open(path, "w") as file:
        file.write(XML.format(mass=mass, damping=damping))
    return mujoco_system(path, ["motor"], joints=["hinge"], substeps=2)
"""


def test_a_mujoco_model_is_fitted_by_a_function_that_writes_it(tmp_path, monkeypatch):
    pytest.importorskip("mujoco")
    (tmp_path / "my_rod.py").write_text(ROD)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "my_rod", raising=False)
    from my_rod import make_rod

    plant = make_rod(tmp_path, mass=0.6, damping=0.05)
    states = [np.zeros(2)]
    inputs = excitation(200, (0, 1.5))
    for u in inputs[:-1]:
        states.append(step(plant, states[-1], u))
    table = pandas.DataFrame(np.array(states), columns=["angle", "rate"])
    table = table.assign(t=0.02 * np.arange(200), torque=inputs[:, 0])
    nominal = {"system": "my_rod:make_rod", "fixed": {"folder": str(tmp_path)}}
    log = log_of(tmp_path, table, {**PENDULUM, "nominal": nominal})
    values, _ = fitted_values(log, steps=10)
    assert values == pytest.approx({"mass": 0.6, "damping": 0.05}, rel=0.01)


def test_start_bounds_and_fixed_arguments_are_the_mappings(arm):
    entry = {
        "system": "gpmpc.systems:pendulum",
        "parameters": {"length": {"start": 0.9, "low": 0.5, "high": 0.95}, "mass": 1.1},
        "fixed": {"damping": 0.1},
    }
    log = read_log(arm / "log.csv", {**PENDULUM, "nominal": entry})
    values, structure = fitted_values(log, steps=10)
    assert [*values] == ["length", "mass"]
    assert values["length"] == pytest.approx(0.95, abs=1e-3)
    assert structure.model.nominal._takes_arrays
    assert structure.model.nominal.fixed == {"damping": 0.1}


CAPPED = """

@dataclass(frozen=True)
class Capped(Arm):
    def __post_init__(self):
        if self.length > 0.95:
            raise ValueError("must be short")
        super().__post_init__()
"""


def test_values_that_a_system_refuses_are_not_tried(arm):
    (arm / "my_robot.py").write_text(ARM + CAPPED)
    length = {"start": 0.95, "low": 0.5, "high": 0.95}
    entry = {"system": "my_robot:Capped", "parameters": {"length": length, "mass": 1}}
    log = read_log(arm / "log.csv", {**PENDULUM, "nominal": entry})
    fit = fit_nominal(bases(log, 40)[0].model, None, log, 5)
    assert fit.model.theta[0] == pytest.approx(0.95, abs=1e-3)
    assert (fit.standard_errors > 1e-4).all()  # tiny ones of derivatives across it
    for length in (0.96, 0.4, np.nan):
        with pytest.raises(SettingError, match="theta0: must lie between"):
            fit_nominal(fit.model, np.array([length, 1.0]), log, 5)


def test_columns_in_another_order_are_found_by_their_names(arm):
    states = {"rate": ["rate"], "angle": ["angle"]}
    log = read_log(
        arm / "log.csv",
        {**PENDULUM, "states": states, "nominal": "gpmpc.systems:pendulum"},
    )
    values, _ = fitted_values(log, steps=10)
    assert values == pytest.approx({"mass": 1, "length": 1, "damping": 0.1}, rel=0.1)


@pytest.mark.parametrize(
    ("nominal", "text"),
    [
        ("os:system", "os:system makes no system"),
        ("subprocess.run", "makes no system"),
        ("gpmpc.logs:learn", "makes no system; of gpmpc itself there are"),
        ("arm", "must be such as my_robot:Arm"),
        ({"parameters": {}}, "nominal.system: must be such as"),
        ({"system": "a:b", "start": 1}, "nominal.start: no such key"),
        ({"system": "a:b", "parameters": {"m": "x"}}, "parameters.m.start: must be a"),
        ({"system": "a:b", "parameters": {"m": {"low": 1}}}, "m.start: must be given"),
        (
            {"system": "a:b", "parameters": {"m": {"start": 3, "high": 1}}},
            "parameters.m: must start between -inf and 1; got 3",
        ),
        (
            {"system": "a:b", "parameters": {"m": {"start": 3, "low": 3, "high": 3}}},
            "parameters.m: must have a low below its high, or stand under fixed",
        ),
    ],
)
def test_what_names_no_system_is_refused(nominal, text):
    with pytest.raises(SettingError, match=text):
        LogMapping.from_dict({**PENDULUM, "nominal": nominal})


@pytest.mark.parametrize(
    ("nominal", "text"),
    [
        ("no_robot:Arm", "no_robot:Arm cannot be imported here"),
        ("my_robot:Leg", "my_robot:Leg cannot be imported here"),
        ("my_robot.GRAVITY", "which my_robot only imports"),
        ({"system": "my_robot:Arm", "parameters": {"width": 1}}, "cannot be made"),
        ("gpmpc.systems:cart_pole", "has the states position, velocity, angle, rate"),
    ],
)
def test_a_system_that_does_not_fit_is_refused(arm, nominal, text):
    log = read_log(arm / "log.csv", {**PENDULUM, "nominal": nominal})
    with pytest.raises(SettingError, match=text):
        bases(log, 40)


def test_a_file_reads_the_users_code_only_where_it_is_trusted(arm):
    log = read_log(arm / "log.csv", {**PENDULUM, "nominal": "my_robot:Arm"})
    fit = fit_nominal(bases(log, 40)[0].model, None, log, steps=5)
    noise = OutputNoise(np.ones((4, 2)), np.ones(2))
    names = (log.space.names, log.input_names, ())
    path = arm / "model.safetensors"
    named = NamedLogModel(fit.model, noise, *names, log.time_step)
    write_model(path, LOG_MODEL, *log_model_parts(path, named))
    with pytest.raises(DataError, match=r"trusted=\['my_robot'\].*model.trusted="):
        load_flyable(path)
    saved = load_flyable(path, ["my_robot"])
    saved.check(pendulum())
    states = np.array([[0.1, 0.2], [2.0, -1.0]])
    inputs = np.array([[0.3], [1.0]])
    truth = [
        step(pendulum(damping=0.1), *pair) for pair in zip(states, inputs, strict=True)
    ]
    check_model(saved.model, torch.from_numpy(states), torch.from_numpy(inputs))
    predicted = saved.model.linearize(states, inputs).mean
    np.testing.assert_allclose(predicted, truth, atol=2e-3)


def saved_start(folder, states, inputs):
    """A pendulum's start as a file of a log in degrees, and the model before it."""
    mapping = {"time": "t", "rest": "use", "states": states, "inputs": inputs}
    columns = {"gyro": "rate", "theta": "angle", "volt": "torque"}
    table = pandas.read_csv(folder / "log.csv")
    table = table.assign(**{new: table[old] for new, old in columns.items()})
    log = log_of(folder, table, {**mapping, "nominal": "gpmpc.systems:pendulum"})
    model = bases(log, 40)[0].model
    model = replace(model, theta=model.nominal.start)
    noise = OutputNoise(np.ones((4, 2)), np.ones(2))
    names = [log.mapping.column_names(role) for role in ("states", "inputs")]
    named = NamedLogModel(model, noise, *names, (), log.time_step, log.mapping.namings)
    path = folder / "model.safetensors"
    write_model(path, LOG_MODEL, *log_model_parts(path, named))
    return path, model


TORQUE = {"torque": {"columns": ["torque"], "scale": 2}}


@pytest.mark.parametrize("older", [False, True])
@pytest.mark.parametrize("keys", [("rate", "angle"), ("gyro", "theta"), ("a", "b")])
def test_a_file_takes_the_states_as_the_fit_did(arm, keys, older):
    """They stand in the log the other way round than in the system."""
    names = ("gyro", "theta") if keys == ("rate", "angle") else ("rate", "angle")
    if older:  # keys did not count then
        names = ("rate", "angle")
    columns = [{"columns": [name], "unit": "deg"} for name in names]
    path, model = saved_start(arm, dict(zip(keys, columns, strict=True)), TORQUE)
    if older:  # as files were that did not say what the system calls its states
        header, tensors = read_model(path, LOG_MODEL)
        del header["namings"]
        for role in ("states", "inputs"):
            del header["nominal"][1][role]
        write_model(path, LOG_MODEL, header, tensors)
    loaded = load_flyable(path).model.model
    x = np.array([[0.3, 1.2], [-2.0, 0.1]])
    u = np.array([[0.4], [-1.0]])
    rates = model.outputs(x, u, np.empty((2, 0)))
    np.testing.assert_array_equal(loaded.outputs(x, u, np.empty((2, 0))), rates)
    after = [step(pendulum(), pair[::-1], v) for pair, v in zip(x, u, strict=True)]
    np.testing.assert_allclose(x + 0.05 * rates, np.array(after)[:, ::-1], atol=1e-9)


@pytest.mark.parametrize(
    ("states", "inputs"),
    [
        ({"a": {"columns": ["angle"], "unit": "deg"}, "w": ["rate"]}, TORQUE),
        ({"angle": {"columns": ["theta"], "unit": "deg"}, "rate": ["rate"]}, TORQUE),
        (
            {"state": {"columns": ["angle", "rate"], "unit": "deg"}},
            {"torque": ["volt"]},
        ),
    ],
)
def test_a_log_in_other_units_flies_by_its_columns_or_keys(arm, states, inputs):
    path, _ = saved_start(arm, states, inputs)
    saved = load_flyable(path)
    plant = pendulum()
    flown = saved.model_for(plant).signals
    assert flown.state_names == plant.state_names
    assert flown.input_names == plant.input_names
    with pytest.raises(SettingError, match=r"has the states .*; cart_pole has"):
        saved.check(cart_pole())
    with pytest.raises(SettingError, match="; Backwards has rate, angle"):
        saved.check(System(Backwards(), plant.time_step))


def test_columns_of_one_name_are_no_names_of_a_model(arm):
    path, _ = saved_start(arm, {"s": ["angle", "rate"]}, TORQUE)
    header, tensors = read_model(path, LOG_MODEL)
    header["names"][0] = ["data", "data"]
    header["namings"]["states"] = []
    write_model(path, LOG_MODEL, header, tensors)
    saved = load_flyable(path)
    assert saved.signals.state_names == ()
    saved.check(pendulum())


class Backwards:
    state_names = ("rate", "angle")
    input_names = ("torque",)

    def derivative(self, x, u):
        return [u[0] - x[1], x[0]]


@pytest.mark.slow
def test_what_was_learned_is_stored_trusted_and_flown(arm):
    mapping = {**PENDULUM, "nominal": "my_robot:Arm"}
    (arm / "map.yaml").write_text(yaml.safe_dump(mapping))
    log = read_log(arm / "log.csv", mapping)
    learned = learn(log, points=20, steps=5, for_control=True)
    chosen = next(one.name for one in learned.candidates if one.chosen)
    assert chosen.startswith("Arm")
    save_learned(learned, arm / "model.safetensors")
    with pytest.raises(DataError, match=r"trusted=\['my_robot'\]"):
        load_learned(arm / "model.safetensors")
    again = load_learned(arm / "model.safetensors", trusted=["my_robot"])
    windows = log.windows(5, past=30, most=20)
    np.testing.assert_array_equal(
        again.model.rollout(windows), learned.model.rollout(windows)
    )
    saved = load_flyable(arm / "model.safetensors", ["my_robot"])
    saved.check(pendulum())
    command = ["run", "system=pendulum", "model=model.safetensors", "steps=3"]
    refused = forked(*command, cwd=arm)
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    flown = forked(*command, "model.trusted=[my_robot]", cwd=arm)
    assert flown.returncode == 0, flown.stderr


def test_a_system_of_another_time_step_or_simulator_is_refused():
    def nominal(factory):
        return SystemNominal(
            factory=factory,
            code="my_robot:make",
            fitted=(FittedParameter("curvature", 1.0),),
            time_step=0.1,
            state_names=("a", "b", "c", "d"),
            input_names=("u", "v"),
        )

    assert nominal(KinematicBicycle).start == [1.0]
    with pytest.raises(SettingError, match="time step of 0.05 s, and the log one of"):
        nominal(lambda curvature: System(KinematicBicycle(curvature), 0.05))
    with pytest.raises(SettingError, match="cannot be made"):
        nominal(lambda: KinematicBicycle())


def test_the_pages_systems_are_fitted_by_its_mappings(tmp_path, monkeypatch):
    page = (ROOT / "docs" / "guide_log_systems.md").read_text()
    for text in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        (tmp_path / text.split()[1]).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("my_robot", "my_rod"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    whole, entry, vehicle = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    mapping = yaml.safe_load(whole)
    table = flight(pendulum(), excitation(200, (0, 2.0), time_step=0.05))
    columns = {"angle": "state.angle", "rate": "state.rate", "torque": "input.torque"}
    table = table.rename(columns={"t": "time", **columns})
    values, _ = fitted_values(log_of(tmp_path, table, mapping), steps=5)
    assert values == pytest.approx({"mass": 1, "length": 1, "damping": 0.05}, rel=0.01)
    values, _ = fitted_values(
        log_of(tmp_path, table, {**mapping, **yaml.safe_load(entry)}), steps=5
    )
    assert values == pytest.approx({"mass": 1, "damping": 0.05}, rel=0.01)
    assert LogMapping.from_dict(yaml.safe_load(vehicle)).model == "bicycle"
    if importlib.util.find_spec("mujoco"):
        nominal = {"system": "my_rod:make_rod", "fixed": {"folder": str(tmp_path)}}
        slow = table.assign(time=0.02 * np.arange(200))
        log = log_of(tmp_path, slow, {**mapping, "nominal": nominal})
        assert bases(log, 40)[0].name == "make_rod"


class Oscillator:
    """Derives a ratio of its parameters where it is made."""

    state_dim = 2
    input_dim = 1
    state_names = ("position", "speed")
    input_names = ("force",)

    def __init__(self, mass=1.0, stiffness=1.0):
        self.mass = mass
        self.stiffness = stiffness
        self.ratio = stiffness / mass

    def derivative(self, x, u):
        return [x[1], u[0] - self.ratio * x[0]]


@pytest.mark.parametrize(
    "fitted",
    [
        (FittedParameter("mass", 1.0), FittedParameter("stiffness", 1.0)),
        (FittedParameter("mass", 1.0, low=0.5, high=1.0),),
        (FittedParameter("mass", 0.5, low=0.5, high=1.0),),
    ],
    ids=["equal starts", "a start on its upper bound", "and on its lower one"],
)
def test_what_is_derived_of_parameters_follows_them(fitted):
    nominal = SystemNominal(
        Oscillator, "own:Oscillator", fitted, 0.01, ("x", "v"), ("u",)
    )
    states = np.array([[[0.5, 0.1]]])
    inputs = np.zeros((1, 1, 1))
    theta = nominal.start
    theta[0] = 0.7
    several = [np.array([[value], [value]]) for value in theta]
    together = nominal.outputs(several, states, inputs, None)
    alone = nominal.outputs(theta, states, inputs, None)
    np.testing.assert_allclose(together[1], alone[0], rtol=1e-12)


@pytest.mark.parametrize(
    ("unit", "thrusts"), [("mN", True), ("kN", True), ("V", False)]
)
def test_inputs_in_any_unit_of_force_are_thrusts(tmp_path, unit, thrusts):
    table = body_table().assign(a=1, b=2, c=3)
    motors = {"columns": ["u", "a", "b", "c"], "unit": unit}
    log = read_log(written(tmp_path, table), {**BODY, "inputs": {"motors": motors}})
    nominal = bases(log, 40)[0].model.nominal
    assert isinstance(nominal, MultirotorNominal)
    assert nominal.thrusts == thrusts
