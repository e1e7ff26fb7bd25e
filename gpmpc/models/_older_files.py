"""What only older files of models hold, and how it is read.

No writer makes any of this. Models of gpmpc 1 (``.npz``) are read by ``gpmpc.gp``.
"""

from collections.abc import Mapping
from typing import Any

from gpmpc.models._casadi_function import CasadiFunction
from gpmpc.models._stored_values import texts
from gpmpc.signals import Signals

#: the kind of a function in CasADi that a file names by what makes it
CASADI_BY_NAME = "casadi"
#: the nominal model of a log that is zero, an ``AffineNominal`` that is not fitted
STILL = "Still"


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
