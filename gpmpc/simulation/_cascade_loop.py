"""Flies the whole quadrotor: a cascade of two controllers at two rates, on 12 states.

The outer controller, on the translational subsystem, decides the thrust U1 and its
direction (ux, uy), once a second say; the direction, by eq. (2) of Cao, Lai and Alam
(2017) inverted, is the attitude that the inner one, on the rotational subsystem, takes
the vehicle to. (With the plant in the loop an inner loop at 1 Hz is unworkable; 20 Hz
flies well.) The references of the angular rates are those of a first-order approach to
the attitude, (angle_d - angle) / response time. Each controller has its own policy for
failures: while the outer one goes on along its last plan, the inner one keeps the
vehicle upright, and the other way round.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import numpy as np

from gpmpc._angles import wrap
from gpmpc._arrays import is_measured
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import to_array
from gpmpc.exceptions import Diverged, ShapeError, check_method, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc import Controller, FlightJudge, Reference
from gpmpc.mpc._policy import Command, OnFailure, decide
from gpmpc.signals import Signals
from gpmpc.simulation._disturbances import Disturbance
from gpmpc.simulation._flight import Flight
from gpmpc.simulation._rollout import Rollout
from gpmpc.simulation._scenario import Scenario, check_belongs
from gpmpc.simulation._simulator import Noise, Simulator, step_together
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

Recorder = Callable[[Literal["outer", "inner"], Step], None]


@explains_arguments
@dataclass(frozen=True)
class Cascade:
    """An outer and an inner controller, whose references are the outer one's inputs.

    Raises:
        SettingError: A ratio below 1, or a response time that is not positive.

    See Also:
        ``cascade_loop``, which flies it.
    """

    #: on states x, vx, y, vy, z, vz [m, m/s] and inputs U1 [N], ux, uy [-]
    outer: Controller
    #: on states phi, p, theta, q, psi, r [rad, rad/s] and inputs U2, U3, U4 [N]
    inner: Controller
    ratio: int = 20  #: inner steps an outer step
    response_time: float = 0.1  #: of the approach to a new attitude [s]

    def __post_init__(self) -> None:
        check_number("ratio", self.ratio, least=1, whole=True)
        check_number("response_time", self.response_time, above=0, unit="[s]")

    def attitude_reference(
        self, planned: np.ndarray, angles: np.ndarray, phase: int
    ) -> Reference:
        """Returns what the inner controller is to follow over its horizon.

        Yaw is to be zero. The inputs that belong to the reference are no moments.

        Args:
            planned: Inputs of the outer plan (H, 3), from its current step on. Inner
                stage i takes outer input (phase + i) // ratio, at most the last.
            angles: Roll, pitch and yaw now (3,) [rad].
            phase: Number of inner steps since the outer step began.
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
    # at its own rate: states x .. vz, inputs U1, ux, uy as they were decided
    outer: Rollout
    # at its own rate: states phi .. r, its references the attitudes to be reached
    inner: Rollout


@explains_arguments
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
    on_step: Recorder | None = None,
) -> CascadeRollout:
    """Flies a cascade at two rates.

    Args:
        plant: The twelve states at the inner rate, such as
            ``gpmpc.systems.coupled()``.
        cascade: Both controllers.
        references: States x, vx, y, vy, z, vz of the outer loop
            (steps + horizon, 6) or more, one an outer step.
        initial: A state (12,) or a ``Gaussian``.
        steps: Number of outer steps.
        noise: As for ``closed_loop``; it acts every inner step.
        disturbances: As for ``closed_loop``.
        on_failure: As for ``closed_loop``; of either controller.
        seed: Of all random numbers.
        on_step: Called with the loop and its step, when the inner step has been
            applied; at the first inner step of an outer one, first with the outer
            step.

    Raises:
        ShapeError: The plant has other states, references are too few, or a state or
            noise has the wrong length.
        DataError: References that are no numbers, or have other names.
        SettingError: An unknown policy, noise or disturbances that do not fit, or a
            controller without ``control``, of other names, or of another time step,
            than its loop.
        SolverFailure: Its step is that of the controller that failed.
        Diverged: Its step is an inner one; ``rollout`` holds the steps before, and its
            last outer step may have fewer inner ones.

    See Also:
        ``Cascade``; ``closed_loop`` for one controller.
    """
    names = (plant.state_names, plant.input_names)
    if names != (Coupled.state_names, Coupled.input_names):
        raise ShapeError(
            f"a cascade flies the states and inputs of Coupled; got {names}"
        )
    scenario = Scenario(
        system=plant,
        controller=cascade.outer,
        references=references,
        initial=initial,
        steps=steps,
        noise=noise,
        disturbances=disturbances,
        on_failure=on_failure,
        name="the outer loop",
        signals=Signals(
            Translational.state_names,
            Translational.input_names,
            time_step=cascade.ratio * plant.time_step,
        ),
    )
    flight = _CascadeFlight(scenario, cascade, seed, on_step)
    for inner_step in range(steps * cascade.ratio):
        flight.advance(inner_step)
    return flight.rollout()


