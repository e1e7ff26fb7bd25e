"""Tubes from held-out predictions hold as often as they say, and an adaptive one does
so against any plant."""

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.stats import beta, norm

from gpmpc.estimation import AdaptiveTube, ConformalTube
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.propagation import Linearization
from gpmpc.signals import Signals

H = 5
F = torch.float64


class Walk:
    """x+ = 0.9 x + u, with a noise that the model believes in."""

    state_dim = output_dim = 2
    input_dim = 2
    dtype = F
    device = torch.device("cpu")

    def __init__(self, std):
        self.noise_covariance = std**2 * torch.eye(2, dtype=F)

    def predict(self, state, input):
        return Gaussian(0.9 * state + input, torch.zeros(*state.shape, 2, dtype=F))


def log(steps, seed):
    """A plant with noise of heavy tails and a standard deviation of three, where the
    model says one."""
    rng = np.random.default_rng(seed)
    x = [np.zeros(2)]
    u = rng.normal(size=(steps, 2))
    for k in range(steps):
        x.append(0.9 * x[-1] + u[k] + 3 / np.sqrt(3) * rng.standard_t(3, size=2))
    return np.array(x), u


MODEL = Walk(1.0)
PROPAGATOR = Linearization(process_noise=True)


def share_that_holds(kappas, seed, rows=None):
    """Of fresh windows, by stage (H,)."""
    fresh = ConformalTube.calibrate(MODEL, PROPAGATOR, *log(5000, seed), H, rows)
    return (fresh.scores <= kappas).mean(0)


@pytest.mark.parametrize("rows", [None, [[1.0, 0.0]]], ids=["all states", "one side"])
@pytest.mark.parametrize("probability", [0.9, 0.95])
def test_held_out_quantiles_hold_where_the_gaussian_does_not(probability, rows):
    tubes = [
        ConformalTube.calibrate(MODEL, PROPAGATOR, *log(1000, seed), H, rows)
        for seed in range(6)
    ]
    coverage = np.mean(
        [
            share_that_holds(tube.kappas(probability), 100 + s, rows)
            for s, tube in enumerate(tubes)
        ],
        axis=0,
    )
    assert (coverage > probability - 0.015).all()
    assert (coverage < probability + 0.03).all()
    assert (
        share_that_holds(np.full(H, 1.65 if probability == 0.95 else 1.28), 100, rows)
        < 0.8
    ).all()


def test_too_few_windows_promise_nothing():
    tube = ConformalTube.calibrate(MODEL, PROPAGATOR, *log(18 * H, 0), H)
    assert (tube.kappas(0.9) == tube.scores[-1]).all()
    with pytest.raises(
        DataError, match="a probability of 0.95 needs 19 windows or more; got 18"
    ):
        tube.kappas(0.95)


@pytest.mark.parametrize("plant", ["noisy", "worse with time", "hostile"])
def test_an_adaptive_tube_holds_in_the_long_run_for_any_plant(plant):
    probability = 0.9
    rate = 0.05
    T = 1000
    scores = np.abs(np.random.default_rng(0).normal(size=(99, H)))
    tube = AdaptiveTube(
        ConformalTube(scores, [[1.0, 0.0]]), probability, rate, largest=10.0
    )
    rng = np.random.default_rng(1)
    covariances = np.tile(np.eye(2), (H + 1, 1, 1))
    for t in range(T):
        size = {"noisy": 1.0, "worse with time": 1 + 2 * t / T, "hostile": 0.0}[plant]
        x = size * rng.normal(size=2)
        if plant == "hostile":
            # just outside of the last bound of the first stage, while that is less than
            # the largest
            x = np.array([min(tube.kappas[0] + 1e-6, 9.99), 0.0])
        tube.observe(np.clip(x, -9.99, 9.99))
        tube.remember(np.zeros((H + 1, 2)), covariances)
    allowed = (
        1 - probability + (1 + rate * (np.arange(1, H + 1) + 1)) / (rate * tube.counts)
    )
    assert (tube.violations <= allowed).all()
    assert tube.counts.tolist() == [T - k for k in range(1, H + 1)]
    if plant != "hostile":
        assert np.allclose(tube.violations, 0.1, atol=0.02)


