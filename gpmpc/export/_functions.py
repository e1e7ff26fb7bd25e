"""Smooth constraints and outputs of the cost as C."""

from typing import Any

from gpmpc.exceptions import SettingError
from gpmpc.export._text import Numbers
from gpmpc.mpc import GPMPC


class FunctionWriter:
    """Writes the functions that a controller linearises along its plans.

    Attributes:
        parameters: How many parameters they take, q.
        text: All that was written.
    """

    def __init__(self, controller: GPMPC, numbers: Numbers):
        self._numbers = numbers
        self.parameters = 0
        self.text = ""
        problem: Any = controller.problem
        if controller.prediction.constraints.smooth:
            rule = "an exported constraint is a Box or Halfspaces"
            raise SettingError("constraints", f"{rule}; got Inequality")
        if problem.outputs:
            rule = "an exported cost has none"
            raise SettingError("outputs", f"{rule}; got {len(problem.outputs)}")
