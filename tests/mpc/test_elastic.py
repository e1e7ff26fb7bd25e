"""A bound that cannot be kept gives way where it would otherwise cost more than all
that the cost is for."""

import numpy as np
import pytest
import torch

from gpmpc.gaussian import Gaussian
from gpmpc.models import KnownModel
from gpmpc.mpc import (
    GPMPC,
    Box,
    Halfspaces,
    Inequality,
    LeastSquares,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc._condense import condense
from gpmpc.mpc._elastic import are_kept_again
from gpmpc.mpc._guess import initial_guess, read_request
from gpmpc.mpc._priced_solver import PricedSolver
from gpmpc.propagation import Linearization
from gpmpc.qp import DualActiveSet
from gpmpc.qp import _record as layout
from gpmpc.status import Status
from tests.mpc.small_models import LinearGaussian, double_integrator
from tests.mpc.systems import linear_gaussian

H = 12


def planned(
    penalty, start, goal=0.0, upper=0.5, form="trajectory", push=50.0, decisions=1
):
    """A cart's plan whose position is to stay below a bound; the push costs next to
    nothing."""
    settings = {} if penalty in ("default", "free") else {"penalty": penalty}
    bound = Box([-np.inf, -np.inf], [upper, np.inf], **settings)
    problem = Problem(
        Tracking([1.0, 0.1], [0.01], penalized="inputs"),
        Box([-push], [push]),
        constraints=[] if penalty == "free" else [bound],
    )
    model = LinearGaussian([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]])
    prediction = PredictionSettings(form, covariance="none")
    controller = GPMPC(model, Linearization(), problem, H, [0.0], prediction)
    belief = Gaussian.certain(np.array(start))
    decision = None
    for _ in range(decisions):
        decision = controller.control(
            belief, Reference(np.array([goal, 0.0])), decision
        )
    return decision


@pytest.mark.parametrize("start", [[0.0, 0.0], [0.4, 0.5], [0.49, -1.0]])
def test_an_elastic_bound_is_exact_where_it_can_be_kept(start):
    elastic, exact = (planned(p, start, goal=3.0) for p in ("default", "exact"))
    assert elastic.status is Status.SOLVED
    assert elastic.means[1:, 0].max() <= 0.5 + 1e-7
    np.testing.assert_allclose(elastic.inputs, exact.inputs, atol=1e-7)


@pytest.mark.parametrize("penalty", ["elastic", "exact"])
@pytest.mark.parametrize("length", [1e-6, 1e-3, 1.0, 1e3])
def test_a_bound_that_can_be_kept_is_kept_at_any_scale(penalty, length):
    """A pressure of half a megapascal, in pascals, and its row as large as one."""
    model = KnownModel(lambda x, u: x + u, 1, 1)
    row = Halfspaces([[length]], [length * 5e5], penalty=penalty)
    problem = Problem(Tracking([1.0], [1e-3], penalized="inputs"), constraints=[row])
    settings = PredictionSettings(covariance="none")
    controller = GPMPC(model, Linearization(), problem, 10, [0.0], settings)
    plan = controller.control(Gaussian.certain([0.0]), Reference(np.array([6e5])))
    assert plan.status is Status.SOLVED
    assert plan.means[1:, 0] == pytest.approx(np.full(10, 5e5), rel=1e-9)


