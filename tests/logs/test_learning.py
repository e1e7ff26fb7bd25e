"""Learning from logs by rollouts: parameters, noise and structure of flights."""

import json
import os
import runpy
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas
import pytest

from gpmpc.cli._learn import (
    _doubts,
    _fingerprint_of_call,
    _reasons_against,
    _save_model,
    _split,
    _StageResults,
)
from gpmpc.cli._learn import _outputs as outputs_in_words
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.logs import (
    IdentifiedModel,
    Log,
    LogMapping,
    fit_nominal,
    inspect_log,
    judge,
    learn,
    load_flyable,
    load_learned,
    read_log,
    save_learned,
)
from gpmpc.logs._fitting import _minimize
from gpmpc.logs._judging import check_learned, most_steps, short_pieces
from gpmpc.logs._log import LogRun
from gpmpc.logs._noise import _scales, error_variances, follow_errors
from gpmpc.logs._output_gps import choose_rows, train_output_gp
from gpmpc.models import LogModel, MultirotorNominal, RigidBodyKinematics
from gpmpc.models._kinematics import Increments
from gpmpc.models._log_dynamics import OutputNoise
from gpmpc.models._parametric import AffineNominal
from gpmpc.models._quaternions import rotation_quaternion
from gpmpc.models._stored_log_model import (
    NamedLogModel,
    log_model_of_parts,
    log_model_parts,
)

EXAMPLE = runpy.run_path(
    str(Path(__file__).resolve().parents[2] / "examples" / "own_log.py")
)
MAPPING = LogMapping.from_dict(EXAMPLE["MAPPING"])
FORCE_ONLY = (20, 20, 20, 0, 0, 0)


def as_log(tables, gaps=()):
    """A log of simulated flights, with rows left out."""
    runs = []
    for number, table in enumerate(tables):
        rows = np.setdiff1d(
            np.arange(len(table)), [row + i for row in gaps for i in range(30)]
        )
        values = table.to_numpy()[rows]
        begins = (0, *(np.flatnonzero(np.diff(rows) > 1) + 1).tolist())
        runs.append(
            LogRun(
                f"flight {number}",
                values[:, 0],
                values[:, 1:14],
                values[:, 14:],
                np.empty((len(rows), 0)),
                begins,
            )
        )
    return Log(MAPPING, 0.01, tuple(runs))


@pytest.fixture(scope="module")
def flights():
    return EXAMPLE["simulate_flights"](3, 1500, seed=3)


def test_the_outputs_of_a_rigid_body_are_those_that_moved_it():
    rng = np.random.default_rng(0)
    body = RigidBodyKinematics(MAPPING.space)
    states = np.hstack(
        [
            rng.normal(size=(40, 3)),
            rotation_quaternion(rng.normal(size=(40, 3))),
            rng.normal(size=(40, 6)),
        ]
    )
    outputs = rng.normal(size=(40, 6)) * 5
    np.testing.assert_allclose(
        body.outputs(states, body.step(states, outputs, 0.01), 0.01), outputs, atol=1e-9
    )
    free = body.coast(states, 0.3)
    np.testing.assert_allclose(
        body.space.difference(free, states)[:, 3:6], 0.3 * states[:, 10:13], atol=1e-9
    )


def test_parameters_come_back_within_their_standard_errors(flights):
    log = as_log(flights, gaps=(700,))
    model = LogModel(
        RigidBodyKinematics(log.space),
        MultirotorNominal(4, torque=True),
        np.empty(0),
        FORCE_ONLY,
    )
    truth = {"drag_xy": EXAMPLE["DRAG"], "torque_x1": 30.0, "torque_y2": -30.0}
    spoiled = [flight.copy() for flight in flights]
    for flight in spoiled:
        flight.loc[300::500, ["vx", "vy", "vz"]] += 5.0
    for data in (log, as_log(spoiled)):
        fit = fit_nominal(model, None, data, steps=20)
        estimates = {name: (value, error) for name, value, error in fit.to_rows()}
        for name, value in truth.items():
            estimate, error = estimates[name]
            bound = 4 * error + 0.05 * abs(value)
            assert abs(estimate - value) < bound, (name, estimate, error)
        assert 0 < estimates["torque_x1"][1] < 5


