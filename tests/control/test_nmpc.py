import numpy as np
import pytest

from gpmpc.control.controller import Decision
from gpmpc.control.nmpc import NMPC
from gpmpc.exceptions import SettingError, ShapeError, SolverFailure
from gpmpc.plants import Integrated, Map, Rotational, Translational, step
from gpmpc.simulation import closed_loop
from gpmpc.status import Status


class DoubleIntegrator:
    state_names, input_names = ("x", "v"), ("a",)

    def derivative(self, x, u):
        return [x[1], u[0]]


def test_on_a_linear_plant_it_is_the_least_squares_solution(rng):
    plant = Integrated(DoubleIntegrator(), time_step=0.5, substeps=1)
    H, Q, R = 5, np.array([3.0, 0.5]), np.array([0.2])
    state, reference = rng.normal(size=2), rng.normal(size=(H, 2))
    A, B = np.array([[1, 0.5], [0, 1]]), np.array([0.125, 0.5])
    free = np.array([np.linalg.matrix_power(A, i) @ state for i in range(H)])
    response = np.zeros((H, 2, H))
    for i in range(H):
        for j in range(i):
            response[i, :, j] = np.linalg.matrix_power(A, i - 1 - j) @ B
    rows = (np.sqrt(Q)[None, :, None] * response).reshape(-1, H)
    right = (np.sqrt(Q) * (reference - free)).ravel()
    best = np.linalg.lstsq(np.vstack([rows, np.sqrt(R) * np.eye(H)]), np.append(right, np.zeros(H)), rcond=None)[0]
    decision = NMPC(plant, H, Q, R, [0.0]).control(state, reference)
    assert decision.status is Status.SOLVED
    assert np.allclose(decision.inputs[:, 0], best, atol=1e-8)
    assert np.allclose(decision.states, free + response @ best, atol=1e-8)


@pytest.mark.parametrize(
    "plant", [Map(Rotational()), Integrated(Translational(), time_step=0.5)], ids=["map", "integrated"]
)
def test_no_small_change_of_the_plan_is_cheaper(plant, rng):
    H, Q, R = 4, np.array([20.0, 1, 20, 1, 20, 1]), np.array([1.0, 1, 1])
    state, reference = 0.1 * rng.normal(size=6), 0.3 * rng.normal(size=(H, 6))
    initial = [7.26, 0, 0] if isinstance(plant, Integrated) else [0, 0, 0]
    decision = NMPC(plant, H, Q, R, initial).control(state, reference)

    def cost(inputs):
        x, total = state, 0.0
        for u, r in zip(inputs, reference, strict=True):
            total += Q @ (x - r) ** 2 + R @ u**2
            x = step(plant, x, u)
        return total

    best = cost(decision.inputs)
    assert decision.status is Status.SOLVED
    for _ in range(50):
        assert cost(decision.inputs + 1e-3 * rng.normal(size=decision.inputs.shape)) > best


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"horizon": 0}, SettingError, "horizon: must be a whole number, 1 or more; got 0"),
        ({"Q": [1.0] * 5}, SettingError, "Q: must be a list of 6 numbers"),
        ({"R": [1.0] * 4}, SettingError, "R: must be a list of 3 numbers"),
        ({"R": [1.0, -1, 1]}, SettingError, "R: must be a number, 0 or more; got -1"),
        ({"initial_input": [0.0]}, SettingError, "initial_input: must be a list of 3 numbers"),
    ],
)
def test_misuse_is_refused_at_construction(arguments, error, message):
    good = {"horizon": 3, "Q": [1.0] * 6, "R": [1.0] * 3, "initial_input": [0.0] * 3}
    with pytest.raises(error, match=message):
        NMPC(Map(Rotational()), **(good | arguments))


def test_a_reference_of_another_shape_is_refused():
    controller = NMPC(Map(Rotational()), 3, [1.0] * 6, [1.0] * 3, [0.0] * 3)
    with pytest.raises(ShapeError, match=r"reference must have shape \(3, 6\); got \(2, 6\)"):
        controller.control(np.zeros(6), np.zeros((2, 6)))


class Scripted:
    """Ends with the given statuses in turn."""

    horizon = 2

    def __init__(self, *statuses):
        self.statuses, self.seen = list(statuses), []

    def control(self, state, reference, previous=None):
        self.seen.append((state, reference, previous))
        return Decision(np.ones(1), np.ones((2, 1)), np.zeros((2, 2)), self.statuses.pop(0), 1, 0.0)


def test_the_loop_hands_on_state_references_and_the_last_decision():
    controller = Scripted(Status.SOLVED, Status.SOLVED, Status.SOLVED)
    plant, references = Integrated(DoubleIntegrator(), time_step=1.0, substeps=1), np.arange(8.0).reshape(4, 2)
    rollout = closed_loop(plant, controller, references, np.zeros(2), 3)
    assert np.allclose(rollout.states, [[0, 0], [0.5, 1], [2, 2], [4.5, 3]])
    assert rollout.inputs.shape == (3, 1)
    assert [seen[1].tolist() for seen in controller.seen] == [references[k : k + 2].tolist() for k in range(3)]
    assert controller.seen[0][2] is None
    assert controller.seen[2][2].status is Status.SOLVED


def test_a_failed_solve_stops_the_loop_and_is_not_applied():
    controller = Scripted(Status.SOLVED, Status.ITERATION_LIMIT)
    plant = Integrated(DoubleIntegrator(), time_step=1.0, substeps=1)
    with pytest.raises(SolverFailure, match="failed at step 1: stopped at the iteration limit") as caught:
        closed_loop(plant, controller, np.zeros((9, 2)), np.zeros(2), 3)
    assert caught.value.step == 1
    assert len(controller.seen) == 2


def test_too_few_references_are_refused_before_the_first_step():
    with pytest.raises(ShapeError, match="3 steps with horizon 2 need 4 references; got 3"):
        closed_loop(Map(DoubleIntegrator()), Scripted(), np.zeros((3, 2)), np.zeros(2), 3)