@pytest.mark.parametrize("eta", [0.9, 0.95, 0.99])
@pytest.mark.parametrize("size", [0.7, 1.4, 2.5])
def test_a_lower_aim_bounds_violations_by_what_is_allowed(eta, size):
    T = 3000
    rng = np.random.default_rng(0)
    quantiles = norm.ppf(np.arange(1, 400) / 400)[
        :, None
    ]  # of a noise that the plant's is ``size`` times
    tube = AdaptiveTube(
        ConformalTube(quantiles, [[1.0]]), eta, largest=20.0, decisions=T
    )
    for x in size * rng.normal(size=T):
        tube.remember(np.zeros((2, 1)), np.ones((2, 1, 1)))
        tube.observe([x])
    misses = tube.misses[0]
    assert beta.ppf(0.95, misses + 1, T - misses) <= 1 - eta
    assert size < 1 or misses / T > 0.3 * (1 - eta)


def test_only_predictions_of_the_stages_that_are_told_count():
    tube = AdaptiveTube(ConformalTube(np.ones((19, 3)), [[1.0]]), 0.9, largest=5.0)
    for k in range(20):
        tube.observe([100.0])  # outside of every bound
        tube.remember(np.zeros((4, 1)), np.ones((4, 1, 1)), [k % 2 == 0, False, True])
    assert tube.counts.tolist() == [10, 0, 17]
    assert tube.misses.tolist() == [10, 0, 17]
    assert tube.kappas[1] == 1.0 < tube.kappas[0] == tube.kappas[2] == 5.0


def test_only_directions_count_in_which_a_plan_touches_a_bound():
    tube = AdaptiveTube(
        ConformalTube(np.ones((19, 1)), [[1.0], [-1.0]]), 0.9, largest=5.0
    )
    touched = {
        "above": [[True, False]],
        "below": [[False, True]],
        "both": [[True, True]],
        "none": [[False, False]],
    }
    counted = []
    for stages in touched.values():
        tube.remember(np.zeros((2, 1)), np.ones((2, 1, 1)), stages)
        tube.observe([100.0])  # far above
        counted.append((int(tube.counts[0]), int(tube.misses[0])))
        tube.remember(np.zeros((2, 1)), np.ones((2, 1, 1)), stages)
        tube.observe([np.nan])  # not measured
    assert counted == [(1, 1), (2, 1), (3, 2), (3, 2)]
    assert tube.counts.tolist() == [3]


def test_a_state_that_is_not_measured_hides_no_bound_on_another():
    tube = AdaptiveTube(ConformalTube(np.ones((19, 1)), np.eye(2)), 0.9, largest=5.0)
    tube.remember(
        np.zeros((2, 2)), np.tile(0.01 * np.eye(2), (2, 1, 1)), [[True, False]]
    )
    tube.observe([100.0, np.nan])
    assert (tube.counts.tolist(), tube.misses.tolist()) == ([1], [1])


@pytest.mark.parametrize("unmeasured", [np.nan, np.inf, 3.4e38])
def test_an_angle_has_no_jumps_beside_what_is_not_measured(unmeasured):
    scores = np.linspace(0.1, 3, 100)[:, None]
    both_sides = [[1.0, 0.0], [-1.0, 0.0]]
    tube = AdaptiveTube(ConformalTube(scores, both_sides, angles=[0]), 0.9)
    plan = np.array([[3.10, 0.0], [3.15, 0.0]])
    covariances = np.tile(0.05**2 * np.eye(2), (2, 1, 1))
    tube.observe([unmeasured, unmeasured])
    tube.observe([3.10, 0.0])
    tube.remember(plan, covariances)
    tube.observe([3.153 - 2 * np.pi, unmeasured])  # beyond the sensor's turn
    assert (tube.counts.tolist(), tube.misses.tolist()) == ([1], [0])
    tube.remember(plan, covariances)
    tube.observe([unmeasured, 0.0])
    tube.remember(plan, covariances)
    tube.observe([2.0, unmeasured])
    assert (tube.counts.tolist(), tube.misses.tolist()) == ([2], [1])


def test_plans_compare_at_their_stage_without_failed_steps():
    tube = AdaptiveTube(ConformalTube(np.ones((19, 3)), [[1.0]]), 0.9, largest=5.0)
    covariances = np.ones((4, 1, 1))
    for t in range(8):
        tube.observe(
            [float(t)]
        )  # the plan of step s says s + k at stage k: it always holds
        if t != 4:
            tube.remember(t + np.arange(4.0)[:, None], covariances)
    assert tube.misses.tolist() == [0, 0, 0]
    assert tube.counts.tolist() == [6, 5, 4]
    tube.observe([11.0])  # of the plans of steps 7, 6 and 5, at stages 1, 2 and 3
    assert tube.misses.tolist() == [1, 1, 1]
    tube.observe([np.nan])
    assert tube.counts.tolist() == [7, 6, 5]


