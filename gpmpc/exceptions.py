"""The two roads of failure, first half: misuse raises, with the rule that was broken and what was got instead.

A numerical outcome (a solver that stops early, an infeasible problem) is no exception but a ``gpmpc.status.Status``.
Every error of this package derives from ``GpmpcError``; its text is one line that a user can act on, and it survives
the way back from a worker process (its constructor's arguments are its ``args``).
"""


class GpmpcError(Exception):
    """Any error that gpmpc raises on purpose."""


class ShapeError(GpmpcError, ValueError):
    """An array or tensor has another shape than the rule says."""


class SettingError(GpmpcError, ValueError):
    """A setting is unknown, of the wrong type, or outside its range.

    Attributes:
        key: The name of the setting, as the user writes it.
    """

    def __init__(self, key: str, message: str):
        super().__init__(key, message)
        self.key = key

    def __str__(self) -> str:
        return f"{self.args[0]}: {self.args[1]}"


class DataError(GpmpcError, ValueError):
    """A data file or data set cannot be used; the text names the file, the row and the column."""


class TrainingError(GpmpcError, RuntimeError):
    """Every start of the hyperparameter optimisation failed for at least one output.

    Attributes:
        outputs: Indices of the outputs (from 0) that could not be trained.
    """

    def __init__(self, outputs: list[int], message: str):
        super().__init__(outputs, message)
        self.outputs = outputs

    def __str__(self) -> str:
        return self.args[1]


class ProblemError(GpmpcError, ValueError):
    """An optimisation problem is malformed: shapes, symmetry, definiteness, crossed bounds, NaN."""


class SolverFailure(GpmpcError, RuntimeError):
    """A controller's solver did not succeed where its caller had declared no other policy.

    Attributes:
        step: The time step (from 0).
    """

    def __init__(self, step: int, advice: str):
        super().__init__(step, advice)
        self.step = step

    def __str__(self) -> str:
        return f"the controller's solver failed at step {self.args[0]}: {self.args[1]}"
