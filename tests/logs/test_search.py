"""What wins is what is written: folds, combinations, smoothing, and what is refused."""

import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

from gpmpc.cli._learn import _doubt_of_held_out, _Split, _split
from gpmpc.exceptions import DataError, SettingError
from gpmpc.gp import train
from gpmpc.logs import Judgement, Log, LogMapping, fit_nominal, judge, learn
from gpmpc.logs._baselines import baseline_errors
from gpmpc.logs._comparison import (
    compare,
    effective_number,
    independent_predictions,
)
from gpmpc.logs._control_fitness import _linearize, judge_for_control
from gpmpc.logs._fitting import _standard_errors, fit_least_squares
from gpmpc.logs._folds import split_folds
from gpmpc.logs._held_out_errors import HeldOutErrors
from gpmpc.logs._judging import _coverage_intervals, most_told_steps
from gpmpc.logs._learning import _plan_folds
from gpmpc.logs._log import LogRun
from gpmpc.logs._noise import (
    _nonnegative_solution,
    error_variances,
    fit_noise,
    learning_gains,
    noise_steps,
    tube_variances,
)
from gpmpc.logs._ranges import ranges_of
from gpmpc.logs._rollout_corrections import (
    _PRIORS,
    _RIDGE,
    _ROLLOUT,
    Rollouts,
    _Regret,
    _stretches_of,
    _without_chance,
    choose_averages,
)
from gpmpc.logs._search import Search
from gpmpc.logs._smoothing import _solve_block_tridiagonal, smooth
from gpmpc.logs._structures import (
    additions,
    affordable_rows_back,
    bases,
    likely_delay_rows,
    past_rows_needed,
)
from gpmpc.models import LogModel
from gpmpc.models._correction import Correction, Prior
from gpmpc.models._kinematics import Increments
from gpmpc.models._parametric import AffineNominal
from gpmpc.plotting import judgement_figure

sys.path.append(str(Path(__file__).resolve().parents[1]))
from tests.cli.command import forked

TWO = LogMapping.from_dict({"states": {"c": ["c"], "T": ["T"]}, "inputs": {"u": ["u"]}})
STEP = 0.1


def log_of(states, inputs, mapping=TWO, step=STEP):
    """A log of runs (R, K, n), (R, K, m)."""
    runs = tuple(
        LogRun(
            f"run {i}",
            step * np.arange(len(x)),
            np.asarray(x),
            np.asarray(u),
            np.empty((len(x), 0)),
        )
        for i, (x, u) in enumerate(zip(states, inputs, strict=True))
    )
    return Log(mapping, step, runs)


def simulate(rates, start, inputs, step=STEP):
    """Euler steps of a system."""
    states = [np.array(start, dtype=float)]
    for u in inputs[:-1]:
        states.append(states[-1] + step * np.array(rates(states[-1], u)))
    return np.array(states)