class _Valley:
    """Residuals along whose curved valley a search takes many steps (Rosenbrock)."""

    bounds = (np.full(2, -np.inf), np.full(2, np.inf))

    def __call__(self, theta):
        x, y = theta
        return np.array([10 * (y - x**2), 1 - x])

    def jacobian(self, theta):
        return np.array([[-20 * theta[0], 10.0], [-1.0, 0.0]])


def test_a_search_of_parameters_goes_on_to_its_end():
    found = _minimize(_Valley(), np.array([-3.0, 1.0]))
    np.testing.assert_allclose(found, 1, rtol=1e-3)


def test_learning_finds_motors_and_noise_and_beats_baselines(flights):
    log = as_log(flights, gaps=(500,))
    train, held_out = log.split(["flight 2"])
    learned = learn(train, points=20, steps=20, for_control=True)
    (chosen,) = [candidate for candidate in learned.candidates if candidate.chosen]
    assert "motor torque" in chosen.name
    judgement = judge(learned, held_out, train, steps=(1, 10, 20))
    assert not [
        loss
        for loss in judgement.losses
        if " 1 steps" not in loss and "ridge" not in loss
    ]
    assert np.all((judgement.coverage[1:] > 0.9) & (judgement.coverage[1:] < 0.985))
    assert np.all((judgement.width[1:] > 0.8) & (judgement.width[1:] < 1.3))
    table = judgement.to_pandas()
    assert set(table["unit"]) == {"m", "rad", "m/s", "rad/s"}
    truth = np.repeat(
        [EXAMPLE["FORCE_NOISE"], EXAMPLE["TORQUE_NOISE"]], 3
    )  # of every output, though headings vary
    np.testing.assert_allclose(
        np.sqrt(learned.noise.outputs.sum(axis=0)), truth, rtol=0.1
    )


