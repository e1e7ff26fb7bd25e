"""Says what to write into a mapping, so that columns are read otherwise."""

from collections.abc import Sequence

from gpmpc._dynamics import Array
from gpmpc.logs._mapping import Signal


def advise_columns(
    signal: Signal, order: Sequence[int], scales: Sequence[float] | Array
) -> str:
    """Says how each axis is taken from another, times a number.

    Args:
        signal: As it is in the mapping.
        order: The present axis that each axis is taken from.
        scales: What each is multiplied by.
    """
    columns = [signal.columns[source] for source in order]
    numbers = [
        scale * signal.scales[source]
        for scale, source in zip(scales, order, strict=True)
    ]
    return _columns_and_scale(signal, columns, numbers)


def advise_quaternion_columns(
    signal: Signal, order: Sequence[int], signs: Sequence[float] | Array
) -> str:
    """Says how x, y, z, w are read as others, with signs, of the present ones."""
    places = [0, 1, 2, 3] if signal.order == "xyzw" else [1, 2, 3, 0]
    columns = list(signal.columns)
    scales = [1.0] * 4
    for entry in range(4):
        source = places[order[entry]]
        columns[places[entry]] = signal.columns[source]
        scales[places[entry]] = signs[entry] * signal.scales[source]
    return _columns_and_scale(signal, columns, scales)


def advise_turned_body(signal: Signal) -> str:
    """Says how the body's axes of an attitude are turned by half a turn about x."""
    if signal.kind == "euler":
        return f"the quaternion of {signal.name}, with its body's axes turned"
    # q * i: (x, y, z, w) becomes (w, z, -y, -x).
    return advise_quaternion_columns(signal, [3, 2, 1, 0], [1, 1, -1, -1])


def _columns_and_scale(
    signal: Signal, columns: Sequence[str], scales: Sequence[float]
) -> str:
    """Writes what differs from the present columns and scale."""
    changes = []
    if list(columns) != list(signal.columns):
        changes.append(f"columns: [{', '.join(columns)}]")
    if tuple(scales) != signal.scales:
        numbers = ", ".join(f"{scale:.5g}" for scale in scales)
        if len(set(scales)) == 1:
            changes.append(f"scale: {scales[0]:.5g}")
        else:
            changes.append(f"scale: [{numbers}]")
    return f"{' and '.join(changes)} for {signal.name}"
