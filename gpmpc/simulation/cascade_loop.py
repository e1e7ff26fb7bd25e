"""Problem: fly the whole quadrotor: two controllers at two rates on the twelve states.

The plant is stepped at the inner rate. Every outer step begins with the outer controller; then, ``ratio`` times, the
inner one turns the vehicle to where the thrust is to point. Each has its own fall-back: while the outer controller
goes on along its last plan, the inner one keeps the vehicle upright, and the other way round.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc.exceptions import ShapeError, check_number
from gpmpc.gaussian import Gaussian
from gpmpc.mpc.cascade import Cascade
from gpmpc.mpc.controller import Reference
from gpmpc.mpc.supervision import Command, OnFailure, check_policy, command
from gpmpc.simulation.disturbances import Disturbance
from gpmpc.simulation.loop import Rollout, Step, checked_references, kept, rollout, window
from gpmpc.simulation.systems import Noise, RunningPlant
from gpmpc.systems import Coupled, Plant

OUTER, INNER = slice(0, 6), slice(6, 12)


@dataclass(frozen=True)
class CascadeRollout:
    """K outer steps of a cascade, K r inner ones.

    Attributes:
        states: Of the plant at the inner rate (K r + 1, 12).
        inputs: What acted, U1 .. U4 (K r, 4) [N].
        outer: The outer loop at its own rate: states x .. vz, inputs U1, ux, uy as they were decided.
        inner: The inner loop at its own rate: states phi .. r, its references the attitudes asked for.
    """

    states: np.ndarray
    inputs: np.ndarray
    outer: Rollout
    inner: Rollout


@dataclass(frozen=True)
class CascadeStep:
    """One inner step.

    Attributes:
        phase: Inner steps since the outer step began.
        whole: All twelve states, what was measured of them, the inputs U1 .. U4; its reference and its command are
            the inner controller's.
        reference: What the outer controller was to follow.
        outer: What the outer controller decided when the outer step began.
    """

    phase: int
    whole: Step
    reference: Reference
    outer: Command

    def of_outer(self, index: int, end: "CascadeStep | None" = None) -> Step:
        """The outer loop's step ``index`` that begins here, and ends with the inner step ``end`` (this one)."""
        return self._part(OUTER, index, self.reference, self.outer, self.outer.input, end or self)

    def of_inner(self) -> Step:
        """The inner loop's step."""
        whole = self.whole
        return self._part(INNER, whole.index, whole.reference, whole.command, whole.input[1:], self)

    def _part(
        self, part: slice, index: int, reference: Reference, command: Command, input: np.ndarray, end: "CascadeStep"
    ) -> Step:
        at, next_state = self.whole, end.whole.next_state[part]
        covariance = at.covariance[part, part]
        return Step(
            index, at.time, at.state[part], covariance, at.measured[part], reference, command, input, next_state
        )


def cascade_loop(
    plant: Plant,
    cascade: Cascade,
    references: Reference | np.ndarray,
    initial: Any,
    steps: int,
    *,
    noise: Noise | None = None,
    disturbances: Sequence[Disturbance] = (),
    on_failure: OnFailure = "raise",
    seed: int = 0,
    on_step: Callable[[CascadeStep], None] | None = None,
) -> CascadeRollout:
    """Flies a cascade.

    Args:
        plant: The twelve states at the inner rate, such as ``Integrated(Coupled(), time_step=0.05)``.
        cascade: The controllers.
        references: Of the outer loop: states x, vx, y, vy, z, vz (steps + horizon, 6) or more, one an outer step; as a
            ``Reference`` with the inputs that belong to them.
        initial: The state (12,), or the ``Gaussian`` that it is drawn from.
        steps: K, outer steps.
        noise: On states, measurements and inputs, every inner step.
        disturbances: What the controllers are not told of.
        on_failure: Of either controller; see ``closed_loop``.
        seed: Of all random numbers.
        on_step: Called with every inner step.

    Raises:
        ShapeError: The plant has other states, or references are too few.
        SettingError: An unknown policy, or negative noise.
        SolverFailure: A solve failed, and the policy is ``"raise"`` or there was nothing to fall back on; its step is
            that of the controller that failed.
        Diverged: The plant left the finite numbers; its step is an inner one.
    """
    check_number("steps", steps, least=1, whole=True)
    check_policy(on_failure)
    names = (tuple(plant.dynamics.state_names), tuple(plant.dynamics.input_names))
    if names != (Coupled.state_names, Coupled.input_names):
        raise ShapeError(f"a cascade flies the states and inputs of Coupled; got {names}")
    references = checked_references(references, steps, cascade.outer.horizon)
    running = RunningPlant(plant, initial, disturbances, noise, seed)
    taken: list[CascadeStep] = []
    outer = inner = None
    angles = np.zeros(3)  # until they are measured
    for k in range(steps):
        ahead = window(references, k, cascade.outer.horizon)
        for phase in range(cascade.ratio):
            j = k * cascade.ratio + phase
            time = round(j * plant.time_step, 9)
            state, belief = running.mean, running.measure(time)
            measured = belief.mean.cpu().numpy().astype(float)
            if phase == 0:
                outer = command(cascade.outer, _part(belief, OUTER), ahead, outer, on_failure, k)
            # Attitudes are asked for from where the vehicle is, or was when that was last known.
            angles = measured[6::2] if np.isfinite(measured[6::2]).all() else angles
            planned = outer.input[None] if outer.plan is None else outer.plan.inputs
            wanted = cascade.attitude_reference(planned, angles, phase)
            inner = command(cascade.inner, _part(belief, INNER), wanted, inner, on_failure, j)
            acted = running.apply(time, np.append(outer.input[:1], inner.input))
            whole = Step(j, time, state, running.covariance, measured, wanted, inner, acted, running.mean)
            taken.append(CascadeStep(phase, whole, ahead, outer))
            if on_step is not None:
                on_step(taken[-1])
    return _rollouts(taken, cascade.ratio, references, plant.time_step)


def _part(belief: Gaussian, states: slice) -> Gaussian:
    return Gaussian(belief.mean[states], belief.covariance[states, states])


def _rollouts(taken: Sequence[CascadeStep], ratio: int, references: Reference, time_step: float) -> CascadeRollout:
    whole = [step.whole for step in taken]
    last = whole[-1]
    outer = [first.of_outer(k, taken[k * ratio + ratio - 1]) for k, first in enumerate(taken[::ratio])]
    inner = [step.of_inner() for step in taken]
    attitudes = Reference(np.array([step.reference.states[0] for step in whole] + [last.reference.states[1]]))
    return CascadeRollout(
        states=np.array([*(step.state for step in whole), last.next_state]),
        inputs=np.array([step.input for step in whole]),
        outer=rollout([kept(step) for step in outer], references, ratio * time_step, outer[-1].next_state),
        inner=rollout([kept(step) for step in inner], attitudes, time_step, inner[-1].next_state),
    )
