"""Lists what the columns of an attitude may mean when they are not what is claimed."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from gpmpc._dynamics import Array
from gpmpc.logs._frames import (
    FRD_TURN,
    NAMES,
    NED_TURN,
    Claim,
    attitudes_to_enu,
    other_convention,
)
from gpmpc.logs._mapping import Signal
from gpmpc.logs._mapping_advice import (
    advise_columns,
    advise_quaternion_columns,
    advise_turned_body,
)
from gpmpc.logs._units import DEGREE
from gpmpc.models._quaternions import quaternion_inverse, quaternion_product

RARE = 1.25  # mistakes that a rare one counts for


@dataclass(frozen=True)
class AttitudeInterpretation:
    """An interpretation of the columns of an attitude."""

    advice: str  # what is so, and what to write into the mapping; empty: nothing else
    cost: float  # number of mistakes
    attitudes: Callable[[Array], Array]  # (..., 4) in ENU and FLU, of those in the file
    turns_axes: bool = False  # whether NED and ENU change places, and nothing else


def attitude_interpretations(claim: Claim) -> list[AttitudeInterpretation]:
    """Lists the interpretations that are tried; the first is what the mapping says."""
    axes = claim.axes[claim.attitude.name]

    def to_enu(attitudes: Array) -> Array:
        return attitudes_to_enu(attitudes, axes)

    column_changes = list(_column_changes(claim))
    axis_changes = list(_axis_changes(claim))
    common_changes = column_changes[:2]

    interpretations = [AttitudeInterpretation(advice="", cost=0, attitudes=to_enu)]
    for change in column_changes:
        interpretations.append(
            replace(change, attitudes=_chain(change.attitudes, to_enu))
        )
    for turn in axis_changes:
        interpretations.append(replace(turn, attitudes=_chain(to_enu, turn.attitudes)))
    for change in common_changes:
        for turn in axis_changes:
            both = _chain(change.attitudes, to_enu, turn.attitudes)
            interpretations.append(_two_mistakes(change, turn, both))
    first, second = common_changes
    both = _chain(first.attitudes, second.attitudes, to_enu)
    interpretations.append(_two_mistakes(first, second, both))
    return interpretations


def _two_mistakes(
    one: AttitudeInterpretation,
    other: AttitudeInterpretation,
    attitudes: Callable[[Array], Array],
) -> AttitudeInterpretation:
    """Supposes two mistakes together, with what both make of the attitudes."""
    return AttitudeInterpretation(
        advice=f"{one.advice}; and {other.advice}",
        cost=one.cost + other.cost,
        attitudes=attitudes,
    )


def _chain(*functions: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """Returns a function that calls functions one after the other."""

    def chained(values: Array) -> Array:
        for function in functions:
            values = function(values)
        return values

    return chained


def _axis_changes(claim: Claim) -> Iterator[AttitudeInterpretation]:
    """Yields attitudes in other axes of the world or of the body."""
    name = claim.attitude.name
    claimed = claim.axes[name]
    axes = other_convention(claimed)
    world, body = NAMES[claimed]
    other_world, other_body = NAMES[axes]

    def turn_world(q: Array) -> Array:
        return quaternion_product(NED_TURN, q)

    def turn_body(q: Array) -> Array:
        return quaternion_product(q, FRD_TURN)

    yield AttitudeInterpretation(
        f"{name} is that of a body in {other_body} axes in a world in {other_world} "
        f"axes, not {body} in {world}: write axes: {axes} for {name}",
        1,
        _chain(turn_world, turn_body),
        turns_axes=True,
    )
    yield AttitudeInterpretation(
        f"{name} is that of a body in {other_body} axes, not {body}, in a world in "
        f"{world} axes: write {advise_turned_body(claim.attitude)}",
        1,
        turn_body,
    )
    yield AttitudeInterpretation(
        f"{name} is that of a body in {body} axes in a world in {other_world} axes, "
        f"not {world}: write {advise_turned_body(claim.attitude)}, and axes: {axes} "
        f"for {name}",
        1,
        turn_world,
    )


def _column_changes(claim: Claim) -> Iterator[AttitudeInterpretation]:
    """Yields other meanings of the columns, the two commonest mistakes first."""
    if claim.attitude.kind == "euler":
        yield from _euler_changes(claim.attitude)
    else:
        yield from _quaternion_changes(claim.attitude)


def _quaternion_changes(signal: Signal) -> Iterator[AttitudeInterpretation]:
    """Yields other meanings of the columns of a quaternion."""
    name = signal.name
    order = "wxyz" if signal.order == "xyzw" else "xyzw"
    shift = -1 if order == "wxyz" else 1
    yield AttitudeInterpretation(
        advice=f"{name} is in the order {order}, not {signal.order}: write order: "
        f"{order} for {name}",
        cost=1,
        attitudes=lambda q: np.roll(q, shift, axis=-1),
    )
    inverse = advise_quaternion_columns(signal, [0, 1, 2, 3], [-1, -1, -1, 1])
    yield AttitudeInterpretation(
        advice=f"{name} turns vectors from world to body axes, the inverse of an "
        f"attitude: write {inverse}",
        cost=1,
        attitudes=quaternion_inverse,
    )
    for axes in ([0], [1], [2], [1, 2], [0, 1], [0, 2]):
        signs = np.ones(4)
        signs[axes] = -1
        columns = advise_quaternion_columns(signal, [0, 1, 2, 3], signs)
        yield AttitudeInterpretation(
            advice=f"{_have_opposite_sign(['xyz'[i] for i in axes], name)}: "
            f"write {columns}",
            cost=RARE if axes in ([0], [1], [2], [1, 2]) else 2,
            attitudes=partial(np.multiply, signs),
        )
    for order in ([1, 0, 2, 3], [2, 1, 0, 3], [0, 2, 1, 3]):
        columns = advise_quaternion_columns(signal, order, np.ones(4))
        yield AttitudeInterpretation(
            advice=f"{_have_changed_places('xyz', order, name)}: write {columns}",
            cost=RARE,
            attitudes=partial(np.take, indices=order, axis=-1),
        )


def _euler_changes(signal: Signal) -> Iterator[AttitudeInterpretation]:
    """Yields other meanings of the columns of roll, pitch and yaw."""
    name = signal.name
    angles = ("roll", "pitch", "yaw")
    in_place = (0, 1, 2)
    yield AttitudeInterpretation(
        advice=f"{name} turns vectors from world to body axes, the inverse of an "
        "attitude: write its quaternion with scale: [-1, -1, -1, 1]",
        cost=1,
        attitudes=quaternion_inverse,
    )
    for axes in ([1], [0], [2], [1, 2], [0, 1], [0, 2], [0, 1, 2]):
        signs = np.ones(3)
        signs[axes] = -1
        yield AttitudeInterpretation(
            advice=f"{_have_opposite_sign([angles[i] for i in axes], name)}: "
            f"write {advise_columns(signal, in_place, signs)}",
            cost=1 if axes in ([0], [1], [2], [1, 2]) else 2,
            attitudes=partial(_change_angles, order=in_place, factors=signs),
        )
    for order in ((1, 0, 2), (2, 1, 0), (0, 2, 1)):
        ones = np.ones(3)
        yield AttitudeInterpretation(
            advice=f"{_have_changed_places(angles, order, name)}: "
            f"write {advise_columns(signal, order, ones)}",
            cost=1,
            attitudes=partial(_change_angles, order=order, factors=ones),
        )
    yield from _angle_unit_changes(signal)


def _angle_unit_changes(signal: Signal) -> Iterator[AttitudeInterpretation]:
    """Yields Euler angles of which all, or one, are in another unit."""
    name = signal.name
    angles = ("roll", "pitch", "yaw")
    in_place = (0, 1, 2)
    other_unit = "rad" if signal.unit == "deg" else "deg"
    ratio = 1 / DEGREE if signal.unit == "deg" else DEGREE
    for axes in ([0, 1, 2], [0], [1], [2]):
        factors = np.ones(3)
        factors[axes] = ratio
        if len(axes) == 3:
            advice = (
                f"the rate is {ratio:.3g} times the derivative of {name}; is its "
                f"unit right? (degrees for radians make a factor of 57) write "
                f"unit: {other_unit} for {name}"
            )
        else:
            advice = (
                f"{angles[axes[0]]} of {name} is in {other_unit}, not {signal.unit}: "
                f"write {advise_columns(signal, in_place, factors)}"
            )
        yield AttitudeInterpretation(
            advice=advice,
            cost=1,
            attitudes=partial(_change_angles, order=in_place, factors=factors),
        )


def _change_angles(attitudes: Array, order: Sequence[int], factors: Array) -> Array:
    """Takes roll, pitch and yaw of attitudes (..., 4) in an order, times factors."""
    turns = Rotation.from_quat(attitudes.reshape(-1, 4))
    angles = turns.as_euler("ZYX")[:, ::-1]  # roll, pitch, yaw
    angles = angles[:, list(order)] * factors
    changed = Rotation.from_euler("ZYX", angles[:, ::-1]).as_quat()
    return changed.reshape(attitudes.shape)


def _have_opposite_sign(names: Sequence[str], signal: str) -> str:
    verb = "has" if len(names) == 1 else "have"
    return f"{' and '.join(names)} of {signal} {verb} the opposite sign"


def _have_changed_places(
    names: Sequence[str], order: Sequence[int], signal: str
) -> str:
    swapped = [names[i] for i in range(3) if order[i] != i]
    return f"{swapped[0]} and {swapped[1]} of {signal} have changed places"
