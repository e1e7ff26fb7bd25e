"""References that leave the data of a model are named, and others are not."""

import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError
from gpmpc.gp import GPPosterior, Trainer, Transitions
from gpmpc.models import Affine, DelayedModel, KnownModel, ResidualModel
from gpmpc.mpc import Reference, beyond_data
from gpmpc.signals import Signals

NAMES = Signals(("position", "angle", "speed"), ("force",), 0.1)


def gp(states, lengthscales, signals=NAMES):
    """A GP of some states and an input of zero."""
    states = torch.as_tensor(states, dtype=torch.float64)
    n = states.shape[1]
    return GPPosterior.from_hyperparameters(
        torch.cat([states, torch.zeros(len(states), 1, dtype=torch.float64)], dim=1),
        states,
        torch.tensor([[*lengthscales, 1.0]] * n, dtype=torch.float64),
        torch.ones(n, dtype=torch.float64),
        torch.full((n,), 0.01, dtype=torch.float64),
        1,
        signals=signals,
    )


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (50, 3)) * [1.0, 1.0, 10.0]
    states[:2] = [[-1.0, -1.0, -10.0], [1.0, 1.0, 10.0]]
    return gp(states, [1.0, 1.0, 1000.0])


def test_a_state_beyond_its_data_is_named_with_both_ranges(model):
    path = np.array([[0.5, 0.0, 0.0], [1.5, 0.5, 3.0], [1.1, -0.9, -3.0]])
    (beyond,) = beyond_data(model, path)
    assert beyond.name == "position"
    assert beyond.reference == (0.5, 1.5)
    assert beyond.data == (-1.0, 1.0)
    expected = "the reference of position is 0.5 to 1.5, its data -1 to 1"
    assert str(beyond) == f"{expected}: learn from data there, too"
    wrapped = DelayedModel(model, 2)
    late = np.hstack([path, np.full((3, 2), 9.0)])
    assert beyond_data(wrapped, late) == [beyond]


def test_small_excesses_and_irrelevant_columns_are_not_named(model):
    assert beyond_data(model, [1.15, -1.15, 0.0]) == []
    assert [each.name for each in beyond_data(model, [1.25, -1.25, 0.0])] == [
        "position",
        "angle",
    ]
    assert beyond_data(model, [0.0, 0.0, 90.0]) == []  # its lengthscale is 1000
    assert [each.name for each in beyond_data(model, [0.0, 0.0, 150.0])] == ["speed"]


def test_names_of_a_reference_sort_its_columns(model):
    named = Signals(("speed", "position", "angle"), ())
    (beyond,) = beyond_data(model, Reference(np.array([0.0, 2.0, 0.0]), signals=named))
    assert beyond.name == "position"


def test_a_column_at_rest_is_left_by_any_part_of_a_lengthscale():
    states = np.zeros((5, 2))
    states[:, 0] = np.linspace(-1, 1, 5)
    still = gp(states, [1.0, 1.0], Signals())
    assert beyond_data(still, [0.0, 0.05]) == []
    assert [each.name for each in beyond_data(still, [0.0, 0.5])] == ["x2"]


def test_angles_compare_by_their_arc_and_no_data_give_no_range():
    rng = np.random.default_rng(0)
    states = rng.uniform(-1, 1, (60, 2))
    states[:, 0] = np.pi + 0.8 * states[:, 0]  # hanging, through half a turn
    inputs = rng.uniform(-1, 1, (60, 1))
    torque = inputs[:, 0] - 5.0 * np.sin(states[:, 0])
    after = states + 0.1 * np.column_stack([states[:, 1], torque])
    learned = ResidualModel.train(
        Affine.identity(2, 1),
        Transitions(states, inputs, after),
        angles=[0],
        trainer=Trainer(restarts=0),
    )
    for hanging in (np.pi, -np.pi, 3 * np.pi + 0.5, -np.pi - 0.5):
        assert beyond_data(learned, [hanging, 0.0]) == []
    (upright,) = beyond_data(learned, [0.0, 0.0])
    assert upright.name == "x1"
    known = KnownModel(Affine.identity(2, 1), 2, 1)
    assert beyond_data(known, [100.0, 0.0]) == []


def test_a_reference_that_is_not_finite_is_refused(model):
    with pytest.raises(DataError, match="reference states must be finite"):
        beyond_data(model, [np.nan, 0.0, 0.0])
