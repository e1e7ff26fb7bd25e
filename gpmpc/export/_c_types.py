"""The structs of the exported header, as far as Python reads and writes them."""

import ctypes
from typing import Any

from gpmpc.mpc import GPMPC


def fields_type(
    controller: GPMPC, number: Any, filters: bool
) -> type[ctypes.Structure]:
    """Returns the type of what ``gpmpc_controller`` begins with (``core.h``).

    Args:
        controller: Which was exported.
        number: The type of a number.
        filters: Whether it was exported with a filter.
    """
    n = controller.prediction.state_dim
    m = controller.prediction.input_dim
    H = controller.horizon
    rates = H * m if controller.problem.input_rates.finite else 0
    rows = H * m + rates + H * controller.prediction.constraints.per_stage
    constraints = H * m + rows

    class Solution(ctypes.Structure):
        _fields_ = (
            ("status", ctypes.c_int),
            ("iterations", ctypes.c_int),
            ("rows", ctypes.c_int),
            ("working", ctypes.c_int),
            ("label", ctypes.c_int * constraints),
            ("multiplier", number * constraints),
            ("x", number * (H * m)),
            ("x_low", number * (H * m)),
            ("violation", number),
        )

    belief = (("mean", number * n), ("covariance", (number * n) * n))

    class Fields(ctypes.Structure):
        _fields_ = (
            ("has_input", ctypes.c_int),
            ("has_plan", ctypes.c_int),
            ("policy_steps", ctypes.c_int),
            ("input", number * m),
            ("means", (number * n) * (H + 1)),
            ("inputs", (number * m) * H),
            ("disturbance", number * n),
            ("solution", Solution),
            ("status", ctypes.c_int),
            ("failed", ctypes.c_int),
            ("violation", number),
            ("estimate", number * n),
            *(belief if filters else ()),
        )

    return Fields


def reference_type(
    controller: GPMPC, number: Any, parameters: int
) -> type[ctypes.Structure]:
    """Returns the type ``gpmpc_reference`` (``core.h``)."""
    n = controller.prediction.state_dim
    m = controller.prediction.input_dim
    H = controller.horizon

    class ReferenceFields(ctypes.Structure):
        _fields_ = (
            ("states", (number * n) * (H + 1)),
            ("inputs", (number * m) * H),
            ("has_inputs", ctypes.c_int),
            ("parameters", (number * max(1, parameters)) * H),
        )

    return ReferenceFields
