"""Contenders get the same instance and are judged by the same measure.

The measure knows an optimum when it sees one.
"""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from benchmarks import peer_daqp, peer_do_mpc
from benchmarks.gp import linearisation_groups
from benchmarks.kkt import Instance, kkt_residual
from benchmarks.peers import OWN, Run, converged, measure, one_program, table
from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.mpc import Box, Problem, Reference, Tracking
from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.status import Status
from gpmpc.systems import System, Translational, step

H = 3
HOVER = np.array([7.26, 0.0, 0.0])
PROBLEM = Problem(
    Tracking([1.0] * 6, [1.0] * 3),
    inputs=Box([7.2, -0.008, -0.008], [7.4, 0.008, 0.008]),
)


@pytest.fixture(scope="module")
def gp():
    random = np.random.default_rng(0)
    plant = System(Translational(), 1.0, 1)
    states = random.uniform(-1.5, 1.5, (30, 6))
    inputs = HOVER + random.uniform(-1.0, 1.0, (30, 3)) * [0.6, 0.1, 0.1]
    changes = (
        np.array([step(plant, x, u) for x, u in zip(states, inputs, strict=True)])
        - states
    )
    features = np.concatenate([states, inputs], axis=1)
    scales = np.tile(4.0 * features.std(0), (6, 1))
    signal = 10.0 * changes.var(0)
    parts = map(torch.from_numpy, (features, changes, scales, signal, 1e-5 * signal))
    offset = torch.from_numpy(changes.mean(0))  # as a trained model has one
    return GPPosterior.from_hyperparameters(*parts, 3, "difference", offset)


@pytest.fixture(scope="module")
def instances():
    def asked(shift):
        states = np.tile([0.3 + shift, 0.0, -0.2, 0.0, 0.4, 0.0], (H + 1, 1))
        belief = Gaussian.certain(
            torch.tensor([0.1 * shift, 0.1, 0.0, -0.1, 0.0, 0.0], dtype=torch.float64)
        )
        return Instance(
            belief, Reference(states), HOVER + np.array([0.05, 0.0, -0.005])
        )

    return [asked(0.0), asked(0.05)]


def cost_of(gp, instance, plan):
    """By torch, from the posterior's predictions alone."""
    x = instance.belief.mean
    total = 0.0
    for u, target in zip(plan, torch.from_numpy(instance.targets), strict=True):
        x = gp.predict(x, u).mean
        total = total + (x - target).square().sum()
    return (
        total
        + torch.diff(plan, dim=0, prepend=torch.from_numpy(instance.last)[None])
        .square()
        .sum()
    )


@pytest.fixture(scope="module")
def optimum(gp, instances):
    """By L-BFGS-B on torch's gradient, polished until nothing moves."""

    def value(flat):
        plan = torch.tensor(flat.reshape(H, 3) * [1.0, 0.1, 0.1], requires_grad=True)
        cost = cost_of(gp, instances[0], plan)
        cost.backward()
        return float(cost.detach()), (plan.grad.numpy() * [1.0, 0.1, 0.1]).ravel()

    bounds = (
        list(
            zip(
                PROBLEM.inputs.lower * [1, 10, 10],
                PROBLEM.inputs.upper * [1, 10, 10],
                strict=True,
            )
        )
        * H
    )
    plan = np.tile(HOVER, H)
    for _ in range(5):
        settings = {"ftol": 1e-16, "gtol": 1e-12, "maxiter": 2000, "maxcor": 30}
        plan = minimize(
            value, plan, jac=True, method="L-BFGS-B", bounds=bounds, options=settings
        ).x
    return plan.reshape(H, 3) * [1.0, 0.1, 0.1]


def test_the_residual_vanishes_at_an_optimum_alone(gp, instances, optimum):
    at_bounds = (optimum == PROBLEM.inputs.lower) | (optimum == PROBLEM.inputs.upper)
    assert at_bounds.any()
    assert not at_bounds.all()
    assert kkt_residual(gp, PROBLEM, instances[0], optimum) < 1e-6
    assert kkt_residual(gp, PROBLEM, instances[1], optimum) > 1e-3
    for k, j in itertools.product(range(H), range(3)):
        moved = optimum.copy()
        moved[k, j] += (
            0.01
            * (PROBLEM.inputs.upper[j] - PROBLEM.inputs.lower[j])
            * (-1 if moved[k, j] > HOVER[j] else 1)
        )
        assert kkt_residual(gp, PROBLEM, instances[0], moved) > 1e-4
    assert kkt_residual(gp, PROBLEM, instances[0], np.full((H, 3), np.nan)) == np.inf


def test_a_plan_beyond_its_bounds_is_never_an_optimum(gp, instances):
    free = Problem(Tracking(PROBLEM.cost.Q, PROBLEM.cost.R))
    answer = converged(gp, free, H)[OWN]()(instances[0], None)
    assert (
        (answer.inputs < PROBLEM.inputs.lower) | (answer.inputs > PROBLEM.inputs.upper)
    ).any()
    assert kkt_residual(gp, free, instances[0], answer.inputs) < 1e-5
    assert kkt_residual(gp, PROBLEM, instances[0], answer.inputs) > 1e-3


def test_the_residual_knows_no_units_of_the_cost(gp, instances):
    plan = np.tile(HOVER, (H, 1))
    scaled = Problem(
        Tracking(100 * PROBLEM.cost.Q, 100 * PROBLEM.cost.R),
        inputs=Box(PROBLEM.inputs.lower, PROBLEM.inputs.upper),
    )
    residual = kkt_residual(gp, PROBLEM, instances[0], plan)
    assert 1e-3 < residual <= 1.0
    assert kkt_residual(gp, scaled, instances[0], plan) == pytest.approx(
        residual, rel=1e-12
    )


