import numpy as np
import pytest
from gpmpc.mpc.ancillary_feedback import lqr_gain, spread

from gpmpc.mpc.condensing import Condenser, respond
from gpmpc.mpc.tracking import TrackingProblem

PENALIZED = ("inputs", "deviations", "increments")


def spd(rng, n):
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def stages(rng, n, blocks, m, H, held):
    K, p = 1 if held else H, n * blocks
    A = rng.normal(size=(K, p, p)) / np.sqrt(p)
    A[0, :, n:] = 0.0  # as at a measured state
    return A, rng.normal(size=(K, p, m)), rng.normal(size=(K, p)), rng.normal(size=p)


def stacked_response(A, B, c, start, H):
    """Gamma (H, p, H, m) and s^0 (H, p), a product at a time."""
    p, m = B.shape[1:]
    gamma, free, s = np.zeros((H, p, H, m)), np.zeros((H, p)), start
    for k in range(H):
        at = min(k, len(A) - 1)
        s = A[at] @ s + c[at]
        free[k] = s
        if k:
            gamma[k] = np.tensordot(A[at], gamma[k - 1], 1)
        gamma[k, :, k, :] += B[at]
    return gamma, free


@pytest.mark.parametrize("terminal", ["own", "the same"])
def test_a_held_model_is_one_that_varies_and_does_not(terminal, rng):
    n, m, r, blocks, H = 3, 2, 2, 4, 9
    Q, R = spd(rng, n), spd(rng, m)
    T = spd(rng, n) if terminal == "own" else Q
    condenser = Condenser(TrackingProblem(Q, R, terminal=T), H, np.tile(Q, (blocks, 1, 1)), np.tile(T, (blocks, 1, 1)))
    A, B, _, _ = stages(rng, n, blocks, m, H, held=True)
    E = rng.normal(size=(1, r, n * blocks))
    held = condenser.curvature(A, B, E)
    varying = condenser.curvature(*(np.repeat(part, H, axis=0) for part in (A, B, E)))
    for one, other in zip(held, varying, strict=True):
        assert np.allclose(one, other, rtol=1e-12, atol=1e-12 * np.abs(other).max())


@pytest.mark.parametrize("H", [1, 2, 7])
@pytest.mark.parametrize("blocks", [1, 2, 4])
@pytest.mark.parametrize("held", [True, False], ids=["held", "varying"])
@pytest.mark.parametrize("penalized", PENALIZED)
def test_the_condensed_problem_is_the_stacked_one(H, blocks, held, penalized, rng):
    n, m, r = 3, 2, 4
    Q, T, R = spd(rng, n), spd(rng, n), spd(rng, m)
    problem = TrackingProblem(Q, R, penalized, T, rate_lower=[-1.0, -2.0], rate_upper=[1.0, np.inf])
    condenser = Condenser(problem, H, np.tile(Q, (blocks, 1, 1)), np.tile(T, (blocks, 1, 1)))
    A, B, c, start = stages(rng, n, blocks, m, H, held)
    E = rng.normal(size=(len(A), r, n * blocks))
    targets, wanted, last = rng.normal(size=(H, n)), rng.normal(size=(H, m)), rng.normal(size=m)
    P, G = condenser.curvature(A, B, E)
    q, values = condenser.slope(A, B, c, start, E, targets, wanted, last)

    gamma, free = stacked_response(A, B, c, start, H)
    gamma = gamma.reshape(-1, H * m)
    reference = np.zeros_like(free)
    reference[:, :n] = targets
    weight = np.kron(np.eye(H * blocks), Q)
    weight[-n * blocks :, -n * blocks :] = np.kron(np.eye(blocks), T)
    D = np.eye(H * m) - np.eye(H * m, k=-m)
    first = np.concatenate([last, np.zeros((H - 1) * m)])
    T_u, centre = {
        "inputs": (np.eye(H * m), np.zeros(H * m)),
        "deviations": (np.eye(H * m), wanted.ravel()),
        "increments": (D, first),
    }[penalized]
    stacked_R = np.kron(np.eye(H), R)
    E_all = np.zeros((H * r, H * n * blocks))
    for k in range(H):
        E_all[k * r : (k + 1) * r, k * n * blocks : (k + 1) * n * blocks] = E[min(k, len(E) - 1)]
    assert np.allclose(P, 2 * (gamma.T @ weight @ gamma + T_u.T @ stacked_R @ T_u), rtol=1e-12, atol=1e-11)
    slope = gamma.T @ weight @ (free - reference).ravel() - T_u.T @ stacked_R @ centre
    assert np.allclose(q, 2 * slope, rtol=1e-12, atol=1e-11)
    assert np.allclose(G, np.vstack([D, E_all @ gamma]), atol=1e-12)
    assert np.allclose(values.ravel(), E_all @ free.ravel(), atol=1e-12)
    assert np.array_equal(P, P.T)
    assert np.linalg.eigvalsh(P)[0] > 0

    inputs, states = rng.normal(size=(H, m)), np.empty((H + 1, n * blocks))
    respond(A, B, c, start, inputs, states)
    assert np.allclose(states[1:].ravel(), gamma @ inputs.ravel() + free.ravel(), atol=1e-12)
    zero = np.zeros((H, m))
    respond(A, B, c, start, zero, free_states := np.empty_like(states))
    difference = condenser.cost(states, inputs, targets, wanted, last) - condenser.cost(
        free_states, zero, targets, wanted, last
    )
    U = inputs.ravel()
    assert difference == pytest.approx(U @ P @ U / 2 + q @ U, rel=1e-10, abs=1e-9)

    lower, upper = condenser.bounds(last, np.zeros((H, r)), np.ones((H, r)))
    assert lower[H * m : H * m + m] == pytest.approx([last[0] - 1, last[1] - 2])
    assert upper[H * m] == pytest.approx(last[0] + 1)
    assert len(lower) == len(upper) == H * m + len(G)


