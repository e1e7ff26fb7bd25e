"""Sequential quadratic programming for plans whose states need not obey the dynamics yet (multiple shooting).

A program's solution is a step from one plan to the next. One step a control step is taken whole (the real-time
iteration of Diehl, Bock and Schloeder, 2005). Where more are taken, a step is as long as it lowers the exact penalty

    cost + price of violated rows + mu |F(s_k, u_k) - s_{k+1}|_1

(Nocedal and Wright, 2006, section 18.3). Beside each length stands a second candidate: the dynamics rolled out under
the feedback u = u' - K (x - x') towards the plan that the program proposes. It has no defects, and exists where inputs
alone would lead an unstable plant away.

A plan is judged by its relative offset (Bates and Watts, 1981): the Gauss-Newton step in the metric of the cost,
relative to the root of the cost, which is the cosine between the residuals and what a plan can change of them; and by
its defects, relative to the states.
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from gpmpc.mpc.constraints import Rows
from gpmpc.mpc.prediction_model import Prediction
from gpmpc.mpc.stages import Plan
from gpmpc.qp import QPSolution
from gpmpc.status import Status

Array = np.ndarray

FEASIBLE = 1e-3  # hard bounds may be missed by so much, in their units, by a plan that a next step would mend
_SUFFICIENT_DECREASE = 1e-4  # of what the program promised (Armijo)
_SHORTEST_STEP = 2.0**-10
_ROUND_OFF = 1e-8  # share of the cost below which a difference says nothing: posteriors with sf2 >> y^2 lose that much


class Functions(NamedTuple):
    """The functions of one step's problem.

    Attributes:
        linearize: The prediction at a plan.
        roll_out: A plan that obeys the dynamics, near one that a program proposes; None where there is no feedback.
        cost: Of states (H + 1, p) and inputs (H, m).
        curvature: Of a change of both: its cost were the references zero.
        price: Of violated rows, from rows, states and the price per unit of those that are hard.
        multiplier: The largest that a solution has for a row of states.
    """

    linearize: Callable[[Plan], Prediction]
    roll_out: Callable[[Plan, Prediction], Plan] | None
    cost: Callable[[Array, Array], float]
    curvature: Callable[[Array, Array], float]
    price: Callable[[Rows, Array, float], float]
    multiplier: Callable[[QPSolution], float]


class Globalization:
    """Chooses the steps of one problem's iteration, and says where it ends.

    Args:
        functions: Of the problem.
        smallest: Cost of moving an input by a thousandth of its size, below which the cost counts as vanished.
        tolerance: Of relative offset and defects.
        failures: Exceptions of a model that was led out of its numbers by a trial plan.
    """

    def __init__(self, functions: Functions, smallest: float, tolerance: float, failures: tuple[type[Exception], ...]):
        self._of, self._smallest, self._tolerance, self._failures = functions, smallest, tolerance, failures
        self._defect_price = self._row_price = 0.0
        self._size, self._rate = math.inf, 1.0

    def __call__(self, at: Prediction, proposed: Plan, solution: QPSolution) -> tuple[Prediction, Status | None]:
        """The prediction at the next plan, and how the iteration ends: None where it goes on.

        Args:
            at: Where the program was made.
            proposed: The plan of its solution.
            solution: The solution itself.
        """
        of, plan, last_rate = self._of, at.plan, self._rate
        self._row_price = max(self._row_price, 2.0 * of.multiplier(solution))
        curvature = of.curvature(proposed.states - plan.states, proposed.inputs - plan.inputs)
        cost, defects = self._cost(at, at.rows), np.abs(at.stages.next - plan.states[1:])
        defect, reach = float(defects.sum()), max(1.0, float(np.abs(plan.states).max()))
        size = max(math.sqrt(curvature / (cost + self._smallest)), float(defects.max()) / reach)
        self._size, self._rate = size, size / self._size if math.isfinite(self._size) else 1.0
        slower = max(self._rate, last_rate)  # the solution is better than the plan by about the slower of two rates
        if size <= self._tolerance or size * slower <= self._tolerance * (1.0 - slower):
            return at._replace(plan=proposed), Status.SOLVED
        promised = of.cost(proposed.states, proposed.inputs) + of.price(at.rows, proposed.states, self._row_price)
        slope = promised - curvature - cost
        if slope > 0.0 and defect > 0.0:
            self._defect_price = max(self._defect_price, 3.0 * slope / defect)
        slope, merit = slope - self._defect_price * defect, cost + self._defect_price * defect
        length = 1.0
        while length >= _SHORTEST_STEP:
            bound = merit + _SUFFICIENT_DECREASE * length * min(slope, 0.0) + _ROUND_OFF * abs(merit)
            for trial in self._candidates(at, proposed if length == 1.0 else _between(plan, proposed, length)):
                defect = float(np.abs(trial.stages.next - trial.plan.states[1:]).sum())
                if self._cost(trial, at.rows) + self._defect_price * defect <= bound:
                    return trial, None
            length /= 2.0
        if size**2 <= _ROUND_OFF:  # size^2 of the cost is what could still be gained
            return at._replace(plan=proposed), Status.SOLVED
        return at, Status.NUMERICAL_TROUBLE

    def _cost(self, at: Prediction, rows: Rows) -> float:
        """Cost and price of violated rows of a plan, within the bounds of ``rows``."""
        plan, own = at.plan, rows._replace(E=at.rows.E)
        return self._of.cost(plan.states, plan.inputs) + self._of.price(own, plan.states, self._row_price)

    def _candidates(self, at: Prediction, towards: Plan) -> Iterator[Prediction]:
        for make in (lambda plan, _: plan, self._of.roll_out):
            try:
                if make is not None:
                    yield self._of.linearize(make(towards, at))
            except self._failures:
                continue


def _between(plan: Plan, other: Plan, share: float) -> Plan:
    return Plan(*(a + share * (b - a) for a, b in zip(plan, other, strict=True)))
