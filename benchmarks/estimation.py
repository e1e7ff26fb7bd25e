"""What it costs not to measure.

An inverted pendulum with a late input, a missing sensor, and lost measurements.

    .venv/bin/python -m benchmarks.estimation [--seeds 20] [--steps 200]

A pendulum with a torque, sampled at 20 Hz, is learned from 30 s of random motion (the
angle seen as sine and cosine) and made to follow two references: a slow swing around
its upper position, where it is unstable, and steps between two angles to the sides of
its lower one, which it cannot follow at once. Printed: RMSE of the angle [rad] pooled
over the seeds, its ratio to the loop in brackets, and pendulums that fell (more than a
right angle off the swing). The delay is three steps; it is found in the random motion
by correlation.

Filters: NEES per state at every fiftieth step, with the band that holds its mean with
95 %, and the time of a step. Writes ``outputs/benchmarks/estimation.json``.
"""

import argparse
import math
from collections import deque
from collections.abc import Callable
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
import torch

from benchmarks.timing import write_results
from gpmpc.estimation import (
    KalmanFilter,
    Measurement,
    estimate_delay,
    estimate_process_noise,
    estimation_errors,
    normalized_errors,
)
from gpmpc.gaussian import Gaussian
from gpmpc.gp import Trainer, Transitions
from gpmpc.models import Affine, DelayedModel, DisturbedModel, Linearized, ResidualModel
from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
from gpmpc.propagation import Linearization

STEP = 0.05
LIMIT = 15.0
HORIZON = 20
DELAY = 3
NOISE = np.array([1e-3, 0.02])  # of a step [rad, rad/s]
SENSOR = np.array([0.01, 0.1])  # of a measurement [rad, rad/s]
FALLEN = math.pi / 2
Array = np.ndarray


def pendulum(x: Array, u: Array, substeps: int = 5) -> Array:
    """Returns angle from hanging [rad] and rate [rad/s] a step later.

    The input is a torque over the inertia [1/s^2].
    """
    angle, rate = x
    for _ in range(substeps):
        rate = rate + STEP / substeps * (-9.81 * math.sin(angle) - 0.1 * rate + u[0])
        angle = angle + STEP / substeps * rate
    return np.array([angle, rate])


class Exact:
    """The pendulum itself as a model: what a controller could know at most."""

    state_dim = 2
    input_dim = 1
    output_dim = 2
    dtype = torch.float64
    device = torch.device("cpu")
    noise_covariance = torch.diag(torch.from_numpy(NOISE**2))

    def predict(self, state: torch.Tensor, input: torch.Tensor) -> Gaussian:
        """The next state, which is certain."""
        next_state = pendulum_many(state.numpy(), input.numpy())[0]
        return Gaussian(
            torch.from_numpy(next_state),
            torch.zeros(*state.shape, 2, dtype=torch.float64),
        )

    def linearize(
        self, states: Array, inputs: Array, covariance: bool = True
    ) -> Linearized:
        """Next states and their derivatives."""
        mean, A, B = pendulum_many(states, inputs)
        return Linearized(
            mean, A, B, np.zeros((len(states), 2, 2)) if covariance else None
        )


def pendulum_many(
    states: Array, inputs: Array, substeps: int = 5
) -> tuple[Array, Array, Array]:
    """``pendulum`` for states (*batch, 2), with derivatives by state and input."""
    h = STEP / substeps
    slope = np.zeros(
        (*states.shape[:-1], 2, 3)
    )  # of angle and rate by both and the torque
    slope[..., 0, 0] = slope[..., 1, 1] = 1.0
    angle = states[..., 0]
    rate = states[..., 1]
    for _ in range(substeps):
        pull = (
            -9.81 * np.cos(angle)[..., None] * slope[..., 0, :]
            - 0.1 * slope[..., 1, :]
            + np.array([0.0, 0.0, 1.0])
        )
        rate = rate + h * (-9.81 * np.sin(angle) - 0.1 * rate + inputs[..., 0])
        slope[..., 1, :] += h * pull
        angle = angle + h * rate
        slope[..., 0, :] = slope[..., 0, :] + h * slope[..., 1, :]
    return (
        np.stack([angle, rate], axis=-1),
        slope[..., :2].copy(),
        slope[..., 2:].copy(),
    )


