import math

import numpy as np
import pytest

from gpmpc.exceptions import SettingError, ShapeError, SolverFailure
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Box, Decision, Problem, Reference, Timing, Tracking
from gpmpc.mpc.baselines import NMPC
from gpmpc.simulation import closed_loop
from gpmpc.status import Status
from gpmpc.systems import Map, Rotational, System, Translational, step


class DoubleIntegrator:
    state_names = ("x", "v")
    input_names = ("a",)

    def derivative(self, x, u):
        return [x[1], u[0]]


def test_on_a_linear_plant_it_is_the_least_squares_solution(rng):
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    H = 5
    Q = np.array([3.0, 0.5])
    R = np.array([0.2])
    state = rng.normal(size=2)
    reference = rng.normal(size=(H + 1, 2))
    A = np.array([[1, 0.5], [0, 1]])
    B = np.array([0.125, 0.5])
    free = np.array([np.linalg.matrix_power(A, i + 1) @ state for i in range(H)])
    response = np.zeros((H, 2, H))
    for i in range(H):
        for j in range(i + 1):
            response[i, :, j] = np.linalg.matrix_power(A, i - j) @ B
    rows = (np.sqrt(Q)[None, :, None] * response).reshape(-1, H)
    right = (np.sqrt(Q) * (reference[1:] - free)).ravel()
    best = np.linalg.lstsq(
        np.vstack([rows, np.sqrt(R) * np.eye(H)]),
        np.append(right, np.zeros(H)),
        rcond=None,
    )[0]
    controller = NMPC(plant, Problem(Tracking(Q, R, penalized="inputs")), H, [0.0])
    decision = controller.control(Gaussian.certain(state), Reference(reference))
    assert decision.status is Status.SOLVED
    assert np.allclose(decision.inputs[:, 0], best, atol=1e-8)
    assert np.allclose(decision.means[1:], free + response @ best, atol=1e-8)


@pytest.mark.parametrize(
    "plant",
    [System(Map(Rotational()), 1.0), System(Translational(), time_step=0.5)],
    ids=["map", "integrated"],
)
def test_no_small_change_of_the_plan_is_cheaper(plant, rng):
    H = 4
    Q = np.array([20.0, 1, 20, 1, 20, 1])
    R = np.array([1.0, 1, 1])
    state = 0.1 * rng.normal(size=6)
    reference = 0.3 * rng.normal(size=(H + 1, 6))
    initial = [7.26, 0, 0] if isinstance(plant, System) else [0, 0, 0]
    controller = NMPC(plant, Problem(Tracking(Q, R, penalized="inputs")), H, initial)
    decision = controller.control(Gaussian.certain(state), Reference(reference))

    def cost(inputs):
        x = state
        total = 0.0
        for u, r in zip(inputs, reference[1:], strict=True):
            x = step(plant, x, u)
            total += Q @ (x - r) ** 2 + R @ u**2
        return total

    best = cost(decision.inputs)
    assert decision.status is Status.SOLVED
    for _ in range(50):
        assert (
            cost(decision.inputs + 1e-3 * rng.normal(size=decision.inputs.shape)) > best
        )


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (
            {"horizon": 0},
            SettingError,
            "horizon: must be a whole number, 1 or more; got 0",
        ),
        (
            {"problem": Problem(Tracking([1.0] * 5, [1.0] * 3, penalized="inputs"))},
            SettingError,
            "must weigh 6 states and 3 inputs; got 5",
        ),
        (
            {"initial_input": [0.0]},
            SettingError,
            "initial_input: must be a list of 3 numbers",
        ),
    ],
)
def test_misuse_is_refused_at_construction(arguments, error, message):
    good = {
        "horizon": 3,
        "problem": Problem(Tracking([1.0] * 6, [1.0] * 3, penalized="inputs")),
        "initial_input": [0.0] * 3,
    }
    with pytest.raises(error, match=message):
        NMPC(System(Map(Rotational()), 1.0), **(good | arguments))


def test_a_reference_of_another_shape_is_refused():
    controller = NMPC(
        System(Map(Rotational()), 1.0),
        Problem(Tracking([1.0] * 6, [1.0] * 3, penalized="inputs")),
        3,
        [0.0] * 3,
    )
    with pytest.raises(
        ShapeError, match=r"shapes \(6,\) and \(4, 6\); got \(6,\) and \(2, 6\)"
    ):
        controller.control(Gaussian.certain(np.zeros(6)), Reference(np.zeros((2, 6))))


def test_bounds_on_inputs_rates_and_states_are_kept(rng):
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    limits = Box([-np.inf, -0.3], [np.inf, 0.3], probability=0.95, penalty=None)
    bounds = {"inputs": Box([-1.0], [0.4]), "input_rates": Box([-0.3], [0.3])}
    problem = Problem(
        Tracking([1.0, 0.0], [1e-3], penalized="inputs"), constraints=[limits], **bounds
    )
    decision = NMPC(plant, problem, 8, [0.0]).control(
        Gaussian.certain(np.zeros(2)), Reference(np.full((9, 2), 1.0))
    )
    assert decision.status is Status.SOLVED
    rates = np.diff(decision.inputs[:, 0], prepend=0.0)
    for values, low, high in (
        (decision.inputs, -1, 0.4),
        (rates, -0.3, 0.3),
        (decision.means[:, 1], -0.3, 0.3),
    ):
        assert low - 1e-8 <= values.min()
        assert values.max() <= high + 1e-8
    assert decision.means[:, 1].max() > 0.3 - 1e-6
    assert rates.max() > 0.3 - 1e-6