@pytest.mark.parametrize("weights", [[1.0, 0.1], [0.0, 0.0]])
def test_what_gives_way_does_so_however_its_row_is_scaled(weights):
    model = LinearGaussian([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]])
    settings = PredictionSettings(covariance="none")
    speed = LeastSquares(lambda x: x[:, 1:], [0.1])
    plans = []
    for unit in (1.0, 1e-3, 1e3):
        lane = Halfspaces([[unit, 0.0]], [0.5 * unit])
        problem = Problem(
            Tracking(weights, [0.01], penalized="inputs"),
            Box([-50.0], [50.0]),
            constraints=[lane],
            outputs=[speed],
        )
        controller = GPMPC(model, Linearization(), problem, H, [0.0], settings)
        plan = controller.control(
            Gaussian.certain(np.array([0.8, 1.0])), Reference(np.zeros(2))
        )
        assert plan.status is Status.SOFT_BOUND_MISSED
        plans.append(plan.inputs)
    assert np.abs(plans[0]).max() < 40.0  # gives way
    np.testing.assert_allclose(plans[1], plans[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(plans[2], plans[0], rtol=1e-9, atol=1e-9)


def test_what_gives_way_knows_no_units_of_rows_nor_of_the_cost():
    """Two rows that a cart misses, at rest and on its way, where one is in another."""
    model = LinearGaussian([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]])
    settings = PredictionSettings(covariance="none")
    flights = []
    for row_unit, cost_unit in ((1.0, 1.0), (1e3, 1.0), (1e-3, 1.0), (1.0, 1e-9)):
        cost = Tracking(
            [cost_unit, 0.1 * cost_unit], [0.01 * cost_unit], penalized="inputs"
        )
        place = Halfspaces([[row_unit, 0.0]], [0.5 * row_unit])
        speed = Halfspaces([[0.0, 1.0]], [0.6])
        problem = Problem(cost, Box([-9.0], [9.0]), constraints=[place, speed])
        controller = GPMPC(model, Linearization(), problem, H, [0.0], settings)
        decision = None
        plans = []
        for start in ([0.8, 1.0], [0.93, 0.2]):
            decision = controller.control(
                Gaussian.certain(np.array(start)), Reference(np.zeros(2)), decision
            )
            assert decision.status is Status.SOFT_BOUND_MISSED
            plans.append(decision.inputs)
        flights.append(plans)
    for plans in flights[1:]:
        np.testing.assert_allclose(plans, flights[0], rtol=0, atol=1e-10)


@pytest.mark.parametrize("form", ["trajectory", "velocity"])
@pytest.mark.parametrize("start", [[0.8, 1.0], [2.0, 0.0], [0.5, 4.0]])
def test_where_it_cannot_its_price_cannot_outweigh_the_cost(start, form):
    free, elastic, exact = (
        planned(p, start, form=form) for p in ("free", "default", "exact")
    )
    assert elastic.status is Status.SOFT_BOUND_MISSED
    outside = np.maximum(0.0, elastic.means[1:, 0] - 0.5)
    assert elastic.violation == pytest.approx(outside.max(), abs=1e-9)
    # The deviation that a violation is beside the reference counts as well.
    missed = np.maximum(0.0, free.means[1:, 0] - 0.5)
    scale = 2 * free.cost + (missed**2).sum()
    assert elastic.cost <= free.cost + 2 * scale  # what violations may cost at most
    assert exact.cost > 1.2 * elastic.cost
    assert outside.sum() < missed.sum()
    assert np.abs(elastic.inputs).max() < np.abs(exact.inputs).max()


@pytest.mark.parametrize("form", ["trajectory", "velocity"])
def test_a_bound_that_is_cheap_is_as_dear_as_an_exact_one(form):
    """Where pushes are small the cost asks for nearly the fastest return anyway."""
    free, elastic, exact = (
        planned(p, [0.8, 1.0], form=form, push=3.0, decisions=2)
        for p in ("free", "default", "exact")
    )
    assert exact.cost < 1.04 * free.cost
    assert elastic.status is Status.SOFT_BOUND_MISSED
    np.testing.assert_allclose(elastic.inputs, exact.inputs, atol=1e-6)


def test_a_plan_that_goes_on_pays_a_tenth_for_a_dear_bound():
    free, first, elastic, exact = (
        planned(penalty, [2.0, 0.0], push=8.0, decisions=decisions)
        for penalty, decisions in (
            ("free", 1),
            ("default", 1),
            ("default", 2),
            ("exact", 1),
        )
    )
    assert exact.cost > 1.3 * free.cost
    missed = np.maximum(0.0, free.means[1:, 0] - 0.5)
    tenth = 0.1 * (free.cost + (missed**2).sum())
    assert 1.05 * first.cost < elastic.cost <= free.cost + tenth + 1e-9
    sums = [np.maximum(0.0, d.means[1:, 0] - 0.5).sum() for d in (first, elastic)]
    assert sums[1] < 0.99 * sums[0]


def controller_beside_a_bound(**options):
    """A controller of a mass whose place is to stay below an elastic bound."""
    problem = Problem(
        Tracking([1.0, 0.1], [0.01], penalized="inputs"),
        Box([-8.0], [8.0]),
        constraints=[Box([-np.inf, -np.inf], [0.5, np.inf])],
    )
    return GPMPC(
        model=LinearGaussian([[1.0, 0.1], [0.0, 1.0]], [[0.005], [0.1]]),
        propagator=Linearization(),
        problem=problem,
        horizon=H,
        initial_input=[0.0],
        prediction=PredictionSettings(covariance="none"),
        **options,
    )


def test_a_plan_that_is_handed_over_is_no_last_one():
    """Its bound takes the safe price, as a first plan's does."""
    controller = controller_beside_a_bound(iterations=1)
    belief = Gaussian.certain(np.array([2.0, 0.0]))
    origin = Reference(np.zeros(2))
    first = controller.control(belief, origin)
    again = controller.control(belief, origin, first)
    handed_over = controller.control(belief, origin, first, plan=first.inputs)
    alone = controller.control(belief, origin, plan=first.inputs)
    np.testing.assert_allclose(handed_over.inputs, alone.inputs, atol=1e-9)
    assert np.abs(again.inputs - alone.inputs).max() > 1e-3


def test_a_reference_beyond_a_bound_does_not_make_it_free():
    """The plan without the bound costs nothing: it rests beyond it."""
    decision = planned("default", [0.8, 0.0], goal=0.8)
    assert decision.means[-1, 0] < 0.65


def test_a_bound_of_what_the_cost_does_not_weigh_counts():
    """The plan without the bound costs nothing, however long it rests beyond it."""
    model = LinearGaussian(np.eye(2), np.eye(2))
    problem = Problem(
        Tracking([1.0, 0.0], [0.01, 0.01], penalized="inputs"),
        Box([-0.5, -0.5], [0.5, 0.5]),
        constraints=[Box([-np.inf, -np.inf], [np.inf, 1.0])],
    )
    prediction = PredictionSettings(covariance="none")
    controller = GPMPC(model, Linearization(), problem, H, [0.0, 0.0], prediction)
    decision = controller.control(
        Gaussian.certain(np.array([0.0, 2.0])), Reference(np.zeros(2))
    )
    assert decision.status is Status.SOFT_BOUND_MISSED
    assert decision.means[-1, 1] == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("iterations", [1, None])
def test_a_vehicle_pushed_out_of_its_lane_returns_without_a_spin(iterations):
    """A tyre that lets go beyond a slip: what exact bounds ask for is more than it
    bears, where programs see it as it is at the plan before."""

    def slide(x, u):
        offset, rate, heading = x.unbind(-1)
        slip = u[..., 0] - 2.0 * heading
        grip = slip / (1.0 + (2.0 * slip) ** 4)
        parts = [
            offset + 0.1 * rate,
            rate + 0.1 * (8.0 * grip - 0.5 * rate + 6.0 * heading),
            heading + 0.1 * (2.0 * grip - 0.3 * heading),
        ]
        return torch.stack(parts, -1)

    ends = {}
    for penalty in ("default", "exact", "none"):
        settings = {"penalty": "exact"} if penalty == "exact" else {}
        lane = Box([-0.05, -np.inf, -np.inf], [0.05, np.inf, np.inf], **settings)
        problem = Problem(
            Tracking([10.0, 1.0, 1.0], [0.5], penalized="inputs"),
            Box([-2.0], [2.0]),
            constraints=[] if penalty == "none" else [lane],
        )
        controller = GPMPC(
            KnownModel(slide, 3, 1),
            Linearization(),
            problem,
            15,
            [0.0],
            PredictionSettings(covariance="none"),
            iterations=iterations,
        )
        state = np.array([0.2, 0.0, 0.0])
        decision = None
        worst = 0.0
        for _ in range(60):
            decision = controller.control(
                Gaussian.certain(state), Reference(np.zeros(3)), decision
            )
            next_state = slide(
                torch.from_numpy(state), torch.from_numpy(decision.input)
            )
            state = next_state.numpy()
            worst = max(worst, abs(state[0]))
        ends[penalty] = worst
    if iterations == 1:
        assert ends["exact"] > 1.0
    else:  # the step back is no slight one beside its price, and is iterated
        assert ends["exact"] < 1.1 * 0.2
    assert ends["default"] < 1.1 * max(0.2, ends["none"])


def test_a_bound_that_can_be_kept_keeps_its_price():
    """Heat that takes long to leave, beside a wall that a slide need not cross."""
    model = LinearGaussian(
        [[0.99, 0.0], [0.0, 1.0]], [[0.01, 0.0], [0.0, 1.0]], c=[0.0, 0.0]
    )
    bounds = [
        Box([-np.inf, -np.inf], [100.0, np.inf]),
        Box([-np.inf, -np.inf], [np.inf, 1.0]),
    ]
    problem = Problem(
        Tracking([1e-4, 1.0], [1e-3, 1e-3], penalized="inputs"),
        Box([-1.0, -1.0], [1.0, 1.0]),
        constraints=bounds,
    )
    prediction = PredictionSettings(covariance="none")
    controller = GPMPC(model, Linearization(), problem, 20, [0.0, 0.0], prediction)
    state = np.array([200.0, 0.0])
    decision = None
    for _ in range(3):
        decision = controller.control(
            Gaussian.certain(state), Reference(np.array([100.0, 2.0])), decision
        )
        assert decision.status is Status.SOFT_BOUND_MISSED
        assert decision.means[1:, 1].max() <= 1.0 + 1e-7
        state = decision.means[1]
    assert state[1] == pytest.approx(1.0, abs=1e-3)


def test_a_bound_of_an_input_that_costs_nothing_counts():
    """The plan without the bound rests at its reference, by an input beyond it."""
    model = LinearGaussian([[0.9]], [[1.0]])
    cost = Tracking([1.0], [0.1], penalized="increments")
    problem = Problem(
        cost,
        Box([-2.0], [2.0]),
        input_rates=Box([-0.1], [0.1]),
        constraints=[Inequality(h=lambda x, u: u - 0.5, count=1)],
    )
    prediction = PredictionSettings(covariance="none")
    controller = GPMPC(model, Linearization(), problem, H, [1.0], prediction)
    belief = Gaussian.certain(np.array([10.0]))
    decision = None
    for _ in range(2):
        decision = controller.control(belief, Reference(np.array([10.0])), decision)
        assert decision.status is Status.SOFT_BOUND_MISSED
        assert decision.inputs[-1, 0] < 0.8  # 1.0 without the bound


def drift_out_of_a_lane(penalty, decisions):
    """A plan of an unstable cart whose tubes become wider than its lane."""
    model = LinearGaussian(
        [[1.0, 0.1], [0.4, 1.05]], [[0.005], [0.1]], W=np.diag([1e-4, 4e-4]).tolist()
    )
    lane = Box([-0.1, -np.inf], [0.1, np.inf], probability=0.95, penalty=penalty)
    problem = Problem(
        Tracking([1.0, 0.1], [0.05], penalized="inputs"),
        Box([-20.0], [20.0]),
        constraints=[lane],
    )
    settings = PredictionSettings(covariance="zero_order", feedback=False)
    controller = GPMPC(model, Linearization(), problem, 20, [0.0], settings)
    belief = Gaussian.certain(np.array([0.0, 0.0]))
    reference = Reference(np.array([0.3, 0.0]))
    decision = None
    for _ in range(decisions):
        decision = controller.control(belief, reference, decision)
    return decision


def test_a_bound_that_is_lost_in_the_end_costs_a_tenth_at_most():
    free = drift_out_of_a_lane(penalty=1e-9, decisions=2)
    exact = drift_out_of_a_lane(penalty="exact", decisions=2)
    assert exact.cost > 1.3 * free.cost
    elastic = drift_out_of_a_lane(penalty="elastic", decisions=2)
    assert elastic.status is Status.SOFT_BOUND_MISSED
    assert 1.01 * free.cost < elastic.cost <= 1.1 * free.cost + 1e-9


class StopsUnderLowPrices(DualActiveSet):
    """Solves only what has no price, or the exact one."""

    def solve(self, problem, warm_start=None, prices=None):
        solution = super().solve(problem, warm_start, prices)
        priced = prices[np.isfinite(prices)]
        if ((priced > 1e-6) & (priced < 1e5)).any():
            record = solution.record.copy()
            record[layout.STATUS] = layout.STATUSES.index(Status.ITERATION_LIMIT)
            solution = solution._replace(record=record)
        return solution


def test_a_solution_stays_where_the_one_of_a_lower_price_fails():
    controller = controller_beside_a_bound(solver=StopsUnderLowPrices())
    decision = controller.control(
        Gaussian.certain(np.array([2.0, 0.0])), Reference(np.zeros(2))
    )
    assert decision.status is Status.SOFT_BOUND_MISSED
    exact = planned("exact", [2.0, 0.0], push=8.0)
    np.testing.assert_allclose(decision.inputs, exact.inputs, atol=1e-7)


def prices_of_rows(starts, is_due):
    """Prices of place and speed, elastic ones, after programs at several starts.

    Each program is due to price them where ``is_due`` says so.
    """
    place = Box([-np.inf, -np.inf], [1.0, np.inf], penalty="elastic")
    speed = Box([-np.inf, -np.inf], [np.inf, 0.5], penalty="elastic")
    problem = Problem(
        Tracking([1.0, 0.1], [0.1]),
        inputs=Box([-1.0], [1.0]),
        constraints=[place, speed],
    )
    controller = GPMPC(
        double_integrator(), Linearization(), problem, horizon=8, initial_input=[0.0]
    )
    prediction = controller.prediction
    reference = Reference(np.zeros(2))
    solver = None
    prices = [prediction.constraints.prices]
    for start, is_program_due in zip(starts, is_due, strict=True):
        request = read_request(prediction, Gaussian.certain(start), reference, None)
        local = prediction.linearize(initial_guess(prediction, request), request)
        program = condense(
            cost=local.cost,
            bounds=prediction.program_bounds,
            stages=local.stages,
            start=local.plan.states[0],
            references=request.references,
            rows=local.rows,
        )
        if solver is None:
            solver = PricedSolver(
                prediction, DualActiveSet(), request, is_late=lambda: False
            )
        if is_program_due:
            solver.look_again()
        assert solver.solve(program, local, warm_start=None).status is Status.SOLVED
        prices.append(solver.row_prices)
    return prices


def test_each_elastic_row_is_priced_once_a_step():
    """A row that a later program misses is priced, too; the first keeps its price."""
    exact, first, second = prices_of_rows(
        starts=([2.0, 0.0], [-3.0, 3.0]), is_due=(True, True)
    )
    assert (first < exact).tolist() == [True, False]
    assert (second < exact).tolist() == [True, True]
    assert second[0] == first[0]


def test_a_row_that_a_later_program_keeps_has_its_exact_price():
    """Once: where it is missed after all, it is priced for good."""
    exact, first, missed, kept, again, last = prices_of_rows(
        starts=([2.0, 0.0], [2.0, 0.0], [0.9, 0.0], [2.0, 0.0], [0.9, 0.0]),
        is_due=(True, False, False, True, False),
    )
    assert first[0] < exact[0]
    assert missed[0] == first[0]
    assert kept[0] == exact[0]
    assert again[0] < exact[0]
    assert last[0] == again[0]


@pytest.mark.parametrize(
    ("violations", "is_kept"),
    [
        ([0.3, 0.1, 0.0, 0.0], True),
        ([0.0, 0.0, 0.1, 0.3], False),
        ([0.3, 0.3, 0.3, 0.3 + 1e-15], True),  # as far as rounding lets one tell
    ],
)
def test_a_bound_is_kept_again_where_it_is_missed_early(violations, is_kept):
    assert are_kept_again(np.array(violations)) is is_kept


def test_an_input_beyond_its_bound_by_rounding_is_no_soft_bound():
    hard = Box([-1.0, -1.0], [1.0, 1.0], penalty=None)
    problem = Problem(
        Tracking([1.0, 1.0], [0.1]), Box([-1e5], [1e5]), constraints=[hard]
    )
    model = linear_gaussian(2, 1)
    prediction = GPMPC(model, Linearization(), problem, 4, [0.0]).prediction
    request = read_request(
        prediction, Gaussian.certain(np.zeros(2)), Reference(np.zeros(2)), None
    )
    local = prediction.linearize(initial_guess(prediction, request), request)
    inputs = np.full((4, 1), 1e5 + 2e-5)
    ending = local._replace(plan=local.plan._replace(inputs=inputs))
    assert prediction.end_of_solved(ending, violation=2e-5) is Status.SOLVED
