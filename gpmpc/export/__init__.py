"""Controllers as C: one header and one source that decide as Python does."""

from gpmpc.export._binding import CompiledController, CompiledLoop, compiled_controller
from gpmpc.export._filter import Estimator
from gpmpc.export._replay import Answer, Question, answers, write_replay
from gpmpc.export._write import Export, export_c

__all__ = [
    "Answer",
    "CompiledController",
    "CompiledLoop",
    "Estimator",
    "Export",
    "Question",
    "answers",
    "compiled_controller",
    "export_c",
    "write_replay",
]
