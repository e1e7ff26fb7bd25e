"""Tells whether a reference leaves the range of the data that a model was learned from.

A GP knows nothing beyond its data: its mean goes back to the prior's, and a controller
follows it there.
"""

from typing import Any, NamedTuple

import numpy as np

from gpmpc._angles import TURN, arc
from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel, to_array
from gpmpc.exceptions import DataError, ShapeError
from gpmpc.gp import GPPosterior
from gpmpc.models import LogDynamics, RigidBodyKinematics
from gpmpc.models._past import measured_dim, measured_signals
from gpmpc.mpc._controller import read_reference
from gpmpc.signals import signals_of

Array = np.ndarray

_SMALL = 0.1  # share of the data's range, or of a lengthscale, that counts for nothing


_MOTION_OF_A_BODY = range(7, 13)  # its velocity and its rate
_ALL_AROUND = 0.75 * TURN  # of an angle


class BeyondData(NamedTuple):
    """A state whose reference leaves the range of the data.

    See Also:
        ``beyond_data``, which finds them.
    """

    name: str
    reference: tuple[float, float]  #: its smallest and largest value
    data: tuple[float, float]  #: those of the data

    def __str__(self) -> str:
        """Returns a line that says what to do."""
        reference = _in_words(self.reference)
        data = _in_words(self.data)
        return (
            f"the reference of {self.name} is {reference}, its data {data}: "
            "learn from data there, too"
        )


def _in_words(limits: tuple[float, float]) -> str:
    low, high = (f"{limit:.3g}" for limit in limits)
    return low if low == high else f"{low} to {high}"


class _Column(NamedTuple):
    """The range of a state that a GP has seen."""

    state: int
    low: float
    high: float
    lengthscale: float  # the shortest of all outputs; infinite where it is not known
    angle: bool = False


@explains_arguments
def beyond_data(model: DynamicsModel, reference: Any) -> list[BeyondData]:
    """Returns the states whose reference leaves the range of the data of a model's GPs.

    They are in their order. It leaves it by more than a tenth of that range, and of the
    shortest lengthscale of the state: what a GP does not depend on may be anything.
    States that no GP sees are left out, and models without data have none.

    Args:
        model: What was learned; models around it are looked through.
        reference: A set point (n,), or states of any number of steps (K, n), as for a
            controller.

    Raises:
        ShapeError: A reference of another number of states.
        DataError: One that is not finite.

    See Also:
        ``BeyondData``; ``gpmpc.datasets.RandomData`` for data that reach
        farther.
    """
    followed = read_reference(reference)
    signals = signals_of(model)
    if np.shape(followed.states)[-1:] == (measured_dim(model),):
        signals = measured_signals(model)
    states = np.atleast_2d(followed.in_order(signals).states)
    states = np.asarray(states, dtype=float)
    columns = _columns(model)
    if not columns:
        return []
    sizes = (measured_dim(model), model.state_dim)
    if states.shape[-1] not in sizes:
        raise ShapeError(
            f"reference must have {sizes[0]} states; got {states.shape[-1]}"
        )
    if not np.isfinite(states).all():
        raise DataError("reference states must be finite")
    beyond = []
    for column in columns:
        values = states[:, column.state]
        if column.angle:
            middle = 0.5 * (column.low + column.high)
            values = values - TURN * np.round((values - middle) / TURN)
        low = float(values.min())
        high = float(values.max())
        excess = max(column.low - low, high - column.high)
        width = column.high - column.low
        if excess <= _SMALL * width or excess <= _SMALL * column.lengthscale:
            continue
        name = f"x{column.state + 1}"
        if signals.state_names:
            name = signals.state_names[column.state]
        beyond.append(
            BeyondData(name, reference=(low, high), data=(column.low, column.high))
        )
    return beyond


def _columns(model: Any) -> list[_Column]:
    """Returns what the GPs of a model have seen, in the order of its states."""
    if isinstance(model, GPPosterior):
        return _columns_of(model, list(range(model.state_dim)), [])
    if isinstance(model, LogDynamics):
        return _columns_of_log(model)
    gp: Any = getattr(model, "residual", None)
    if isinstance(gp, GPPosterior):
        return _columns_of(gp, list(model.states), list(model.angles))
    within = getattr(model, "model", None)
    return [] if within is None else _columns(within)


def _columns_of_log(model: LogDynamics) -> list[_Column]:
    """Returns the columns of a log, but those that its model does not depend on.

    Of an angle that was everywhere nothing is beyond.
    """
    if model.ranges is None:
        return []
    states = list(range(model.measured_dim))
    if isinstance(model.model.kinematics, RigidBodyKinematics):
        states = list(_MOTION_OF_A_BODY)
    columns = []
    for i in states:
        low, high = (float(limit) for limit in model.ranges[:, i])
        is_angle = i in model.angles
        if not (is_angle and high - low > _ALL_AROUND):
            columns.append(_Column(i, low, high, lengthscale=0.0, angle=is_angle))
    return columns


def _columns_of(gp: GPPosterior, states: list[int], angles: list[int]) -> list[_Column]:
    """Returns the columns of the states that a GP sees, an angle as sine and cosine."""
    features = to_array(gp.features)
    lengthscales = to_array(gp.lengthscales)
    shortest = lengthscales.min(axis=0)
    columns = []
    j = 0  # the feature that is next
    for state in states:
        is_angle = state in angles
        width = 2 if is_angle else 1
        if is_angle:
            low, high = arc(np.arctan2(features[:, j], features[:, j + 1]))
        else:
            low = float(features[:, j].min())
            high = float(features[:, j].max())
        lengthscale = float(shortest[j : j + width].min())
        columns.append(_Column(state, low, high, lengthscale, angle=is_angle))
        j += width
    return sorted(columns)
