"""Models of logs that remember past rows, and inputs that act through lags."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from gpmpc.exceptions import SettingError
from gpmpc.gp import GPPosterior
from gpmpc.logs import (
    Log,
    LogMapping,
    fit_nominal,
    learn,
    load_learned,
    save_learned,
)
from gpmpc.logs._baselines import CONSTANT_STATE
from gpmpc.logs._fit_form import fit_from
from gpmpc.logs._folds import split_folds
from gpmpc.logs._linear_terms import (
    choose_penalties,
    fit_linear_term,
    refine_linear_term,
)
from gpmpc.logs._log import LogRun
from gpmpc.logs._stability import grows_outside
from gpmpc.logs._structure_fits import StructureFits
from gpmpc.logs._structures import additions, bases
from gpmpc.models import LogDynamics, LogModel
from gpmpc.models._kinematics import Increments
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._log_model import OutputGP
from gpmpc.models._memory import Memory, Products
from gpmpc.models._namings import order_by_name
from gpmpc.models._parametric import AffineNominal
from gpmpc.models._state_space import StateGroup, StateSpace
from gpmpc.models._stored_log_model import (
    NamedLogModel,
    log_model_of_parts,
    log_model_parts,
)

ROWS = Memory(rows=3, decays=(0.8,), output_decays=(0.5,))


def as_log(states, inputs, time_step, names=("y",)):
    """A log of one run."""
    mapping = LogMapping.from_dict(
        {"states": {name: [name] for name in names}, "inputs": {"u": ["u"]}}
    )
    time = time_step * np.arange(len(states))
    run = LogRun("run", time, states, inputs, np.empty((len(states), 0)))
    return Log(mapping, time_step, (run,))


def tanks(seed, rows=700, noise=0.01):
    """Two tanks one above the other, of which the lower level alone is measured."""
    rng = np.random.default_rng(seed)
    u = np.clip(1.5 + np.repeat(rng.normal(size=rows // 20), 20), 0, 4)
    upper = lower = 2.0
    levels = []
    for pumped in u:
        levels.append(lower)
        inflow = 0.2 * np.sqrt(upper)
        upper = max(upper + 0.2 * pumped - inflow, 0.0)
        lower = max(lower + inflow - 0.2 * np.sqrt(lower), 0.0)
    measured = np.array(levels) + noise * rng.normal(size=rows)
    return as_log(measured[:, None], u[:, None], time_step=1.0)


def arx_error(train, windows, order, steps):
    """Mean error of rollouts of the linear model that is best one step ahead."""
    run = train.runs[0]
    y = run.states[:, 0]
    u = run.inputs[:, 0]
    rows = range(order, len(y))
    regressors = np.array([np.r_[y[k - order : k], u[k - order : k], 1] for k in rows])
    weights = np.linalg.lstsq(regressors, y[order:], rcond=None)[0]
    past = windows.past
    levels = windows.states[:, past - order + 1 : past + 1, 0]
    one = np.ones((len(levels), 1))
    for k in range(steps):
        first = past - order + 1 + k
        inputs = windows.inputs[:, first : first + order, 0]
        seen = np.hstack([levels[:, -order:], inputs, one])
        levels = np.hstack([levels, (seen @ weights)[:, None]])
    return np.abs(levels[:, -1] - windows.states[:, past + steps, 0]).mean()


def fitted_term(model, log):
    """A model with its linear term."""
    return fit_linear_term(model, log, choose_penalties(model, log, steps=40))


def test_outputs_alone_are_learned_with_their_past(tmp_path):
    train = tanks(0)
    held_out = tanks(1)
    learned = learn(train, points=20, steps=40)
    model = learned.model
    assert not model.memory.empty
    windows = held_out.windows(40, past=45)
    dynamics = replace(model, correction=None)
    for steps in (10, 40):
        error = np.abs(dynamics.rollout_errors(windows, [steps])).mean()
        linear = [arx_error(train, windows, order, steps) for order in (1, 2, 4, 8)]
        assert error < 1.02 * min(linear)
    save_learned(learned, tmp_path / "model.safetensors")
    loaded = load_learned(tmp_path / "model.safetensors").model
    np.testing.assert_allclose(loaded.rollout(windows), model.rollout(windows))


def test_gps_are_tried_upon_a_still_state_as_well():
    runs = [replace(tanks(seed, 200).runs[0], name=f"{seed}") for seed in range(4)]
    learned = learn(replace(tanks(0), runs=tuple(runs)), points=10, steps=10)
    names = [candidate.name for candidate in learned.candidates]
    assert any(name.startswith("constant state, GP on y") for name in names)


def with_memory(log, memory=ROWS):
    """A linear model of past rows, not fitted yet."""
    kinematics = Increments(log.space)
    outputs = len(kinematics.output_names)
    return LogModel(
        kinematics=kinematics,
        nominal=AffineNominal(kinematics, fitted=False),
        theta=np.empty(0),
        history=(0,) * outputs,
        memory=memory,
    )


def test_noisy_rows_are_fitted_better_on_rollouts():
    found = []
    for origin in (0.0, 300.0):  # such as that of kelvin
        train = moved(tanks(0, noise=0.05), origin)
        model = fitted_term(with_memory(train, Memory(rows=2)), train)
        refined = refine_linear_term(model, train, steps=40)
        windows = moved(tanks(1, noise=0.0), origin).windows(40, past=model.past)
        errors = [
            np.abs(one.rollout_errors(windows)).mean() for one in (model, refined)
        ]
        assert errors[1] < 0.9 * errors[0]
        found.append(refined.weights[:, :-1])
    np.testing.assert_allclose(found[1], found[0], rtol=1e-4)


def moved(log, origin):
    """A log in units that begin elsewhere."""
    runs = [replace(run, states=run.states + origin) for run in log]
    return replace(log, runs=tuple(runs))


def test_a_memory_takes_the_place_of_a_disturbance():
    base = next(one for one in bases(tanks(0), 10) if one.base == CONSTANT_STATE)
    by_key = {one.key: one for one in additions(base)}
    with_disturbance = base.extended(by_key["disturbance"])
    with_rows = base.extended(by_key["rows4"])
    both = with_disturbance.extended(by_key["rows4"])
    assert (both.name, both.key, both.size) == (
        with_rows.name,
        with_rows.key,
        with_rows.size,
    )


def test_each_regressor_of_a_memory_has_a_name():
    memory = Memory(rows=2, decays=(0.9,), output_decays=(0.8,))
    names = memory.regressor_names(["angle", "torque"], ["d_angle"])
    assert names[:3] == ["angle", "torque", "change of angle over 1 row"]
    assert names[-2:] == [
        "torque less its mean over 10 rows",
        "mean of d_angle over 5 rows",
    ]
    remembered = np.zeros(memory.dim(2, 1))
    assert len(names) == len(memory.regressors(np.zeros(2), remembered)) - 1


def test_a_structure_has_the_same_penalties_in_every_fold():
    log = tanks(0, rows=320, noise=0.0)
    folds = split_folds(log, past=10, steps=20)
    base = next(one for one in bases(log, 10) if one.base == CONSTANT_STATE)
    four_rows = next(one for one in additions(base) if one.rows_back == 4)
    structure = base.extended(four_rows)
    assert structure is not None
    fits = StructureFits(
        log=log,
        folds=folds.parts,
        kinematics=base.model.kinematics,
        points=10,
        steps=20,
        seed=0,
        results={},
    )
    penalties = choose_penalties(structure.model, log, steps=20)
    assert penalties[0] < 1e-2  # less than where none can be chosen: without noise
    models = [*fits.fit_nominal(structure, parent=None)]
    models.append(fits.fit_to_all_runs(structure).model)
    logs = [*(fold.train for fold in folds.parts), log]
    for model, own in zip(models, logs, strict=True):
        expected = fit_linear_term(structure.model, own, penalties)
        np.testing.assert_allclose(model.weights, expected.weights, rtol=1e-6)


def test_a_memory_is_what_a_rollout_over_measured_rows_leaves():
    log = tanks(0, rows=60, noise=0.0)
    model = fitted_term(with_memory(tanks(0)), tanks(0))
    windows = log.windows(1, past=model.past)
    features, residuals = model.nominal_residuals(windows, slice(0, model.past))
    memory = np.tile(features[:, 0], (1, 4))
    memory = np.hstack([memory, residuals[:, 0]])
    for k in range(model.past):
        memory = model.memory.step(memory, features[:, k], residuals[:, k])
    filled = model.memory.begin(features, residuals)
    np.testing.assert_allclose(filled, memory)
    np.testing.assert_allclose(model.parts(model.recall(windows), 1).memory, memory)


@pytest.mark.parametrize("time_constant", [0.02, 0.1])
def test_first_order_lags_come_back(time_constant):
    dt = 0.01
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=150), 20)[:, None]
    rate = acting = 0.0
    rates = []
    for command in u[:, 0]:
        rates.append(rate)
        for _ in range(20):  # finer than the log
            acting += (command - acting) * dt / 20 / time_constant
            rate += (acting - rate) * dt / 20
    log = as_log(np.array(rates)[:, None], u, dt)
    kinematics = Increments(log.space)
    affine = AffineNominal(kinematics)
    model = LogModel(kinematics, affine, np.empty(0), (0,), time_constants=np.zeros(1))
    fit = fit_from(model, model, log, 50, choose_penalties=lambda _: np.empty(0))
    (fitted,) = fit.model.time_constants
    assert abs(fitted - time_constant) < 0.3 * time_constant
    named = replace(model, nominal=Pull())
    fit = fit_nominal(named, None, log, steps=50).model
    np.testing.assert_allclose(fit.time_constants, time_constant, rtol=0.1)
    np.testing.assert_allclose(fit.theta, 1.0, rtol=0.05)


class Pull:
    """A state that an input pulls at, with a gain."""

    parameter_names = ("gain",)
    start = np.array([0.5])

    def outputs(self, theta, states, inputs, context):
        (gain,) = theta
        return np.asarray(gain)[..., None] * inputs - states


def test_products_of_past_rows_learn_a_stiffening_spring():
    rng = np.random.default_rng(0)
    u = np.repeat(rng.normal(size=200), 4)
    y = np.zeros(800)
    for k in range(1, 799):
        force = 0.3 * u[k] - 0.2 * y[k] - 0.4 * y[k] ** 3
        y[k + 1] = y[k] + 0.8 * (y[k] - y[k - 1]) + force
    log = as_log(y[:, None], u[:, None], 1.0)
    for share in (0.0, 1.0, 1.5):
        with pytest.raises(SettingError, match="share: must be"):
            log.split_by_time(share)
    train, held_out = log.split_by_time(0.7)
    low, high = (tuple(f(np.c_[y, u], axis=0).tolist()) for f in (np.min, np.max))
    memory = Memory(rows=1, products=Products(2, 3, low, high))
    windows = held_out.windows(60, past=2)
    rmse = []
    for one in (Memory(rows=1), memory):
        model = fitted_term(with_memory(train, one), train)
        rmse.append(np.sqrt(np.square(model.rollout_errors(windows)).mean()))
    assert rmse[1] < 0.02 * rmse[0]
    # Outside of the data products stand still, and the linear part decides.
    assert not grows_outside(model, 1, 1.0)
    pushed = replace(model, weights=model.weights + np.eye(1, model.weights.shape[1]))
    assert grows_outside(pushed, 1, 1.0)


def test_attitudes_that_grow_outside_of_their_data_are_seen():
    space = StateSpace((StateGroup("q", ("x", "y", "z", "w"), kind="quaternion"),))
    kinematics = Increments(space)
    products = Products(1, 2, (-1.0,) * 5, (1.0,) * 5)
    rows = 11 + len(products.factors)  # of features of two rows, of products, of one
    model = LogModel(
        kinematics=kinematics,
        nominal=AffineNominal(kinematics, fitted=False),
        theta=np.empty(0),
        history=(0,) * 3,
        memory=Memory(rows=1, products=products),
        weights=np.zeros((3, rows)),
    )
    assert not grows_outside(model, 1, 1.0)
    assert grows_outside(replace(model, weights=0.5 * np.eye(3, rows)), 1, 1.0)


@pytest.mark.parametrize("remembers", ["rows, for GPs alone", "products of now alone"])
def test_a_model_is_read_whatever_part_of_it_sees_the_memory(remembers):
    groups = (StateGroup("x", ("x",)), StateGroup("v", ("v",)))
    kinematics = Increments(StateSpace(groups))
    products = Products(1, 2, (-1.0,) * 3, (1.0,) * 3)
    memory = Memory(products=products)
    parts = {"weights": np.ones((2, memory.regressor_dim(3, 2)))}
    if remembers == "rows, for GPs alone":
        memory = Memory(rows=1)
        one = torch.ones(1).double()
        points = torch.from_numpy(np.random.default_rng(1).normal(size=(9, 6)))
        gp = GPPosterior.from_hyperparameters(
            points, points[:, :1], one.expand(1, 6), one, one, 0, "value"
        )
        parts = {"gps": (OutputGP((1,), gp, sees_memory=True),)}
    model = LogModel(
        kinematics=kinematics,
        nominal=AffineNominal(kinematics),
        theta=np.linspace(0.0, 0.1, 8),
        history=(0, 0),
        memory=memory,
        **parts,
    )
    noise = OutputNoise(np.ones((4, 2)), np.ones(2))
    named = NamedLogModel(model, noise, ("x", "v"), ("u",), (), 0.1)
    header, tensors = log_model_parts(Path("model"), named)
    stored = json.loads(json.dumps(header))
    again = log_model_of_parts(Path("model"), stored, tensors, ()).model
    assert again.memory == memory
    before, after = (LogDynamics(one, 1, 0.1) for one in (model, again))
    states = np.random.default_rng(0).normal(size=(3, before.state_dim))
    local = before.linearize(states, np.ones((3, 1)))
    for one, other in zip(local, after.linearize(states, np.ones((3, 1))), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("own", "names", "order"),
    [
        (("angle", "rate"), ("state.rate", "state.angle"), [1, 0]),
        (("arm.rate", "arm.angle"), ("arm.angle", "arm.rate"), [1, 0]),
        (("gps.x", "imu.x"), ("imu.x", "gps.x"), [1, 0]),
        (("a.rate", "a.angle"), ("b.angle", "b.rate"), [1, 0]),
        (("a.x", "b.x"), ("c.x", "d.x"), None),
        (("angle", "rate"), ("angle", "speed"), None),
    ],
)
def test_names_with_prefixes_are_told_apart(own, names, order):
    assert order_by_name(own, [names]) == order


def test_scaled_noise_has_no_largest_variances_of_its_own():
    noise = OutputNoise(np.ones((4, 2)), np.ones(2), (1, 10), np.ones((2, 2)))
    twice = noise.scaled(np.full((2, 1), 2.0))
    assert (twice.scales == 2.0).all()
    assert np.isinf(twice.largest_at([1, 5])).all()


def test_misuse_of_a_memory_is_named():
    with pytest.raises(SettingError, match="products: must be of 2 rows at most"):
        Memory(rows=1, products=Products(3, 2, (0.0,), (1.0,)))
    with pytest.raises(SettingError, match="low: must be as many as high"):
        Products(1, 2, (2.0,), (1.0,))
    with pytest.raises(SettingError, match=r"decays: must be within \[0, 1\)"):
        Memory(decays=(1.0,))
    with pytest.raises(SettingError, match="must be zero beside a memory"):
        replace(with_memory(tanks(0, rows=60)), history=(20,))
