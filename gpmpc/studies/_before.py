"""What can be said of a flight before it begins: whether its loop settles, and whether its data reach its reference."""

import math
from dataclasses import dataclass
from typing import Any

from gpmpc._dynamics import DynamicsModel
from gpmpc.mpc import GPMPC, Reference, beyond_data


@dataclass(frozen=True)
class Outlook:
    """What was known of a flight before it."""

    spectral_radius: float | None = None  #: ``Stability``'s; None where not judged
    shortest_horizon: int | None = None  #: likewise
    warnings: tuple[str, ...] = ()  #: what may go wrong and what to do, a line each


def outlook(
    controller: Any, model: DynamicsModel | None, reference: Reference
) -> Outlook:
    """Returns what is known of a flight along a reference before it begins.

    Args:
        controller: Of the flight.
        model: That was learned for it; None where the controller knows the plant.
        reference: Of all steps.
    """
    warnings: list[str] = []
    if model is not None:
        warnings += map(str, beyond_data(model, reference))
    if not isinstance(controller, GPMPC):
        return Outlook(warnings=tuple(warnings))
    stability = controller.stability(reference)
    radius = stability.spectral_radius
    return Outlook(
        spectral_radius=radius if math.isfinite(radius) else None,
        shortest_horizon=stability.shortest_horizon,
        warnings=(*stability.warnings, *warnings),
    )