def test_soft_state_bounds_give_way_where_they_must():
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    limits = Box([-np.inf, -0.3], [np.inf, 0.3], probability=0.95, penalty=100.0)
    problem = Problem(
        Tracking([1.0, 0.0], [1e-3], penalized="inputs"),
        inputs=Box([-0.2], [0.2]),
        constraints=[limits],
    )
    fast = Gaussian.certain(np.array([0.0, 0.5]))
    decision = NMPC(plant, problem, 5, [0.0]).control(fast, Reference(np.zeros((6, 2))))
    assert decision.status is Status.SOFT_BOUND_MISSED
    assert decision.violation == pytest.approx(0.1, abs=1e-6)
    assert np.allclose(decision.means[1:3, 1], [0.4, 0.3], atol=1e-6)
    assert decision.means[2:, 1].max() < 0.3 + 1e-6


class Scripted:
    """Ends with the given statuses in turn."""

    horizon = 2

    def __init__(self, *statuses):
        self.statuses = list(statuses)
        self.seen = []

    def control(self, belief, reference, previous=None):
        self.seen.append((belief.mean, reference.states, previous))
        timing = Timing(0.0, 0.0, 0.0)
        return Decision(
            np.ones(1),
            np.ones((2, 1)),
            np.zeros((3, 2)),
            np.zeros((3, 2, 2)),
            self.statuses.pop(0),
            1,
            timing,
        )


def test_the_loop_passes_state_references_and_last_decision():
    controller = Scripted(Status.SOLVED, Status.SOLVED, Status.SOLVED)
    plant = System(DoubleIntegrator(), time_step=1.0, substeps=1)
    references = np.arange(10.0).reshape(5, 2)
    rollout = closed_loop(plant, controller, references, np.zeros(2), 3)
    assert np.allclose(rollout.states, [[0, 0], [0.5, 1], [2, 2], [4.5, 3]])
    assert rollout.inputs.shape == (3, 1)
    assert [seen[1].tolist() for seen in controller.seen] == [
        references[k : k + 3].tolist() for k in range(3)
    ]
    assert controller.seen[0][2] is None
    assert controller.seen[2][2].status is Status.SOLVED


def test_a_failed_solve_stops_the_loop_and_is_not_applied():
    controller = Scripted(Status.SOLVED, Status.ITERATION_LIMIT)
    plant = System(DoubleIntegrator(), time_step=1.0, substeps=1)
    with pytest.raises(
        SolverFailure, match="failed at step 1: stopped at the iteration limit"
    ) as caught:
        closed_loop(plant, controller, np.zeros((9, 2)), np.zeros(2), 3)
    assert caught.value.step == 1
    assert len(controller.seen) == 2


def test_too_few_references_are_refused_before_the_first_step():
    with pytest.raises(
        ShapeError, match="3 steps with horizon 2 need 5 references; got 3"
    ):
        closed_loop(
            System(Map(DoubleIntegrator()), 1.0),
            Scripted(),
            np.zeros((3, 2)),
            np.zeros(2),
            3,
        )


def test_soft_bounds_of_one_state_leave_the_others_free():
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    state = Gaussian.certain(np.array([0.2, 0.1]))
    reference = Reference(np.full((6, 2), 1.0))
    wide = Box([-np.inf, -9.0], [np.inf, 9.0], probability=0.95, penalty=1.0)
    free, bounded = (
        NMPC(
            plant,
            Problem(
                Tracking([1.0, 0.1], [0.1], penalized="inputs"), constraints=bounds
            ),
            5,
            [0.0],
        ).control(state, reference)
        for bounds in ((), [wide])
    )
    assert np.allclose(free.inputs, bounded.inputs, atol=1e-6)


def test_a_bad_measurement_is_reported_and_the_plan_shifted():
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    controller = NMPC(
        plant, Problem(Tracking([1.0, 0.1], [0.1], penalized="inputs")), 3, [0.0]
    )
    good = controller.control(
        Gaussian.certain(np.array([1.0, 0.0])), Reference(np.zeros((4, 2)))
    )
    decision = controller.control(
        Gaussian.certain(np.array([1.0, np.nan])), Reference(np.zeros((4, 2))), good
    )
    assert decision.status is Status.INVALID_MEASUREMENT
    assert np.array_equal(decision.inputs, good.inputs[[1, 2, 2]])


