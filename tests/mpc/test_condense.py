"""Condensing against the matrices of the stacked problem, the paper's formulas, and
itself in other coordinates."""

from itertools import product

import numpy as np
import pytest

from gpmpc.exceptions import ShapeError
from gpmpc.mpc import Box, Problem, Tracking, dlqr
from gpmpc.mpc._condense import condense, condense_with_feedback
from gpmpc.mpc._cost import PENALIZED
from gpmpc.mpc._linear_quadratic import (
    InputBounds,
    QuadraticCost,
    References,
    StageRows,
    Stages,
    evaluate_cost,
    expand,
)
from gpmpc.mpc._riccati import finite_horizon_lqr
from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.status import Status
from tests.mpc.double_pendulum import ACROBOT, PENDUBOT, UPRIGHT, DoublePendulum


def spd(rng, n):
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def random_stages(rng, p, m, H, held):
    K = 1 if held else H
    return Stages(
        rng.normal(size=(K, p, p)) / np.sqrt(p),
        rng.normal(size=(K, p, m)),
        rng.normal(size=(K, p)),
    )


def random_references(rng, H, n, m):
    return References(
        rng.normal(size=(H, n)), rng.normal(size=(H, m)), 0.1 * rng.normal(size=m)
    )


class Condensing:
    """Condenses with a problem's bounds, the cost of an extended state of so many
    blocks, and squares of outputs."""

    def __init__(self, problem, H, blocks=1, squares=None):
        rates = (
            problem.input_rates.by_stage(H)
            if problem.input_rates.finite
            else np.empty((2, 0, problem.input_dim))
        )
        self.bounds = InputBounds(*problem.inputs.by_stage(H), *rates)
        cost = problem.cost
        Q, R = cost.by_stage(H)
        z = problem.state_dim + problem.input_dim + 1
        W = np.repeat(Q[:, None], blocks, axis=1)
        squares = np.empty((0, z, z)) if squares is None else squares
        self.cost = QuadraticCost(
            state=W if cost.Q.ndim > 2 else np.tile(cost.Q, (1, blocks, 1, 1)),
            terminal=W[-1],
            input=R if cost.R.ndim > 2 else R[:1],
            penalized=PENALIZED.index(cost.penalized),
            squares=squares,
        )

    def condense(self, *arguments):
        return condense(self.cost, self.bounds, *arguments)


def no_rows(p, H):
    return state_rows(np.zeros((1, 0, p)), np.empty((H, 0)), np.empty((H, 0)))


def state_rows(E, lower, upper):
    return StageRows(E, np.empty((0, 0, 1)), lower, upper)


def at(array, k):
    return array[min(k, len(array) - 1)]


def stacked_response(stages, start, H):
    """Gamma (H, p, H, m) and s^0 (H, p), a product at a time."""
    p, m = stages.B.shape[1:]
    gamma = np.zeros((H, p, H, m))
    free = np.zeros((H, p))
    s = start
    for k in range(H):
        free[k] = s = at(stages.A, k) @ s + at(stages.c, k)
        if k:
            gamma[k] = np.tensordot(at(stages.A, k), gamma[k - 1], 1)
        gamma[k, :, k, :] += at(stages.B, k)
    return gamma, free


@pytest.mark.parametrize("terminal", ["own", "the same"])
def test_constant_stages_are_stages_that_vary_and_do_not(terminal, rng):
    n = 3
    m = 2
    r = 2
    blocks = 4
    H = 9
    Q = spd(rng, n)
    R = spd(rng, m)
    T = spd(rng, n) if terminal == "own" else Q
    condenser = Condensing(
        Problem(Tracking(Q, R, terminal=T, penalized="inputs")), H, blocks
    )
    stages = random_stages(rng, n * blocks, m, H, held=True)
    start = rng.normal(size=n * blocks)
    references = random_references(rng, H, n, m)
    rows = state_rows(
        rng.normal(size=(1, r, n * blocks)), -np.ones((H, r)), np.ones((H, r))
    )
    repeated = Stages(*(np.repeat(part, H, axis=0) for part in stages))
    constant = condenser.condense(stages, start, references, rows)
    varying = condenser.condense(
        repeated, start, references, rows._replace(E=np.repeat(rows.E, H, axis=0))
    )
    for one, other in zip(constant[:5], varying[:5], strict=True):
        assert np.allclose(
            one,
            other,
            rtol=1e-12,
            atol=1e-12 * np.abs(other[np.isfinite(other)]).max(initial=0.0),
        )


