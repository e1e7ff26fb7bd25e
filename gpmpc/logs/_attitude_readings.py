"""Lists what the columns of an attitude may mean when they are not what is claimed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from gpmpc.logs._frames import FRD_TURN, NAMES, NED_TURN, Claim, attitudes_to_enu
from gpmpc.logs._kinematics import Array, quaternion_inverse, quaternion_product
from gpmpc.logs._mapping import Signal
from gpmpc.logs._units import DEGREE

RARE = 1.25  # mistakes that a rare one counts for


@dataclass(frozen=True)
class AttitudeReading:
    """Another reading of the columns of an attitude."""

    advice: str  # what is so, and what to write into the mapping; empty: nothing else
    cost: float  # number of mistakes
    attitudes: Callable[[Array], Array]  # (..., 4) in ENU and FLU, of those in the file
    turns_axes: bool = False  # whether NED and ENU change places, and nothing else


def attitude_readings(claim: Claim) -> list[AttitudeReading]:
    """All readings that are tried; the first is what the mapping says."""
    axes = claim.axes[claim.attitude.name]

    def to_enu(attitudes: Array) -> Array:
        return attitudes_to_enu(attitudes, axes)

    changes = [AttitudeReading("", 0, to_enu)]
    columns = list(_column_changes(claim))
    turns = list(_turn_changes(claim))
    changes += [
        AttitudeReading(change.advice, change.cost, _chain(change.attitudes, to_enu))
        for change in columns
    ]
    changes += [
        replace(turn, attitudes=_chain(to_enu, turn.attitudes)) for turn in turns
    ]
    changes += [
        AttitudeReading(
            f"{change.advice}; and {turn.advice}",
            change.cost + turn.cost,
            _chain(change.attitudes, to_enu, turn.attitudes),
        )
        for change in columns[:2]
        for turn in turns
    ]
    first, second = columns[:2]
    changes.append(
        AttitudeReading(
            f"{first.advice}; and {second.advice}",
            first.cost + second.cost,
            _chain(first.attitudes, second.attitudes, to_enu),
        )
    )
    return changes


def _chain(*functions: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """The functions one after the other."""

    def chained(values: Array) -> Array:
        for function in functions:
            values = function(values)
        return values

    return chained


def _turn_changes(claim: Claim) -> Iterator[AttitudeReading]:
    """Other axes of the world or of the body."""
    name = claim.attitude.name
    axes = claim.axes[name]
    other = "ned" if axes == "enu" else "enu"
    (world, body), (other_world, other_body) = NAMES[axes], NAMES[other]

    def turn_world(q: Array) -> Array:
        return quaternion_product(NED_TURN, q)

    def turn_body(q: Array) -> Array:
        return quaternion_product(q, FRD_TURN)

    yield AttitudeReading(
        f"{name} is that of a body in {other_body} axes in a world in {other_world} "
        f"axes, not {body} in {world}: write axes: {other} for {name}",
        1,
        _chain(turn_world, turn_body),
        turns_axes=True,
    )
    yield AttitudeReading(
        f"{name} is that of a body in {other_body} axes, not {body}, in a world in "
        f"{world} axes: write {words_of_turned_body(claim.attitude)}",
        1,
        turn_body,
    )
    yield AttitudeReading(
        f"{name} is that of a body in {body} axes in a world in {other_world} axes, "
        f"not {world}: write {words_of_turned_body(claim.attitude)}, and axes: {other} "
        f"for {name}",
        1,
        turn_world,
    )


def _column_changes(claim: Claim) -> Iterator[AttitudeReading]:
    """Other meanings of the columns; the first two are the commonest mistakes."""
    if claim.attitude.kind == "euler":
        yield from _euler_changes(claim.attitude)
    else:
        yield from _quaternion_changes(claim.attitude)


def _quaternion_changes(signal: Signal) -> Iterator[AttitudeReading]:
    name = signal.name
    other = "wxyz" if signal.order == "xyzw" else "xyzw"
    shift = -1 if other == "wxyz" else 1
    yield AttitudeReading(
        f"{name} is in the order {other}, not {signal.order}: write order: {other} "
        f"for {name}",
        1,
        lambda q: np.roll(q, shift, axis=-1),
    )
    yield AttitudeReading(
        f"{name} turns vectors from world to body axes, the inverse of an attitude: "
        f"write {_quaternion_columns(signal, [0, 1, 2, 3], [-1, -1, -1, 1])}",
        1,
        quaternion_inverse,
    )
    for axes in ([0], [1], [2], [1, 2], [0, 1], [0, 2]):
        signs = np.ones(4)
        signs[axes] = -1
        letters = " and ".join("xyz"[axis] for axis in axes)
        several = len(axes) > 1
        yield AttitudeReading(
            f"{letters} of {name} {'have' if several else 'has'} the opposite sign: "
            f"write {_quaternion_columns(signal, [0, 1, 2, 3], signs)}",
            RARE if axes in ([0], [1], [2], [1, 2]) else 2,
            partial(np.multiply, signs),
        )
    for order in ([1, 0, 2, 3], [2, 1, 0, 3], [0, 2, 1, 3]):
        swapped = [i for i in range(3) if order[i] != i]
        yield AttitudeReading(
            f"{'xyz'[swapped[0]]} and {'xyz'[swapped[1]]} of {name} have changed "
            f"places: write {_quaternion_columns(signal, order, np.ones(4))}",
            RARE,
            partial(np.take, indices=order, axis=-1),
        )


def _euler_changes(signal: Signal) -> Iterator[AttitudeReading]:
    name = signal.name
    angles = ("roll", "pitch", "yaw")
    unit = "rad" if signal.unit == "deg" else "deg"
    ratio = 1 / DEGREE if signal.unit == "deg" else DEGREE

    def changed(order: Sequence[int], factors: Array) -> Callable[[Array], Array]:
        def attitudes(q: Array) -> Array:
            turns = Rotation.from_quat(q.reshape(-1, 4))
            values = turns.as_euler("ZYX")[:, ::-1]  # roll, pitch, yaw
            values = values[:, list(order)] * factors
            turned = Rotation.from_euler("ZYX", values[:, ::-1]).as_quat()
            return turned.reshape(q.shape)

        return attitudes

    same = (0, 1, 2)
    yield AttitudeReading(
        f"{name} turns vectors from world to body axes, the inverse of an attitude: "
        f"write its quaternion with scale: [-1, -1, -1, 1]",
        1,
        quaternion_inverse,
    )
    for axes in ([1], [0], [2], [1, 2], [0, 1], [0, 2], [0, 1, 2]):
        signs = np.ones(3)
        signs[axes] = -1
        several = len(axes) > 1
        yield AttitudeReading(
            f"{' and '.join(angles[i] for i in axes)} of {name} "
            f"{'have' if several else 'has'} the opposite sign: "
            f"write {words_of_columns(signal, same, signs)}",
            1 if axes in ([0], [1], [2], [1, 2]) else 2,
            changed(same, signs),
        )
    for order in ((1, 0, 2), (2, 1, 0), (0, 2, 1)):
        swapped = [angles[i] for i in range(3) if order[i] != i]
        yield AttitudeReading(
            f"{swapped[0]} and {swapped[1]} of {name} have changed places: "
            f"write {words_of_columns(signal, order, np.ones(3))}",
            1,
            changed(order, np.ones(3)),
        )
    for axes in ([0, 1, 2], [0], [1], [2]):
        factors = np.ones(3)
        factors[axes] = ratio
        if len(axes) == 3:
            advice = (
                f"the rate is {ratio:.3g} times the derivative of {name}; is its "
                f"unit right? (degrees for radians make a factor of 57) write "
                f"unit: {unit} for {name}"
            )
        else:
            columns = words_of_columns(signal, same, factors)
            advice = (
                f"{angles[axes[0]]} of {name} is in {unit}, not {signal.unit}: "
                f"write {columns}"
            )
        yield AttitudeReading(advice, 1, changed(same, factors))


def words_of_turned_body(signal: Signal) -> str:
    """How a mapping turns the body's axes of an attitude by half a turn about x."""
    if signal.kind == "euler":
        return f"the quaternion of {signal.name}, with its body's axes turned"
    # q * i: (x, y, z, w) becomes (w, z, -y, -x).
    return _quaternion_columns(signal, [3, 2, 1, 0], [1, 1, -1, -1])


