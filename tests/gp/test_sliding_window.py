import logging

import pytest
import torch

from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel
from gpmpc.gp import (
    GPPosterior,
    SlidingWindow,
    Transitions,
    append_transitions,
    remove_points,
)
from gpmpc.gp._online import _divergence, _noise_variances, least_informative
from tests.gp.small_models import residual_model


def transitions(rows, seed=0):
    generator = torch.Generator().manual_seed(seed)
    x = 4 * torch.rand(rows, 2, generator=generator) - 2
    u = torch.rand(rows, 1, generator=generator)
    next_states = torch.stack(
        [torch.sin(2 * x[:, 0]) + u[:, 0], 100 * torch.cos(x[:, 1])], dim=1
    )
    return Transitions(x, u, next_states)


def posterior(data, noise=1e-2):
    scale = torch.tensor([1.0, 1e4])
    return GPPosterior.from_hyperparameters(
        data.features,
        data.next_states,
        lengthscales=torch.tensor([[1.0, 1.5, 2.0], [1.2, 0.8, 3.0]]),
        signal_variance=scale,
        noise_variance=noise * scale,
        input_dim=1,
    )


def divergence_over_functions(one, other, points):
    """KL(one || other) of the posteriors of f at the points, summed over the
    outputs."""
    total = 0.0
    for a in range(one.output_dim):
        belief = []
        for gp in (one, other):
            difference = (gp.features[:, None] - points) / gp.lengthscales[a]
            across = gp.signal_variance[a] * torch.exp(-difference.square().sum(-1) / 2)
            difference = (points[:, None] - points) / gp.lengthscales[a]
            prior = gp.signal_variance[a] * torch.exp(-difference.square().sum(-1) / 2)
            half = torch.linalg.solve_triangular(gp.cholesky[a], across, upper=False)
            covariance = (
                prior
                - half.mT @ half
                + 1e-12 * gp.signal_variance[a] * torch.eye(len(points))
            )
            belief.append(
                torch.distributions.MultivariateNormal(
                    across.mT @ gp.weights[a], covariance
                )
            )
        total += float(torch.distributions.kl_divergence(*belief))
    return total


def information(gp):
    return _divergence(
        gp.precision.diagonal(dim1=-2, dim2=-1), gp.weights, _noise_variances(gp)
    )


def test_information_is_the_divergence_of_with_and_without():
    gp = posterior(transitions(6))
    expected = [
        divergence_over_functions(gp, remove_points(gp, i), gp.features)
        for i in range(6)
    ]
    assert information(gp).tolist() == pytest.approx(expected, rel=1e-5)


def test_points_are_chosen_in_turn_as_if_each_was_dropped():
    gp = posterior(transitions(25))
    left = gp
    names = list(range(25))
    for chosen in least_informative(gp, 12):
        position = int(information(left).argmin())
        assert names.pop(position) == chosen
        left = remove_points(left, position)


def test_of_two_equal_points_one_is_the_first_to_go():
    data = transitions(20)
    twice = append_transitions(posterior(data), data[7:8])
    assert least_informative(twice, 1)[0] in (7, 20)
    assert least_informative(twice, 1, candidates=20) == [7]


@pytest.mark.parametrize("rule", ["oldest", "least_informative"])
def test_a_window_is_held_and_what_just_came_stays(rule):
    data = transitions(60)
    gp = posterior(transitions(60)[:20])
    window = SlidingWindow(30, rule)
    for first in range(20, 60, 4):
        new = data[first : first + 4]
        gp = window(gp, new)
        assert len(gp) == min(first + 4, 30)
        assert torch.equal(gp.features[-4:], new.features)
    fresh = posterior(Transitions(gp.features[:, :2], gp.features[:, 2:], gp.targets))
    assert torch.allclose(gp.weights, fresh.weights, atol=1e-9)


def test_the_oldest_points_go_first():
    data = transitions(30)
    assert torch.equal(
        SlidingWindow(12)(posterior(data[:10]), data[10:]).features, data.features[18:]
    )


def test_dropping_uninformative_points_beats_dropping_the_oldest():
    data = transitions(150)
    held_out = transitions(200, seed=1)
    errors = {}
    for rule in ("oldest", "least_informative"):
        gp = posterior(data[:40])
        window = SlidingWindow(40, rule)
        for i in range(40, 150):
            gp = window(gp, data[i : i + 1])
        off = gp.predict(held_out.states, held_out.inputs).mean - held_out.next_states
        errors[rule] = float((off / torch.tensor([1.0, 100.0])).square().mean().sqrt())
    assert errors["least_informative"] < 0.8 * errors["oldest"]


@pytest.mark.parametrize("rule", ["oldest", "least_informative"])
def test_a_batch_larger_than_the_window_is_cut_and_logged(rule, caplog):
    data = transitions(30)
    with caplog.at_level(logging.WARNING, "gpmpc"):
        gp = SlidingWindow(8, rule)(posterior(data[:10]), data[10:])
    assert len(gp) == 8
    assert "20 new points exceed the window of 8" in caplog.text
    assert all((data.features[10:] == row).all(1).any() for row in gp.features)


def test_misuse_is_refused_with_the_rule():
    with pytest.raises(
        SettingError, match="points: must be a whole number, 1 or more; got 0"
    ):
        SlidingWindow(0)
    with pytest.raises(
        SettingError, match="'oldest', 'least_informative'; got 'random'"
    ):
        SlidingWindow(5, "random")
    with pytest.raises(
        ShapeError, match="2 states and 1 inputs; got transitions with 1 and 1"
    ):
        SlidingWindow(5)(
            posterior(transitions(3)),
            Transitions(torch.zeros(1, 1), torch.zeros(1, 1), torch.zeros(1, 1)),
        )


def test_a_window_of_another_model_says_what_takes_one():
    with pytest.raises(
        UnsupportedModel,
        match="must be a GPPosterior; got ResidualModel .* ResidualModel.append takes",
    ):
        SlidingWindow(3)(residual_model(), transitions(2))
    with pytest.raises(
        SettingError, match=r"transitions: must be Transitions\(...\); got Tensor"
    ):
        SlidingWindow(3)(posterior(transitions(5)), torch.zeros(2, 3))