@pytest.mark.parametrize("H", [1, 2, 7])
@pytest.mark.parametrize("blocks", [1, 2, 4])
@pytest.mark.parametrize("held", [True, False], ids=["held", "varying"])
@pytest.mark.parametrize("penalized", PENALIZED)
def test_the_condensed_problem_is_the_stacked_one(H, blocks, held, penalized, rng):
    n = 3
    m = 2
    r = 4
    p = 3 * blocks
    Q = spd(rng, n)
    T = spd(rng, n)
    R = spd(rng, m)
    problem = Problem(
        Tracking(Q, R, terminal=T, penalized=penalized),
        input_rates=Box([-1.0, -2.0], [1.0, np.inf]),
    )
    condenser = Condensing(problem, H, blocks)
    stages = random_stages(rng, p, m, H, held)
    start = rng.normal(size=p)
    references = random_references(rng, H, n, m)
    rows = state_rows(
        rng.normal(size=(len(stages.A), r, p)), np.zeros((H, r)), np.ones((H, r))
    )
    targets, wanted, last = references
    P, q, G, lower, upper, feedback = condenser.condense(
        stages, start, references, rows
    )

    gamma, free = stacked_response(stages, start, H)
    gamma = gamma.reshape(-1, H * m)
    reference = np.zeros_like(free)
    reference[:, :n] = targets
    weight = np.kron(np.eye(H * blocks), Q)
    weight[-p:, -p:] = np.kron(np.eye(blocks), T)
    D = np.eye(H * m) - np.eye(H * m, k=-m)
    first = np.concatenate([last, np.zeros((H - 1) * m)])
    T_u, centre = {
        "inputs": (np.eye(H * m), np.zeros(H * m)),
        "deviations": (np.eye(H * m), wanted.ravel()),
        "increments": (D, first),
    }[penalized]
    stacked_R = np.kron(np.eye(H), R)
    E = np.zeros((H * r, H * p))
    for k in range(H):
        E[k * r : (k + 1) * r, k * p : (k + 1) * p] = at(rows.E, k)
    assert np.allclose(
        P,
        2 * (gamma.T @ weight @ gamma + T_u.T @ stacked_R @ T_u),
        rtol=1e-12,
        atol=1e-11,
    )
    gradient = (
        gamma.T @ weight @ (free - reference).ravel() - T_u.T @ stacked_R @ centre
    )
    assert np.allclose(q, 2 * gradient, rtol=1e-12, atol=1e-11)
    assert np.allclose(G, np.vstack([D, E @ gamma]), atol=1e-12)
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P)[0] > 0
    assert np.allclose(upper[-H * r :] - lower[-H * r :], 1.0)
    assert np.allclose(lower[-H * r :], -E @ free.ravel(), atol=1e-12)
    assert lower[H * m : H * m + m] == pytest.approx([last[0] - 1, last[1] - 2])
    assert upper[H * m] == pytest.approx(last[0] + 1)
    assert len(lower) == len(upper) == H * m + len(G)

    unknowns = rng.normal(size=H * m)
    inputs, states = expand(stages, start, feedback, last, unknowns)
    assert np.array_equal(inputs.ravel(), unknowns)
    assert np.allclose(states[1:].ravel(), gamma @ unknowns + free.ravel(), atol=1e-12)
    rest, at_rest = expand(stages, start, feedback, last, np.zeros(H * m))
    difference = evaluate_cost(condenser.cost, states, inputs, references, 1.0)
    difference -= evaluate_cost(condenser.cost, at_rest, rest, references, 1.0)
    assert difference == pytest.approx(
        unknowns @ P @ unknowns / 2 + q @ unknowns, rel=1e-10, abs=1e-9
    )