def test_in_increments_it_is_the_papers_problem(rng):
    """Cao, Lai and Alam (2017), (38)-(39) with the missing factor 2, on s = [mu; vec S] of three states."""
    n, m, H = 3, 2, 5
    p = n + n * n
    Q, R = spd(rng, n), spd(rng, m)
    A, B, _, s0 = stages(rng, n, n + 1, m, H, held=True)
    before, last = rng.normal(size=p), rng.normal(size=m)
    targets = rng.normal(size=(H, n))
    condenser = Condenser(TrackingProblem(Q, R), H, *[np.tile(Q, (n + 1, 1, 1))] * 2)
    c = s0 - A[0] @ before - B[0] @ last
    P, _ = condenser.curvature(A, B, np.zeros((1, 0, p)))
    q, _ = condenser.slope(A, B, c[None], s0, np.zeros((1, 0, p)), targets, np.zeros((H, m)), last)

    Qbar = np.zeros((p, p))
    Qbar[:n, :n], Qbar[n:, n:] = Q, np.kron(np.eye(n), Q)
    powers = [np.linalg.matrix_power(A[0], k) for k in range(H + 1)]
    A_tilde = np.vstack(powers[1:])
    zeros = np.zeros((p, m))
    B_tilde = np.block([[powers[i - j] @ B[0] if i >= j else zeros for j in range(H)] for i in range(H)])
    T_z, T_u = np.kron(np.tri(H), np.eye(p)), np.kron(np.tri(H), np.eye(m))
    Q_tilde, R_tilde = np.kron(np.eye(H), Qbar), np.kron(np.eye(H), R)
    r = np.zeros((H, p))
    r[:, :n] = targets
    paper_P = 2 * (B_tilde.T @ T_z.T @ Q_tilde @ T_z @ B_tilde + T_u.T @ R_tilde @ T_u)
    offset = np.tile(s0, H) + T_z @ A_tilde @ (s0 - before) - r.ravel()
    paper_q = 2 * (B_tilde.T @ T_z.T @ Q_tilde @ offset + T_u.T @ R_tilde @ np.tile(last, H))
    increments = np.linalg.solve(paper_P, -paper_q)
    assert np.allclose(T_u.T @ P @ T_u, paper_P, rtol=1e-11, atol=1e-10)
    assert np.allclose(np.linalg.solve(P, -q), np.tile(last, H) + T_u @ increments, atol=1e-9)


def test_the_gain_is_that_of_the_riccati_equation_and_exists_for_any_system(rng):
    from scipy.linalg import solve_discrete_are

    A, B, Q, R = rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), spd(rng, 4), spd(rng, 2)
    M = solve_discrete_are(A, B, Q, R)
    expected = -np.linalg.solve(R + B.T @ M @ B, B.T @ M @ A)
    assert np.allclose(lqr_gain(A, B, Q, R, Q, 500), expected, atol=1e-7)
    unreachable = lqr_gain(2 * np.eye(4), np.zeros((4, 2)), Q, R, Q, 20)
    assert np.array_equal(unreachable, np.zeros((2, 4)))
    closed = spread(A + B @ expected, np.eye(4), np.zeros((4, 4)), 50)
    assert np.array_equal(closed[1], np.eye(4))
    assert np.abs(closed[-1] - closed[-2]).max() < 1e-3 * np.abs(closed[-1]).max()
