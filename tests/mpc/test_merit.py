"""What globalises the iteration, written out in loops: prices, merit, promises,
multipliers and updates."""

import numpy as np
import pytest

from gpmpc.mpc._constraints import keep_rates, price_violations
from gpmpc.mpc._linear_quadratic import (
    INCREMENTS,
    Plan,
    QuadraticCost,
    References,
    StageRows,
    Stages,
    evaluate_cost,
)
from gpmpc.mpc._linearization import LocalProblem
from gpmpc.mpc._sqp import (
    MeritTerms,
    _between,
    _cost_of_small_input,
    _costates,
    _forecast_step,
    _merit,
    _update,
)

# stages, states, inputs, entries of s, rows
H = 3
N = 2
M = 2
P = 4
R = 2


def definite(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1]))
    return root @ root.mT + np.eye(shape[-1])


class Case:
    """A cost, rows and two plans of random numbers; ``squares`` and ``inputs`` whether
    outputs and rows hold inputs."""

    def __init__(self, rng, squares=True, inputs=True):
        Z = definite(rng, H if squares else 0, N + M + 1)
        self.cost = QuadraticCost(
            state=definite(rng, H, P // N, N),
            terminal=definite(rng, P // N, N),
            input=definite(rng, 1, M),
            penalized=INCREMENTS,
            squares=Z,
        )
        self.references = References(
            rng.normal(size=(H, N)), rng.normal(size=(H, M)), rng.normal(size=M)
        )
        low = rng.normal(size=(H, R)) - 1.0
        high = rng.normal(size=(H, R)) + 1.0
        low[:, 0] = -np.inf
        high[0, 1] = np.inf
        self.rows = StageRows(
            rng.normal(size=(H, R, P)),
            rng.normal(size=(H if inputs else 0, R, M)),
            low,
            high,
        )
        self.plan, self.proposed = (
            Plan(
                2 * rng.normal(size=(H + 1, P)),
                rng.normal(size=(H, M)),
                np.zeros((H + 1, N, N)),
            )
            for _ in range(2)
        )
        self.A = rng.normal(size=(H, P, P))
        self.after = 2 * rng.normal(size=(H, P))
        self.prices = np.array([3.0, 7.0])
        self.defect_prices = rng.uniform(0, 2, P)
        self.z = rng.normal(size=(H, R))

    @property
    def local(self):
        stages = Stages(
            A=self.A,
            B=np.zeros((H, P, M)),
            c=np.zeros((H, P)),
            next=self.after,
            V=np.zeros((H, N, N)),
        )
        covariances = np.zeros((H + 1, N, N))
        return LocalProblem(self.plan, stages, covariances, self.rows, self.cost)

    @property
    def terms(self):
        return MeritTerms(self.references, self.prices)

    def cost_of(self, plan):
        return evaluate_cost(self.cost, plan.states, plan.inputs, self.references, 1.0)

    def price_of(self, plan):
        total = 0.0
        for k in range(H):
            values = self.rows.E[k] @ plan.states[k + 1]
            values = values + (
                self.rows.D[k] @ plan.inputs[k] if len(self.rows.D) else 0.0
            )
            for e, price in enumerate(self.prices):
                total += price * max(
                    0.0,
                    values[e] - self.rows.upper[k, e],
                    self.rows.lower[k, e] - values[e],
                )
        return total


CASES = pytest.mark.parametrize(("squares", "inputs"), [(True, True), (False, False)])


@CASES
def test_violated_rows_cost_their_price(squares, inputs, rng):
    seen = set()
    for _ in range(20):
        case = Case(rng, squares, inputs)
        price = price_violations(case.prices, case.rows, case.plan)
        assert price == pytest.approx(case.price_of(case.plan), rel=1e-12)
        seen.add(price > 0)
    assert True in seen


@CASES
def test_the_merit_is_cost_price_and_weighed_defects(squares, inputs, rng):
    for _ in range(10):
        case = Case(rng, squares, inputs)
        merit = _merit(case.local, case.terms, case.defect_prices)
        defects = (
            np.abs(case.after - case.plan.states[1:]).sum(axis=0) @ case.defect_prices
        )
        assert merit == pytest.approx(
            case.cost_of(case.plan) + case.price_of(case.plan) + defects, rel=1e-12
        )


@CASES
def test_multipliers_of_the_dynamics_are_the_cost_of_a_push(squares, inputs, rng):
    """Central differences of cost and rows, with the push passed on to all later
    states; exact for quadratics."""
    case = Case(rng, squares, inputs)
    multipliers = _costates(
        case.cost, case.A, case.plan, case.references.states, case.rows.E, case.z
    )

    def lagrangian(states):
        rows = sum(case.z[k] @ case.rows.E[k] @ states[k + 1] for k in range(H))
        return (
            evaluate_cost(case.cost, states, case.plan.inputs, case.references, 1.0)
            + rows
        )

    for k in range(H):
        for i in range(P):
            values = []
            for push in (0.5, -0.5):
                states = case.plan.states.copy()
                push_of_state = push * np.eye(P)[i]
                for j in range(k, H):
                    states[j + 1] += push_of_state
                    push_of_state = (
                        case.A[j + 1] @ push_of_state if j + 1 < H else push_of_state
                    )
                values.append(lagrangian(states))
            assert multipliers[k, i] == pytest.approx(
                values[0] - values[1], rel=1e-9, abs=1e-9
            )


@CASES
@pytest.mark.parametrize("known", [0.0, 1e6])
def test_the_promise_of_a_step_is_measured_by_the_plans_cost(
    squares, inputs, known, rng
):
    for _ in range(5):
        case = Case(rng, squares, inputs)
        before = np.full(P, known)
        forecast = _forecast_step(case.local, case.terms, before, case.proposed, case.z)
        zero = References(*(np.zeros_like(part) for part in case.references))
        step = [b - a for a, b in zip(case.plan[:2], case.proposed[:2], strict=True)]
        missed = np.abs(case.after - case.plan.states[1:])
        assert forecast.cost == pytest.approx(case.cost_of(case.plan), rel=1e-12)
        assert forecast.squared_length == pytest.approx(
            evaluate_cost(case.cost, *step, zero, 0.0), rel=1e-12
        )
        assert forecast.promised == pytest.approx(
            case.cost_of(case.proposed) + case.price_of(case.proposed), rel=1e-12
        )
        assert forecast.defect == pytest.approx(
            missed.max() / max(1.0, np.abs(case.plan.states[1:]).max()), rel=1e-12
        )
        costates = _costates(
            case.cost,
            case.A,
            case.proposed,
            case.references.states,
            case.rows.E,
            case.z,
        )
        np.testing.assert_allclose(
            forecast.defect_prices,
            np.maximum(known, 1.5 * np.abs(costates).max(axis=0)),
            rtol=1e-12,
        )
        priced_cost = forecast.cost + case.price_of(case.plan)
        assert forecast.merit == pytest.approx(
            priced_cost + missed.sum(axis=0) @ forecast.defect_prices, rel=1e-12
        )
        assert (before == known).all()


def test_an_update_has_the_steps_curvature_and_stays_definite(rng):
    for turn in (1.0, -1.0, 0.0):
        P_ = definite(rng, 5)
        step = rng.normal(size=5)
        B = P_.copy()
        change = turn * definite(rng, 5) @ step
        _update(B, step, change)
        np.testing.assert_allclose(B, B.T, atol=1e-12)
        assert np.linalg.eigvalsh(B).min() > 0
        if step @ change >= 0.2 * step @ P_ @ step:
            np.testing.assert_allclose(B @ step, change, rtol=1e-9)
        else:  # damped: a fifth of the curvature that was there stays (Powell, 1978)
            assert step @ B @ step == pytest.approx(0.2 * step @ P_ @ step)


def test_between_two_plans_every_part_moves_by_the_same_share(rng):
    case = Case(rng)
    assert _between(case.plan, case.proposed, 1.0) is case.proposed
    for step_length in (0.0, 0.25):
        for part, a, b in zip(
            _between(case.plan, case.proposed, step_length),
            case.plan,
            case.proposed,
            strict=True,
        ):
            np.testing.assert_allclose(
                part, (1 - step_length) * a + step_length * b, atol=1e-15
            )


def test_the_smallest_cost_is_of_a_thousandth_of_one_input():
    R_ = np.diag([4.0, 9.0])
    wide = np.full(2, np.inf)
    assert _cost_of_small_input(R_, -wide, wide, np.zeros(2)) == pytest.approx(4e-6)
    assert _cost_of_small_input(
        R_, -wide, wide, np.array([-10.0, 0.5])
    ) == pytest.approx(9e-6)
    assert _cost_of_small_input(
        R_, np.array([-0.25, -9.0]), np.array([0.25, 9.0]), np.zeros(2)
    ) == pytest.approx(1e-6)
    assert _cost_of_small_input(0 * R_, -wide, wide, np.zeros(2)) > 0


def test_inputs_are_clipped_to_their_rates_one_after_another(rng):
    for stages in (1, H):
        low = -rng.uniform(0.1, 0.5, (stages, M))
        high = rng.uniform(0.1, 0.5, (stages, M))
        inputs = rng.normal(size=(H, M))
        last = rng.normal(size=M)
        expected = []
        before = last
        for k, u in enumerate(inputs):
            at = min(k, stages - 1)
            before = np.clip(u, before + low[at], before + high[at])
            expected.append(before)
        keep_rates(inputs, last, low, high)
        np.testing.assert_allclose(inputs, expected, atol=1e-15)
