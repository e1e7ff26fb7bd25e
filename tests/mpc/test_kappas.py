"""The standard deviations that a bound is moved by can come with the reference, by
stage: of a conformal tube, say."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.estimation import AdaptiveTube, ConformalTube
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization
from gpmpc.simulation import ModelLoop, closed_loop
from tests.mpc.small_models import double_integrator

H = 6
UPPER = 0.3
STD = np.array([0.01, 0.02])
FAR = Reference(np.tile([1.0, 0.0], (H + 1, 1)), np.zeros((H, 1)))  # beyond the bound
START = Gaussian.certain(np.zeros(2))


def controller(probability=0.95, **settings):
    bounds = Box([-np.inf, -np.inf], [UPPER, np.inf], probability=probability)
    problem = Problem(
        Tracking([10.0, 0.1], [1e-3]), Box([-20.0], [20.0]), constraints=[bounds]
    )
    propagator = Linearization()
    return GPMPC(
        double_integrator(W=np.diag(STD**2).tolist()),
        propagator,
        problem,
        H,
        [0.0],
        PredictionSettings(**settings),
    )


def test_bounds_are_moved_by_the_kappas_of_the_reference():
    mpc = controller()
    plain = None
    for kappas in (np.full(H, 1.6448536269514722), np.linspace(1.0, 4.0, H)):
        decision = mpc.control(START, replace(FAR, kappas=kappas))
        sd = np.sqrt(decision.covariances[1:, 0, 0])
        assert sd.min() > 0
        margins = (UPPER - decision.means[1:, 0]) / sd
        assert (margins > kappas - 1e-6).all()
        assert np.isclose(margins, kappas, atol=1e-5).any()
        plain = mpc.control(START, FAR) if plain is None else plain
        assert np.allclose(decision.inputs, plain.inputs, atol=1e-9) == (
            kappas[0] == kappas[-1]
        )


def test_the_steps_of_a_closed_loop_keep_to_their_own_kappas():
    steps = 6
    rising = np.where(np.arange(steps + H) < 4, 4.0, 8.0)
    path = Reference(
        np.tile([1.0, 0.0], (steps + H + 1, 1)), np.zeros((steps + H, 1)), rising
    )
    point = Reference([1.0, 0.0], [0.0], np.full(H, 4.0))
    system = ModelLoop(double_integrator(), Linearization(), 0.1)
    at_bound = []
    for reference in (path, point):
        flight = closed_loop(system, controller(), reference, START, steps)
        at_bound.append(flight.states[1:, 0])
    # As near as 4 deviations of the next state, and 8 from the fourth step on.
    assert np.allclose(at_bound[0], [0.26] * 4 + [0.22] * 2, atol=1e-6)
    assert np.allclose(at_bound[1], 0.26, atol=1e-6)


def test_a_set_point_keeps_its_kappas():
    mpc = controller()
    kappas = np.full(H, 3.0)
    point = mpc.control(START, Reference(FAR.states[0], np.zeros(1), kappas))
    assert np.array_equal(
        point.inputs, mpc.control(START, replace(FAR, kappas=kappas)).inputs
    )
    with pytest.raises(ShapeError, match=r"kappas must be \(6,\); got \(2,\)"):
        mpc.control(START, Reference(FAR.states[0], np.zeros(1), kappas[:2]))


def test_a_bound_on_the_mean_stays_one():
    mpc = controller(probability=None)
    with_kappas = mpc.control(START, replace(FAR, kappas=np.full(H, 4.0)))
    assert np.array_equal(with_kappas.inputs, mpc.control(START, FAR).inputs)


def test_an_adaptive_tube_holds_where_noise_exceeds_the_model():
    mpc = controller()
    rng = np.random.default_rng(0)
    outside = {}
    for name in ("as learned", "adapted"):
        tube = ConformalTube(
            np.abs(np.random.default_rng(1).normal(size=(200, H))), [[1.0, 0.0]]
        )
        adaptive = AdaptiveTube(tube, 0.95, rate=0.05)
        x = np.zeros(2)
        last = None
        count = 0
        for _ in range(250):
            adaptive.observe(x)
            kappas = adaptive.kappas if name == "adapted" else None
            last = mpc.control(Gaussian.certain(x), replace(FAR, kappas=kappas), last)
            adaptive.remember(last.means, last.covariances)
            next_mean = mpc.prediction.model.predict(
                torch.from_numpy(x), torch.from_numpy(last.input)
            ).mean.numpy()
            x = next_mean + 3 * STD * rng.normal(size=2)
            count += x[0] > UPPER
        outside[name] = count / 250
    assert outside["as learned"] > 0.15
    assert outside["adapted"] < 0.1


@pytest.mark.parametrize(
    ("make", "error", "rule"),
    [
        (
            lambda: replace(FAR, kappas=np.ones(H + 1)),
            ShapeError,
            r"kappas must be \(6,\); got \(7,\)",
        ),
        (
            lambda: replace(FAR, kappas=np.full(H, -1.0)),
            SettingError,
            "kappas: must not be negative",
        ),
        (
            lambda: controller().control(
                START, replace(FAR, kappas=np.full(H, np.nan))
            ),
            DataError,
            "must be finite",
        ),
        (
            lambda: controller(covariance="full").control(
                START, replace(FAR, kappas=np.ones(H))
            ),
            SettingError,
            "kappas: are for covariances of 'zero_order'; this controller has 'full'",
        ),
    ],
)
def test_misuse_is_refused(make, error, rule):
    with pytest.raises(error, match=rule):
        make()
