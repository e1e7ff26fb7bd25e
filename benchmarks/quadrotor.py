"""The flying quadrotor that the benchmarks of the controllers share.

GPs from dithered flights, and recorded steps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gpmpc.datasets import Excitation, ExcitedData
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, Trainer, standardize
from gpmpc.mpc import Box, Controller, Decision, Problem, Reference, Tracking
from gpmpc.simulation import Noise, closed_loop
from gpmpc.systems import rotational, translational
from gpmpc.trajectories import Elliptical, Lorenz, states_along

TRAJECTORIES = {"elliptical": Elliptical(), "lorenz": Lorenz()}
STATE_BOUNDS = {  # x [m], vx [m/s], y, vy, z, vz: a little inside the trajectory
    "elliptical": (
        [-14, -np.inf, -14, -np.inf, -np.inf, -np.inf],
        [14, np.inf, 14, np.inf, np.inf, np.inf],
    ),
    "lorenz": (
        [-10, -np.inf, -13, -np.inf, -np.inf, -np.inf],
        [10, np.inf, 13, np.inf, np.inf, np.inf],
    ),
}
HOVER = [7.26, 0.0, 0.0]  # U1 [N], ux, uy [-]
OUTER = translational()
INNER = rotational()
NOISE = Noise(process=[0.01] * 6)
DATA = ExcitedData(
    Excitation([1] * 6, [1] * 3, HOVER, [0.3, 0.03, 0.03], [0.01] * 6),
    Excitation([1] * 6, [1] * 3, [0.0] * 3, [0.05] * 3, [1e-4, 1e-3] * 3),
)
TRAINER = Trainer(predicts="difference", scaling=standardize)


@dataclass(frozen=True)
class Asked:
    """One recorded instance to a controller, and what it decided."""

    belief: Gaussian
    reference: Reference
    previous: Decision | None
    decision: Decision


def trained(
    trajectory: str, subsystem: str = "translational", size: int = 189
) -> GPPosterior:
    """GPs on 189 transitions of a dithered flight, or on some of them."""
    data = DATA.transitions(
        {"translational": OUTER, "rotational": INNER}[subsystem],
        TRAJECTORIES[trajectory],
    )
    data = data[sorted(np.random.default_rng(0).permutation(len(data))[:size].tolist())]
    return TRAINER(data, seed=0).posterior


def problem(
    bounds: Box | None = None, thrust: Sequence[float] = (0.0, 100.0), tilt: float = 0.7
):
    """Weights of the flights with the plant in the loop."""
    box = Box([thrust[0], -tilt, -tilt], [thrust[1], tilt, tilt])
    return Problem(
        Tracking([1] * 6, [1] * 3), box, constraints=[] if bounds is None else [bounds]
    )


def recorded(
    controller: Controller, trajectory: str, steps: int, std: float = 0.0, seed: int = 0
) -> list[Asked]:
    """The instances of a flight with the plant in the loop.

    ``std`` is what the controller is told to be unsure of.
    """
    requests: list[Asked] = []

    class Recording:
        horizon = controller.horizon
        problem = controller.problem

        def control(self, belief, reference, previous=None):
            eye = torch.eye(6, dtype=torch.float64)
            belief = Gaussian(
                torch.as_tensor(belief.mean, dtype=torch.float64), std**2 * eye
            )
            decision = controller.control(belief, reference, previous)
            requests.append(Asked(belief, reference, previous, decision))
            return decision

    references = states_along(
        TRAJECTORIES[trajectory], np.arange(steps + controller.horizon + 1.0)
    )
    closed_loop(
        OUTER,
        Recording(),
        references,
        references[0],
        steps,
        noise=NOISE,
        seed=seed,
        on_failure="previous_plan",
    )
    return requests
