"""The novelty of plans in every covariance mode, against numbers worked out by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, SparseTrainer, Transitions, train
from gpmpc.models import Affine, DelayedModel, KnownModel, ResidualModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.mpc._novelty import DataScales, data_scales, novelty_of
from gpmpc.propagation import Linearization, MomentMatching

PROBLEM = Problem(Tracking([1.0, 1.0], [0.1]), Box([-1.0], [1.0]))
MODES = ["full", "diagonal", "zero_order", "none"]


def transitions(rows=60, unstable=0.0, noise=1e-3):
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (rows, 2))
    inputs = rng.uniform(-1, 1, (rows, 1))
    after = states + 0.1 * np.stack(
        [states[:, 1], np.sin(states[:, 0]) + inputs[:, 0]], axis=1
    )
    after = after + unstable * states
    return Transitions(states, inputs, after + rng.normal(0, noise, (rows, 2)))


@pytest.fixture(scope="module")
def gp():
    return train(transitions(), predicts="difference", restarts=0).posterior


def controller(model, covariance="zero_order", horizon=5, propagator=None, **settings):
    prediction = PredictionSettings(covariance=covariance, **settings)
    propagator = Linearization() if propagator is None else propagator
    return GPMPC(model, propagator, PROBLEM, horizon, [0.0], prediction)


def decide(chosen, place):
    state = np.full(2, place)
    return chosen.control(Gaussian.certain(state), Reference(state))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("form", ["trajectory", "velocity"])
def test_every_mode_knows_whether_its_plan_is_among_the_data(gp, mode, form):
    chosen = controller(gp, mode, form=form)
    among = decide(chosen, 0.2)
    beyond = decide(chosen, 4e3)
    assert 0.0 < among.novelty < 0.2
    assert not among.far_from_data
    assert 0.95 < beyond.novelty < 1.5  # what is added adds up
    assert beyond.far_from_data


@pytest.mark.parametrize("mode", MODES)
def test_moments_may_be_matched(gp, mode):
    chosen = controller(gp, mode, propagator=MomentMatching())
    assert 0.0 < decide(chosen, 0.2).novelty < 0.2


@pytest.mark.parametrize("mode", ["none", "zero_order"])
def test_it_is_the_added_deviation_over_that_of_what_was_learned(gp, mode):
    chosen = controller(gp, mode)
    state = np.full(2, 0.9)
    decision = None
    for _ in range(5):  # until the stages are those of the plan
        decision = chosen.control(Gaussian.certain(state), Reference(state), decision)
        state = state if mode == "none" else decision.means[0]
    assert decision is not None
    states = torch.from_numpy(decision.means[:-1])
    inputs = torch.from_numpy(decision.inputs)
    added = gp.predict(states, inputs).variance.sqrt()
    learned = gp.targets.std(dim=0, correction=0)
    near = 1e-9 if mode == "none" else 0.5  # stages of the last plan
    assert decision.novelty == pytest.approx(float((added / learned).max()), rel=near)


def test_noise_is_no_novelty(gp):
    quiet = decide(controller(gp, propagator=Linearization(process_noise=False)), 0.2)
    noisy = decide(controller(gp), 0.2)
    assert noisy.covariances[1].trace() > 2 * quiet.covariances[1].trace()
    assert noisy.novelty == pytest.approx(quiet.novelty, rel=1e-6)


def test_a_linear_function_is_not_known_far_beyond_its_data(gp):
    """Its prior is far wider than its data, and a ratio to it stays small there."""
    learned = gp.targets.var(dim=0, correction=0)
    assert float((gp.signal_variance / learned).max()) > 5.0**2
    decision = decide(controller(gp, "none"), 4.0)
    states = torch.from_numpy(decision.means[:-1])
    inputs = torch.from_numpy(decision.inputs)
    to_prior = (gp.predict(states, inputs).variance / gp.signal_variance).sqrt()
    assert decision.far_from_data
    assert float(to_prior.max()) < 0.4


def test_a_deviation_beyond_the_range_of_the_data_is_above_one():
    gp = train(transitions(unstable=0.5), predicts="difference", restarts=0).posterior
    chosen = controller(gp, horizon=40, feedback=False)
    decision = decide(chosen, 0.0)
    ranges = np.ptp(gp.features.numpy()[:, :2], axis=0)
    deviations = np.sqrt(np.diagonal(decision.covariances, axis1=1, axis2=2))
    assert decision.novelty == pytest.approx((deviations / ranges).max())
    assert decision.novelty > 10.0
    assert decide(controller(gp, horizon=40), 0.0).novelty < 0.2


def test_a_state_moved_by_noise_alone_is_not_far_from_its_data():
    rng = np.random.default_rng(1)
    features = torch.from_numpy(rng.uniform(-1, 1, (60, 2)) * [1.0, 1e-4])
    targets = torch.from_numpy(rng.normal(0, 1e-4, (60, 1)))
    ones = torch.ones(1, dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(
        features, targets, ones.expand(1, 2), 1e-12 * ones, 1e-8 * ones, 1
    )
    belief = Gaussian.certain([0.1])
    cost = Tracking([1.0], [0.1])
    decision = GPMPC(gp, Linearization(), Problem(cost), 10, [0.0]).control(
        belief, Reference([0.1])
    )
    assert 0.0 < decision.novelty < 0.1


def test_scales_of_angles_resting_columns_and_pseudo_data():
    data = transitions()
    turned = ResidualModel.train(Affine.identity(2, 1), data, angles=[0])
    scales = data_scales(turned)
    assert scales is not None
    assert scales.ranges[0] == np.pi
    assert scales.ranges[1] == pytest.approx(np.ptp(data.states[:, 1].numpy()))
    still = replace(data, states=data.states * torch.tensor([1.0, 0.0]))
    posterior = train(still, restarts=0).posterior
    scales = data_scales(posterior)
    assert scales is not None
    assert scales.ranges[1] == np.inf
    sparse = SparseTrainer(inducing=20, restarts=0)(data).posterior
    scales = data_scales(sparse)
    assert scales is not None
    assert scales.variances == pytest.approx(sparse.signal_variance.numpy())


@pytest.mark.parametrize("mode", ["none", "zero_order"])
def test_models_around_gps_know_it_too(gp, mode):
    plain = decide(controller(gp, mode), 0.2).novelty
    delayed = DelayedModel(gp, 1.0)
    scales = data_scales(delayed)
    assert scales is not None
    assert scales.variances.tolist()[2:] == [0.0]
    assert scales.ranges.tolist()[2:] == [np.inf]
    problem = Problem(Tracking([1.0, 1.0, 0.0], [0.1]), Box([-1.0], [1.0]))
    settings = PredictionSettings(covariance=mode)
    chosen = GPMPC(delayed, Linearization(), problem, 5, [0.0], settings)
    for place, far in ((0.2, False), (4e3, True)):
        state = np.array([place, place, 0.0])
        decision = chosen.control(Gaussian.certain(state), Reference(state))
        assert decision.far_from_data is far
    curved = ResidualModel.train(lambda x, u: x + 0.1 * x.sin(), transitions())
    assert curved.affine_form is None
    assert 0.0 < decide(controller(curved, mode), 0.2).novelty < 0.2
    assert decide(controller(curved, mode), 4e3).far_from_data
    assert plain < 0.2


def test_novelty_of_a_plan_of_means_is_computed_when_read(gp, monkeypatch):
    requests = []
    linearize = GPPosterior.linearize

    def counted(self, states, inputs, covariance=True):
        requests.append(covariance)
        return linearize(self, states, inputs, covariance)

    monkeypatch.setattr(GPPosterior, "linearize", counted)
    decision = decide(controller(gp, "none"), 0.2)
    copied = replace(decision, suboptimal=True)
    assert not any(requests)
    novelty = decision.novelty
    assert sum(requests) == 1
    assert decision.novelty == novelty == decision.plan_novelty
    assert copied.novelty == novelty


def test_it_is_not_known_of_models_that_are_no_gps():
    nominal = KnownModel(Affine.identity(2, 1), 2, 1)
    decision = decide(controller(nominal), 0.2)
    assert math.isnan(decision.novelty)
    assert not decision.far_from_data


@pytest.mark.parametrize("overflown", ["added", "covariances"])
def test_what_overflowed_is_not_near_the_data(overflown):
    arrays = {"added": np.zeros((2, 1, 1)), "covariances": np.zeros((3, 1, 1))}
    arrays[overflown][1] = np.nan
    scales = DataScales(variances=np.ones(1), ranges=np.ones(1))
    assert novelty_of(noise=np.zeros(1), scales=scales, **arrays) == math.inf
