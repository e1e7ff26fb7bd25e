"""How a numerical method ended, with advice on what to try.

A solver that stops without a solution has not been misused: it reports a ``Status``,
and its caller's declared policy acts on it. Misuse raises an error of
``gpmpc.exceptions``.
"""

from enum import Enum


class Status(Enum):
    """How a solve ended; the value is the advice to the user."""

    #: whether the residuals of the solution meet the tolerance
    solved: bool

    SOLVED = "solved to the requested tolerance"
    INFEASIBLE = (
        "no point satisfies the constraints: soften state constraints, "
        "or loosen the bounds"
    )
    ITERATION_LIMIT = (
        "stopped at the iteration limit: raise the limit, "
        "or check the scaling of the problem"
    )
    TIME_LIMIT = (
        "stopped at the time limit: raise the limit, shorten the horizon, or warm-start"
    )
    NUMERICAL_TROUBLE = (
        "the residuals could not be brought to the tolerance: "
        "check the scaling of the problem"
    )
    INVALID_MEASUREMENT = (
        "the state is not finite: check the estimator; the last plan can bridge a gap "
        "(or parameters of the controller are not finite)"
    )
    FUNCTION_NOT_FINITE = (
        "a constraint or output, or its gradient, is not finite along the plan: "
        "check it at its start"
    )
    SOFT_BOUND_MISSED = (
        "solved, but no plan near this one keeps a soft bound: loosen it, "
        "or see how far it is missed"
    )
    STALLED = (
        "no step lowers the cost any more, short of the tolerance: "
        "the plan is the best there was; loosen it"
    )
    HARD_BOUND_MISSED = (
        "the program keeps a hard bound, and the plan that the model makes of it "
        "does not: take more programs a step, or soften the bound"
    )

    def __init__(self, _: str) -> None:
        self.solved = self.name in ("SOLVED", "SOFT_BOUND_MISSED")

    @property
    def advice(self) -> str:
        """Text on what the outcome means and what to try next."""
        return self.value