def pendulum_log(friction, rows=900, seed=0, noise=0.02):
    rng = np.random.default_rng(seed)
    runs = []
    for number in range(3):
        x = np.array([0.3, 0.0])
        table = []
        torques = np.repeat(rng.uniform(-8, 8, rows // 10), 10)
        for u in torques:
            table.append((*x, u))
            x = (
                x
                + 0.02 * np.array([x[1], u - friction(x)])
                + rng.normal(0, noise, 2) * [0, 1]
            )
        table = np.array(table)
        time = 0.02 * np.arange(rows)
        runs.append(
            LogRun(
                f"run {number}", time, table[:, :2], table[:, 2:], np.empty((rows, 0))
            )
        )
    mapping = LogMapping.from_dict(
        {"states": {"angle": ["angle"], "rate": ["rate"]}, "inputs": {"torque": ["u"]}}
    )
    return Log(mapping, 0.02, tuple(runs))


class LearnedPendulum(NamedTuple):
    """A pendulum's model, with the runs and the stages that it came from."""

    train: Log
    held_out: Log
    learned: IdentifiedModel
    memory: dict


@pytest.fixture(scope="module")
def pendulum():
    log = pendulum_log(lambda x: 9 * np.sin(x[0]) + 0.5 * x[1], rows=500)
    train, held_out = log.split(["run 2"])
    memory = {}
    learned = learn(train, points=40, steps=20, memory=memory)
    return LearnedPendulum(train, held_out, learned, memory)


def test_a_gp_stays_only_where_held_out_rollouts_get_better(pendulum):
    assert [gp.outputs for gp in pendulum.learned.model.gps][-1] == (1,)
    log = pendulum_log(lambda x: 4 * x[0] + 0.5 * x[1], rows=500, noise=0.1)
    linear = learn(log, points=40, steps=20)
    assert not linear.model.gps
    (chosen,) = [candidate.name for candidate in linear.candidates if candidate.chosen]
    assert chosen.startswith("least squares")


def spinning_log(kind, rows=400):
    """A pendulum that turns over, whose sensor shows an angle within a turn."""
    torques = np.random.default_rng(0).uniform(-8, 8, rows)
    states = [np.array([0.0, 9.0])]
    for u in torques[:-1]:
        states.append(states[-1] + 0.02 * np.array([states[-1][1], u]))
    shown = np.array(states)
    shown[:, 0] = np.mod(shown[:, 0] + np.pi, 2 * np.pi) - np.pi
    angle = {"columns": ["angle"], "unit": "rad", "kind": kind}
    mapping = {
        "states": {"angle": angle, "rate": ["rate"]},
        "inputs": {"torque": ["u"]},
    }
    time = 0.02 * np.arange(rows)
    nothing = np.empty((rows, 0))
    runs = [LogRun(f"{i}", time, shown, torques[:, None], nothing) for i in range(2)]
    return Log(LogMapping.from_dict(mapping), 0.02, tuple(runs))


class Begun(Exception):
    """Raised by the first line of progress: what comes later is not of interest."""


def begin(text):
    raise Begun


def test_learning_names_an_undeclared_angle_that_wraps(caplog):
    for kind, warnings in (("vector", 1), ("angle", 0)):
        caplog.clear()
        with pytest.raises(Begun):
            learn(spinning_log(kind), steps=10, progress=begin)
        assert (
            caplog.text.count("column 1 of the states jumps by whole turns") == warnings
        )


def test_a_rate_is_averaged_over_more_than_half_a_turn():
    log = spinning_log("angle")
    kinematics = Increments(log.space)
    nominal = AffineNominal(kinematics, fitted=False)
    model = LogModel(kinematics, nominal, np.empty(0), (0, 0))
    # in 20 rows it turns by 3.6 rad
    gp = train_output_gp(model, log, outputs=(0,), rows=20, points=30, seed=0)
    assert gp.posterior.targets.min() > 6.0


def test_a_model_that_loses_to_a_baseline_is_called_so(pendulum):
    train, held_out, learned, _ = pendulum
    assert not judge(learned, held_out, train, steps=(1, 10)).losses
    # What is said of a corrected candidate was measured, as what it won by was.
    errors = {one.name: one.errors for one in learned.candidates}
    (chosen,) = (one for one in learned.candidates if one.chosen)
    second = learned.comparisons[-1]
    assert "corrected by the past" in chosen.name
    ratio = chosen.errors[:, 1] / errors[second.name][:, 1]
    np.testing.assert_allclose(ratio, second.ratio[:, 1])
    for steps in ((10, 1), (1, 1)):
        with pytest.raises(SettingError, match="steps: must increase"):
            judge(learned, held_out, train, steps=steps)
    twice = replace(held_out, time_step=2 * held_out.time_step)
    with pytest.raises(SettingError, match="held_out: must have the model's time step"):
        judge(learned, twice, train)
    states = held_out.mapping.signals[:2][::-1]
    exchanged = replace(
        held_out.mapping, signals=(*states, *held_out.mapping.signals[2:])
    )
    with pytest.raises(SettingError, match="train: must have the states of the model"):
        judge(learned, held_out, replace(train, mapping=exchanged))
    short = [replace(run, begins=tuple(range(0, 500, 21))) for run in held_out]
    needed = max(learned.model.past, 20) + 2
    with pytest.raises(DataError, match=f"judging it needs {needed} rows"):
        check_learned(learned, replace(held_out, runs=tuple(short)), train)
    wrong = replace(
        learned, model=replace(learned.model, theta=-learned.model.theta, gps=())
    )
    # One that gives no numbers is no exception.
    nothing = replace(wrong.model, theta=np.full_like(wrong.model.theta, np.nan))
    judgement = judge(replace(wrong, model=nothing), held_out, train, steps=(1, 10))
    assert any("constant velocity" in loss for loss in judgement.losses)
    # Where no velocity is known both are one predictor, and one loss.
    cells = [loss.split(":")[0] for loss in judgement.losses if "constant" in loss]
    assert len(cells) == len(set(cells)) == 4
    # Two predictions of ten steps tell nothing, and twenty of one step do.
    rows = held_out.runs[0].part(0, needed + 28, "few")
    few = judge(wrong, replace(held_out, runs=(rows,)), train, steps=(1, 10))
    assert few.steps_not_told == (10,)
    assert few.losses
    assert not any("10 steps ahead" in loss for loss in few.losses)
    # Where nothing is told at any step, a model is not called usable.
    untold = judge(learned, replace(held_out, runs=(rows,)), train, steps=(10,))
    assert not untold.losses
    (reason,) = _reasons_against(learned, untold)
    assert "10 steps ahead: too few held-out rows to tell" in reason
    # Pieces too short for the longest predictions count at shorter ones.
    (run,) = held_out.runs
    begins = (0, 300, 350, 400, 450)
    runs = (replace(run, begins=begins), run.part(0, 20, "stub"))
    pieces = replace(held_out, runs=runs)
    judgement = judge(learned, pieces, train, steps=(1, 50))
    parts = [run.part(begin, begin + 50, "short") for begin in begins[1:]]
    alone = replace(held_out, runs=(run.part(0, 251, "long"), *parts))
    expected = judge(learned, alone, train, steps=(1,))
    assert judgement.windows[:1] == expected.windows
    for name, mean in expected.mean.items():
        np.testing.assert_allclose(judgement.mean[name][:1], mean, rtol=1e-9)
    assert judgement.runs == (run.name,)
    (sentence,) = short_pieces(learned, judgement, pieces, train)
    assert "42% of the held-out rows" in sentence
    # How well a controller's tube holds is measured.
    doubts = _doubts(learned, judgement, pieces, train)
    (sentence,) = [one for one in doubts if "A controller's tube" in one]
    coverage = judgement.tube_coverage[1]
    width = judgement.tube_width[1]
    assert f" a tube of {judgement.level:.0%} holds " in sentence
    assert " of the errors 1 step ahead, and is " in sentence
    assert f"{coverage.max():.0%} of the errors 50 steps ahead" in sentence
    assert f" to {width.max():.2f} times as wide as they are (smallest to" in sentence
    assert "alike for several rows" in sentence
    is_white = np.array(learned.noise.time_constants) == 0
    outputs = learned.noise.outputs * is_white[:, np.newaxis]
    white = replace(learned, noise=replace(learned.noise, outputs=outputs))
    words = " ".join(_doubts(white, judgement, pieces, train))
    assert "alike for several rows" not in words
    assert any("knows the inputs to come" in one for one in doubts)
    terms = replace(learned.model, weights=np.ones((2, 3)), without_nominal=(0,))
    first, last = outputs_in_words(replace(learned, model=terms))
    assert first.partition(": ")[2].split(", ")[0] == "linear term of past rows"
    assert last.partition(": ")[2].startswith("nominal model, linear term of past")
    ranges = learned.ranges.copy()
    ranges[:, 1] = 2.0
    still = replace(learned, ranges=ranges)
    *_, doubt = _doubts(still, judgement, pieces, train)
    assert doubt.endswith(f"nothing is known of it: {train.space.names[1]}.")
    # Of short pieces the baselines are fitted to fewer steps.
    short = [replace(run, begins=tuple(range(0, 500, 70))) for run in train]
    train = replace(train, runs=tuple(short))
    assert most_steps(learned, held_out, train) == 49
    assert min(judge(learned, held_out, train, steps=(1, 49)).windows)
    losses = judge(wrong, held_out, train, steps=(1, 10)).losses
    assert any(
        "rate 10 steps ahead" in loss and "constant state" in loss for loss in losses
    )


def test_a_model_is_the_same_after_saving_and_damage_is_named(
    pendulum, tmp_path, caplog
):
    log, _, learned, memory = pendulum
    assert learned.model.gps
    save_learned(learned, tmp_path / "model.safetensors")
    loaded = load_learned(tmp_path / "model.safetensors")
    windows = log.windows(20, max(learned.model.past, 20), 100)
    expected = learned.model.rollout(windows)
    np.testing.assert_allclose(
        loaded.model.rollout(windows), expected, rtol=0, atol=1e-9
    )
    variances = [
        error_variances(one.model, windows, one.noise, (1, 20))
        for one in (learned, loaded)
    ]
    np.testing.assert_allclose(*variances, rtol=1e-6)
    assert [c.name for c in loaded.candidates] == [c.name for c in learned.candidates]
    load_flyable(tmp_path / "model.safetensors")
    assert not caplog.records
    # One that should not be used says so, beside no report of another.
    for name in ("report.html", "report.csv", "card.md"):
        (tmp_path / name).write_text("of an earlier model")
    (tmp_path / "report.pdf").write_text("of the user")
    _save_model(replace(learned, reasons=("no effect of u shows",)), tmp_path)
    files = {path.name for path in tmp_path.iterdir()}
    assert files == {"model.safetensors", "report.pdf"}
    loaded = load_learned(tmp_path / "model.safetensors")
    assert loaded.reasons == ("no effect of u shows",)
    load_flyable(tmp_path / "model.safetensors")
    assert "do not use this model: no effect of u shows" in caplog.text
    (tmp_path / "cut.safetensors").write_bytes(
        (tmp_path / "model.safetensors").read_bytes()[:-100]
    )
    with pytest.raises(DataError, match="damaged"):
        load_learned(tmp_path / "cut.safetensors")
    # What an earlier call has gone through is not done again, and changes nothing.
    again = learn(log, points=40, steps=20, memory=dict(memory))
    other = replace(log, runs=log.runs[:1])
    for other_log, points in ((other, 40), (log, 41)):
        with pytest.raises(SettingError, match="memory: holds results of other data"):
            learn(other_log, points=points, steps=20, memory=memory)
    np.testing.assert_array_equal(again.model.rollout(windows), expected)


def test_the_same_rows_in_other_pieces_give_the_same_model(flights):
    one = as_log(flights[:2], gaps=(700,))
    other = replace(
        one,
        runs=tuple(replace(run, time=run.time + 100 * (run.time > 7)) for run in one),
    )
    model = LogModel(
        RigidBodyKinematics(one.space), MultirotorNominal(4), np.empty(0), FORCE_ONLY
    )
    fits = [fit_nominal(model, None, log, steps=10).model.theta for log in (one, other)]
    np.testing.assert_allclose(*fits, rtol=0, atol=1e-9)


def test_learning_is_the_same_whatever_marks_a_gap(tmp_path):
    """Missing or empty rows and stamps that jump leave the other rows as they are."""
    tables = {way: [] for way in ("missing", "empty", "jump")}
    for run in pendulum_log(lambda x: 9 * np.sin(x[0]) + 0.5 * x[1], rows=300):
        table = pandas.DataFrame(
            np.column_stack([run.time, run.states, run.inputs]),
            columns=["t", "angle", "rate", "u"],
        )
        gap = table.index.isin(range(120, 150))
        tables["missing"].append(table[~gap])
        tables["empty"].append(table.assign(rate=table["rate"].where(~gap)))
        tables["jump"].append(
            table[~gap].assign(t=table["t"] + 100.0 * (table.index >= 150))
        )
    logs = {}
    for way, runs in tables.items():
        files = [tmp_path / f"{number}.csv" for number in range(3)]
        for file, table in zip(files, runs, strict=True):
            table.to_csv(file, index=False)
        mapping = {
            "time": "t",
            "states": {"angle": ["angle"], "rate": ["rate"]},
            "inputs": {"torque": ["u"]},
        }
        log = read_log(files, mapping)
        assert [run.begins for run in log] == [(0, 120)] * 3, way
        logs[way] = log
    # An empty row is not there at all, so that the first two are one log.
    for run, other in zip(logs["missing"], logs["empty"], strict=True):
        for name in ("time", "states", "inputs", "context"):
            np.testing.assert_array_equal(getattr(run, name), getattr(other, name))
    noises = []
    for log in (logs["missing"], logs["jump"]):
        learned = learn(log, points=30, steps=10)
        noise = learned.noise
        numbers = [
            learned.model.theta,
            *(c.errors for c in learned.candidates),
            noise.outputs,
            noise.measurement,
        ]
        windows = log.windows(10, 60, 50)
        noises.append(
            np.concatenate(
                [
                    a.ravel()
                    for a in (*numbers, learned.model.rollout(windows), windows.inputs)
                ]
            )
        )
    np.testing.assert_allclose(noises[1], noises[0], rtol=1e-6, atol=1e-9)


def test_intervals_follow_a_rougher_run_and_never_its_future(flights):
    windows = as_log(flights[:2]).windows(20, 20, 2)
    rng = np.random.default_rng(0)
    rough = np.where(windows.runs == 1, 3.0, 1.0)[:, None, None]
    errors = rough * rng.normal(size=(len(windows), 2, 12))
    claimed = np.ones((len(windows), 2, 12))
    scaled = follow_errors(windows, errors, claimed, (10, 20))
    late = windows.times > 2
    for run, std in ((0, 1.0), (1, 3.0)):
        scales = np.sqrt(scaled[late & (windows.runs == run)].mean(axis=(0, 2)))
        np.testing.assert_allclose(scales, std, rtol=0.1)
    np.testing.assert_array_equal(
        scaled[windows.times < 0.3][:, 1], 1.0
    )  # no prediction of 20 steps is over
    changed = errors * np.where(windows.times > 5, 9.0, 1.0)[:, None, None]
    early = windows.times <= 5
    np.testing.assert_array_equal(
        follow_errors(windows, changed, claimed, (10, 20))[early], scaled[early]
    )


def test_a_calm_run_is_soon_known_one_step_ahead(flights):
    """Errors one step ahead are many where those of fifty steps are one."""
    windows = as_log(flights[:1]).windows(50, 20)
    errors = np.full((len(windows), 2, 12), 0.1)
    claimed = np.ones_like(errors)
    scaled = follow_errors(windows, errors, claimed, (1, 50))
    row = 61  # 61 predictions of one step are over, and twelve of fifty
    forgotten = np.exp(-np.arange(61.0) / 300)
    near = 1 - 0.99 * forgotten.sum() / (20 + forgotten.sum())
    far = 1 - 0.99 * forgotten[:12].sum() / (25 + forgotten[:12].sum())
    np.testing.assert_allclose(scaled[row, 0], near, rtol=0.02)
    np.testing.assert_allclose(scaled[row, 1], far, rtol=0.02)


def test_a_run_that_paused_is_followed_as_one_that_begins_anew(flights):
    (run,) = as_log(flights[:1]).runs
    half = len(run) // 2
    pause = np.where(np.arange(len(run)) < half, 0.0, 3600.0)
    paused = replace(run, time=run.time + pause, begins=(0, half))
    log = as_log(flights[:1])
    windows = replace(log, runs=(paused,)).windows(20, 20, 2)
    alone = replace(log, runs=(run.part(half, len(run), "half"),)).windows(20, 20, 2)
    errors = np.random.default_rng(0).normal(size=(len(windows), 2, 12))
    scaled = follow_errors(windows, errors, np.ones_like(errors), (10, 20))
    expected = follow_errors(
        alone, errors[-len(alone) :], np.ones((len(alone), 2, 12)), (10, 20)
    )
    np.testing.assert_allclose(scaled[-len(alone) :], expected)


def test_intervals_are_as_wide_as_errors_where_claims_go_astray(flights):
    windows = as_log(flights[:1]).windows(20, 20, 2)
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(len(windows), 2, 12))
    claimed = np.exp(rng.normal(size=errors.shape))
    late = windows.times > 2
    widths = np.sqrt(follow_errors(windows, errors, claimed, (10, 20))[late].mean(0))
    assert 1.0 < widths.min() < widths.mean() < 1.35


def test_scales_of_a_noise_lie_between_their_steps():
    scales = np.array([[1.0, 2.0], [4.0, 2.0]])
    noise = OutputNoise(np.ones((4, 2)), np.ones(2), (1, 100), scales)
    expected = [[1.0, 2.0], [2.0, 2.0], [4.0, 2.0], [4.0, 2.0]]
    np.testing.assert_allclose(noise.scales_at((1, 10, 100, 500)), expected)
    without = OutputNoise(np.ones((4, 2)), np.ones(2))
    np.testing.assert_array_equal(without.scales_at((1, 10)), np.ones((2, 2)))
    assert np.isinf(without.largest_at((1, 10))).all()


def test_variances_that_explode_are_cut_off(flights):
    """What is left of them still explains the errors."""
    log = as_log(flights[:1])
    kinematics = Increments(log.space)
    squared = np.ones((1, 12))
    explained = np.ones((50, 1, 12))
    explained[0] = 1e4
    largest = 9 * squared
    scales = _scales(kinematics, squared, explained, largest)
    # A linearised rollout that overflows leaves factors that can be saved.
    for value in (np.inf, np.nan):
        explained[0] = value
        factors = _scales(kinematics, squared, explained, largest)
        assert (np.isfinite(factors) & (factors > 0)).all()
    explained[0] = 1e4
    claimed = np.minimum(scales * explained, largest)
    np.testing.assert_allclose(claimed.mean(axis=0), squared, rtol=1e-3)
    assert claimed[1].min() > 0.8


def test_noise_is_of_rows_whatever_the_time_step(flights, tmp_path):
    log = as_log(flights[:1])
    kinematics = Increments(log.space)
    still = AffineNominal(kinematics, fitted=False)
    model = LogModel(kinematics, still, np.empty(0), (0,) * 12)
    windows = log.windows(20, 20, 300)
    variances = []
    for step in (0.01, 1e-6, 4.0):
        noise = OutputNoise(np.ones((4, 12)) / step**2, np.ones(12))
        cut = replace(windows, time_step=step)
        variances.append(error_variances(model, cut, noise, (1, 20)))
        np.testing.assert_allclose(variances[-1], variances[0], rtol=1e-3)
    path = tmp_path / "model"
    named = NamedLogModel(model, noise, ("a",) * 13, ("u",) * 4, (), 0.02)
    header, tensors = log_model_parts(path, named)
    header = json.loads(json.dumps(header))
    assert log_model_of_parts(path, header, tensors).noise.time_constants[2] == 25
    del header["noise_rows"]  # as in files from before: then they are seconds
    assert log_model_of_parts(path, header, tensors).noise.time_constants[2] == 12.5
    white = replace(noise, time_constants=(0.0,) * 4)
    assert (error_variances(model, cut, white, (1, 20)) < variances[0])[:, 1].all()


def test_chosen_rows_cover_what_is_rare():
    rng = np.random.default_rng(0)
    frequent = rng.normal(0, 0.01, (3000, 2))
    rare = rng.uniform(-1, 1, (150, 2))
    rows = choose_rows(np.vstack([frequent, rare]), 40)
    assert (rows >= 3000).sum() > 12
    assert len(set(rows.tolist())) == len(rows) <= 40


def test_misuse_is_named(flights):
    log = as_log(flights[:1])
    model = LogModel(
        RigidBodyKinematics(log.space), MultirotorNominal(4), np.empty(0), FORCE_ONLY
    )
    with pytest.raises(ShapeError, match="theta0 must have 6 entries"):
        fit_nominal(model, np.zeros(3), log)
    with pytest.raises(DataError, match="the longest has 1500"):
        fit_nominal(model, None, log, steps=3000)
    affine = replace(model, nominal=AffineNominal(model.kinematics))
    with pytest.raises(SettingError, match="model: must have named parameters"):
        fit_nominal(affine, None, log)
    with pytest.raises(SettingError, match="most: must be"):
        log.windows(10, most=0)
    with pytest.raises(SettingError, match="past"):
        replace(model, theta=model.nominal.start).rollout(log.windows(10))


OF_OTHER_KINDS = {
    "log: must be a Log": lambda log: learn("flight.csv"),
    "seed: must be a whole number": lambda log: learn(log, seed="a"),
    "learned: must be what learn returns": lambda log: judge(log, log, log),
    "model: must be a LogModel": lambda log: fit_nominal(log, None, log),
    "learned: must be what": lambda log: save_learned(log, "model.safetensors"),
    "mapping: must be a LogMapping": lambda log: inspect_log("a.csv", {"time": "t"}),
    "path: must be the name of a file": lambda log: inspect_log(log),
    "files: must be the name of a file": lambda log: read_log(5, MAPPING),
    "files: must be names of files": lambda log: read_log([log], MAPPING),
}


@pytest.mark.parametrize("text", OF_OTHER_KINDS)
def test_arguments_of_another_kind_are_named(flights, text):
    with pytest.raises(SettingError, match=f"^{text}"):
        OF_OTHER_KINDS[text](as_log(flights[:1]))


FLIGHTS = os.environ.get("GPMPC_FLIGHTS")


@pytest.mark.slow
@pytest.mark.skipif(not FLIGHTS, reason="GPMPC_FLIGHTS names no folder of flights")
def test_real_flights_are_predicted_better_than_by_baselines():
    mapping = {
        "time": "t",
        "keep": {"pz": [0.2, None]},
        "model": "rigid_body",
        "states": {
            "position": {"columns": ["px", "py", "pz"], "unit": "m"},
            "attitude": {"columns": ["qx", "qy", "qz", "qw"], "kind": "quaternion"},
            "velocity": {
                "columns": ["vx", "vy", "vz"],
                "unit": "m/s",
                "frame": "world",
            },
            "rate": {
                "columns": [f"w{axis}_vicon" for axis in "xyz"],
                "unit": "rad/s",
                "frame": "body",
            },
        },
        "inputs": {
            "motors": {
                "columns": [f"motor_motor_m{i}" for i in range(1, 5)],
                "scale": 1 / 65535,
            }
        },
        "context": {"battery": {"columns": ["pwr_pm_vbat"], "unit": "V"}},
    }
    log = read_log(sorted(Path(FLIGHTS).glob("*.csv.gz")), mapping)
    train, held_out = log.split(["B2_circle_medium_rep1", "B3_figure8_fast_rep2"])
    judgement = judge(learn(train), held_out, train)
    for name in ("constant state", "constant velocity", "least squares"):
        assert (judgement.mean["model"][1:] < judgement.mean[name][1:]).all()
    assert ((judgement.coverage[1:] > 0.9) & (judgement.coverage[1:] < 0.98)).all()
    assert ((judgement.width[1:] > 0.8) & (judgement.width[1:] < 1.3)).all()


def run_of(rows, name="run"):
    values = np.arange(rows * 2.0).reshape(rows, 2)
    time = 0.1 * np.arange(rows)
    return LogRun(name, time, values[:, :1], values[:, 1:], np.empty((rows, 0)))


@pytest.mark.parametrize(
    ("lengths", "held_out"),
    [
        ([40, 300, 200, 250, 100], [200]),
        ([300, 40], [40]),
        ([*range(30, 41)], [32, 38]),
        ([-25, -22, 300, 40], [40]),
        ([-25, -22, 300], [36]),  # the last fifth of it
        ([-28], [-29]),
    ],
)
def test_runs_of_middle_length_are_held_out_by_default(lengths, held_out):
    runs = tuple(run_of(rows + 30, f"{rows}") for rows in lengths)
    mapping = LogMapping.from_dict({"states": {"x": ["x"]}, "inputs": {"u": ["u"]}})
    split = _split(Log(mapping, 0.1, runs), [])
    assert sorted(len(run) - 30 for run in split.held_out_rows) == held_out
    assert len(split.train) + len(split.held_out_rows) == sum(map(len, runs))


def test_outcomes_are_of_the_times_and_pieces_of_the_rows():
    mapping = LogMapping.from_dict({"states": {"x": ["x"]}, "inputs": {"u": ["u"]}})
    arguments = Namespace(points=10, steps=5, seed=0, for_control=False)
    run = run_of(30)
    logs = [
        Log(mapping, 0.1, (run,)),
        Log(mapping, 0.2, (replace(run, time=2 * run.time),)),
        Log(mapping, 0.1, (replace(run, begins=(0, 10)),)),
    ]
    names = [_fingerprint_of_call(arguments, log) for log in (*logs, logs[0])]
    assert names[0] == names[3]
    assert len({*names}) == 3


def test_stage_results_are_reused_or_a_line_says_why_not(tmp_path):
    path = tmp_path / "progress.json"
    memory = _StageResults(path, "name")
    assert memory == {}
    assert memory.begun_anew == ""
    memory["fit"] = [1.5]
    again = _StageResults(path, "name")
    assert again == {"fit": [1.5]}
    assert again.begun_anew == ""
    stored = json.loads(path.read_text())
    older = {"fingerprint": "name of older code", "stages": {"fit": [2.5]}}
    for content, reason in (
        (json.dumps(stored | {"fingerprint": "other"}), "is of other data or settings"),
        (json.dumps(older | {"code": "0" * 32}), "is of other code of gpmpc than this"),
        (json.dumps(older), "is of other code of gpmpc than this"),
        ('{"fingerprint": "na', "is not whole"),
        ("[]", "is not whole"),
        ("[" * 100_000, "is not whole"),
        (json.dumps(stored | {"stages": 3}), "is not whole"),
    ):
        path.write_text(content)
        memory = _StageResults(path, "name")
        assert memory == {}
        assert memory.begun_anew == f"{path}: {reason}; all is learned anew"
