"""Roll-outs of a model under a feedback, against the model itself, stage by stage."""

import numpy as np
import pytest
import torch

from gpmpc._kernels.gp_rollout import Feedback
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gp import GPPosterior
from gpmpc.models import Affine, DisturbedModel, ResidualModel, RollOut, linearize

GENERATOR = torch.Generator().manual_seed(3)


def gp(features, inputs, outputs, predicts):
    x = (
        3 * torch.rand(30, features + inputs, generator=GENERATOR, dtype=torch.float64)
        - 1.5
    )
    y = torch.sin(
        x
        @ torch.rand(
            features + inputs, outputs, generator=GENERATOR, dtype=torch.float64
        )
    )
    scales = 1 + torch.rand(
        outputs, features + inputs, generator=GENERATOR, dtype=torch.float64
    )
    one = torch.ones(outputs, dtype=torch.float64)
    return GPPosterior.from_hyperparameters(
        x, y, scales, one, 1e-3 * one, inputs, predicts, 0.1 * one
    )


def affine():
    A, G, c = (
        torch.rand(shape, generator=GENERATOR, dtype=torch.float64)
        for shape in ((3, 3), (3, 2), (3,))
    )
    return Affine(0.5 * A, G, c)


def residual(nominal):
    """With an angle, selected states and inputs."""
    B = torch.rand(3, 2, generator=GENERATOR, dtype=torch.float64)
    return ResidualModel(nominal, gp(3, 1, 2, "value"), B, [2, 0], [1], 2, angles=[0])


MODELS = {
    "next states": lambda: gp(3, 2, 3, "next_state"),
    "differences": lambda: gp(3, 2, 3, "difference"),
    "an affine nominal model": lambda: residual(affine()),
    "a nominal model in torch": lambda: residual(
        lambda x, u: torch.sin(x) + u.sum(-1, keepdim=True)
    ),
    "a model around another one": lambda: DisturbedModel(
        residual(affine()), torch.eye(3, 1, dtype=torch.float64), std=[0.1]
    ),
}


@pytest.mark.parametrize("kind", MODELS)
def test_a_roll_out_obeys_the_model_and_the_bounded_feedback(kind):
    model = MODELS[kind]()
    random = np.random.default_rng(0)
    T = 3
    H = 6
    n = model.state_dim
    m = 2
    planned = random.normal(size=(T, H + 1, n))
    inputs = random.normal(size=(T, H, m))
    gains = random.normal(size=(H, m, n))
    bounds = [
        np.array(side)
        for side in ([-0.8, -np.inf], [0.9, np.inf], [-np.inf, -0.7], [np.inf, 0.6])
    ]
    last = np.array([0.1, 0.2])
    disturbance = 0.1 * random.normal(size=n)
    start = random.normal(size=(T, n))
    limits = [np.tile(bound, (H, 1)) for bound in bounds]
    lower, upper, rate_lower, rate_upper = limits
    feedback = Feedback(
        states=planned,
        inputs=inputs,
        gains=gains[None],
        lower=lower,
        upper=upper,
        rate_lower=rate_lower,
        rate_upper=rate_upper,
        previous_input=last,
    )
    states, applied = RollOut(model)(start, feedback, disturbance)
    assert (states[:, 0] == start).all()
    for t in range(T):
        before = last
        for k in range(H):
            u = inputs[t, k] + gains[k] @ (states[t, k] - planned[t, k])
            before = np.clip(
                np.clip(u, before + bounds[2], before + bounds[3]), bounds[0], bounds[1]
            )
            assert np.allclose(applied[t, k], before, rtol=1e-12, atol=1e-12)
            after = (
                linearize(
                    model, states[t, k : k + 1], applied[t, k : k + 1], False
                ).mean[0]
                + disturbance
            )
            assert np.allclose(states[t, k + 1], after, rtol=1e-10, atol=1e-12)