def test_in_increments_it_is_the_papers_problem(rng):
    """Cao, Lai and Alam (2017), (38)-(39) with the missing factor 2, on s = [mu; vec S]
    of three states."""
    n = 3
    m = 2
    H = 5
    p = n + n * n
    Q = spd(rng, n)
    R = spd(rng, m)
    A, B, *_ = random_stages(rng, p, m, H, held=True)
    A[0, :, n:] = 0.0  # as at a measured state
    s0 = rng.normal(size=p)
    before = rng.normal(size=p)
    last = rng.normal(size=m)
    targets = rng.normal(size=(H, n))
    condenser = Condensing(Problem(Tracking(Q, R, penalized="inputs")), H, n + 1)
    c = s0 - A[0] @ before - B[0] @ last
    references = References(targets, np.zeros((H, m)), last)
    P, q, *_ = condenser.condense(Stages(A, B, c[None]), s0, references, no_rows(p, H))

    Qbar = np.zeros((p, p))
    Qbar[:n, :n], Qbar[n:, n:] = Q, np.kron(np.eye(n), Q)
    powers = [np.linalg.matrix_power(A[0], k) for k in range(H + 1)]
    A_tilde = np.vstack(powers[1:])
    zeros = np.zeros((p, m))
    B_tilde = np.block(
        [
            [powers[i - j] @ B[0] if i >= j else zeros for j in range(H)]
            for i in range(H)
        ]
    )
    T_z = np.kron(np.tri(H), np.eye(p))
    T_u = np.kron(np.tri(H), np.eye(m))
    Q_tilde = np.kron(np.eye(H), Qbar)
    R_tilde = np.kron(np.eye(H), R)
    r = np.zeros((H, p))
    r[:, :n] = targets
    paper_P = 2 * (B_tilde.T @ T_z.T @ Q_tilde @ T_z @ B_tilde + T_u.T @ R_tilde @ T_u)
    offset = np.tile(s0, H) + T_z @ A_tilde @ (s0 - before) - r.ravel()
    paper_q = 2 * (
        B_tilde.T @ T_z.T @ Q_tilde @ offset + T_u.T @ R_tilde @ np.tile(last, H)
    )
    increments = np.linalg.solve(paper_P, -paper_q)
    assert np.allclose(T_u.T @ P @ T_u, paper_P, rtol=1e-11, atol=1e-10)
    assert np.allclose(
        np.linalg.solve(P, -q), np.tile(last, H) + T_u @ increments, atol=1e-9
    )


@pytest.mark.parametrize("rated", [True, False], ids=["rates", "no rates"])
@pytest.mark.parametrize("held", [True, False], ids=["held", "varying"])
@pytest.mark.parametrize("penalized", PENALIZED)
def test_feedback_coordinates_give_the_same_plan(penalized, held, rated, rng):
    n = 3
    m = 2
    r = 2
    blocks = 2
    H = 8
    p = n * blocks
    solver = DualActiveSet()
    Q = spd(rng, n)
    T = spd(rng, n)
    R = spd(rng, m)
    rates = {"input_rates": Box([-0.4, -0.3], [0.4, np.inf])} if rated else {}
    problem = Problem(
        Tracking(Q, R, terminal=T, penalized=penalized),
        inputs=Box([-0.5, -0.3], [np.inf, 0.4]),
        **rates,
    )
    condenser = Condensing(problem, H, blocks)
    stages = random_stages(rng, p, m, H, held)
    start = rng.normal(size=p)
    references = random_references(rng, H, n, m)
    rows = state_rows(
        rng.normal(size=(len(stages.A), r, p)),
        np.full((H, r), -3.0),
        np.full((H, r), 4.0),
    )
    price = np.full(H * r, 2.0)
    solutions = []
    plain = condenser.condense(stages, start, references, rows)
    assert len(plain.feedback) == 0
    other = condense_with_feedback(
        condenser.cost, condenser.bounds, stages, start, references, rows
    )
    for program in (plain, other):
        prices = np.concatenate([np.full(len(program.G) - H * r, np.inf), price])
        solution = solver.solve(QuadraticProgram.unchecked(*program[:5]), prices=prices)
        assert solution.status is Status.SOLVED
        inputs, states = expand(
            stages, start, program.feedback, references.previous_input, solution.x
        )
        z = solution.multipliers[
            -(len(problem.inputs.lower) * H * (2 if rated else 1) + H * r) :
        ]
        solutions.append((inputs, states, z))
    assert np.count_nonzero(solutions[0][2]) > 3
    for one, same in zip(*solutions, strict=True):
        assert np.allclose(one, same, rtol=0, atol=1e-8)
    assert len(other.feedback) == H
    assert np.array_equal(other.P * np.kron(np.eye(H), np.ones((m, m))), other.P)
    assert not other.q.any()