def test_all_contenders_that_are_here_agree(gp, instances, optimum):
    """Each stops by a measure of its own.

    What that leaves is less than a hundredth of the inputs' range.
    """
    makers = converged(gp, PROBLEM, H)
    assert (makers["do-mpc, IPOPT"] is None) == (not peer_do_mpc.installed())
    accuracy = 1e-2 * (PROBLEM.inputs.upper - PROBLEM.inputs.lower)
    for name, make in makers.items():
        if make is None:
            continue
        solve = make()
        first = solve(instances[0], None)
        assert (np.abs(first.inputs - optimum) <= accuracy).all(), name
        warm = solve(instances[1], first)
        cold = solve(instances[1], None)
        for answer in (warm, cold):
            assert kkt_residual(gp, PROBLEM, instances[1], answer.inputs) < 1e-3, name
        assert (np.abs(warm.inputs - cold.inputs) <= accuracy).all(), name


@pytest.mark.skipif(not peer_daqp.installed(), reason="daqp is not installed")
def test_daqp_in_the_controller_decides_the_same(gp, instances):
    cases = one_program(gp, PROBLEM, H)
    for name in ("gpmpc, mean only", "gpmpc, zero order"):
        first = cases[name]()
        second = cases[f"{name}, DAQP inside"]()
        mine = None
        other = None
        for instance in [*instances, instances[0]]:
            mine = first(instance, mine)
            other = second(instance, other)
            assert other.status is Status.SOLVED
            assert np.allclose(mine.inputs, other.inputs, rtol=0, atol=1e-7)


@pytest.mark.skipif(not peer_daqp.installed(), reason="daqp is not installed")
def test_daqp_says_what_has_no_solution_and_goes_on():
    solver = peer_daqp.Daqp()
    rows = {"G": [[1.0, 1.0]], "h_lower": [3.0], "h_upper": [4.0], "lb": [0.0, 0.0]}
    contradiction = QuadraticProgram(np.eye(2), [1.0, 0.0], ub=[1.0, 1.0], **rows)
    possible = QuadraticProgram(np.eye(2), [1.0, 0.0], ub=[5.0, 5.0], **rows)
    assert solver.solve(contradiction).status is Status.INFEASIBLE
    found = solver.solve(possible)
    assert found.is_optimal(1e-9)
    assert np.allclose(found.x, DualActiveSet().solve(possible).x)


@pytest.mark.parametrize("cold", [False, True])
def test_a_run_forgets_its_solution_at_the_end_or_when_cold(cold, instances):
    seen = []

    def solve(instance, last):
        seen.append((instance, last and last.inputs))
        return _Plan(len(seen))

    run = Run(solve, instances, cold)
    for _ in range(3):
        run()
    assert [
        instance is instances[k]
        for (instance, _), k in zip(seen, (0, 1, 0), strict=True)
    ] == [True] * 3
    assert [last for _, last in seen] == [None, None if cold else 1, None]
    assert run.plans == [(0, 1), (1, 2), (0, 3)]


def test_the_table_of_peers_says_who_is_missing(gp, instances):
    cases = converged(gp, PROBLEM, H) | {"absent": None}
    cases = {
        name: cases[name] for name in (OWN, "CasADi, IPOPT, Gauss-Newton", "absent")
    }
    *rows, missing = measure(cases, gp, PROBLEM, instances, 0.01, cold=False)
    assert [row["what"] for row in rows] == list(cases)[:2]
    assert rows[0]["times_ours"] == rows[0]["times_ours_evicted"] == 1.0
    assert rows[1]["times_ours"] > 1
    assert all(row["kkt"] <= row["kkt_worst"] < 1e-3 for row in rows)
    assert "not installed" in missing["note"]
    assert len(table([*rows, missing]).splitlines()) == 5


class _Plan:
    def __init__(self, inputs):
        self.inputs = inputs


def test_ways_to_linearise_give_the_same_derivatives(gp):
    at = Gaussian(
        torch.full((6,), 0.2, dtype=torch.float64),
        0.01 * torch.eye(6, dtype=torch.float64),
    )
    # The kernels know the latent functions alone.
    latent = replace(
        gp, offset=torch.zeros_like(gp.offset), targets=gp.targets - gp.offset
    )
    for group in linearisation_groups(
        latent, at, torch.from_numpy(HOVER), reverse_mode=True
    ):
        own, *others = [call() for call in group.values()]
        for answer in others:
            for a, b in zip(own, answer, strict=True):
                assert np.allclose(a, b, rtol=1e-6, atol=1e-9)


def test_what_the_measure_does_not_cover_is_refused(gp, instances):
    bounded = Problem(
        Tracking([1.0] * 6, [1.0] * 3, penalized="inputs"),
        constraints=[Box([-1.0] * 6, [1.0] * 6, probability=0.95, penalty=None)],
    )
    with pytest.raises(SettingError, match="problem: must bound nothing but inputs"):
        kkt_residual(gp, bounded, instances[0], np.tile(HOVER, (H, 1)))
    with pytest.raises(ShapeError, match=r"shape \(3, 3\); got \(2, 3\)"):
        kkt_residual(gp, PROBLEM, instances[0], np.tile(HOVER, (2, 1)))