def _quaternion_columns(
    signal: Signal, order: Sequence[int], signs: Sequence[float] | Array
) -> str:
    """Columns and scale that read x, y, z, w as others, with signs, of the present."""
    places = [0, 1, 2, 3] if signal.order == "xyzw" else [1, 2, 3, 0]
    columns = list(signal.columns)
    scales = [1.0] * 4
    for entry in range(4):
        source = places[order[entry]]
        columns[places[entry]] = signal.columns[source]
        scales[places[entry]] = signs[entry] * _scales(signal)[source]
    return _columns_and_scale(signal, columns, scales)


def words_of_columns(
    signal: Signal, order: Sequence[int], scales: Sequence[float] | Array
) -> str:
    """Columns and scale that take each axis from another, times a number."""
    columns = [signal.columns[source] for source in order]
    own = _scales(signal)
    numbers = [scale * own[source] for scale, source in zip(scales, order, strict=True)]
    return _columns_and_scale(signal, columns, numbers)


def _scales(signal: Signal) -> tuple[float, ...]:
    if isinstance(signal.scale, tuple):
        return signal.scale
    return (signal.scale,) * len(signal.columns)


def _columns_and_scale(
    signal: Signal, columns: Sequence[str], scales: Sequence[float]
) -> str:
    words = []
    if list(columns) != list(signal.columns):
        words.append(f"columns: [{', '.join(columns)}]")
    if tuple(scales) != _scales(signal):
        equal = len(set(scales)) == 1
        numbers = ", ".join(f"{scale:.5g}" for scale in scales)
        words.append(f"scale: {scales[0]:.5g}" if equal else f"scale: [{numbers}]")
    return f"{' and '.join(words)} for {signal.name}"