@pytest.mark.parametrize("held", [True, False], ids=["held", "varying"])
@pytest.mark.parametrize("penalized", PENALIZED)
def test_weights_by_stage_outputs_and_rows_make_the_stacked_qp(penalized, held, rng):
    n = 3
    m = 2
    r = 2
    blocks = 2
    H = 6
    p = n * blocks
    z = n + m + 1
    Q = np.array([spd(rng, n) for _ in range(H)])
    R = np.array([spd(rng, m) for _ in range(H)])
    outputs = rng.normal(size=(H, 2, z))
    problem = Problem(
        Tracking(Q, R, terminal=spd(rng, n), penalized=penalized),
        inputs=Box([-0.4] * m, [0.5] * m),
    )
    condenser = Condensing(problem, H, blocks, outputs.mT @ outputs)
    stages = random_stages(rng, p, m, H, held)
    start = rng.normal(size=p)
    references = random_references(rng, H, n, m)
    E = rng.normal(size=(H, r, p))
    D = rng.normal(size=(H, r, m))
    rows = StageRows(E, D, np.full((H, r), -3.0), np.full((H, r), 1.0))
    W, _ = problem.cost.by_stage(H)

    def cost_and_rows(inputs):
        s = start
        total = 0.0
        values = []
        for k, u in enumerate(inputs):
            s = at(stages.A, k) @ s + at(stages.B, k) @ u + at(stages.c, k)
            error = s.reshape(blocks, n).copy()
            before = inputs[k - 1] if k else references.previous_input
            error[0] -= references.states[k]
            v = {
                "inputs": u,
                "deviations": u - references.inputs[k],
                "increments": u - before,
            }[penalized]
            y = outputs[k] @ np.concatenate([s[:n], u, [1.0]])
            total += np.einsum("bi,ij,bj->", error, W[k], error) + v @ R[k] @ v + y @ y
            values.append(at(E, k) @ s + D[k] @ u)
        return total, np.array(values)

    at_rest = cost_and_rows(np.zeros((H, m)))
    plans = []
    with_feedback = condense_with_feedback(
        condenser.cost, condenser.bounds, stages, start, references, rows
    )
    plain = condenser.condense(stages, start, references, rows)
    for program in (plain, with_feedback):
        x = rng.normal(size=H * m)
        inputs, states = expand(
            stages, start, program.feedback, references.previous_input, x
        )
        origin, _ = expand(
            stages, start, program.feedback, references.previous_input, 0.0 * x
        )
        total, values = cost_and_rows(inputs)
        assert evaluate_cost(
            condenser.cost, states, inputs, references, 1.0
        ) == pytest.approx(total, rel=1e-11)
        gained = x @ program.P @ x / 2 + program.q @ x
        assert gained == pytest.approx(total - cost_and_rows(origin)[0], rel=1e-9)
        left = program.upper[-H * r :] - program.G[-H * r :] @ x
        assert np.allclose(left.reshape(H, r), 1.0 - values, atol=1e-10)
        solution = DualActiveSet().solve(
            QuadraticProgram.unchecked(*program[:5]), prices=priced(program, H * r)
        )
        plans.append(
            expand(
                stages, start, program.feedback, references.previous_input, solution.x
            )[0]
        )
        assert cost_and_rows(plans[-1])[0] < at_rest[0]
    assert np.allclose(*plans, atol=1e-8)


def priced(program, rows):
    return np.concatenate([np.full(len(program.G) - rows, np.inf), np.full(rows, 2.0)])


def test_an_unstable_plant_is_solved_in_feedback_coordinates(rng):
    """x+ = 2 x + u over 50 stages: 2^100 stands beside R in P, and nothing of R is
    left."""
    H = 50
    problem = Problem(
        Tracking([1.0], [1.0], penalized="inputs"), inputs=Box([-3.0], [3.0])
    )
    condenser = Condensing(problem, H, 1)
    stages = Stages(np.array([[[2.0]]]), np.array([[[1.0]]]), np.zeros((1, 1)))
    references = References(np.zeros((H, 1)), np.zeros((H, 1)), np.zeros(1))
    program = condenser.condense(stages, np.array([2.5]), references, no_rows(1, H))
    assert len(program.feedback) == H
    solution = DualActiveSet().solve(QuadraticProgram.unchecked(*program[:5]))
    inputs, states = expand(
        stages, np.array([2.5]), program.feedback, references.previous_input, solution.x
    )
    assert solution.status is Status.SOLVED
    assert inputs.min() == pytest.approx(-3.0, abs=1e-9)
    assert np.abs(states[-20:]).max() < 1e-6
    assert np.allclose(states[1:], 2 * states[:-1] + inputs, atol=1e-12)


def test_arrays_that_are_not_contiguous_are_refused(rng):
    condenser = Condensing(
        Problem(Tracking([1.0, 1.0], [1.0], penalized="inputs")), 3, 1
    )
    stages = random_stages(rng, 2, 1, 3, held=False)
    with pytest.raises(ShapeError, match="contiguous"):
        condenser.condense(
            stages._replace(A=stages.A.swapaxes(1, 2)),
            np.zeros(2),
            random_references(rng, 3, 2, 1),
            no_rows(2, 3),
        )