def test_a_plant_without_numbers_is_numerical_trouble(monkeypatch):
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    problem = Problem(Tracking([1.0, 0.1], [0.1], penalized="inputs"))
    controller = NMPC(plant, problem, 3, [0.0])

    def successor(self, state, input):
        return math.exp(1e4)

    monkeypatch.setattr(System, "successor", successor)
    decision = controller.control(
        Gaussian.certain(np.array([1.0, 0.0])), Reference(np.zeros((4, 2)))
    )
    assert decision.status is Status.NUMERICAL_TROUBLE


def test_reference_inputs_of_another_number_are_refused():
    controller = NMPC(
        System(Map(Rotational()), 1.0),
        Problem(Tracking([1.0] * 6, [1.0] * 3, penalized="inputs")),
        3,
        [0.0] * 3,
    )
    with pytest.raises(
        ShapeError, match=r"reference inputs must have shape \(3, 3\); got \(3, 2\)"
    ):
        controller.control(
            Gaussian.certain(np.zeros(6)), Reference(np.zeros((4, 6)), np.zeros((3, 2)))
        )


@pytest.mark.parametrize("price", [0.3, 2.0])
def test_a_soft_state_bound_costs_what_it_says_on_either_side(price):
    """One step of x+ = x + u: minimise (x - r)^2 + u^2 + price v on a fine grid."""

    class Shifted:
        state_names = ("x",)
        input_names = ("u",)

        def derivative(self, x, u):
            return [x[0] + u[0]]

    limits = Box([-0.5], [0.2], penalty=price)
    controller = NMPC(
        System(Map(Shifted()), 1.0),
        Problem(Tracking([1.0], [1.0], penalized="inputs"), constraints=[limits]),
        1,
        [0.0],
    )
    x = np.linspace(-3, 3, 600_001)
    outside = np.maximum(0, np.maximum(x - 0.2, -0.5 - x))
    for start, target in ((0.0, 2.0), (0.1, -3.0), (0.4, 0.1), (-2.0, -0.9)):
        best = x[np.argmin((x - target) ** 2 + (x - start) ** 2 + price * outside)]
        decision = controller.control(
            Gaussian.certain(np.array([start])), Reference(np.full((2, 1), target))
        )
        is_missed = decision.violation > 1e-5
        assert (decision.status is Status.SOFT_BOUND_MISSED) == is_missed
        assert decision.status.solved
        assert decision.means[1, 0] == pytest.approx(best, abs=2e-5)


def test_bounds_that_contradict_each_other_are_not_called_solved():
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    limits = Box([1.0, -np.inf], [np.inf, np.inf], probability=0.95, penalty=None)
    problem = Problem(
        Tracking([1.0, 0.0], [1.0], penalized="inputs"),
        inputs=Box([-0.1], [0.1]),
        constraints=[limits],
    )
    decision = NMPC(plant, problem, 3, [0.0]).control(
        Gaussian.certain(np.zeros(2)), Reference(np.zeros((4, 2)))
    )
    assert not decision.status.solved


@pytest.mark.parametrize("penalized", ["inputs", "deviations", "increments"])
def test_the_last_state_has_its_weight_and_inputs_theirs(penalized, rng):
    """No small change of the plan is cheaper by the problem's own words."""
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    H = 4
    Q = np.array([[2.0, 0.3], [0.3, 1.0]])
    T = np.diag([9.0, 0.1])
    R = np.array([[0.4]])
    controller = NMPC(
        plant, Problem(Tracking(Q, R, terminal=T, penalized=penalized)), H, [0.7]
    )
    state = rng.normal(size=2)
    reference = Reference(rng.normal(size=(H + 1, 2)), rng.normal(size=(H, 1)))
    decision = controller.control(Gaussian.certain(state), reference)

    def cost(inputs):
        x = state
        total = 0.0
        last = np.array([0.7])
        for k, u in enumerate(inputs):
            x = step(plant, x, u)
            error = x - reference.states[k + 1]
            weight = T if k == H - 1 else Q
            v = {
                "inputs": u,
                "deviations": u - reference.inputs[k],
                "increments": u - last,
            }[penalized]
            total = total + error @ weight @ error + v @ R @ v
            last = u
        return total

    best = cost(decision.inputs)
    for k in range(H):
        for change in (-1e-4, 1e-4):
            changed = decision.inputs.copy()
            changed[k] += change
            assert cost(changed) > best


def test_references_without_a_use_are_refused():
    plant = System(DoubleIntegrator(), time_step=0.5, substeps=1)
    still = Gaussian.certain(np.zeros(2))
    cost = Tracking([1.0, 0.0], [1e-3], penalized="deviations")
    deviating = NMPC(plant, Problem(cost), 2, [0.0])
    with pytest.raises(ShapeError, match=r"needs reference inputs \(2, 1\); got none"):
        deviating.control(still, Reference(np.zeros((3, 2))))
    cost = Tracking([1.0, 0.0], [1e-3])
    with pytest.raises(SettingError, match="kappas: are for .* NMPC predicts none"):
        NMPC(plant, Problem(cost), 2, [0.0]).control(
            still, Reference(np.zeros((3, 2)), kappas=np.ones(2))
        )