def random_motion(steps: int, delay: int, seed: int = 0) -> tuple[Array, Array]:
    """A log (steps + 1, 2), (steps, 1) with torques that change every fourth step."""
    rng = np.random.default_rng(seed)
    inputs = np.repeat(rng.uniform(-LIMIT, LIMIT, (steps // 4 + 1, 1)), 4, axis=0)[
        :steps
    ]
    states = [np.zeros(2)]
    for k in range(steps):
        next_state = pendulum(
            states[-1], inputs[k - delay] if k >= delay else np.zeros(1)
        )
        states.append(next_state + rng.normal(0, NOISE))
    return np.array(states), inputs


def learned(states: Array, inputs: Array, delay: int) -> ResidualModel:
    """Returns a model of the undelayed pendulum, from a log of late inputs.

    Its noise is that of all rows.
    """
    rows = Transitions(
        states[delay:-1], inputs[: len(inputs) - delay], states[delay + 1 :]
    )
    picked = rows[
        sorted(np.random.default_rng(0).permutation(len(rows))[:200].tolist())
    ]
    model = ResidualModel.train(
        Affine.identity(2, 1), picked, angles=[0], trainer=Trainer(restarts=1)
    )
    noise = estimate_process_noise(model, rows)
    print(
        f"noise of a step {noise.variance.sqrt().tolist()} (true {NOISE.tolist()}), "
        f"correlation {noise.correlation}"
    )
    parts = (
        model.nominal,
        model.residual,
        model.B,
        model.states,
        model.inputs,
        model.input_dim,
        model.angles,
    )
    return ResidualModel(*parts, noise=torch.diag(noise.variance))


class Loop(NamedTuple):
    """One way to control.

    Attributes: assumed: The delay that the controller believes in [steps]. delay: Of
        the plant [steps]. measures: What of a state is measured, NaN where nothing is;
        None: the state itself without noise. filtered: Whether a Kalman filter
        estimates the state. augmented: Whether the controller plans with the delayed
        model, not from where the inputs on their way lead. noise: Factor of the noise
        of the plant. task: The reference, ``"swing"`` or ``"steps"``. against: The loop
        that the error is compared with. gain: Of the controller's own disturbance
        estimate. known: Whether the controller has the true model in place of the
        learned one. drift: Standard deviation by which an angular acceleration,
        estimated beside the state, may change in a step [rad/s per step]; 0 for none.
    """

    delay: int = 0
    assumed: int = 0
    measures: Callable[[np.random.Generator], Array] | None = None
    filtered: bool = False
    augmented: bool = False
    noise: float = 1.0
    task: str = "swing"
    against: str = "state measured"
    drift: float = 0.0
    gain: float = 0.0
    known: bool = False


def all_states(rng: np.random.Generator) -> Array:
    """Both are measured."""
    return np.zeros(2)


def angle_only(rng: np.random.Generator) -> Array:
    """The rate is not."""
    return np.array([0.0, np.nan])


def one_in_five_lost(rng: np.random.Generator) -> Array:
    """Both are measured in four of five steps."""
    return np.full(2, np.nan if rng.random() < 0.2 else 0.0)


LATE = f"delay {DELAY}"
FULL = "noisy, filtered"
LOOPS = {
    "state measured": Loop(),
    f"{LATE}, ignored": Loop(DELAY),
    f"{LATE}, compensated": Loop(DELAY, DELAY),
    f"{LATE}, planned with": Loop(DELAY, DELAY, augmented=True),
    f"{LATE}, planned, estimate": Loop(DELAY, DELAY, augmented=True, gain=0.2),
    f"{LATE}, true model": Loop(DELAY, DELAY, augmented=True, known=True),
    "state measured, true model": Loop(known=True),
    f"{LATE}, believed {DELAY - 1}": Loop(DELAY, DELAY - 1, augmented=True),
    f"{LATE}, believed {DELAY + 1}": Loop(DELAY, DELAY + 1, augmented=True),
    "no noise": Loop(noise=0.0),
    f"no noise, {LATE}": Loop(
        DELAY, DELAY, augmented=True, noise=0.0, against="no noise"
    ),
    "steps": Loop(task="steps"),
    f"steps, {LATE}, ignored": Loop(DELAY, task="steps", against="steps"),
    f"steps, {LATE}, compensated": Loop(DELAY, DELAY, task="steps", against="steps"),
    f"steps, {LATE}, planned with": Loop(
        DELAY, DELAY, augmented=True, task="steps", against="steps"
    ),
    "noisy, as measured": Loop(measures=all_states),
    FULL: Loop(measures=all_states, filtered=True),
    "angle only, filtered": Loop(measures=angle_only, filtered=True, against=FULL),
    "20 % lost, filtered": Loop(measures=one_in_five_lost, filtered=True, against=FULL),
    "angle only, with a disturbance": Loop(
        measures=angle_only, filtered=True, against=FULL, drift=1e-3
    ),
    f"angle only, {LATE}": Loop(DELAY, DELAY, angle_only, True, True, against=FULL),
}


def reference_states(task: str, steps: int) -> Array:
    """Angles and rates (steps, 2) [rad, rad/s]."""
    time = STEP * np.arange(steps)
    if task == "swing":
        return np.stack(
            [math.pi + 0.5 * np.sin(1.5 * time), 0.75 * np.cos(1.5 * time)], axis=1
        )
    return np.stack(
        [np.where(np.arange(steps) // 50 % 2, 0.8, -0.8), np.zeros(steps)], axis=1
    )


class Flown(NamedTuple):
    """Of one seed.

    Attributes:
        errors: Of the angle to its reference (K,) [rad].
        estimates: Errors (E, 2) and covariances (E, 2, 2) of every fiftieth belief.
        decisions: Times of the decisions with the filter's (K,) [s].
        filters: Of the filter alone (K,) [s].
    """

    errors: Array
    estimates: tuple[Array, Array]
    decisions: Array
    filters: Array


def fly(model: Any, loop: Loop, steps: int, seed: int) -> Flown:
    """One flight."""
    rng = np.random.default_rng(seed)
    model = Exact() if loop.known else model
    delayed = DelayedModel(model, loop.assumed) if loop.assumed else None
    planned: Any = delayed if delayed is not None and loop.augmented else model
    extra = planned.state_dim - 2
    cost = Tracking([10.0, 0.1] + [0.0] * extra, [1e-2])
    problem = Problem(cost, Box([-LIMIT], [LIMIT]))
    propagator = Linearization()
    controller = GPMPC(
        planned,
        propagator,
        problem,
        HORIZON,
        [0.0],
        PredictionSettings(disturbance_gain=loop.gain),
    )
    estimated: Any = model
    if loop.drift:
        effect = torch.tensor([[STEP], [1.0]], dtype=torch.float64)
        estimated = DisturbedModel(model, effect, [loop.drift])
    sensor = Measurement.of_states(estimated.state_dim, [0, 1], SENSOR.tolist())
    kalman = KalmanFilter.extended(estimated, sensor)
    references = reference_states(loop.task, steps + HORIZON + 20)
    lead = delayed.lead if delayed is not None and not loop.augmented else 0
    x = references[0].copy()
    queue = deque([np.zeros(1)] * loop.delay, loop.delay)
    believed = deque([np.zeros(1)] * loop.assumed, loop.assumed)
    belief = Gaussian(
        torch.from_numpy(x.copy()),
        torch.diag(torch.tensor([0.01, 0.1], dtype=torch.float64) ** 2),
    )
    if loop.drift:
        belief = estimated.augmented(belief, [5 * loop.drift])
    decision = None
    errors = []
    decisions = []
    filters = []
    wrong = []
    doubts = []
    for k in range(steps):
        begin = perf_counter()
        if loop.measures is None:
            belief = Gaussian.certain(x)
        else:
            measured = x + rng.normal(0, SENSOR) + loop.measures(rng)
            belief = (
                kalman.update(belief, measured).belief
                if loop.filtered
                else Gaussian.certain(measured)
            )
        at = perf_counter()
        start = Gaussian(belief.mean[:2], belief.covariance[:2, :2])
        if delayed is not None:
            pending = np.array(believed)
            start = (
                delayed.augmented(start, pending)
                if loop.augmented
                else delayed.ahead(propagator, start, pending)
            )
        window = references[k + lead : k + lead + HORIZON + 1]
        reference = Reference(np.hstack([window, np.zeros((HORIZON + 1, extra))]))
        decision = controller.control(start, reference, decision)
        decisions.append(perf_counter() - begin)
        acting = queue[0] if loop.delay else decision.input
        now = believed[0] if loop.assumed else decision.input
        queue.append(decision.input)
        believed.append(decision.input)
        if k % 50 == 49:
            state = Gaussian(belief.mean[:2], belief.covariance[:2, :2])
            wrong.append(estimation_errors(state, x).numpy())
            doubts.append(state.covariance.numpy())
        again = perf_counter()
        if loop.filtered:
            belief = kalman.predict(belief, now)
        filters.append(perf_counter() - again + at - begin)
        x = pendulum(x, acting) + loop.noise * rng.normal(0, NOISE)
        errors.append(x[0] - references[k + 1, 0])
        if abs(errors[-1]) > FALLEN:
            break
    return Flown(
        np.array(errors),
        (np.array(wrong), np.array(doubts)),
        np.array(decisions),
        np.array(filters),
    )


def main() -> None:
    """Learns, flies and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    states, inputs = random_motion(600, DELAY)
    delay = estimate_delay(states, inputs)
    low, high = delay.interval
    print(
        f"delay found in the random motion: {delay.steps:.1f} steps, 95 % interval "
        f"{low:.2f} to {high:.2f}"
    )
    model = learned(states, inputs, round(delay.steps))
    columns = (
        f"{'RMSE':>9}  {'ratio':24}fell  {'NEES (95 % band)':22}{'ms':>8}{'filter':>8}"
    )
    print(f"{'':30}{columns}")
    results = []
    rmse = {}
    for name, loop in LOOPS.items():
        flown = [
            fly(model, loop, arguments.steps, seed) for seed in range(arguments.seeds)
        ]
        fallen = sum(len(flight.errors) < arguments.steps for flight in flown)
        rmse[name] = float(
            np.sqrt(np.mean(np.concatenate([flight.errors for flight in flown]) ** 2))
        )
        over = rmse[name] / rmse[loop.against]
        row: dict[str, Any] = {
            "loop": name,
            "rmse": rmse[name],
            "ratio": over,
            "against": loop.against,
            "fallen": fallen,
        }
        row["decision_ms"] = 1e3 * float(
            np.median(np.concatenate([flight.decisions for flight in flown]))
        )
        row["filter_ms"] = 1e3 * float(
            np.median(np.concatenate([flight.filters for flight in flown]))
        )
        text = ""
        if loop.filtered:
            nees = normalized_errors(
                *(
                    np.concatenate(part)
                    for part in zip(*(f.estimates for f in flown), strict=True)
                )
            )
            row |= {"nees": nees.mean, "band": nees.band}
            text = f"{nees.mean:.2f} ({nees.band[0]:.2f} to {nees.band[1]:.2f})"
        ratio = f"{over:.2f} [{loop.against}]"
        numbers = f"{row['decision_ms']:8.2f}{row['filter_ms']:8.3f}"
        print(
            f"{name:30}{rmse[name]:9.4f}  {ratio:24}{fallen:4}  {text:22}{numbers}",
            flush=True,
        )
        results.append(row)
    write_results("estimation", results)


if __name__ == "__main__":
    main()
