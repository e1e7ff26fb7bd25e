"""Makes the quadratic programs that a quadrotor's MPC meets in closed loop.

A solver that is warm-started is judged only by a sequence in which the next problem
resembles the last one as it does in use. Here the translational subsystem of the
quadrotor (thrust and two tilts in, positions and velocities out) follows a fast
Lissajous curve under process noise. Its MPC is condensed to the inputs of the horizon:
input bounds become the box of the QP (n = 3H), bounds on the six states of every stage
its rows (6H); or, as a second family, on the three positions (3H). The bounds narrow
and widen (a corridor that the vehicle passes), so that constraints come and go; they
are never narrower than what a known feasible plan needs.

``constant``: the model is linearised once, at hover; P and G stay. ``changing``: it is
linearised at every step around the thrust and tilt of the reference motion, so P and G
are new in each problem.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.quadrotor import HOVER, TRAJECTORIES, problem, recorded, trained
from gpmpc.mpc import GPMPC, Box
from gpmpc.propagation import Linearization
from gpmpc.trajectories import states_along

Array = NDArray[np.float64]

TIME_STEP = 0.1  # [s]
MASS = 0.74  # [kg]
GRAVITY = 9.81  # [m/s^2]
DRAG = 0.2  # [1/s]
STATE_WEIGHT = np.diag([20.0, 1.0, 20.0, 1.0, 20.0, 1.0])
INPUT_WEIGHT = np.diag([0.05, 2.0, 2.0])
INPUT_LIMIT = np.array([4.0, 0.45, 0.45])  # deviation from hover: thrust [N], tilts [-]
WIDE = np.array(
    [5.0, 6.0] * 3
)  # bounds on positions [m] and velocities [m/s] outside the corridor
NARROW = np.array([2.5, 2.5] * 3)  # and inside it
# standard deviations per step [m], [m/s]
POSITION_NOISE = 0.01
VELOCITY_NOISE = 0.05


# Bounds that are active at about one step in ten: of ux and uy [-], and of the
# increments of U1 [N], ux, uy.
TIGHT = {
    "elliptical": (0.015, [0.014, 0.004, 0.004]),
    "lorenz": (0.04, [0.2, 0.02, 0.03]),
}


@dataclass(frozen=True)
class SequenceProblem:
    """One QP of a sequence: ``min 1/2 x'Px + q'x`` with ``lower <= [x; Gx] <= upper``.

    The box is stacked first.
    """

    P: Array
    q: Array
    G: Array
    lower: Array
    upper: Array


def _reference(times: Array) -> Array:
    """Positions and velocities of the curve, one row of six per time."""
    frequencies = np.array([0.9, 1.3, 0.7])
    amplitudes = np.array([4.0, 3.0, 2.0])
    phase = times[:, None] * frequencies
    positions = amplitudes * np.sin(phase)
    velocities = amplitudes * frequencies * np.cos(phase)
    return np.stack([positions, velocities], axis=2).reshape(len(times), 6)


def _linear_model(thrust: float, tilt: Array) -> tuple[Array, Array]:
    """Returns the discrete A, B at a thrust [N] and two tilts [-].

    They are explicit in velocity, exact in position.
    """
    acceleration = np.array(
        [
            [tilt[0] / MASS, thrust / MASS, 0.0],
            [tilt[1] / MASS, 0.0, thrust / MASS],
            [-1.0 / MASS, 0.0, 0.0],
        ]
    )
    A = np.eye(6)
    B = np.zeros((6, 3))
    A[[0, 2, 4], [1, 3, 5]] = TIME_STEP
    A[[1, 3, 5], [1, 3, 5]] -= DRAG * TIME_STEP
    B[[1, 3, 5]] = TIME_STEP * acceleration
    B[[0, 2, 4]] = 0.5 * TIME_STEP**2 * acceleration
    return A, B


def _condense(A: Array, B: Array, horizon: int) -> tuple[Array, Array]:
    """``states = free x_0 + forced U`` over the horizon, A and B held."""
    free = np.zeros((6 * horizon, 6))
    forced = np.zeros((6 * horizon, 3 * horizon))
    power = A
    response = B
    for stage in range(horizon):
        free[6 * stage : 6 * stage + 6] = power
        for start in range(horizon - stage):
            row = 6 * (start + stage)
            forced[row : row + 6, 3 * start : 3 * start + 3] = response
        power = A @ power
        response = A @ response
    return free, forced


def _state_limits(times: Array) -> Array:
    """Returns the bound on each state: a corridor two seconds out of every six."""
    inside = np.mod(times, 6.0) > 4.0
    return np.where(inside[:, None], NARROW, WIDE).ravel()


def quadrotor_sequence(
    horizon: int, changing: bool, length: int, solve, seed: int = 0
) -> Iterator[SequenceProblem]:
    """Yields the QPs of closed-loop steps; ``solve(problem) -> x`` closes the loop."""
    rng = np.random.default_rng(seed)
    weight = np.kron(np.eye(horizon), STATE_WEIGHT)
    box = np.tile(INPUT_LIMIT, horizon)
    state = _reference(np.zeros(1))[0]
    plan = np.zeros(3 * horizon)
    prepared = None
    for step in range(length):
        now = step * TIME_STEP
        if changing or prepared is None:
            motion = (
                np.array([np.sin(0.8 * now), np.cos(0.6 * now), np.sin(0.5 * now)])
                if changing
                else np.zeros(3)
            )
            A, B = _linear_model(
                MASS * GRAVITY * (1.0 + 0.2 * motion[0]), 0.3 * motion[1:]
            )
            free, forced = _condense(A, B, horizon)
            P = 2.0 * (
                forced.T @ weight @ forced + np.kron(np.eye(horizon), INPUT_WEIGHT)
            )
            prepared = 0.5 * (P + P.T), forced, 2.0 * forced.T @ weight
        P, forced, gradient = prepared
        G = np.ascontiguousarray(forced)
        times = now + TIME_STEP * np.arange(1, horizon + 1)
        drift = free @ state
        q = gradient @ (drift - _reference(times).ravel())
        limits = _state_limits(times)
        offset = drift
        feasible = G @ np.clip(np.concatenate([plan[3:], plan[-3:]]), -box, box)
        lower = np.concatenate([-box, np.minimum(-limits - offset, feasible - 0.01)])
        upper = np.concatenate([box, np.maximum(limits - offset, feasible + 0.01)])
        program = SequenceProblem(P, q, G, lower, upper)
        yield program
        plan = solve(program)
        noise = rng.standard_normal(6) * np.tile([POSITION_NOISE, VELOCITY_NOISE], 3)
        state = A @ state + B @ plan[:3] + noise


def flight_sequence(
    trajectory: str, horizon: int, length: int
) -> list[SequenceProblem]:
    """Yields the QPs of a flight of the learned quadrotor with the plant in the loop.

    Those without a solution are left out.
    """
    states = states_along(TRAJECTORIES[trajectory], np.arange(length + horizon + 1.0))
    margin = 0.05 + 0.02 * np.ptp(
        states, axis=0
    )  # [m, m/s] around all that the reference visits
    bounds = Box(
        states.min(axis=0) - margin,
        states.max(axis=0) + margin,
        probability=0.95,
        penalty=None,
    )
    bounded = problem(bounds, tilt=TIGHT[trajectory][0])
    controller = GPMPC(trained(trajectory), Linearization(), bounded, horizon, HOVER)
    steps = recorded(controller, trajectory, length)
    programs = [step.decision.problem for step in steps if step.decision.status.solved]
    return [
        _two_sided(*(np.array(part) for part in program[:5])) for program in programs
    ]


def _two_sided(
    P: Array, q: Array, G: Array, lower: Array, upper: Array
) -> SequenceProblem:
    """Merges rows that are equal, such as an upper and a lower bound of one state.

    Other solvers have fewer to scan.
    """
    n = len(q)
    rows, first, group = np.unique(G, axis=0, return_index=True, return_inverse=True)
    low = np.full(len(rows), -np.inf)
    high = np.full(len(rows), np.inf)
    np.maximum.at(low, group.ravel(), lower[n:])
    np.minimum.at(high, group.ravel(), upper[n:])
    order = np.argsort(first)
    G = np.ascontiguousarray(rows[order])
    low = low[order]
    high = high[order]
    return SequenceProblem(
        P, q, G, np.concatenate([lower[:n], low]), np.concatenate([upper[:n], high])
    )