def test_plans_may_have_gains_of_their_own():
    model = MODELS["differences"]()
    random = np.random.default_rng(1)
    planned = random.normal(size=(2, 5, 3))
    inputs = random.normal(size=(2, 4, 2))
    gains = random.normal(size=(2, 4, 2, 3))
    free = np.full((4, 2), np.inf)
    feedback = Feedback(
        states=planned,
        inputs=inputs,
        gains=gains,
        lower=-free,
        upper=free,
        rate_lower=-free,
        rate_upper=free,
        previous_input=np.zeros(2),
    )
    both = RollOut(model)(planned[:, 0], feedback)
    for t in range(2):
        plan = slice(t, t + 1)
        one = feedback._replace(
            states=planned[plan], inputs=inputs[plan], gains=gains[plan]
        )
        alone = RollOut(model)(planned[plan, 0], one)
        for together, by_itself in zip(both, alone, strict=True):
            assert np.array_equal(together[t], by_itself[0])


def test_integer_starts_and_strided_disturbances_are_taken():
    roll_out = RollOut(MODELS["differences"]())
    inputs = np.zeros((1, 3, 2))
    wide = np.arange(9.0).reshape(3, 3) / 10
    expected = roll_out.open_loop(
        np.array([[1.0, 0.0, 1.0]]), inputs, wide[:, 0].copy()
    )
    for start in (np.array([[1, 0, 1]]), np.array([[1.0, 0.0, 1.0]])):
        assert np.array_equal(roll_out.open_loop(start, inputs, wide[:, 0]), expected)


@pytest.mark.parametrize("kind", ["differences", "a nominal model in torch"])
def test_arrays_of_other_sizes_are_refused(kind):
    roll_out = RollOut(MODELS[kind]())
    start = np.zeros((2, 3))
    inputs = np.zeros((2, 4, 2))
    for mistake in (
        (start[:, :2], inputs),
        (np.zeros((2, 4)), inputs),
        (start[:1], inputs),
        (start, inputs[..., :1]),
        (start, inputs[0]),
        (start, inputs, np.zeros(1)),
    ):
        with pytest.raises(ShapeError, match=r"start \(T, n\), inputs|\(T, H, m\)"):
            roll_out.open_loop(*mistake)


@pytest.mark.parametrize(
    ("part", "shape"),
    [
        ("states", (2, 3, 3)),
        ("states", (1, 4, 3)),
        ("gains", (1, 3, 2, 3)),
        ("lower", (2,)),
        ("rate_upper", (3, 2)),
        ("previous_input", (1,)),
    ],
)
def test_a_feedback_of_other_shapes_is_refused(part, shape):
    free = np.full((4, 2), np.inf)
    feedback = Feedback(
        states=np.zeros((2, 5, 3)),
        inputs=np.zeros((2, 4, 2)),
        gains=np.zeros((1, 4, 2, 3)),
        lower=-free,
        upper=free,
        rate_lower=-free,
        rate_upper=free,
        previous_input=np.zeros(2),
    )
    roll_out = RollOut(MODELS["differences"]())
    roll_out(np.zeros((2, 3)), feedback)
    with pytest.raises(ShapeError, match="must be of 2 plans of 4 stages, 3 states"):
        roll_out(np.zeros((2, 3)), feedback._replace(**{part: np.zeros(shape)}))


@pytest.mark.parametrize("outputs", [1, 2, 4])
def test_only_a_model_of_next_states_is_rolled_out(outputs):
    with pytest.raises(SettingError, match=f"next state; got 3 states and {outputs}"):
        RollOut(gp(3, 2, outputs, "value"))


def test_a_feedback_of_whole_numbers_and_strided_arrays_is_taken():
    free = np.full((4, 2), 9.0)
    rng = np.random.default_rng(0)
    feedback = Feedback(
        states=rng.normal(size=(2, 4, 3)),
        inputs=np.round(rng.normal(size=(2, 4, 2))),
        gains=rng.normal(size=(1, 4, 2, 3)),
        lower=-free,
        upper=free,
        rate_lower=-free,
        rate_upper=free,
        previous_input=np.ones(2),
    )
    roll_out = RollOut(MODELS["differences"]())
    start = rng.normal(size=(2, 3))
    expected = roll_out(start, feedback)
    wide = np.zeros((2, 4, 6))
    wide[:, :, ::2] = feedback.states
    same = feedback._replace(
        states=wide[:, :, ::2],
        inputs=feedback.inputs.astype(int),
        upper=np.broadcast_to(np.array([9.0, 9.0]), (4, 2)),
        previous_input=np.array([1, 1]),
    )
    for part, right in zip(roll_out(start, same), expected, strict=True):
        assert np.array_equal(part, right)
