"""Small made-up runs: a point mass in the plane of x and z.

Their quadratic programs are really solved.
"""

import numpy as np

from gpmpc.mpc import Decision, Timing
from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.recording import McapRecorder, RecordedSystem, Step
from gpmpc.status import Status

STATES = ("x", "vx", "y", "vy", "z", "vz")
INPUTS = ("U1", "ux", "uy")
UNITS = {
    "x": "m",
    "vx": "m/s",
    "y": "m",
    "vy": "m/s",
    "z": "m",
    "vz": "m/s",
    "U1": "N",
    "ux": "1",
    "uy": "1",
}
POSE = {axis: axis for axis in "xyz"}
BOUNDS = [[0.0, -0.5, -0.5], [10.0, 0.5, 0.5]]
TIME_STEP = 0.1  # [s]


def problem(rng, variables=6, rows=8):
    A = rng.standard_normal((variables, variables))
    G = rng.standard_normal((rows, variables))
    bounds = {"h_lower": -np.ones(rows), "h_upper": np.ones(rows)}
    box = {"lb": -np.ones(variables), "ub": np.ones(variables)}
    return QuadraticProgram(
        A @ A.T + np.eye(variables),
        3 * rng.standard_normal(variables),
        G,
        **bounds,
        **box,
    )


def make_step(
    k,
    rng,
    horizon=5,
    status=Status.SOLVED,
    failed=False,
    qp=True,
    prices=None,
    variables=6,
):
    n = len(STATES)
    m = len(INPUTS)
    roots = rng.standard_normal((horizon + 1, n, n))
    program = problem(rng, variables) if qp else None
    solution = DualActiveSet().solve(program, prices=prices) if qp else None
    inputs = rng.standard_normal((horizon, m))
    decision = Decision(
        input=inputs[0],
        inputs=inputs,
        means=rng.standard_normal((horizon + 1, n)),
        covariances=0.01 * roots @ roots.mT,
        status=status,
        iterations=k + 3,
        timing=Timing(0.001, 0.002, 0.003),
        problem=program,
        solution=solution,
    )
    return Step(
        time=k * TIME_STEP,
        k=k,
        reference=rng.standard_normal(n),
        state=rng.standard_normal(n),
        measured=rng.standard_normal(n),
        input=inputs[0] if not failed else np.zeros(m),
        decision=decision,
        innovation=np.full(n, np.nan) if k == 0 else rng.standard_normal(n),
        belief_covariance=0.04 * np.eye(n),
        gp_size=100 + k,
        gp_version=k // 2,
        failed=failed,
    )


def recorder(path, **settings):
    """A recorder of small chunks, so that a short run has several."""
    options = {
        "chunk_size": 20_000,
        "time_step": TIME_STEP,
        "units": UNITS,
        "input_bounds": BOUNDS,
        "pose": POSE,
    } | settings
    of_system = {
        key: options.pop(key)
        for key in ("time_step", "units", "input_bounds", "pose", "z_down")
        if key in options
    }
    system = RecordedSystem(STATES, INPUTS, **of_system)
    return McapRecorder(
        path, system, **({"config": {"seed": 7}, "metadata": {"seed": 7}} | options)
    )


def record_run(path, steps=8, **settings):
    rng = np.random.default_rng(0)
    recorded = [make_step(k, rng) for k in range(steps)]
    with recorder(path, **settings) as to:
        for step in recorded:
            to.record(step)
    return recorded
