"""Flies the whole quadrotor: a cascade of two controllers at two rates, on the twelve states.

The outer controller, on the translational subsystem, decides the thrust U1 and its direction (ux, uy), once a second
say; the direction, by eq. (2) of Cao, Lai and Alam (2017) inverted, is the attitude that the inner one, on the
rotational subsystem, takes the vehicle to. (With the plant in the loop an inner loop at 1 Hz is unworkable; 20 Hz flies
well.) The references of the angular rates are those of a first-order approach to the attitude,
(angle_d - angle) / response time. Each controller has its own policy for failures: while the outer one goes on along
its last plan, the inner one keeps the vehicle upright, and the other way round.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from gpmpc._angles import wrap
from gpmpc.exceptions import Diverged, ShapeError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Controller, FlightJudge, Reference
from gpmpc.mpc._policy import OnFailure, check_policy, command
from gpmpc.signals import Signals
from gpmpc.simulation._disturbances import Disturbance
from gpmpc.simulation._loop import (
    Flight,
    Rollout,
    check_belongs,
    check_references,
    window,
)
from gpmpc.simulation._simulator import Noise, PlantSimulator, step_together
from gpmpc.step import Step
from gpmpc.systems import (
    Coupled,
    Rotational,
    System,
    Translational,
    attitude_for_thrust_direction,
)

_OUTER = slice(0, 6)
_INNER = slice(6, 12)


@dataclass(frozen=True)
class Cascade:
    """An outer and an inner controller, and how the one's inputs are the other's references.

    Raises:
        SettingError: A ratio below 1, or a response time that is not positive.
    """

    outer: Controller  #: on states x, vx, y, vy, z, vz [m, m/s] and inputs U1 [N], ux, uy [-]
    inner: Controller  #: on states phi, p, theta, q, psi, r [rad, rad/s] and inputs U2, U3, U4 [N]
    ratio: int = 20  #: inner steps an outer step
    response_time: float = 0.1  #: of the approach to a new attitude [s]

    def __post_init__(self) -> None:
        check_number("ratio", self.ratio, least=1, whole=True)
        check_number("response_time", self.response_time, above=0, unit="[s]")

    def attitude_reference(
        self, planned: np.ndarray, angles: np.ndarray, phase: int
    ) -> Reference:
        """What the inner controller is to follow over its horizon, with no moments as the inputs that belong to it.

        It is asked ``phase`` inner steps after the outer step began, at roll, pitch and yaw (3,) [rad]; yaw is to be
        zero. ``planned`` are the outer plan's inputs from that step on (H, 3): the inner horizon looks beyond the first
        where it reaches the next outer step, and holds the last.
        """
        ahead = phase + np.arange(self.inner.horizon + 1)
        direction = planned[np.minimum(ahead // self.ratio, len(planned) - 1)]
        states = np.zeros((len(ahead), 6))
        ux, uy = direction[:, 1:].T
        states[:, [0, 2]] = attitude_for_thrust_direction(ux, uy, angles[2])
        states[:, 1::2] = wrap(states[:, ::2] - angles) / self.response_time
        return Reference(states, np.zeros((self.inner.horizon, 3)))


@dataclass(frozen=True)
class CascadeRollout:
    """K outer steps of a cascade, K r inner ones."""

    states: np.ndarray  # (K r + 1, 12) of the plant at the inner rate
    inputs: np.ndarray  # (K r, 4) that were applied, U1 .. U4 [N]
    outer: Rollout  # at its own rate: states x .. vz, inputs U1, ux, uy as they were decided
    inner: Rollout  # at its own rate: states phi .. r, its references the attitudes to be reached


def cascade_loop(
    plant: System,
    cascade: Cascade,
    references: Reference | np.ndarray,
    initial: Any,
    steps: int,
    *,
    noise: Noise | None = None,
    disturbances: Sequence[Disturbance] = (),
    on_failure: OnFailure = "raise",
    seed: int = 0,
    on_step: Callable[[Literal["outer", "inner"], Step], None] | None = None,
) -> CascadeRollout:
    """Flies a cascade over K outer ``steps``; arguments are those of ``closed_loop``, at two rates.

    The ``plant`` has the twelve states at the inner rate, such as ``gpmpc.systems.coupled()``; ``initial`` is a state
    (12,) or a ``Gaussian``. ``references`` are of the outer loop, states x, vx, y, vy, z, vz (steps + horizon, 6) or
    more, one an outer step. Noise acts every inner step. ``on_step`` is called with the loop and its step: of the outer
    one as it begins, of the inner one as it ends.

    Raises:
        ShapeError: The plant has other states, or references are too few.
        SolverFailure: Its step is that of the controller that failed.
        Diverged: Its step is an inner one.
    """
    check_policy(on_failure)
    if (names := (plant.state_names, plant.input_names)) != (
        Coupled.state_names,
        Coupled.input_names,
    ):
        raise ShapeError(
            f"a cascade flies the states and inputs of Coupled; got {names}"
        )
    horizon = cascade.outer.horizon
    ratio = cascade.ratio
    slow = Signals(
        Translational.state_names, Translational.input_names, ratio * plant.time_step
    )
    fast = Signals(Rotational.state_names, Rotational.input_names, plant.time_step)
    check_belongs(cascade.outer, slow, "the outer loop")
    check_belongs(cascade.inner, fast, "the inner loop")
    references = check_references(references, steps, horizon, slow)
    simulator = PlantSimulator(plant, initial, disturbances, noise, seed)
    calls: Any = (
        (None, None)
        if on_step is None
        else [partial(on_step, loop) for loop in ("outer", "inner")]
    )
    outer = Flight(
        simulator,
        references,
        ratio * plant.time_step,
        FlightJudge.of(cascade.outer, 6, 3, (slow.state_names, slow.input_names)),
        calls[0],
        _OUTER,
    )
    inner = Flight(
        simulator,
        references,
        plant.time_step,
        FlightJudge.of(cascade.inner, 6, 3, (fast.state_names, fast.input_names)),
        calls[1],
        _INNER,
    )
    states = [simulator.mean]
    inputs = []
    angles = np.zeros(3)
    thrust: Any = None  # the command of the outer step under way
    attitude: Any = None  # what the inner controller is to follow
    for j in range(steps * ratio):
        (k, phase), time, before = (
            divmod(j, ratio),
            round(j * plant.time_step, 9),
            (states[-1], simulator.covariance),
        )
        belief = simulator.measure(time)
        if phase == 0:
            ahead = window(references, k, horizon)
            thrust = command(
                cascade.outer, _part(belief, _OUTER), ahead, outer.last, on_failure, k
            )
        # Attitudes start from where the vehicle is, or was when that was last known.
        measured = belief.mean.numpy()[6::2]
        angles = measured if np.isfinite(measured).all() else angles
        planned = thrust.input[None] if thrust.plan is None else thrust.plan.inputs
        attitude = cascade.attitude_reference(planned, angles, phase)
        moments = command(
            cascade.inner, _part(belief, _INNER), attitude, inner.last, on_failure, j
        )
        (applied,) = step_together(
            [simulator], time, [np.append(thrust.input[:1], moments.input)]
        )
        if isinstance(applied, Diverged):
            raise applied
        if phase == 0:
            ahead = window(references, k, horizon).states
            outer.add(before, belief, thrust.input, thrust, ahead)
        inner.add(before, belief, applied[1:], moments, attitude.states)
        states.append(simulator.mean)
        inputs.append(applied)
    return CascadeRollout(
        np.array(states),
        np.array(inputs),
        outer.rollout(),
        inner.rollout(attitude.states[1]),
    )


def _part(belief: Gaussian, states: slice) -> Gaussian:
    return Gaussian(belief.mean[states], belief.covariance[states, states])
