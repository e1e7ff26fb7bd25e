"""Problem: let a controller steer a plant along references, and keep what happened."""

from dataclasses import dataclass

import numpy as np

from gpmpc.control.controller import Controller, Decision, Reference
from gpmpc.exceptions import ShapeError, SolverFailure
from gpmpc.gaussian import Gaussian
from gpmpc.plants import Plant, step


@dataclass(frozen=True)
class Rollout:
    """K steps of a closed loop.

    Attributes:
        states: x[0] .. x[K], (K + 1, n).
        inputs: u[0] .. u[K-1], (K, m).
        references: r[0] .. r[K-1], (K, n).
        seconds: Wall time of every decision (K,) [s].
    """

    states: np.ndarray
    inputs: np.ndarray
    references: np.ndarray
    seconds: np.ndarray


def closed_loop(
    plant: Plant, controller: Controller, references: np.ndarray, initial_state: np.ndarray, steps: int
) -> Rollout:
    """Runs a controller on a plant.

    Args:
        plant: The system.
        controller: Its feedback law; it sees the next ``controller.horizon`` references.
        references: Reference states r[0] .. (steps + horizon, n) or more, one a time step.
        initial_state: (n,).
        steps: K.

    Raises:
        ShapeError: Too few references for the steps and the horizon.
        SolverFailure: The controller's solver did not succeed at a step; its iterate is not applied.
    """
    needed = steps + controller.horizon
    if len(references) < needed:
        raise ShapeError(
            f"{steps} steps with horizon {controller.horizon} need {needed} references; got {len(references)}"
        )
    states, inputs, seconds = [np.asarray(initial_state, dtype=float)], [], []
    decision: Decision | None = None
    for k in range(steps):
        ahead = Reference(references[k : k + controller.horizon + 1])
        decision = controller.control(Gaussian.certain(states[-1]), ahead, decision)
        if not decision.status.solved:
            raise SolverFailure(k, decision.status.advice)
        inputs.append(decision.input)
        seconds.append(decision.timing.total)
        states.append(step(plant, states[-1], decision.input))
    return Rollout(np.array(states), np.array(inputs), np.array(references[:steps]), np.array(seconds))
