"""Judges a flight before it begins: its stability, and how far its data reach."""

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from gpmpc._dynamics import DynamicsModel
from gpmpc.exceptions import GpmpcError
from gpmpc.mpc import GPMPC, Reference, beyond_data
from gpmpc.mpc._sqp import LINEAR_ALGEBRA_FAILURES


@dataclass(frozen=True)
class Outlook:
    """What was known of a flight before it."""

    #: ``Stability``'s; None where not judged
    spectral_radius: float | None = None
    #: ``Stability``'s; None where not judged
    shortest_horizon: int | None = None
    #: what may go wrong and what to do, a line each
    warnings: tuple[str, ...] = ()


def outlook(
    controller: Any, model: DynamicsModel | None, reference: Reference
) -> Outlook:
    """Returns what is known of a flight along a reference before it begins.

    Args:
        controller: Of the flight.
        model: The one learned for it; None where the controller knows the plant.
        reference: Of all steps.
    """
    far_from_data: list[str] = []
    if model is not None:
        far_from_data = [str(warning) for warning in beyond_data(model, reference)]
    stability = None
    controller = getattr(controller, "source", controller)  # of compiled code
    if isinstance(controller, GPMPC):
        # What cannot be judged, such as outputs of parameters, is no reason not to fly.
        with suppress(GpmpcError, *LINEAR_ALGEBRA_FAILURES):
            stability = controller.stability(reference)
    if stability is None:
        return Outlook(warnings=tuple(far_from_data))
    radius = stability.spectral_radius
    return Outlook(
        spectral_radius=radius if math.isfinite(radius) else None,
        shortest_horizon=stability.shortest_horizon,
        warnings=(*stability.warnings, *far_from_data),
    )
