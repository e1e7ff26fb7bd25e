"""What only older files of models hold, and how it is read.

No writer makes any of this. Models of gpmpc 1 (``.npz``) are read by ``gpmpc.gp``.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from gpmpc.models._casadi_function import CasadiFunction
from gpmpc.models._namings import Namings
from gpmpc.models._state_space import StateSpace
from gpmpc.models._stored_values import texts
from gpmpc.signals import Signals

#: the kind of a function in CasADi that a file names by what makes it
CASADI_BY_NAME = "casadi"
#: the nominal model of a log that is zero, an ``AffineNominal`` that is not fitted
STILL = "Still"
#: what a name of a column says of its values, behind the name
_REMARK = re.compile(r"( times [-+.\de]+)?( in other axes)?$")


def casadi_function_by_name(maker: Any, parameters: Mapping[str, Any]) -> Any:
    """Returns the function in CasADi that a trusted function makes of parameters."""
    return CasadiFunction(maker(**parameters))


def signals_of_metadata(metadata: Any) -> Signals:
    """Returns the names and the time step that a caller put into the metadata.

    Models carry their names since; see ``signals``.

    Raises:
        SettingError: The metadata do not describe a model.
    """
    metadata = metadata or {}
    return Signals(
        state_names=texts("states", metadata.get("states") or []),
        input_names=texts("inputs", metadata.get("inputs") or []),
        time_step=metadata.get("time_step"),
    )


def namings_of_columns(
    space: StateSpace, state_columns: Sequence[str], input_columns: Sequence[str]
) -> Namings:
    """Returns what states and inputs may be called, of a file without namings.

    Args:
        space: Of the states.
        state_columns: Their columns, which say what was done to the values.
        input_columns: Likewise.
    """
    states = (_without_remarks(state_columns), space.names)
    inputs = (_without_remarks(input_columns),)
    return Namings(_distinct(states), _distinct(inputs))


def _without_remarks(columns: Sequence[str]) -> tuple[str, ...]:
    return tuple(_REMARK.sub("", column) for column in columns)


def _distinct(ways: Sequence[tuple[str, ...]]) -> tuple[tuple[str, ...], ...]:
    """Returns ways to call entries that call no two of them the same."""
    return tuple(names for names in ways if len(set(names)) == len(names))
