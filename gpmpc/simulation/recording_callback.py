"""Problem: a loop's step and a recorder's step are told from different sides: what happened, and what was decided.

The loop keeps what it needs to go on (``Command``, with the last plan moved on); a recorder wants one flat ``Step`` of
everything a reader may ask for. This is the bridge, so that neither has to know the other.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from gpmpc import step as recorded
from gpmpc.simulation.cascade_loop import CascadeStep
from gpmpc.simulation.loop import Step


def recording_callback(recorder: Any, gp_size: int = 0) -> Callable[[Step], None]:
    """What ``closed_loop`` takes as ``on_step`` to have every step recorded.

    Args:
        recorder: Any object with ``record(step)`` of a ``gpmpc.step.Step``.
        gp_size: Transitions that the model holds.
    """
    expected: np.ndarray | None = None  # of the next measurement

    def on_step(step: Step) -> None:
        nonlocal expected
        n, decision = len(step.state), step.command.decision
        nothing = np.full(n, np.nan)
        recorder.record(
            recorded.Step(
                time=step.time,
                k=step.index,
                reference=np.asarray(step.reference.states[0], dtype=float),
                state=step.state,
                measured=step.measured,
                input=np.asarray(step.input, dtype=float),
                decision=decision,
                status=step.command.status,
                innovation=nothing if expected is None else step.measured - expected,
                belief_covariance=step.covariance,
                gp_size=gp_size,
                failed=step.command.failed,
            )
        )
        expected = None if step.command.failed else decision.means[1]

    return on_step


def cascade_recording_callback(
    outer: Any, inner: Any, gp_sizes: tuple[int, int] = (0, 0)
) -> Callable[[CascadeStep], None]:
    """What ``cascade_loop`` takes as ``on_step`` to have both loops recorded, each at its own rate.

    Args:
        outer: Any object with ``record(step)``, told of x .. vz and U1, ux, uy once an outer step.
        inner: The same of phi .. r and U2, U3, U4, once an inner step.
        gp_sizes: Transitions that the outer model holds, and the inner one.
    """
    tell_outer, tell_inner = recording_callback(outer, gp_sizes[0]), recording_callback(inner, gp_sizes[1])
    begun = 0  # outer steps

    def on_step(step: CascadeStep) -> None:
        nonlocal begun
        if step.phase == 0:
            tell_outer(step.of_outer(begun))
            begun += 1
        tell_inner(step.of_inner())

    return on_step