def held_inputs(rng, rows, width, hold=8):
    return np.repeat(rng.uniform(-width, width, (rows // hold + 1, 1)), hold, axis=0)[
        :rows
    ]


def reactor_log(rows=500):
    """Concentration and temperature, each of which burns by a product of both."""

    def rates(x, u):
        burned = x[0] * np.exp(1.5 * x[1])
        return [0.5 * (1 - x[0]) - 0.4 * burned, 0.4 * burned - 0.9 * x[1] + u[0]]

    inputs = held_inputs(np.random.default_rng(0), rows, 0.5)
    return log_of([simulate(rates, [0.6, 0.2], inputs)], [inputs])


def test_a_transient_and_its_rest_are_in_all_folds():
    time = np.arange(600)
    states = np.column_stack([3 * np.exp(-time / 40), np.exp(-time / 40)])
    folds = split_folds(log_of([states], [np.zeros((600, 1))]), past=23, steps=10)
    assert folds.coverage > 0.7
    for fold in folds.parts:
        assert max(run.states[:, 0].max() for run in fold.train) > 0.9
        trained = {tuple(row) for run in fold.train for row in run.states}
        # What comes before the rows to predict may be of the block before.
        predicted = {tuple(row) for run in fold.held_out for row in run.states[23:]}
        assert not trained & predicted
    blocks = [run for fold in folds.parts for run in fold.held_out]
    assert sum(len(run) - 23 for run in blocks) == 600 - 23
    halves = split_folds(log_of([states[:90]], [np.zeros((90, 1))]), past=23, steps=10)
    assert "halves" in halves.method
    long = split_folds(log_of([np.tile(states, (6, 1))], [np.zeros((3600, 1))]), 23, 10)
    assert (len(folds.parts), len(long.parts)) == (4, 2)


@pytest.mark.parametrize(("mistakes", "gain"), [((0.2, 0.2), 0.25), ((0.2, 0.05), 1.0)])
def test_models_of_all_rows_err_less_where_folds_agree(mistakes, gain):
    """By a power law; rates of models of fewer rows are wrong by ``mistakes``."""
    slope = np.tile(STEP * np.arange(60)[:, None], (1, 2))
    log = log_of([slope], [np.zeros((60, 1))])

    def wrong_by(mistake):
        kinematics = Increments(log.space)
        affine = AffineNominal(kinematics, fitted=True)
        theta = np.zeros((2, 4))
        theta[:, -1] = 1 + mistake
        return LogModel(kinematics, affine, theta.ravel(), (0, 0))

    gains = learning_gains(
        fewer=[wrong_by(one) for one in mistakes],
        models=[wrong_by(0.1)] * 2,
        logs=[log] * 2,
        steps=(1, 10),
        exponent=1.0,
    )
    np.testing.assert_allclose(gains, np.full((2, 2), gain))


@pytest.mark.parametrize(
    ("rows", "reach", "longest"), [(1000, 40, "8 past rows"), (120, 7, "7 past rows")]
)
def test_short_runs_are_looked_back_on_a_little(rows, reach, longest):
    log = log_of([np.zeros((rows, 2))] * 5, [np.zeros((rows, 1))] * 5)
    assert affordable_rows_back(log, for_control=False) == reach
    assert (
        affordable_rows_back(log, for_control=True) == 40
    )  # lags alone know the past there
    possible = [one.label for one in additions(bases(log, reach)[0])]
    assert longest in [words[:11] for words in possible]
    assert ("14 past rows" in possible) == (reach >= 14)


def test_inputs_that_act_late_are_known_to_controllers():
    rng = np.random.default_rng(0)
    rows = 240
    commands = held_inputs(rng, rows, 1.0, hold=4)
    logs = []
    for late in (0, 3):
        acting = np.vstack([np.zeros((late, 1)), commands[: rows - late]])
        exact = simulate(lambda x, u: [x[1], 4 * u[0] - 2 * x[1]], [0, 0], acting)
        states = exact + rng.normal(size=exact.shape) * [0.002, 0.02]
        logs.append(log_of([states], [commands]))
    assert [likely_delay_rows(log, most_rows_back=40) for log in logs] == [0, 3]
    search = Search(
        log=logs[1],
        folds=split_folds(logs[1], past_rows_needed(40, 3), 5, most=2).parts,
        most_rows_back=40,
        points=10,
        steps=5,
        seed=0,
        progress=lambda text: None,
        results={},
        for_control=True,
        delay_rows=3,
    )
    search._search_nominals()
    assert search.best.model.lag == 3
    assert "inputs 3 rows late" in search.best.name


@pytest.mark.parametrize("control", [False, True])
def test_a_short_run_is_learned_by_few_steps(control):
    """A GP whose targets are averaged over ten rows has no windows in its halves."""
    log = reactor_log(55)
    lines = []
    learned = learn(log, points=10, progress=lines.append, for_control=control)
    assert "short log: rollouts of 2 steps decide, not of 50" in lines
    names = [one.name for one in learned.candidates]
    assert not any("disturbance, GP" in name and "over 10" in name for name in names)
    with pytest.raises(DataError, match="needs 54 rows without a gap"):
        learn(reactor_log(53), points=10)
    # The longest run alone is no measure of what the others hold.
    long, *short = np.split(reactor_log(250).runs[0].states, [90, 130, 170, 210])
    lengths = [len(long), *map(len, short)]
    runs = log_of([long, *short], [np.zeros((rows, 1)) for rows in lengths])
    plan = _plan_folds(runs, 50, for_control=False)
    assert 10 <= plan.steps <= 20


def test_what_is_slower_than_all_that_is_sought_is_no_delay():
    commands = held_inputs(np.random.default_rng(0), 400, 1.0, hold=4)
    acting = np.vstack([np.zeros((30, 1)), commands[:370]])
    states = simulate(lambda x, u: [x[1], 4 * u[0] - 2 * x[1]], [0, 0], acting)
    assert (
        likely_delay_rows(
            log_of([states], [np.zeros_like(commands)]), most_rows_back=40
        )
        == 0
    )
    assert likely_delay_rows(log_of([states], [commands]), most_rows_back=0) == 0
    # The longest delay that is sought is found.
    acting = np.vstack([np.zeros((15, 1)), commands[:385]])
    states = simulate(lambda x, u: [x[1], 4 * u[0] - 2 * x[1]], [0, 0], acting)
    assert likely_delay_rows(log_of([states], [commands]), most_rows_back=40) == 15


def test_runs_are_dealt_so_that_ranges_are_covered():
    rng = np.random.default_rng(0)
    sizes = [1, 1, 3, 3, 1, 3]
    states = [size * rng.uniform(-1, 1, (200, 2)) for size in sizes]
    log = log_of(states, [rng.uniform(-1, 1, (200, 1))] * 6)
    folds = split_folds(log, past=23, steps=10)
    assert "6 runs" in folds.method
    for fold in folds.parts:
        wide = [size for run in fold.train for size in [np.abs(run.states).max()]]
        assert max(wide) > 2
    # Of many runs, deals are compared that are not alike.
    rng = np.random.default_rng(2)
    lengths = np.sort(rng.integers(80, 200, 20))
    centres = rng.permutation(np.repeat([0, 0, 0, 0, 0, 0, 3, -3, 6, -6], 2))
    runs = zip(centres, lengths, strict=True)
    states = [centre + rng.uniform(-1, 1, (rows, 2)) for centre, rows in runs]
    log = log_of(states, [rng.uniform(-1, 1, (rows, 1)) for rows in lengths])
    assert split_folds(log, past=23, steps=10).coverage > 0.95


def test_turns_and_signs_that_runs_count_otherwise_are_covered():
    """Headings that go on over a turn, and quaternions of the other sign."""
    states = {
        "heading": {"columns": ["h"], "kind": "angle", "unit": "rad"},
        "attitude": {"columns": ["x", "y", "z", "w"], "kind": "quaternion"},
    }
    states["attitude"]["order"] = "xyzw"
    mapping = LogMapping.from_dict({"states": states, "inputs": {"u": ["u"]}})
    half = 0.3 * np.sin(0.1 * np.arange(80))
    runs = []
    for number in range(4):
        sign = (-1) ** number
        heading = np.pi + half + 2 * np.pi * number
        attitude = sign * np.stack([np.sin(half), 0 * half, 0 * half, np.cos(half)])
        runs.append(np.column_stack([heading, attitude.T]))
    log = log_of(runs, [half[:, None]] * 4, mapping)
    assert split_folds(log, past=5, steps=5).coverage == 1.0
    low, high = ranges_of(log)[:, [0, 4]].T
    np.testing.assert_allclose(low, np.pi + np.array([-0.3, 0.3]), atol=1e-3)
    np.testing.assert_allclose(high, [np.cos(0.3), 1.0], atol=1e-3)


def test_coupled_outputs_are_learned_together():
    """As well as by plain ``train``, though a GP on either output alone is worse."""
    fitting, held_out = reactor_log().split_by_time(0.8)
    learned = learn(fitting, points=60, steps=20)
    judgement = judge(learned, held_out, fitting, steps=(1, 20))
    assert not judgement.losses
    posterior = train(fitting.transitions(), predicts="difference").posterior
    windows = held_out.windows(20, 20)
    x = windows.states[:, 20]
    for k in range(20):
        x = x + posterior.linearize(x, windows.inputs[:, 20 + k], False).mean
    plain = np.abs(x - windows.states[:, 40]).mean(axis=0)
    assert (judgement.mean["model"][-1] < 2 * plain + 1e-3 * x.std(axis=0)).all()
    best = next(one for one in learned.candidates if one.chosen)
    linear = [one for one in learned.candidates if one.name == "least squares"]
    assert (best.errors[-1] < 0.3 * linear[0].errors[-1]).all()


def test_smoothing_takes_noise_away_and_leaves_clean_rows(monkeypatch):
    rng = np.random.default_rng(0)
    inputs = held_inputs(rng, 1500, 2.0)
    clean = simulate(lambda x, u: [x[1], -4 * x[0] - x[1] + u[0]], [0, 0], inputs, 0.02)
    kinematics = Increments(TWO.space)
    assert smooth(log_of([clean], [inputs], step=0.02), kinematics, 0) is None
    noisy = clean + rng.normal(0, [0.02, 0.05], clean.shape)
    with_stub = log_of([noisy, noisy[:1]], [inputs, inputs[:1]], step=0.02)
    smoothed = smooth(with_stub, kinematics, 0)
    assert smoothed is not None
    np.testing.assert_array_equal(smoothed.runs[1].states, noisy[:1])
    errors = np.sqrt(np.square(smoothed.runs[0].states - clean).mean(axis=0))
    assert (errors < 0.4 * np.array([0.02, 0.05])).all()
    # Of long runs, a block at a time makes equations.
    monkeypatch.setattr("gpmpc.logs._smoothing._BLOCK", 400)
    monkeypatch.setattr("gpmpc.logs._smoothing._OVERLAP", 300)
    blocks = []

    def solve(diagonal, below, right):
        blocks.append(len(right))
        return _solve_block_tridiagonal(diagonal, below, right)

    monkeypatch.setattr("gpmpc.logs._smoothing._solve_block_tridiagonal", solve)
    in_blocks = smooth(log_of([noisy], [inputs], step=0.02), kinematics, 0)
    assert in_blocks is not None
    assert max(blocks) == 1000
    in_rows = in_blocks.runs[0].states
    np.testing.assert_allclose(in_rows, smoothed.runs[0].states, rtol=0, atol=1e-3)
    # Steps that are random themselves are no noise of the measurement.
    walk = np.cumsum(rng.normal(size=(1500, 2)), axis=0)
    assert smooth(log_of([walk], [inputs]), kinematics, 0) is None


def test_noisy_rows_lose_to_no_baseline():
    rng = np.random.default_rng(1)
    inputs = held_inputs(rng, 2000, 2.0)
    clean = simulate(
        lambda x, u: [x[1], -6 * np.sin(x[0]) - 0.4 * x[1] + u[0]], [0, 0], inputs, 0.02
    )
    noisy = clean + rng.normal(0, [0.02, 0.05], clean.shape)
    log = log_of([noisy], [inputs], step=0.02)
    fitting, held_out = log.split_by_time(0.8)
    learned = learn(fitting, points=40, steps=20)
    judgement = judge(learned, held_out, fitting, steps=(1, 10, 20))
    assert not judgement.losses
    baselines = [e for name, e in judgement.mean.items() if name != "model"]
    ratio = judgement.mean["model"] / np.min(baselines, axis=0)
    assert ratio.max() < 1.03
    assert ratio[-1].max() < 0.95


def test_a_correction_upon_a_still_state_is_a_regression():
    log = reactor_log(400)
    kinematics = Increments(log.space)
    windows = log.windows(10, past=20)
    still = np.repeat(windows.states[:, 20:21], 10, axis=1)
    correction, free = Correction.fit_each(
        kinematics, windows, still, (1, 10), [Prior(1e-6), Prior(np.inf)]
    )
    corrected = correction(windows, still)
    np.testing.assert_array_equal(free(windows, still)[:, -1], still[:, -1])
    error = [
        np.square(windows.states[:, 30] - states[:, -1]).mean()
        for states in (corrected, still)
    ]
    assert error[0] < 0.2 * error[1]
    shares = np.full((2, 2, 2), [[[0.25]], [[0.75]]])
    averaged = Correction.average([correction, free], shares)(windows, still)
    quarter = 0.25 * corrected + 0.75 * still
    np.testing.assert_allclose(averaged, quarter, rtol=0, atol=1e-12)
    (of_few,) = Correction.fit_each(
        kinematics, windows[:100], still[:100], (1, 10), [Prior(1e-6)]
    )
    averaged = Correction.average([of_few, correction], shares)(windows, still)
    quarter = 0.25 * of_few(windows, still) + 0.75 * corrected
    np.testing.assert_allclose(averaged, quarter, rtol=0, atol=1e-9)
    between = correction(windows, still)[:, 4] - still[:, 4]  # 5 of 1 to 10 steps
    ends = correction(windows, still) - still
    expected = ends[:, 0] + (ends[:, 9] - ends[:, 0]) * 4 / 9
    np.testing.assert_allclose(between, expected, atol=1e-12)
    # After its last step it fades, to nothing at twice as many.
    longer = log.windows(25, past=20)
    rested = np.repeat(longer.states[:, 20:21], 25, axis=1)
    moved = correction(longer, rested) - rested
    np.testing.assert_allclose(moved[:, 14], moved[:, 9] / 2, atol=1e-12)
    assert not moved[:, 19:].any()


def test_a_correction_keeps_a_share_of_the_movement():
    log = reactor_log(400)
    windows = log.windows(10, past=20)
    start = windows.states[:, 20:21]
    predicted = start + np.random.default_rng(0).normal(size=(len(windows), 10, 2))
    half, none, near_none = Correction.fit_each(
        kinematics=Increments(log.space),
        windows=windows,
        predicted=predicted,
        steps=(1, 10),
        priors=[Prior(np.inf, 0.5), Prior(np.inf, 0.0), Prior(1e9, 0.0)],
    )
    movement = predicted[:, -1:] - start
    for correction, share in ((half, 0.5), (none, 0.0)):
        corrected = correction(windows, predicted)[:, -1:]
        np.testing.assert_allclose(corrected, start + share * movement, atol=1e-12)
    # A large penalty leaves the constant, which is the mean error of the prior.
    measured = windows.states[:, 30:31]
    corrected = near_none(windows, predicted)[:, -1:]
    expected = start + (measured - start).mean(axis=0)
    np.testing.assert_allclose(corrected, expected, atol=1e-6)


def test_a_correction_without_movement_is_the_ridge_regression():
    log = reactor_log(200)
    windows = log.windows(10, past=20)
    still = np.repeat(windows.states[:, 20:21], 10, axis=1)
    wild = still + np.random.default_rng(0).normal(size=still.shape)
    corrected = []
    for predicted in (still, wild):
        (ridge,) = Correction.fit_each(
            Increments(log.space), windows, predicted, (1, 10), [Prior(0.01, 0.0)]
        )
        corrected.append(ridge(windows, predicted)[:, [0, 9]])
    np.testing.assert_allclose(corrected[1], corrected[0], rtol=0, atol=1e-9)


def test_least_absolute_errors_are_those_of_most_rows():
    """Of a tank whose gain is thirty times as large in a fifth of the rows."""
    rng = np.random.default_rng(0)
    inputs = rng.normal(size=(1, 1000, 2))
    states = np.zeros((1, 1000, 2))
    for k in range(999):
        gain = 0.1 if k < 800 else 3.0
        noise = 0.01 * rng.normal(size=2)
        states[0, k + 1] = 0.8 * states[0, k] + gain * inputs[0, k] + noise
    log = log_of(states, inputs)
    windows = log.windows(2, past=20)
    still = np.repeat(windows.states[:, 20:21], 2, axis=1)
    squared, absolute = Correction.fit_each(
        kinematics=Increments(log.space),
        windows=windows,
        predicted=still,
        steps=(1, 2),
        priors=[Prior(0.001), Prior(0.001, absolute=True)],
    )
    of_most_rows = windows[:700]
    errors = [
        np.abs(windows.states[:700, 21:] - one(of_most_rows, still[:700])).mean()
        for one in (squared, absolute)
    ]
    assert errors[1] < 0.5 * errors[0]


def test_averages_take_what_is_best_on_other_runs():
    log = log_of(
        [np.random.default_rng(i).normal(size=(100, 2)) for i in range(6)],
        [np.zeros((100, 1))] * 6,
    )
    windows = log.windows(10, past=20)
    still = Rollouts.of_constant_state(windows)
    measured = windows.states[:, 21:]
    errors = np.random.default_rng(9).normal(size=measured.shape)

    def ratios(predicted):
        averages = choose_averages(
            kinematics=Increments(log.space),
            rollouts=Rollouts(windows, predicted),
            judged_steps=(1, 10),
            constant_states=dict.fromkeys((1, 10), still),
        )
        return averages.ratios_to_rollout

    # What is exact stays; of what only errs, less than the rest is kept.
    np.testing.assert_allclose(ratios(measured), 1.0)
    assert (ratios(measured + 10 * errors) < 0.2).all()


@pytest.mark.parametrize(
    ("widths", "width_of_input", "offset"),
    [([1e-9, 1e5], 1e-6, 0.0), ([1e-9, 1e-9], 1e-9, 0.0), ([1.0, 1e3], 1e4, 1e6)],
)
def test_units_and_origins_change_nothing(widths, width_of_input, offset):
    """A pressure in Pa beside an opening in nm, and places far from their origin."""
    log = reactor_log(160)
    run = log.runs[0]
    scaled = replace(
        run,
        states=np.array(widths) * (run.states + offset),
        inputs=width_of_input * (run.inputs + offset),
    )
    errors = []
    for one, scale in ((run, 1.0), (scaled, np.array(widths))):
        part = replace(log, runs=(one,))
        search = tiny_search(part, for_control=True)
        search._search_nominals()
        relative = {key: value / scale for key, value in search._errors.items()}
        fitness = judge_for_control(search._fits.models(search.best)[0], part, {})
        errors.append((search.best.name, relative, fitness.faults))
    assert errors[0][0] == errors[1][0] != "constant state"
    assert errors[0][2] == errors[1][2]
    for key, expected in errors[0][1].items():
        np.testing.assert_allclose(errors[1][1][key], expected, rtol=1e-3)


def test_what_runs_have_each_for_themselves_is_not_corrected():
    rng = np.random.default_rng(1)
    levels = rng.normal(size=(6, 2))
    # A constant state is no better than the rollouts.
    states = [level + 10 * rng.normal(size=(100, 2)) for level in levels]
    log = log_of(states, [np.full((100, 1), level) for level in rng.normal(size=6)])
    windows = log.windows(10, past=20)
    still = Rollouts.of_constant_state(windows)
    measured = windows.states[:, 21:]

    def averages(errors):
        return choose_averages(
            kinematics=Increments(log.space),
            rollouts=Rollouts(windows, measured + errors),
            judged_steps=(1, 10),
            constant_states=dict.fromkeys((1, 10), still),
        )

    own = averages(rng.normal(size=(6, 1, 2))[windows.runs])
    assert (own.ratios_to_rollout > 0.8).all()
    common = averages(np.ones((len(windows), 1, 2)))
    np.testing.assert_allclose(common.shares.sum(axis=0), 1.0)
    assert (common.ratios_to_rollout < 0.1).all()


def test_a_pause_is_no_stretch():
    log = log_of(np.zeros((2, 1000, 2)), np.zeros((2, 1000, 1)))
    runs = [replace(run, begins=(0, 400)) for run in log.runs]
    whole = replace(log, runs=tuple(runs)).windows(10, past=20)
    after = np.where(np.arange(1000) < 400, 0.0, 3600.0)
    runs[0] = replace(runs[0], time=runs[0].time + after)
    paused = replace(log, runs=tuple(runs)).windows(10, past=20)
    stretches = _stretches_of(paused)
    assert stretches.max() == 7
    np.testing.assert_array_equal(stretches, _stretches_of(whole))


def test_a_run_at_rest_does_not_decide_for_those_that_move():
    rng = np.random.default_rng(2)
    states = [np.zeros((100, 2)), *rng.normal(size=(5, 100, 2))]
    log = log_of(states, rng.normal(size=(6, 100, 1)))
    windows = log.windows(10, past=20)
    still = Rollouts.of_constant_state(windows)
    errors = rng.normal(size=(len(windows), 10, 2))
    averages = choose_averages(
        kinematics=Increments(log.space),
        rollouts=Rollouts(windows, windows.states[:, 21:] + 0.1 * errors),
        judged_steps=(1, 10),
        constant_states=dict.fromkeys((1, 10), still),
    )
    # Beside a constant state, which is exact at rest, everything else is infinitely
    # far behind there; for the others that state errs fourteen times as much.
    assert (averages.ratios_to_rollout < 2.0).all()


def test_intervals_of_a_comparison_hold():
    hits = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        distances = rng.exponential(1.0, (400, 1, 1))
        others = rng.exponential(2.0, (400, 1, 1))
        one = compare("other", distances, others, block=5, independent=[400], seed=seed)
        hits += bool(one.low < 0.5 < one.high)
        assert one.high - one.low < 0.25
    assert hits >= 33  # of 38 expected, with a standard error of 1.4
    again = compare("other", distances, others, block=5, independent=[400], seed=39)
    np.testing.assert_array_equal(one.low, again.low)
    # Of a few independent errors it is wider; of fewer than four nothing is told.
    few = compare("other", distances, others, block=5, independent=[4], seed=39)
    assert few.high / few.low > (again.high / again.low) ** 1.5
    none = compare("other", distances, others, block=5, independent=[3.9], seed=39)
    assert (none.low.item(), none.high.item()) == (0.0, np.inf)
    assert none.ratio == again.ratio


@pytest.mark.parametrize("are_pieces", [False, True])
def test_predictions_of_different_pieces_are_independent(are_pieces):
    log = log_of(np.zeros((60, 71, 2)), np.zeros((60, 71, 1)))
    if are_pieces:
        log = log_of(np.zeros((1, 60 * 71, 2)), np.zeros((1, 60 * 71, 1)))
        (run,) = log.runs
        log = replace(log, runs=(replace(run, begins=tuple(range(0, 60 * 71, 71))),))
    for windows, steps in log.windows_by_step((1, 50), 20, most=1000):
        independent = independent_predictions(windows, steps)
        np.testing.assert_array_equal(independent, [60] * len(steps))
    learned = SimpleNamespace(model=SimpleNamespace(past=20))
    assert most_told_steps(learned, log) == 50
    one_run = log_of(np.zeros((1, 71, 2)), np.zeros((1, 71, 1)))
    assert most_told_steps(learned, one_run) == 50 // 4


def test_a_fifth_of_a_thousand_rows_tells_fifty_steps_ahead():
    values = np.random.default_rng(0).standard_normal((1, 1000, 2))
    split = _split(log_of(values, values[..., :1]), [])
    held_out = split.held_out(40)
    model = SimpleNamespace(past=40)
    assert most_told_steps(SimpleNamespace(model=model), held_out) == 50
    windows = held_out.windows(50, past=40)
    assert independent_predictions(windows, [50]) == 4
    # The first one is predicted from the last row that was learned from.
    last_row = split.train.runs[0].states[-1]
    np.testing.assert_array_equal(windows.states[0, 40], last_row)
    assert len(split.held_out_rows) == len(windows) + 50 - 1


def test_steps_that_were_asked_for_decide():
    log = log_of(np.ones((4, 200, 2)), np.zeros((4, 200, 1)))
    folds = split_folds(log, 24, 120).parts
    errors = HeldOutErrors(log, folds, Increments(TWO.space), 24, 120)
    assert errors.judged_steps == (1, 10, 50, 120)


def test_windows_that_overlap_are_one_error():
    """Of ten windows that share their rows a mean is known no better than of one."""
    signs = np.tile([1.0, -1.0], 8)
    residuals = np.repeat(1e-3 * signs, 10)[:, None]
    errors = [
        _standard_errors(np.ones((160, 1)), residuals, block) for block in (1, 10)
    ]
    np.testing.assert_allclose(errors[1] / errors[0], np.sqrt(10), rtol=1e-3)


def test_coverage_intervals_hold_for_errors_alike_for_long():
    log = log_of(np.zeros((2, 500, 2)), np.zeros((2, 500, 1)))
    windows = log.windows(1)
    rng = np.random.default_rng(0)
    rho = np.exp(-1 / 25)
    held = []
    for _ in range(60):
        noise = np.sqrt(1 - rho**2) * rng.normal(size=(1000 + len(windows), 1, 2))
        errors = lfilter([1], [1, -rho], noise, axis=0)[1000:]
        sizes = np.abs(errors) / 1.96
        coverage = np.mean(sizes <= 1, axis=0)
        intervals = _coverage_intervals(coverage, sizes, windows, (1,))
        held.append((intervals[..., 0] <= 0.95) & (intervals[..., 1] >= 0.95))
    assert np.mean(held) >= 0.92
    white = rng.normal(size=len(windows))
    assert effective_number(white, windows.runs) > 0.8 * len(white)


def test_held_out_runs_that_are_too_short_are_told_first():
    train = log_of(np.zeros((1, 900, 2)), np.zeros((1, 900, 1)))
    for rows, is_told in ((30, True), (200, False)):
        held_out = log_of(np.zeros((1, rows, 2)), np.zeros((1, rows, 1)))
        doubt = _doubt_of_held_out(_Split(train, held_out), for_control=False)
        assert (f"has {rows} rows" in doubt) == is_told
    whole = _Split(train, held_out, train.runs[0])  # its last rows have a past
    assert not _doubt_of_held_out(whole, for_control=False)


def test_noise_is_known_as_far_as_rollouts_reach():
    walk = np.cumsum(np.random.default_rng(0).normal(size=(2, 800, 2)), axis=1)
    log = log_of(walk, np.zeros((2, 800, 1)))
    kinematics = Increments(log.space)
    still = AffineNominal(kinematics, fitted=False)
    model = LogModel(kinematics, still, np.empty(0), history=(0, 0))
    noise = fit_noise([model], [log], noise_steps(120))
    assert noise.steps[-4:] == (50, 70, 100, 120)
    largest = noise.largest_at((50, 120))
    assert (largest[1] > 1.5 * largest[0]).all()


def test_noise_is_not_that_of_one_wild_stretch():
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(size=(2, 2000, 2)), axis=1)
    walk[0, 100:120, 0] += 100 * rng.normal(size=20)
    log = log_of(walk, np.zeros((2, 2000, 1)))
    kinematics = Increments(log.space)
    still = AffineNominal(kinematics, fitted=False)
    model = LogModel(kinematics, still, np.empty(0), history=(0, 0))
    noise = fit_noise([model], [log], noise_steps(50))
    steps = (1, 10, 50)
    windows = log.windows(50, past=1)
    for variances in (
        error_variances(model, windows, noise, steps),
        tube_variances(model, windows, noise.tube, steps),
    ):
        ratios = variances.mean(axis=0) / np.array([[1.0], [10.0], [50.0]])
        assert (ratios > 0.7).all()
        assert (ratios < 1.6).all()


def test_noise_is_fitted_to_what_is_finite():
    regressors = np.array([[1.0, 0.0], [np.inf, 1.0], [0.0, 2.0], [np.nan, 0.0]])
    solution = _nonnegative_solution(regressors, np.array([1.0, 5.0, 4.0, 7.0]))
    np.testing.assert_allclose(solution, [1.0, 2.0])


def test_a_state_that_never_moves_is_drawn(recwarn):
    nothing = np.zeros((2, 1))
    judgement = Judgement(
        groups=("pressure",),
        units=("Pa",),
        steps=(1, 10),
        mean={"model": nothing, "constant state": nothing},
        rmse={"model": nothing, "constant state": nothing},
        coverage=nothing + 1,
        coverage_interval=np.ones((2, 1, 2)),
        width=nothing + 1,
        windows=20,
    )
    judgement_figure(judgement).canvas.draw()
    assert not recwarn.list


@pytest.mark.parametrize(
    ("coverage", "width", "limits_of_coverage", "limits_of_width"),
    [
        (0.3, 17000.0, (0.15, 1.05), (1 / 3, 25500.0)),
        (0.95, 1.0, (0.5, 1.05), (1 / 3, 3.0)),
        (np.nan, np.nan, (0.5, 1.05), (1 / 3, 3.0)),
    ],
)
def test_intervals_are_shown_however_wrong_they_are(
    coverage, width, limits_of_coverage, limits_of_width
):
    errors = np.ones((2, 1))
    coverage = np.array([[coverage], [np.nan]])
    width = np.array([[width], [np.nan]])
    judgement = Judgement(
        groups=("pressure",),
        units=("Pa",),
        steps=(1, 10),
        mean={"model": errors, "constant state": errors},
        rmse={"model": errors, "constant state": errors},
        coverage=coverage,
        coverage_interval=np.stack([coverage - 0.1, coverage + 0.1], axis=-1),
        width=width,
        windows=20,
    )
    _, axis_of_coverage, axis_of_width = judgement_figure(judgement).axes
    assert axis_of_coverage.get_ylim() == pytest.approx(limits_of_coverage)
    assert axis_of_width.get_ylim() == pytest.approx(limits_of_width)


def test_one_stretch_tells_no_average_from_chance():
    """Its errors are least where two corrections are averaged."""
    errors = np.full((len(_PRIORS), 20, 1), 2.0)
    errors[_ROLLOUT] = 1.0
    errors[_ROLLOUT + 1] = -0.9
    shares = np.zeros(len(_PRIORS))
    shares[[_ROLLOUT, _ROLLOUT + 1]] = 0.5
    one = _Regret(errors, np.zeros(20, dtype=int))
    assert _without_chance(shares, errors, one)[_ROLLOUT] == 1.0
    two = _Regret(errors, np.repeat([0, 1], 10))
    np.testing.assert_allclose(_without_chance(shares, errors, two), shares)


def test_a_window_that_diverges_spoils_no_comparison():
    rng = np.random.default_rng(0)
    distances = rng.exponential(1.0, (400, 1, 1))
    others = rng.exponential(2.0, (400, 1, 1))
    expected = compare(
        "other", distances[1:], others[1:], block=5, independent=[400], seed=0
    )
    distances[0] = 1e20  # once, whose draws are few
    once = compare("other", distances, others, block=5, independent=[400], seed=0)
    assert abs(once.low - expected.low) < 0.1
    for wrong in (np.inf, np.nan):
        distances[0] = wrong
        one = compare("other", distances, others, block=5, independent=[400], seed=0)
        assert np.isfinite([one.low, one.high, one.ratio]).all()
        assert one.low < 1 < one.ratio
        both = compare(
            "other", distances, distances, block=5, independent=[400], seed=0
        )
        np.testing.assert_array_equal([both.low, both.high], 1.0)


@pytest.mark.parametrize("step", [10.0, 0.01])
def test_a_lag_is_found_whatever_the_time_step(step):
    """Of two steps, which a search from three of them jumps over."""

    class Follower:
        parameter_names = ("decay", "gain")
        start = np.array([-0.02, 0.05]) / step

        def outputs(self, theta, states, inputs, context):
            decay, gain = theta
            rate = decay * states[..., 0] + gain * inputs[..., 0]
            return rate[..., None]

    inputs = held_inputs(np.random.default_rng(0), 300, 1.0, hold=5)
    kept = np.exp(-1 / 2)

    def rates(x, u):
        lagged = kept * x[1] + (1 - kept) * u[0]
        return [(-0.05 * x[0] + 0.1 * lagged) / step, (lagged - x[1]) / step]

    states = simulate(rates, [0, 0], inputs, step)[:, :1]
    mapping = LogMapping.from_dict({"states": {"c": ["c"]}, "inputs": {"u": ["u"]}})
    log = log_of([states], [inputs], mapping, step)
    model = LogModel(
        kinematics=Increments(log.space),
        nominal=Follower(),
        theta=np.empty(0),
        history=(0,),
        time_constants=np.zeros(1),
    )
    fit = fit_nominal(model, None, log, steps=20)
    assert 1.0 < fit.model.time_constants[0] / step < 2.5


def test_a_model_that_no_controller_should_use_is_named():
    rng = np.random.default_rng(0)

    def rates(x, u):
        return [x[1], -x[0] - 0.5 * x[1] + 2 * u[0]]

    def fitness(inputs, states, history=(0, 0), theta=THETA):
        log = log_of([states], [inputs])
        kinematics = Increments(log.space)
        model = LogModel(kinematics, AffineNominal(kinematics), theta, history)
        return judge_for_control(model, log, {})

    inputs = held_inputs(rng, 600, 1.0)
    states = simulate(rates, [0.1, 0], inputs)
    good = fitness(inputs, states)
    assert not good.faults
    assert not good.advice
    assert not good.warnings
    (warning,) = fitness(inputs, states, history=(0, 20)).warnings
    assert "mean error of d_T over the last 20 rows" in warning
    assert "disturbance_gain=0.1" in warning
    assert (good.effects[0].output, round(good.effects[0].gain, 3)) == ("d_T", 2.0)
    noisy = states + 0.6 * rng.normal(size=states.shape)
    other_sign = np.where(THETA == 2, -0.1, THETA)
    assert not fitness(inputs, noisy).warnings
    (warning,) = fitness(inputs, noisy, theta=other_sign).warnings
    assert warning.startswith("the model says -0.1 for the effect of u on d_T, the")
    constant = fitness(np.full((600, 1), 0.3), simulate(rates, [1, 0], [[0.3]] * 600))
    assert "does not move" in constant.faults[0]
    assert "noise.input=[0.03]" in constant.advice[0]
    gain = np.array([-0.5, -0.7])
    closed = simulate(lambda x, u: rates(x, [x @ gain]), [1, 0], inputs)
    followed = fitness(closed @ gain[:, None], closed)
    assert "follows the states" in followed.faults[0]


# of [c, T, u, 1] for each rate of change
THETA = np.array([0, 1, 0, 0, -1, -0.5, 2, 0], dtype=float)


@pytest.mark.parametrize(
    ("rates", "start", "measured", "is_hidden"),
    [
        (lambda x, u: [x[1], -9 * x[0] - 2 * x[1] + 9 * u[0]], [0, 0], [0], True),
        (lambda x, u: [x[1], -9 * x[0] - 2 * x[1] + 9 * u[0]], [0, 0], [0, 1], False),
        (lambda x, u: [3 * (u[0] - x[0]), 0], [0, 0], [0], False),
    ],
)
def test_a_position_without_its_velocity_is_no_state(rates, start, measured, is_hidden):
    """Where the rows before say where it goes, noise or not."""
    rng = np.random.default_rng(0)
    inputs = held_inputs(rng, 600, 1.0, hold=20)
    states = simulate(rates, start, inputs)[:, measured]
    states += 1e-3 * rng.normal(size=states.shape)
    signals = {name: [name] for name in "ab"[: len(measured)]}
    mapping = LogMapping.from_dict({"states": signals, "inputs": {"u": ["u"]}})
    log = log_of([states], [inputs], mapping)
    model = fit_least_squares(Increments(log.space), log)
    faults = judge_for_control(model, log, {}).faults
    said = [fault for fault in faults if "do not say where they go" in fault]
    assert len(said) == len(faults) == is_hidden
    assert all("Add the velocity" in fault for fault in said)


def test_a_feedback_that_fails_on_a_rival_is_told():
    rng = np.random.default_rng(0)
    inputs = held_inputs(rng, 600, 1.0)

    def rates(x, u):
        return [x[1], -0.5 * x[1] + 2 * u[0]]

    log = log_of([simulate(rates, [0.1, 0], inputs)], [inputs])
    theta = np.array([0, 1, 0, 0, 0, -0.5, 2, 0], dtype=float)
    model = LogModel(
        Increments(log.space), AffineNominal(Increments(log.space)), theta, (0, 0)
    )
    opposite = replace(model, theta=np.array([0, 1, 0, 0, 0, -0.5, -2, 0], dtype=float))
    fitness = judge_for_control(model, log, {"itself": model, "opposite": opposite})
    (warning,) = fitness.warnings
    assert "'opposite' unstable" in warning


class Saturated:
    parameter_names = ()
    start = np.empty(0)

    def outputs(self, theta, states, inputs, context):
        return np.tanh(inputs[..., :1] / 1e-5) - states


def test_slopes_are_taken_within_the_range_of_an_input():
    rng = np.random.default_rng(0)
    inputs = held_inputs(rng, 200, 2e-6)
    mapping = LogMapping.from_dict({"states": {"c": ["c"]}, "inputs": {"u": ["u"]}})
    rates = lambda x, u: Saturated().outputs(None, x, u, None)  # noqa: E731
    states = simulate(rates, [0.0], inputs)
    log = log_of([states], [inputs], mapping)
    model = LogModel(Increments(log.space), Saturated(), np.empty(0), (0,))
    _, slopes = _linearize(model, states, inputs, np.empty((200, 0)), STEP)
    expected = STEP * 1e5 / np.cosh(inputs / 1e-5) ** 2
    np.testing.assert_allclose(slopes[:, :, 0], expected, rtol=1e-4)


def test_inputs_of_equal_names_are_told_apart():
    rng = np.random.default_rng(0)
    inputs = np.column_stack([held_inputs(rng, 300, 1.0), np.zeros(300)])
    motors = {side: {"columns": ["u"], "topic": side} for side in ("left", "right")}
    mapping = LogMapping.from_dict(
        {
            "rate": 10,
            "states": {"c": {"columns": ["c"], "topic": "left"}},
            "inputs": motors,
        }
    )
    states = simulate(lambda x, u: [u[0] - x[0]], [0.0], inputs)
    log = log_of([states], [inputs], mapping)
    theta = np.array([-1.0, 1.0, 0.0, 0.0])
    model = LogModel(
        Increments(log.space), AffineNominal(Increments(log.space)), theta, (0,)
    )
    (fault,) = judge_for_control(model, log, {}).faults
    assert fault.startswith("right.u does not move")


def test_a_losing_model_says_so_first_and_ends_with_code_3(tmp_path):
    gain = np.array([-0.8, -0.9])
    states = simulate(lambda x, u: [x[1], -x[0] + x @ gain], [1, 1], [[0.0]] * 160)
    table = np.column_stack([STEP * np.arange(160), states, states @ gain])
    table = np.insert(table, 5, table[5], axis=0)  # a stamp that comes twice
    np.savetxt(tmp_path / "a.csv", table, delimiter=",", header="t,c,T,u", comments="")
    (tmp_path / "map.yaml").write_text(
        "time: t\nrest: use\nstates: {c: [c], T: [T]}\ninputs: {u: [u]}\n"
    )
    done = forked(
        *("learn", "map.yaml", "a.csv", "--steps", "5", "--points", "10"),
        "--for-control",
        cwd=tmp_path,
    )
    assert done.returncode == 3, done.stderr
    assert "do not use this model: u follows the states" in done.stderr
    assert "noise.input=[" in done.stdout
    for name in ("report.md", "card.md"):
        first = (tmp_path / "learned" / name).read_text().splitlines()[0]
        assert first.startswith("# This model should not be used: u follows"), first
    left_out = (tmp_path / "learned" / "card.md").read_text().split("Left out of")[1]
    assert "a: repeated stamp: " in left_out
    assert "1 / 5 steps ahead" in (tmp_path / "learned" / "report.md").read_text()


def tiny_search(log, for_control=False):
    """A search whose bases were considered, and nothing else."""
    search = Search(
        log=log,
        folds=split_folds(log, past_rows_needed(40), 5).parts,
        most_rows_back=40,
        points=10,
        steps=5,
        seed=0,
        progress=lambda text: None,
        results={},
        for_control=for_control,
    )
    for base in bases(log, 40):
        search._consider_nominal(base, parent=None)
    return search


def test_a_runner_up_does_not_stand_for_the_baseline_of_its_name(monkeypatch):
    search = tiny_search(reactor_log(240))
    names = [one.name for one in search.comparisons()]
    assert len(names) == len({*names}) == 5
    (rival,) = [name for name in names if "fitted on rollouts" in name]
    assert rival.partition(",")[0] in names
    # A short run has a window, however many rows the others have.
    monkeypatch.setattr("gpmpc.logs._validation._CORRECTED_WINDOWS", 1)
    validations = search._validations._validate(search.best)
    assert all(len(one.rollouts.windows) for one in validations)


def test_a_search_ends_where_all_that_is_best_is_unstable(monkeypatch):
    search = tiny_search(reactor_log(240))
    monkeypatch.setattr(search, "_is_unstable", lambda models: True)
    for name in ("_search_nominals", "_search_combinations", "_consider_correction"):
        monkeypatch.setattr(search, name, lambda *structure: None)
    for name in ("_starts_of_gps", "_starts_of_gps_of_past"):
        monkeypatch.setattr(search, name, list)
    search.run()
    assert search.best.nominal.key in search._unstable


@pytest.mark.parametrize("rows", [110, 240])
def test_corrections_and_noise_are_fitted_to_held_out_rows(rows):
    search = tiny_search(log := reactor_log(rows))
    start = next(one for one in search._structures.values() if one.size == 0)
    for one in search._validations._validate(start):
        seen = np.concatenate([run.time for run in one.train])
        windows = one.held_out.windows(5, past=20)
        for times in (one.rollouts.windows.times, windows.times):
            predicted = times[:, None] + log.time_step * np.arange(1, 6)
            assert not np.isclose(predicted[..., None], seen, atol=1e-6).any()


@pytest.mark.parametrize("scale", [1.0, 2e7])
def test_states_of_any_unit_are_corrected(scale):
    """A pressure of 200 bar in Pa is no rollout that diverged."""
    log = reactor_log(120)
    runs = tuple(replace(run, states=scale * (2 + run.states)) for run in log)
    search = tiny_search(replace(log, runs=runs))
    start = next(one for one in search._structures.values() if one.size == 0)
    assert search._validations.choose_averages(start) is not None


def test_a_correction_by_ridge_alone_is_the_baseline():
    """It is fitted to all windows, and not to those of held-out blocks alone."""
    log = reactor_log(240)
    search = tiny_search(log)
    start = next(one for one in search._structures.values() if one.size == 0)
    shares = np.zeros((len(_PRIORS), 2, 2))
    shares[_RIDGE] = 1.0
    ridge = replace(
        start, correction_shares=tuple(tuple(map(tuple, one)) for one in shares)
    )

    def check(model, fitted_to):
        for step in search.judged_steps:
            windows = log.windows(step, past=20)
            errors = model.rollout_errors(windows, [step])
            baselines = baseline_errors(model.kinematics, fitted_to, windows, [step])
            expected = baselines["ridge regression"]
            np.testing.assert_allclose(errors, expected, rtol=0, atol=1e-9)

    check(search._validations.fit_to_all_runs(ridge).model, log)
    models = search._validations.corrected_models(ridge)
    for model, fold in zip(models, search._folds, strict=True):
        check(model, fold.train)


def test_without_inputs_nothing_acts_through_lags():
    mapping = LogMapping.from_dict({"states": {"c": ["c"], "T": ["T"]}})
    log = log_of([np.zeros((50, 2))], [np.empty((50, 0))], mapping)
    for base in bases(log, 40):
        extended = [base.extended(addition) for addition in additions(base)]
        assert not [one for one in extended if one and "lags" in one.name]
    with pytest.raises(SettingError, match="for_control: needs inputs"):
        learn(log, for_control=True)


@pytest.mark.parametrize("control", [False, True])
def test_the_same_seed_gives_the_same_numbers(control):
    log = reactor_log(300)
    memory = {}
    first = learn(log, points=20, steps=10, for_control=control, memory=memory)
    stopped = dict(list(memory.items())[: len(memory) // 2])  # and begun again
    again = learn(log, points=20, steps=10, for_control=control, memory=stopped)
    assert stopped == memory
    for one, other in zip(first.candidates, again.candidates, strict=True):
        np.testing.assert_array_equal(one.errors, other.errors)
    windows = log.windows(10, 20)
    np.testing.assert_array_equal(
        first.model.rollout(windows), again.model.rollout(windows)
    )
    assert (first.control is not None) == control


def test_what_moves_by_round_off_says_nothing():
    """A place on a map where a vehicle stands, and an input that is held."""
    log = reactor_log(400)
    rng = np.random.default_rng(0)
    (run,) = log.runs
    place = 5e3 * (1 + rng.uniform(-1, 1, len(run.states)) * 2e-16)
    held = 9.81 * (1 + rng.uniform(-1, 1, (len(run.states), 1)) * 1e-14)
    states = np.column_stack([run.states[:, 0], place])
    log = replace(log, runs=(replace(run, states=states, inputs=held),))
    windows = log.windows(10, past=20)
    still = np.repeat(windows.states[:, 20:21], 10, axis=1)
    (correction,) = Correction.fit_each(
        Increments(log.space), windows, still, (1, 10), [Prior(0.01)]
    )
    moved = replace(
        windows,
        states=windows.states + [0.0, 0.01] * np.arange(31)[:, None],
        inputs=windows.inputs + 0.01,
    )
    start = np.repeat(moved.states[:, 20:21], 10, axis=1)
    change = correction(moved, start) - start
    assert np.abs(change[..., 0]).max() < 0.5
    assert np.abs(change[..., 1]).max() < 1e-6


def test_rollouts_that_end_before_the_first_step_stay(recwarn):
    log = reactor_log(200)
    windows = log.windows(10, past=20)
    still = np.repeat(windows.states[:, 20:21], 10, axis=1)
    (correction,) = Correction.fit_each(
        Increments(log.space), windows, still, (5, 10), [Prior(0.01)]
    )
    assert np.array_equal(correction(windows, still[:, :3]), still[:, :3])
    assert not recwarn.list
