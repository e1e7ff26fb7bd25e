"""Controllers as C: one header and one source that decide as Python does.

``export_c`` writes the code, ``write_replay`` what it is checked with, and
``choose_points`` finds how many training points a chip holds. ``CompiledController``
and ``CompiledLoop`` compile the code and call it from Python.
"""

from gpmpc.export._binding import CompiledController, CompiledLoop, compiled_controller
from gpmpc.export._chip import Footprint, measure_footprint
from gpmpc.export._choice import Budget, PointChoice, PointRow, choose_points
from gpmpc.export._filter import Estimator
from gpmpc.export._points import with_points
from gpmpc.export._replay import Answer, Question, answers, write_replay
from gpmpc.export._write import Export, export_c

__all__ = [
    "Answer",
    "Budget",
    "CompiledController",
    "CompiledLoop",
    "Estimator",
    "Export",
    "Footprint",
    "PointChoice",
    "PointRow",
    "Question",
    "answers",
    "choose_points",
    "compiled_controller",
    "export_c",
    "measure_footprint",
    "with_points",
    "write_replay",
]