def wild_plans(rng, model, start, goal, H):
    """Plans to linearise along: the straight line, a rollout without torque, one with
    two kicks, and sheer noise."""
    line = np.linspace(0.0, 1.0, H + 1)[:, None]
    torques = np.zeros((H, 1))
    yield (1 - line) * start + line * goal, torques
    kicks = np.repeat([3.0, -3.0, 0.0], [10, 10, H - 20])[:, None]
    for inputs in (torques, kicks):
        states = [start]
        for u in inputs:
            states.append(model.successor(states[-1], u))
        yield np.array(states), inputs
    noise = rng.normal(size=(H, 4)) * [2.0, 2.0, 30.0, 30.0]
    yield np.vstack([start, noise]), rng.uniform(-6, 6, (H, 1))


def programs_of_the_double_pendulum(starts, seed):
    """Solves the program of every wild plan over 1.2 s; says how many were made in
    feedback coordinates, and how many.

    Six poses count as upright, a turn apart. Every solution is checked against the
    stages and the bounds.
    """
    H = 60
    rng = np.random.default_rng(seed)
    solver = DualActiveSet()
    counts = np.zeros(2, dtype=int)
    bounds = {"inputs": Box([-6.0], [6.0])}
    for joint, penalized, _ in product(
        (ACROBOT, PENDUBOT), ("inputs", "increments"), range(starts)
    ):
        problem = Problem(
            Tracking([100.0, 100.0, 1.0, 1.0], [1e-3], penalized=penalized),
            **bounds,
        )
        model = DoublePendulum(joint)
        condenser = Condensing(problem, H, 1)
        start = np.concatenate([rng.uniform(-np.pi, np.pi, 2), rng.uniform(-15, 15, 2)])
        for turns in product((0, 1), (-1, 0, 1)):
            goal = UPRIGHT + 2 * np.pi * np.array([*turns, 0, 0])
            references = References(
                np.tile(goal, (H, 1)), np.zeros((H, 1)), np.zeros(1)
            )
            for states, inputs in wild_plans(rng, model, start, goal, H):
                at = model.linearize(states[:-1], inputs)
                c = (
                    at.mean
                    - np.einsum("kij,kj->ki", at.A, states[:-1])
                    - np.einsum("kij,kj->ki", at.B, inputs)
                )
                stages = Stages(at.A, at.B, c)
                program = condenser.condense(stages, start, references, no_rows(4, H))
                solution = solver.solve(
                    QuadraticProgram.unchecked(*program[:5])
                )  # raises where P is indefinite
                plan_inputs, plan_states = expand(
                    stages,
                    start,
                    program.feedback,
                    references.previous_input,
                    solution.x,
                )
                assert solution.status is Status.SOLVED
                assert np.isfinite(plan_states).all()
                # Where torques are at their bounds the states of the linear stages
                # grow, and rounding with them.
                assert np.abs(plan_inputs).max() < 6.0 + 1e-9 * (
                    1.0 + np.abs(plan_states).max()
                )
                counts += len(program.feedback) > 0, 1
    return counts


def test_long_programs_of_a_double_pendulum_stay_definite():
    in_feedback, solved = programs_of_the_double_pendulum(starts=2, seed=0)
    assert solved == 192
    assert 20 < in_feedback < 150


@pytest.mark.slow
def test_nor_do_nine_hundred_and_sixty_from_other_starts():
    in_feedback, solved = programs_of_the_double_pendulum(starts=10, seed=1)
    assert solved == 960
    assert in_feedback > 100


def test_the_gain_of_a_long_horizon_is_stationary_and_exists(rng):
    A = rng.normal(size=(1, 4, 4))
    B = rng.normal(size=(1, 4, 2))
    Q = np.eye(4)
    R = np.eye(2)
    gains, hessians = finite_horizon_lqr(A, B, Q[None], R[None], Q, 500)
    varying, same = finite_horizon_lqr(
        np.repeat(A, 500, axis=0), np.repeat(B, 500, axis=0), Q[None], R[None], Q, 500
    )
    assert np.allclose(gains[0], dlqr(A[0], B[0], Q, R), atol=1e-7)
    assert np.allclose(gains, varying, atol=1e-7)
    assert np.allclose(hessians, same, atol=1e-6)
    unreachable, _ = finite_horizon_lqr(
        2 * np.eye(4)[None], np.zeros((1, 4, 2)), Q[None], R[None], Q, 20
    )
    assert np.array_equal(unreachable, np.zeros((20, 2, 4)))
