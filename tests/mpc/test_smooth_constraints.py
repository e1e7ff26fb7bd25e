from dataclasses import dataclass

import casadi
import numpy as np
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError, SolverFailure
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import (
    GPMPC,
    Box,
    ControlLoop,
    Halfspaces,
    Inequality,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc.baselines import NMPC
from gpmpc.propagation import Linearization
from gpmpc.status import Status
from tests.mpc.small_models import LinearGaussian
from tests.mpc.systems import LinearPlant, linear_gaussian

H, RADIUS = 12, 0.4
CENTRE = np.array([0.6, 0.03])
COST = Tracking([1.0] * 2, [0.05] * 2)
FREE = Problem(COST, Box([-0.15] * 2, [0.15] * 2))


def integrator(noise=0.0):
    """x+ = x + u in the plane."""
    model, eye = linear_gaussian(2, 2), torch.eye(2, dtype=torch.float64)
    return type(model)(
        A=eye, B=eye, c=torch.zeros(2, dtype=torch.float64), V=noise * eye
    )


def disc(x, u, p):
    """Distance into a disc at p."""
    return RADIUS - torch.linalg.vector_norm(x - p, dim=-1)


def casadi_disc():
    x, u, p = (casadi.SX.sym(name, 2) for name in "xup")
    return casadi.Function("disc", [x, u, p], [RADIUS - casadi.norm_2(x - p)])


@dataclass
class Disc:
    """The disc as an object that is called, which has no hash."""

    radius: float

    def __call__(self, x, u, p):
        return self.radius - torch.linalg.vector_norm(x - p, dim=-1)


def controller(constraint, **settings):
    problem = Problem(COST, FREE.inputs, constraints=[constraint])
    return GPMPC(
        integrator(settings.pop("noise", 0.0)),
        Linearization(),
        problem,
        H,
        [0.0] * 2,
        **settings,
    )


def flown(steering, goal, steps=40, parameters=lambda k: CENTRE):
    """States of a loop to a set point."""
    states, last = [np.zeros(2)], None
    for k in range(steps):
        last = steering.control(
            Gaussian.certain(states[-1]), Reference(goal), last, parameters(k)
        )
        assert last.status is Status.SOLVED
        states.append(states[-1] + last.input)
    return np.array(states)


@pytest.mark.parametrize("h", [disc, casadi_disc()], ids=["torch", "CasADi"])
def test_a_disc_in_the_way_is_passed_without_touching_it(h):
    goal = np.array([1.3, 0.0])
    straight = flown(
        GPMPC(integrator(), Linearization(), FREE, H, [0.0] * 2),
        goal,
        parameters=lambda _: None,
    )
    around = flown(controller(Inequality(h)), goal)
    assert np.linalg.norm(straight - CENTRE, axis=1).min() < 0.1
    assert np.linalg.norm(around - CENTRE, axis=1).min() > RADIUS - 1e-6
    assert np.allclose(around[-1], goal, atol=1e-3)


def inside(x, u, p):
    """Distance out of a disc at p: plans miss it by more than programs promise."""
    return torch.linalg.vector_norm(x - p, dim=-1) - RADIUS


def test_a_spent_budget_ends_whole_steps_too():
    belief = Gaussian.certain(np.array([0.6, -0.3]))
    reference = Reference(np.array([1.3, 0.4]))
    patient = controller(Inequality(inside)).control(belief, reference, None, CENTRE)
    assert patient.iterations > 1
    hurried = controller(Inequality(inside), budget=1e-9)
    decision = hurried.control(belief, reference, None, CENTRE)
    assert decision.iterations == 1
    assert decision.status is Status.TIME_LIMIT


@pytest.mark.parametrize("price", ["elastic", "exact", 30.0])
def test_a_kept_curved_bound_takes_as_many_programs_at_any_price(price):
    """A step along it misses it in second order, which is not to be refused."""
    belief = Gaussian.certain(np.array([0.9, 0.0]))
    reference = Reference(np.array([1.3, 0.4]))
    programs = []
    for penalty in (None, price):
        steering = controller(Inequality(inside, penalty=penalty), iterations=30)
        first = steering.control(belief, reference, None, CENTRE)
        second = steering.control(belief, reference, first, CENTRE)
        assert second.status is Status.SOLVED
        programs.append(second.iterations)
    assert programs[0] == programs[1]


def test_a_moving_disc_is_passed_where_it_will_be():
    goal = np.array([1.3, 0.0])

    def places(k):
        return CENTRE + [[0.0, 0.02 * (k + i + 1)] for i in range(H)]

    states = flown(controller(Inequality(disc)), goal, parameters=places)
    distances = [
        np.linalg.norm(x - CENTRE - [0.0, 0.02 * k]) for k, x in enumerate(states)
    ]
    assert min(distances) > RADIUS - 1e-6
    assert np.allclose(states[-1], goal, atol=1e-3)


class Drifting(LinearGaussian):
    """A double integrator whose noise grows with its speed."""

    def predict(self, state, input=None):
        mean = super().predict(state, input).mean
        variance = 0.02 * state[..., 1, None, None] ** 2
        return Gaussian(mean, variance * torch.eye(2, dtype=torch.float64))


def test_a_line_as_a_function_is_iterated_as_the_box_that_it_is():
    """How the tube grows along a step is no part of the program, nor of its merit."""
    model = Drifting(
        np.array([[1.0, 0.5], [0.0, 1.0]]),
        np.array([[0.125], [0.5]]),
        c=np.zeros(2),
        W=np.zeros((2, 2)),
    )
    box = Box([-np.inf] * 2, [1.0, np.inf], probability=0.95)
    line = Inequality(lambda x: x[:, :1] - 1.0, probability=0.95)
    belief = Gaussian.certain(np.array([-0.5, -0.5]))
    reference = Reference(np.array([1.5, 1.0]))
    programs = []
    plans = []
    for constraint in (box, line):
        problem = Problem(
            Tracking([1.0, 0.1], [0.1], penalized="inputs"),
            Box([-3.0], [3.0]),
            constraints=[constraint],
        )
        steering = GPMPC(model, Linearization(), problem, 8, [0.0], iterations=40)
        first = steering.control(belief, reference)
        second = steering.control(belief, reference, first)
        assert first.status is second.status is Status.SOLVED
        programs.append([first.iterations, second.iterations])
        plans.append([first.inputs, second.inputs])
    assert programs[0] == programs[1]
    np.testing.assert_allclose(plans[0], plans[1], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("covariance", ["zero_order", "diagonal", "full"])
def test_an_uncertain_plan_keeps_its_margin_along_the_gradient(covariance):
    reference, at = (
        Reference(np.array([1.3, 0.2])),
        Gaussian.certain(np.array([0.0, 0.1])),
    )
    constraint = Inequality(disc, probability=0.95, penalty=None)
    settings = PredictionSettings(covariance=covariance)
    plan = controller(
        constraint, noise=1e-3, prediction=settings, iterations=50
    ).control(at, reference, None, CENTRE)
    assert plan.status is Status.SOLVED
    away = plan.means[1:] - CENTRE
    distance = np.linalg.norm(away, axis=1)
    g = away / distance[:, None]
    sd = np.sqrt(np.einsum("ki,kij,kj->k", g, plan.covariances[1:], g))
    margin = distance - RADIUS - constraint.standard_deviations() * sd
    assert margin.min() == pytest.approx(0.0, abs=1e-5)
    assert sd.min() > 0.01


def test_linear_functions_are_halfspaces_and_boxes_two_of_them():
    F, f, at = (
        np.array([[1.0, 0.0], [0.6, 0.8]]),
        np.array([0.7, 0.5]),
        Gaussian.certain(np.array([0.1, 0.2])),
    )
    lower = np.array([[-1.0, 0.0]])
    box, smooth = (
        Box([-0.2, -np.inf], [0.3, np.inf], probability=0.9),
        lambda x: x @ torch.tensor(F).T - torch.tensor(f),
    )
    pairs = [
        (
            Inequality(smooth, count=2, probability=0.9),
            Halfspaces(F, f, probability=0.9),
        ),
        (box, Halfspaces([[1.0, 0.0], *lower], [0.3, 0.2], probability=0.9)),
    ]
    for pair in pairs:
        for mode in ("zero_order", "full"):
            settings = {
                "noise": 1e-3,
                "prediction": PredictionSettings(covariance=mode),
                "iterations": 1,
            }
            plans = [
                controller(one, **settings).control(at, Reference(np.array([1.0, 1.0])))
                for one in pair
            ]
            assert np.allclose(plans[0].inputs, plans[1].inputs, atol=1e-9)
            assert np.abs(plans[0].solution.z).max() > 1e-3


def test_a_constraint_of_inputs_is_kept_over_a_horizon_of_one():
    bound = Inequality(lambda x, u: u - 0.05, count=2, penalty=None)
    problem = Problem(COST, FREE.inputs, constraints=[bound])
    steering = GPMPC(integrator(), Linearization(), problem, 1, [0.0] * 2)
    decision = steering.control(Gaussian.certain(np.zeros(2)), Reference(np.ones(2)))
    assert decision.inputs == pytest.approx(np.full((1, 2), 0.05), abs=1e-8)


def test_a_default_that_is_bound_is_the_functions_own():
    centre = torch.as_tensor(CENTRE)
    bound = Inequality(lambda x, c=centre: disc(x, None, c))
    assert np.array_equal(
        flown(controller(bound), [1.2, 0.0], steps=4),
        flown(controller(Inequality(disc)), [1.2, 0.0], steps=4),
    )


def test_bounds_hold_at_the_stages_that_they_are_for():
    box = Box([-np.inf] * 2, [0.2, np.inf], stages=range(3, 6))
    plan = controller(box).control(
        Gaussian.certain(np.zeros(2)), Reference(np.array([1.0, 0.0]))
    )
    assert plan.means[3:6, 0].max() <= 0.2 + 1e-9
    assert plan.means[6:, 0].max() > 0.3
    with pytest.raises(SettingError, match=r"stages: must be of 1 .. 12; got 13"):
        controller(Box([0.0] * 2, stages=[13]))


def test_an_exact_price_is_paid_only_where_it_must_be():
    at, reference = Gaussian.certain(np.zeros(2)), Reference(np.array([3.0, 0.0]))
    soft, hard = (
        controller(Box(None, [0.4, np.inf], penalty=price)).control(at, reference)
        for price in ("exact", None)
    )
    assert np.allclose(soft.inputs, hard.inputs, atol=1e-7)
    outside = Gaussian.certain(np.array([1.0, 0.0]))
    assert (
        not controller(Box(None, [0.4, np.inf], penalty=None))
        .control(outside, reference)
        .applicable
    )
    exact = Box(None, [0.4, np.inf], penalty="exact")
    back = controller(exact).control(outside, reference)
    assert back.status is Status.SOFT_BOUND_MISSED
    assert back.violation == pytest.approx(back.means[1:, 0].max() - 0.4, abs=1e-9)
    assert np.allclose(back.inputs[:4, 0], -0.15, atol=1e-7)


def test_angles_are_steered_the_short_way_and_others_unchanged():
    cost = Tracking([1.0] * 2, [0.05] * 2, angles=[0])
    turning = GPMPC(
        integrator(), Linearization(), Problem(cost, FREE.inputs), H, [0.0] * 2
    )
    goal = Reference(np.array([-3.0, 0.2]))
    short = turning.control(Gaussian.certain(np.array([3.0, 0.0])), goal)
    assert short.inputs[0, 0] > 0.1
    plain = GPMPC(integrator(), Linearization(), FREE, H, [0.0] * 2)
    near = Gaussian.certain(np.array([-2.8, 0.0]))
    assert np.array_equal(
        plain.control(near, goal).inputs, turning.control(near, goal).inputs
    )
    wrapped = Gaussian.certain(
        short.means[1] - [2 * np.pi, 0.0]
    )  # the sensor takes the turn off
    again = turning.control(wrapped, goal, short)
    assert np.allclose(again.inputs[:-1], short.inputs[1:], atol=5e-2)


def test_mistakes_are_one_clear_error():
    at, reference = Gaussian.certain(np.zeros(2)), Reference(np.zeros(2))
    with pytest.raises(
        ShapeError, match=r"parameters must be \(q,\) or \(12, q\); got \(3, 2\)"
    ):
        controller(Inequality(disc)).control(at, reference, None, np.zeros((3, 2)))
    with pytest.raises(DataError, match="parameters must be finite"):
        controller(Inequality(disc)).control(at, reference, None, [np.nan, 0.0])
    with pytest.raises(ShapeError, match=r"h must give \(12, 2\); got \(12, 1\)"):
        controller(Inequality(disc, count=2)).control(at, reference, None, CENTRE)
    blind = controller(Inequality(lambda x: x[:, 0].log())).control(at, reference)
    assert (blind.applicable, blind.status) == (False, Status.FUNCTION_NOT_FINITE)
    with pytest.raises(
        SolverFailure,
        match="step 0: a constraint or output, or its gradient, "
        "is not finite along the",
    ):
        ControlLoop(
            controller(Inequality(lambda x: x[:, 0].log())), on_failure="raise"
        ).input(np.zeros(2), np.zeros(2))
    for wrong, found in ((lambda x: x.sum(), r"\(\)"), (lambda x: "inside", "str")):
        with pytest.raises(
            ShapeError, match=rf"h must give a tensor \(12, 1\); got {found}"
        ):
            controller(Inequality(wrong)).control(at, reference)
    with pytest.raises(SettingError, match="h: must be a function; got float"):
        Inequality(1.0)
    with pytest.raises(SettingError, match="NMPC takes Box and Halfspaces"):
        NMPC(
            LinearPlant(integrator()),
            Problem(COST, constraints=[Inequality(disc)]),
            3,
            [0.0] * 2,
        )
    with pytest.raises(
        SettingError, match="angles: must be a list of different indices"
    ):
        Tracking([1.0] * 2, [1.0], angles=[2])


def test_a_casadi_function_takes_parameters_of_its_own_size():
    x, u, p = casadi.SX.sym("x", 2), casadi.SX.sym("u", 2), casadi.SX.sym("p", 3)
    function = casadi.Function("disc", [x, u, p], [p[2] - casadi.norm_2(x - p[:2])])
    steering = controller(Inequality(function))
    at = Gaussian.certain(np.zeros(2))
    goal = Reference([1.0, 0.0])
    assert steering.control(at, goal, parameters=[*CENTRE, RADIUS]).status.solved
    for parameters in (CENTRE, [*CENTRE, RADIUS, 1.0]):
        with pytest.raises(
            ShapeError, match=r"h: disc takes \(2,\), \(2,\), \(3,\); got"
        ):
            steering.control(at, goal, parameters=parameters)


def test_a_callable_object_without_a_hash_is_a_constraint():
    goal = [1.0, 0.0]
    expected = flown(controller(Inequality(disc)), goal, steps=3)
    assert np.array_equal(
        flown(controller(Inequality(Disc(RADIUS))), goal, steps=3), expected
    )


def test_a_decision_tells_the_steps_of_all_its_programs():
    """The first plan keeps the circle as it was seen from outside, and leaves it."""
    inside = Inequality(lambda x, u: (x**2).sum(dim=-1) - 0.25)
    decision = controller(inside).control(
        Gaussian.certain(np.zeros(2)), Reference([1.2, 0.0])
    )
    assert decision.iterations > 1
    assert len(decision.steps) == decision.iterations


def test_a_form_of_one_point_takes_no_plan():
    model = integrator()
    settings = {"prediction": PredictionSettings("velocity")}
    steering = GPMPC(model, Linearization(), FREE, H, [0.0] * 2, **settings)
    with pytest.raises(SettingError, match="plan: is not taken by a form that"):
        steering.control(
            Gaussian.certain(np.zeros(2)),
            Reference([1.0, 0.0]),
            plan=np.zeros((H, 2)),
        )
