"""Compares disturbance states with the observer gain of the controller.

The vehicle is a fifth heavier than learned.

    .venv/bin/python -m benchmarks.disturbance_states [--steps 189] [--seeds 3]

The flights of ``benchmarks.wrong_model``: GPs of 189 dithered transitions of the
lighter quadrotor, H = 10, both trajectories, as learned and 20 % heavier, three kinds
of noise. ``L`` are gains of the controller's own estimate. The others estimate six
constants beside the six states by an extended Kalman filter that is told the noise of
the measurements, and plan with them; the number is by how much a constant may change in
a step. RMSE of the position, total over x, y, z [m], pooled over the seeds, and the
median times of filter and controller [ms]. Writes
``outputs/benchmarks/disturbance_states.json``.
"""

import argparse
from dataclasses import replace
from time import perf_counter

import numpy as np
import torch

from benchmarks.quadrotor import HOVER, TRAJECTORIES, problem, trained
from benchmarks.timing import write_results
from benchmarks.wrong_model import HORIZON, MASSES, NOISES, flights, pooled
from gpmpc.estimation import KalmanFilter, Measurement
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.models import DisturbedModel
from gpmpc.mpc import GPMPC, Decision, PredictionSettings, Reference, Tracking
from gpmpc.propagation import Linearization

GAINS = (0.0, 0.3, 1.0)
CHANGES = (0.01, 0.1)
STATES = 6
SENSORS = {
    "process 0.01": 1e-3,
    "measured 0.01": 0.01,
    "measured 0.03": 0.03,
}  # what the filter is told
CONSTANTS = 1.0  # prior standard deviation


class FilteredControl:
    """GP-MPC of a model with disturbance states, which a filter estimates.

    Args:
        model: Without disturbances.
        change: Standard deviation of a disturbance's change in a step.
        sensor: Standard deviation of the measurements.
    """

    def __init__(self, model: GPPosterior, change: float, sensor: float):
        eye = torch.eye(STATES, dtype=torch.float64)
        n = STATES
        self.model = DisturbedModel(model, eye, [change] * n)
        self.sensor = sensor
        self.problem = problem()
        self.horizon = HORIZON
        cost = Tracking([1] * n + [0] * n, [1] * 3)
        self.inner = GPMPC(
            self.model,
            Linearization(),
            replace(self.problem, cost=cost),
            HORIZON,
            HOVER,
        )
        self.initial_input = self.inner.initial_input
        self.filter = KalmanFilter.extended(
            self.model, Measurement.of_states(2 * n, range(n), [sensor] * n)
        )
        self.seconds: list[tuple[float, float]] = []
        self._belief = None
        self._last = None

    def control(
        self, belief: Gaussian, reference: Reference, previous: Decision | None = None
    ) -> Decision:
        """Estimates and decides; a flight begins without a previous decision."""
        begin = perf_counter()
        if previous is None or self._belief is None:
            covariance = self.sensor**2 * torch.eye(STATES, dtype=torch.float64)
            self._belief = self.model.augmented(
                Gaussian(belief.mean, covariance), [CONSTANTS] * STATES
            )
            last = None
        else:
            predicted = self.filter.predict(self._belief, previous.input)
            self._belief = self.filter.update(predicted, belief.mean).belief
            last = replace(self._last, input=previous.input)
        estimated = perf_counter()
        wide = Reference(
            np.hstack([reference.states, np.zeros_like(reference.states)]),
            reference.inputs,
        )
        decision = self._last = self.inner.control(self._belief, wide, last)
        self.seconds.append((estimated - begin, perf_counter() - estimated))
        return replace(
            decision,
            means=decision.means[:, :STATES],
            covariances=decision.covariances[:, :STATES, :STATES],
            disturbance=None,
        )


def main() -> None:
    """Flies and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=189)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    print(f"{'':32}" + "".join(f"{mass:>42}" for mass in MASSES))
    print(f"{'':32}" + "".join(f"{noise:>14}" for _ in MASSES for noise in NOISES))
    for trajectory in TRAJECTORIES:
        model = trained(trajectory)
        for way in (*GAINS, *(f"states, {change}" for change in CHANGES)):
            row = []
            times = []
            for mass in MASSES:
                for noise in NOISES:
                    if isinstance(way, float):
                        prediction = PredictionSettings(disturbance_gain=way)
                        controller = GPMPC(
                            model,
                            Linearization(),
                            problem(),
                            HORIZON,
                            HOVER,
                            prediction,
                        )
                    else:
                        controller = FilteredControl(
                            model, float(way.partition(", ")[2]), SENSORS[noise]
                        )
                    row.append(
                        pooled(flights(controller, trajectory, mass, noise, arguments))
                    )
                    times += getattr(controller, "seconds", [])
                    results.append(
                        {
                            "trajectory": trajectory,
                            "way": way,
                            "mass": mass,
                            "noise": noise,
                            "rmse": row[-1],
                        }
                    )
            name = f"L = {way}" if isinstance(way, float) else way
            spent = (
                " filter {:.2f}, control {:.2f} ms".format(
                    *1e3 * np.median(times, axis=0)
                )
                if times
                else ""
            )
            print(
                f"{trajectory:12}{name:20}"
                + "".join(f"{rmse:14.4f}" for rmse in row)
                + spent,
                flush=True,
            )
    write_results("disturbance_states", results)


if __name__ == "__main__":
    main()