class _CascadeFlight:
    """A cascade under way."""

    def __init__(
        self,
        scenario: Scenario,
        cascade: Cascade,
        seed: int,
        on_step: Recorder | None,
    ):
        inner_time_step = scenario.system.time_step
        inner_signals = Signals(
            Rotational.state_names, Rotational.input_names, inner_time_step
        )
        check_method("inner", cascade.inner, "control", "GPMPC(...)")
        check_belongs(cascade.inner, inner_signals, "the inner loop")
        self._scenario = scenario
        self._cascade = cascade
        self._inner_time_step = inner_time_step
        self._simulator = scenario.simulator(seed)
        self._outer = _flight_of_loop(
            "outer",
            simulator=self._simulator,
            controller=cascade.outer,
            signals=scenario.signals,
            states=_OUTER,
            on_step=on_step,
        )
        self._inner = _flight_of_loop(
            "inner",
            simulator=self._simulator,
            controller=cascade.inner,
            signals=inner_signals,
            states=_INNER,
            on_step=on_step,
        )
        self._states = [self._simulator.mean]
        self._inputs: list[np.ndarray] = []
        self._angles = np.zeros(3)  # as they were measured last [rad]
        self._thrust: Command | None = None  # of the outer step under way
        # Of the last reference of the inner controller (H + 1, 6).
        self._attitude_states: np.ndarray | None = None

    def advance(self, inner_step: int) -> None:
        """Flies one inner step; the outer controller decides at each ``ratio``-th."""
        outer_step, phase = divmod(inner_step, self._cascade.ratio)
        time = round(inner_step * self._inner_time_step, 9)
        state = self._simulator.state
        belief = self._simulator.measure(time)
        measured = np.array(to_array(belief.mean))
        outer_reference = self._scenario.reference_from(outer_step)
        if phase == 0:
            self._thrust = self._decide_thrust(belief, outer_reference, outer_step)
        thrust = self._thrust
        assert thrust is not None  # the first inner step is the first of an outer one
        attitude = self._attitude_reference(thrust, measured, phase)
        attitude_states = np.array(attitude.states)  # recorded
        moments = self._decide_moments(belief, attitude, inner_step)
        decided_input = np.append(thrust.input[:1], moments.input)
        (result,) = step_together([self._simulator], time, [decided_input])
        if isinstance(result, Diverged):
            if self._inputs:
                result.rollout = self.rollout()
            raise result
        if phase == 0:
            self._outer.add(
                state=state,
                measured_by_simulator=measured,
                command=thrust,
                input=thrust.input,
                reference=self._scenario.reference_states_from(outer_step),
            )
        self._inner.add(
            state=state,
            measured_by_simulator=measured,
            command=moments,
            input=result.input[1:],
            reference=attitude_states,
        )
        self._attitude_states = attitude_states
        self._states.append(self._simulator.mean)
        self._inputs.append(result.input)

    def _decide_thrust(
        self, belief: Gaussian, reference: Reference, step: int
    ) -> Command:
        """Returns the command of the outer loop."""
        return decide(
            self._cascade.outer,
            _part(belief, _OUTER),
            reference,
            last=self._outer.last,
            on_failure=self._scenario.on_failure,
            step=step,
        )

    def _decide_moments(
        self, belief: Gaussian, attitude: Reference, step: int
    ) -> Command:
        """Returns the command of the inner loop."""
        return decide(
            self._cascade.inner,
            _part(belief, _INNER),
            attitude,
            last=self._inner.last,
            on_failure=self._scenario.on_failure,
            step=step,
        )

    def _attitude_reference(
        self, thrust: Command, measured: np.ndarray, phase: int
    ) -> Reference:
        """Returns what the inner controller is to follow under an outer command."""
        angles = measured[6::2]
        if is_measured(angles).all():
            self._angles = angles
        # Its first input belongs to the outer step under way, after a failure as well.
        planned = thrust.input[None]
        if thrust.plan is not None:
            planned = thrust.plan.inputs
        return self._cascade.attitude_reference(planned, self._angles, phase)

    def rollout(self) -> CascadeRollout:
        """Returns what was flown."""
        assert self._attitude_states is not None
        outer_end = self._scenario.reference_state(len(self._outer.steps))
        return CascadeRollout(
            states=np.array(self._states),
            inputs=np.array(self._inputs),
            outer=self._outer.rollout(outer_end),
            inner=self._inner.rollout(self._attitude_states[1]),
        )


def _flight_of_loop(
    loop: Literal["outer", "inner"],
    *,
    simulator: Simulator,
    controller: Controller,
    signals: Signals,
    states: slice,
    on_step: Recorder | None,
) -> Flight:
    """Returns the flight of one of the two loops, about to start."""
    names = (signals.state_names, signals.input_names)
    assert signals.time_step is not None
    return Flight(
        simulator=simulator,
        time_step=signals.time_step,
        judge=FlightJudge.of(
            controller, state_dim=len(names[0]), input_dim=len(names[1]), names=names
        ),
        on_step=None if on_step is None else partial(on_step, loop),
        own_states=states,
    )


def _part(belief: Gaussian, states: slice) -> Gaussian:
    """Returns the belief of some of the states."""
    return Gaussian(belief.mean[states], belief.covariance[states, states])
