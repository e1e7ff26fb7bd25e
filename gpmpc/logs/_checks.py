"""Compares signals with each other: are rates the derivatives of positions and attitudes, in the units stated?

A velocity in other units than stated, a rate in degrees or an attitude in another order makes every model wrong, and
each is visible from the log alone: the signal is compared with the other's finite differences by least squares.
"""

from collections.abc import Sequence

import numpy as np

from gpmpc.exceptions import DataError
from gpmpc.logs._log import LogRun
from gpmpc.logs._mapping import LogMapping, Signal
from gpmpc.logs._state_space import Array, quaternion_inverse, quaternion_product, rotate, rotation_vector

SPAN = 4  # rows on each side of a finite difference: above the noise of one row
SLOPES = (0.5, 2.0)  # of a signal over the derivative that it should be
FIT = 0.7  # correlation from which a slope says something
MOST_ROWS = 20_000
_HINTS = ((180 / np.pi, "degrees instead of radians"), (np.pi / 180, "radians instead of degrees"))


def check_plausible(runs: Sequence[LogRun], step: float, mapping: LogMapping) -> None:
    """Raises where a log contradicts its mapping.

    Raises:
        DataError: A velocity or rate is a multiple of the derivative of position or attitude, or in another frame; or
            no input changes.
    """
    inputs = [run.inputs for run in runs]
    if inputs[0].shape[1] and all(np.ptp(u, axis=0).max() == 0 for u in inputs):
        rows = sum(len(run) for run in runs)
        raise DataError(f"no input changes in {rows} rows: the system is at rest, and nothing can be learned of it")
    if mapping.model != "rigid_body":
        return
    rigid_body_signals(mapping)
    before, now, after = (_rows(runs, shift) for shift in (-SPAN, 0, SPAN))
    if len(now) < 50:
        return
    at, time = mapping.space.columns, 2 * SPAN * step
    _, q, v, w = (now[:, columns] for columns in at)
    names, frames = zip(*((signal.name, signal.frame) for signal in mapping.of("states")), strict=True)
    speed = (after[:, at[0]] - before[:, at[0]]) / time
    _compare(v if frames[2] != "body" else rotate(q, v), speed, names[2], f"the derivative of {names[0]}")
    turn = quaternion_product(quaternion_inverse(before[:, at[1]]), after[:, at[1]])
    body = rotation_vector(turn) / time
    world = rotate(q, body)
    found, other = (world, body) if frames[3] == "world" else (body, world)
    _compare(w, found, names[3], f"the derivative of {names[1]}", other, frames[3] or "body")


def rigid_body_signals(mapping: LogMapping) -> tuple[Signal, ...]:
    """The four signals of a rigid body's state: position, attitude, velocity, rate.

    Raises:
        DataError: They are others, or in another order.
    """
    signals = mapping.of("states")
    shapes = [(s.group.kind, s.group.error_dim) for s in signals]
    if shapes != [("vector", 3), ("quaternion", 3), ("vector", 3), ("vector", 3)]:
        raise DataError(
            "a rigid body's states are position (3), attitude (quaternion or Euler angles), velocity (3) and angular "
            f"rate (3), in this order; the mapping has {', '.join(s.name for s in signals)}"
        )
    return signals


def _rows(runs: Sequence[LogRun], shift: int) -> Array:
    rows = [run.states[run.starts(SPAN, SPAN) + shift] for run in runs]
    states = np.concatenate(rows)
    return states[:: max(len(states) // MOST_ROWS, 1)]


def _compare(
    signal: Array, derivative: Array, name: str, what: str, elsewhere: Array | None = None, frame: str = ""
) -> None:
    slope, fit = _regression(signal, derivative)
    if elsewhere is not None:
        _, fit_elsewhere = _regression(signal, elsewhere)
        if fit_elsewhere > FIT and fit_elsewhere > fit + 0.1:
            other = "world" if frame == "body" else "body"
            raise DataError(f"{name} is {what} in {other} axes (correlation {fit_elsewhere:.2f}), not {frame} ones")
    if fit > FIT and not SLOPES[0] < slope < SLOPES[1]:
        hint = next((f": {text}?" for factor, text in _HINTS if abs(np.log(abs(slope) / factor)) < 0.2), "")
        hint = ": its sign is turned" if -SLOPES[1] < slope < -SLOPES[0] else hint
        raise DataError(f"{name} is {slope:.3g} times {what} (correlation {fit:.2f}); is its unit right?{hint}")


def _regression(signal: Array, derivative: Array) -> tuple[float, float]:
    """Slope of the signal over the derivative, and the absolute correlation of the two."""
    a, b = (x - x.mean(axis=0) for x in (signal, derivative))
    aa, bb, ab = float((a * a).sum()), float((b * b).sum()), float((a * b).sum())
    return (ab / bb, abs(ab) / np.sqrt(aa * bb)) if aa > 0 and bb > 0 else (1.0, 0.0)
