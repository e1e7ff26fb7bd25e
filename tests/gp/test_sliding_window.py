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


def loses_least(gp, candidates):
    """Which of the first points changes the functions least where it is dropped."""
    losses = [
        divergence_over_functions(gp, remove_points(gp, i), gp.features)
        for i in range(candidates)
    ]
    return losses.index(min(losses))


def dropped(gp, new, points):
    """Numbers of the points that the least informative rule drops for new ones."""
    left = SlidingWindow(points, "least_informative")(gp, new).features
    both = torch.cat([gp.features, new.features])
    stays = (both[:, None] == left).all(-1).any(-1)
    return torch.nonzero(~stays)[:, 0].tolist()


@pytest.mark.parametrize("seed", range(8))
def test_the_point_whose_loss_changes_least_is_dropped(seed):
    data = transitions(7, seed)
    gp = posterior(data[:6], noise=[1e-4, 1e-2, 1.0][seed % 3])
    grown = append_transitions(gp, data[6:])
    assert dropped(gp, data[6:], 6) == [loses_least(grown, candidates=6)]


def test_points_are_chosen_in_turn_as_if_each_was_dropped():
    data = transitions(26)
    gp = posterior(data[:25])
    left = append_transitions(gp, data[25:])
    names = list(range(25))
    chosen = []
    for _ in range(12):
        position = loses_least(left, candidates=len(names))
        chosen.append(names.pop(position))
        left = remove_points(left, position)
    assert dropped(gp, data[25:], 14) == sorted(chosen)


def test_of_two_equal_points_one_is_the_first_to_go():
    data = transitions(21)
    copy = data[7:8]
    gp = posterior(data[:20])
    window = SlidingWindow(20, "least_informative")
    # what just came stays
    assert torch.equal(
        window(gp, copy).features,
        torch.cat([data.features[:7], data.features[8:20], copy.features]),
    )
    twice = append_transitions(gp, copy)
    left = SlidingWindow(21, "least_informative")(twice, data[20:]).features
    assert (left == copy.features).all(-1).sum() == 1


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
