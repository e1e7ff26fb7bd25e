"""A nominal model whose outputs come from several, such as physics and a regression."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError
from gpmpc.models._parametric import (
    ParametricNominal,
    feedback_outputs,
    sees_inputs,
)


@dataclass(frozen=True)
class GroupedNominal:
    """Outputs some of which are those of one nominal model, some those of another.

    Raises:
        SettingError: The parts do not belong together.
    """

    parts: tuple[ParametricNominal, ...]  #: the nominal models
    outputs_of: tuple[tuple[int, ...], ...]  #: indices of the outputs of each part
    sizes: tuple[int, ...]  #: number of the parameters of each part

    def __post_init__(self) -> None:
        if not len(self.parts) == len(self.outputs_of) == len(self.sizes):
            raise SettingError("parts", "must have outputs and a size each")
        indices = [i for outputs in self.outputs_of for i in outputs]
        if sorted(indices) != list(range(len(indices))):
            raise SettingError(
                "outputs_of", f"must name every output once; got {self.outputs_of}"
            )

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters; empty where those of a part have none."""
        names: list[str] = []
        for part, size in zip(self.parts, self.sizes, strict=True):
            if part.parameter_names:
                names += part.parameter_names
            else:
                names += [""] * size
        return tuple(names)

    @property
    def start(self) -> Array:
        """Parameters at which a fit begins (P,); zero for those without a name."""
        starts = []
        for part, size in zip(self.parts, self.sizes, strict=True):
            starts.append(part.start if len(part.start) == size else np.zeros(size))
        return np.concatenate(starts)

    @property
    def sees_inputs(self) -> bool:
        """Whether the outputs of any part are functions of the inputs."""
        return any(map(sees_inputs, self.parts))

    @property
    def feedback_outputs(self) -> tuple[int, ...]:
        """Indices of the outputs that hold the feedback of the controller that flew."""
        indices: list[int] = []
        for part, outputs in zip(self.parts, self.outputs_of, strict=True):
            indices += set(outputs) & set(feedback_outputs(part))
        return tuple(sorted(indices))

    def outputs(
        self, theta: Any, states: Array, inputs: Array, context: Array
    ) -> Array:
        """Computes the outputs (..., o)."""
        first = 0
        columns: dict[int, Array] = {}
        for part, outputs, size in zip(
            self.parts, self.outputs_of, self.sizes, strict=True
        ):
            values = part.outputs(theta[first : first + size], states, inputs, context)
            columns |= {i: values[..., i] for i in outputs}
            first += size
        ordered = [columns[i] for i in sorted(columns)]
        return np.stack(np.broadcast_arrays(*ordered), axis=-1)