def test_misuse_is_refused():
    x, u = log(40, 0)
    with pytest.raises(DataError, match="a log of 5 states has no window of 5 steps"):
        ConformalTube.calibrate(MODEL, PROPAGATOR, x[:5], u[:4], H)
    with pytest.raises(
        DataError, match="a direction has no variance: predict with the process noise"
    ):
        ConformalTube.calibrate(MODEL, Linearization(process_noise=False), x, u, H)
    with pytest.raises(
        ShapeError, match=r"must be one log; got \(41, 2\) and \(30, 2\)"
    ):
        ConformalTube.calibrate(MODEL, PROPAGATOR, x, u[:30], H)
    with pytest.raises(DataError, match="scores must be finite; got"):
        ConformalTube([[1.0], [np.nan]], [[1.0]])
    tube = ConformalTube.calibrate(MODEL, PROPAGATOR, x, u, H)
    with pytest.raises(
        SettingError, match="probability: must lie between 0 and 1; got 1"
    ):
        tube.kappas(1.0)
    with pytest.raises(SettingError, match="rate: must be a number above 0"):
        AdaptiveTube(tube, 0.9, rate=0.0)
    with pytest.raises(
        SettingError, match="decisions: are too few for a probability of 0.99; got 100"
    ):
        AdaptiveTube(tube, 0.99, decisions=100)
    with pytest.raises(ShapeError, match=r"means must be \(6, 2\); got \(5, 2\)"):
        AdaptiveTube(tube, 0.8).remember(np.zeros((5, 2)), np.zeros((5, 2, 2)))
    adaptive = AdaptiveTube(tube, 0.8)
    means = np.zeros((H + 1, 2))
    covariances = np.zeros((H + 1, 2, 2))
    for mistake, rule in (
        (lambda: adaptive.observe([0.0]), r"a state must be \(2,\); got \(1,\)"),
        (lambda: adaptive.observe(np.zeros(3)), r"must be \(2,\); got \(3,\)"),
        (lambda: adaptive.observe(np.zeros((1, 2))), r"\(2,\); got \(1, 2\)"),
        (
            lambda: adaptive.remember(means, covariances[1:]),
            r"covariances must be \(6, 2, 2\); got \(5, 2, 2\)",
        ),
        (
            lambda: adaptive.remember(means, covariances, [True]),
            r"stages must be \(5,\) or \(5, 4\); got \(1,\)",
        ),
        (
            lambda: AdaptiveTube(tube, 0.8, noise=[0.1, 0.1]),
            r"noise must be \(2, 2\); got \(2,\)",
        ),
        (lambda: ConformalTube(np.ones(5), [[1.0]]), r"scores must be \(N, H\)"),
        (lambda: ConformalTube(np.ones((5, 1)), [1.0]), r"rows must be \(r, n\)"),
    ):
        with pytest.raises(ShapeError, match=rule):
            mistake()
    with pytest.raises(SettingError, match="angles: must be a list of different"):
        ConformalTube(np.ones((5, 1)), [[1.0, 0.0]], angles=[2])


def test_columns_of_a_table_are_sorted_by_the_names_of_the_model():
    x, u = log(60, 0)
    named = Walk(1.0)
    named.signals = Signals(["a", "b"], ["c", "d"])
    states = pd.DataFrame(x, columns=["a", "b"])[["b", "a"]]
    inputs = pd.DataFrame(u, columns=["c", "d"])[["d", "c"]]
    expected = ConformalTube.calibrate(MODEL, PROPAGATOR, x, u, H)
    tube = ConformalTube.calibrate(named, PROPAGATOR, states, inputs, H)
    assert np.array_equal(tube.scores, expected.scores)


def test_what_was_handed_out_or_taken_belongs_to_each_side():
    tubes = [
        AdaptiveTube(
            ConformalTube(np.arange(1.0, 20.0)[:, None], [[1.0]], angles=[0]),
            0.8,
            rate=0.3,
        )
        for _ in range(2)
    ]
    state = np.zeros(1)
    history = []
    copies = []
    for k in range(8):
        state[:] = k % 3
        history.append(tubes[0].observe(state))
        copies.append(tubes[1].observe(state.copy()).copy())
        for tube in tubes:
            tube.remember(np.zeros((2, 1)), 0.01 * np.ones((2, 1, 1)))
    assert len({float(kappas[0]) for kappas in copies}) > 2
    assert np.array_equal(history, copies)
    assert np.array_equal(tubes[0].counts, tubes[1].counts)
