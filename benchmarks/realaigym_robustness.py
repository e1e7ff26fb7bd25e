"""Plays the league's robustness board (version 2).

Is the pendulum up after 10 s where something is not as expected?

Six parts, each a share of flights: other masses, inertias and frictions; noise on the
rates; noise on the torque; a motor that follows slowly or overshoots; late
measurements; torque pulses on both joints. The league's own class disturbs, simulates
(its plant, too) and judges. The pilot is told nothing: a Kalman filter makes rates of
the angles, delay and responsiveness are estimated from 0.3 s of random torques and made
up for. Nothing adapts to other masses and frictions.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.realaigym import (
    INPUT,
    TORQUE,
    Array,
    Flies,
    league_parameters,
    state_of,
    torque_limits,
)
from gpmpc._files import write_whole
from gpmpc.estimation import KalmanFilter, Measurement, estimate_delay
from gpmpc.gaussian import Gaussian
from gpmpc.models import Affine, DisturbedModel, KnownModel, RollOut

# deviations of measured angles and rates, and of accelerations' changes in 2 ms
ANGLE = 1e-6
RATE = 0.3
JERK = 40.0
# inputs that are random, to estimate the delay, and its longest
PROBES = 150
LONGEST = 25
PROBE = 3.0  # their size [N m]


class RateFilter:
    """The steady state of a Kalman filter that knows no dynamics.

    Accelerations are states that change at random.
    """

    def __init__(self) -> None:
        moves = Affine.identity(4, 1)
        effect = torch.zeros(4, 2, dtype=torch.float64)
        moves.A[[0, 2], [1, 3]] = INPUT
        effect[[0, 2], [0, 1]] = INPUT**2 / 2
        effect[[1, 3], [0, 1]] = INPUT
        model = DisturbedModel(KnownModel(moves, 4, 1), effect, [JERK, JERK])
        kalman = KalmanFilter.extended(
            model, Measurement.of_states(6, range(4), [ANGLE, RATE, ANGLE, RATE])
        )
        zero = np.zeros((1, 6))
        belief = Gaussian(torch.zeros(6).double(), torch.eye(6).double())
        for _ in range(100):
            update = kalman.update(belief, zero[0, :4])
            gain = torch.linalg.solve(update.covariance, belief.covariance[:4]).T
            belief = kalman.predict(update.belief, [0.0])
        self._gain = gain.numpy()
        self._moves = model.linearize(zero, zero[:, :1]).A[0]
        self._state = np.zeros(6)

    def restart(self, measured: Array) -> None:
        """Begins at a measured state (4,)."""
        self._state = np.concatenate([measured, np.zeros(2)])

    def __call__(self, measured: Array) -> Array:
        """The state (4,) 2 ms after the last one."""
        expected = self._moves @ self._state
        self._state = expected + self._gain @ (measured - expected[:4])
        return self._state[:4]


def identify(states: list[Array], inputs: list[float]) -> tuple[int, float]:
    """Returns the delay [inputs] and the responsiveness of a motor.

    They explain best what inputs (T,) did to states (T, 4).
    """
    candidates = []
    for response in np.linspace(0.1, 2.0, 20):
        acting = np.array(inputs)
        for k in range(1, len(acting)):
            acting[k] = acting[k - 1] + response * (inputs[k] - acting[k - 1])
        estimate = estimate_delay(
            states, acting[:, None], LONGEST, resolution=1.0, resamples=1
        )
        candidates.append(
            (estimate.correlations.max(), round(estimate.steps), float(response))
        )
    return max(candidates)[1:]


@dataclass
class Watchful:
    """Probes delay and responsiveness, then lets a pilot fly.

    Attributes:
        pilot: Flies.
        ahead: Predicts over 2 ms.
        joint: With the motor: 0, 1.
    """

    pilot: Flies
    ahead: RollOut
    joint: int
    delay: int = 0  #: that was found [inputs]
    response: float = (
        1.0  #: that was found: share of a change of the torque that acts at once
    )
    _filter: RateFilter = field(default_factory=RateFilter)
    _states: list[Array] = field(default_factory=list)
    _acting: list[float] = field(
        default_factory=list
    )  #: torques that the motor is believed to have given
    _last: float = np.inf

    def __post_init__(self) -> None:
        self._probes = (
            PROBE * np.random.default_rng(0).choice([-1.0, 1.0], PROBES // 5)
        ).repeat(5)

    def torques(self, x: Any, t: float) -> Array:
        """Returns the torques of both joints (2,) at a measurement and a time [s]."""
        measured = state_of(x)
        if t < self._last:
            self._filter.restart(measured)
            self._states = []
            self._acting = []
            self.delay = 0
            self.response = 1.0
        self._last, state = t, self._filter(measured)
        count = len(self._acting)
        torques = np.zeros(2)
        if count < PROBES:
            self._states.append(state)
            torques[self.joint] = self._probes[count]
            self._acting.append(self._probes[count])
            return torques
        if count == PROBES:
            self.delay, self.response = identify(self._states, self._acting)
        if self.delay:
            state = self.ahead.open_loop(
                state[None], np.array(self._acting[-self.delay :])[None, :, None]
            )[0, -1]
        command = self.pilot.torques(
            [state[0] + np.pi, state[2], state[1], state[3]], t
        )[self.joint]
        last = self._acting[-1]
        torques[self.joint] = np.clip(
            last + (command - last) / self.response, -TORQUE, TORQUE
        )
        self._acting.append(
            float(
                np.clip(
                    last + self.response * (torques[self.joint] - last), -TORQUE, TORQUE
                )
            )
        )
        return torques


def robustness(
    controller: Any, robot: str, size: int, store: Path
) -> dict[str, list[bool]]:
    """Which flights of each part ended upright.

    Those of a part that the file has are read, not flown again.

    Args: controller: In the league's interface. robot: ``"acrobot"`` or ``"pendubot"``.
        size: Values of each quantity; the league takes 21, and 10 flights at each noise
        and 50 with pulses. store: A JSON file, of one code.
    """
    from double_pendulum.analysis.benchmark import benchmarker

    parameters = league_parameters(torque_limits(robot))
    flights = benchmarker(
        controller,
        [0.0] * 4,
        INPUT,
        10.0,
        [np.pi, 0.0, 0.0, 0.0],
        [0.35, 0.35, 1.0, 1.0],
        check_only_final_state=True,
    )
    flights.set_model_parameter(model_pars=parameters)
    masses = parameters.m
    centres = parameters.r
    inertias = parameters.I
    nominal = {"m1r1": masses[0] * centres[0], "I1": inertias[0]}
    nominal |= {"m2r2": masses[1] * centres[1], "m2": masses[1], "I2": inertias[1]}
    values = {
        name: np.linspace(0.75, 1.25, size) * value for name, value in nominal.items()
    }
    values |= {"Ir": np.linspace(0.0, 1e-4, size)}
    values |= {name: np.linspace(-0.1, 0.1, size) for name in ("b1", "b2")}
    values |= {name: np.linspace(-0.2, 0.2, size) for name in ("cf1", "cf2")}
    repeated, pulses = (10, 50) if size >= 21 else (1, size)

    def model() -> list[bool]:
        results = flights.check_modelpar_robustness(list(values), values)
        return [success for name in values for success in results[name]["successes"]]

    def most(results: dict[str, Any]) -> list[bool]:
        return [np.mean(successes) > 0.5 for successes in results["successes"]]

    noises = np.linspace(0.0, 0.5, size), np.linspace(0.0, 1.1, size)
    fly = {
        "model": model,
        "rate noise": lambda: most(
            flights.check_meas_noise_robustness(repeated, "vel", noises[0])["None"]
        ),
        "torque noise": lambda: most(
            flights.check_unoise_robustness(repeated, noises[1])
        ),
        "responsiveness": lambda: flights.check_uresponsiveness_robustness(
            np.linspace(0.1, 2.0, size)
        )["successes"],
        "delay": lambda: flights.check_delay_robustness(
            "posvel", np.linspace(0.0, 0.04, size)
        )["successes"],
        "pulses": lambda: flights.check_perturbation_robustness(
            pulses, 3, 1.0, [0.05, 0.1], [0.5, 5.0]
        )["successes"],
    }
    done: dict[str, list[bool]] = (
        json.loads(store.read_text()) if store.exists() else {}
    )
    for part, successes in fly.items():
        if part not in done:
            np.random.seed(0)  # noqa: NPY002 (the league draws from it)
            done[part] = [bool(success) for success in successes()]
            write_whole(store, json.dumps(done, indent=1))
    return done
