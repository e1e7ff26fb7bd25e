"""Reads numbers that a user hands over: float64 arrays, in the order of known names.

Numbers come as arrays, tensors or lists, and from tables and series of pandas and the
like, whose columns and entries have labels. Text, truth values, dates, complex numbers
and tensors of a graph only could be taken for numbers: they are refused.
"""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpmpc.exceptions import DataError

Array = NDArray[np.float64]

#: Size from which on a number was not measured: with the largest numbers of their type
#: (3.4e38, 1.8e308) and the infinite ones sensors mark what they did not see. One that
#: was planned from would leave the plans after it no digits.
UNMEASURED = 1e30

_RULE = "must be real numbers"
_TOPIC = re.compile(r"^(state|measured|input)\.")


def read_array(
    key: str, values: Any, names: Sequence[str] = (), rule: str = _RULE
) -> Array:
    """Returns numbers as a float64 array, their last axis in the order of the names.

    An array that is one already is returned itself. Only what has labels is sorted.

    Args:
        key: What the numbers are, for the message.
        values: Anything that is an array of numbers.
        names: Of the entries of the last axis; empty where they are not known.
        rule: What they must be, for the message.

    Raises:
        DataError: They are no real numbers, or their labels are not the names.
    """
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values
    if getattr(values, "requires_grad", False):
        got = "a tensor of a graph: hand over its numbers, tensor.detach()"
        raise DataError(f"{key} {rule}; got {got}")
    if np.ma.is_masked(values):
        raise DataError(f"{key} {rule}; got a masked array with masked entries")
    on_host: Any = values
    if hasattr(on_host, "cpu"):  # a tensor
        on_host = on_host.cpu()
    try:
        array = np.asarray(on_host)
    except (TypeError, ValueError, RuntimeError) as error:
        got = f"a {type(values).__name__} whose parts are no numbers of one shape"
        raise DataError(f"{key} {rule}; got {got}") from error
    if array.dtype.kind not in "fiu":
        raise DataError(f"{key} {rule}; got {_described(values, array)}")
    labels = labels_of(values)
    if labels and names and all(isinstance(label, str) for label in labels):
        array = sorted_columns(key, array, labels, names)
    array = np.asarray(array, dtype=np.float64)
    return array if array.flags.writeable else array.copy()  # torch wants to write


def is_measured(values: Array) -> NDArray[np.bool_]:
    """Tells which numbers were measured: no NaN, and below ``UNMEASURED`` in size."""
    return np.abs(values) < UNMEASURED


def sorted_columns(
    key: str, values: Any, names: Sequence[str], wanted: Sequence[str]
) -> Any:
    """Values (*batch, n) with names on their last axis, in the order of wanted names.

    Raises:
        DataError: The names are others.
    """
    order = order_of(names, wanted)
    if order is None:
        rule = f"{key} must have the names {', '.join(wanted)}"
        raise DataError(f"{rule}; got {', '.join(names)}")
    return values[..., order]


def labels_of(values: Any) -> tuple[Any, ...]:
    """The labels of a table's columns or a series' entries; empty without any."""
    if isinstance(values, np.ndarray | list | tuple):
        return ()
    labels = getattr(values, "columns", None)
    if labels is None:
        labels = getattr(values, "index", None)
    if labels is None or callable(labels):
        return ()
    return plain_names(tuple(labels))


def plain_names(labels: Sequence[Any]) -> tuple[Any, ...]:
    """Labels without the topic that our recordings put before them (``state.x``).

    They stay where two would be one, such as the state and what was measured of it.
    """
    plain = tuple(
        _TOPIC.sub("", label) if isinstance(label, str) else label for label in labels
    )
    return plain if len(set(plain)) == len(plain) else tuple(labels)


def names_of(values: Any) -> tuple[str, ...]:
    """The labels of a table or a series where all are texts, and no two the same."""
    labels = labels_of(values)
    texts = all(isinstance(label, str) for label in labels)
    return labels if texts and len(set(labels)) == len(labels) else ()


def order_of(labels: Sequence[Any], names: Sequence[Any]) -> list[int] | None:
    """Where each name stands among as many labels; None where the labels are others."""
    if not len(names) == len(labels) == len(set(labels)) or set(labels) != set(names):
        return None
    return [labels.index(name) for name in names]


def _described(values: Any, array: NDArray[Any]) -> str:
    """What is no number, in a few words."""
    if hasattr(values, "requires_grad"):
        return str(values.dtype)  # as torch calls it
    if not array.ndim:
        text = repr(values)
        return text if len(text) < 60 and "\n" not in text else type(values).__name__
    if array.dtype.kind != "O":
        return str(array.dtype)
    numbers = int, float, np.number
    first = next((one for one in array.ravel() if not isinstance(one, numbers)), None)
    return f"object, such as {type(first).__name__}"
