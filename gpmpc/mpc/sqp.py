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
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from gpmpc.compiled import compiled
from gpmpc.mpc.constraints import Rows
from gpmpc.mpc.prediction import Prediction
from gpmpc.mpc.stages import Plan
from gpmpc.qp import QPSolution
from gpmpc.status import Status

Array = np.ndarray

FEASIBLE = 1e-3  # hard bounds may be missed by so much, in their units, by a plan that a next step would mend
_SUFFICIENT_DECREASE = 1e-4  # of what the program promised (Armijo)
_SHORTEST_STEP = 2.0**-10
_NOISE = 1e-10  # the square of an offset that a model with that round-off need not get below
_MEMORY = 10  # pairs of a corrected Hessian
_NEAR = 0.2  # relative offset from which pairs are kept: those from far away mislead
_CREEP = 0.25  # ratio of two offsets above which the Hessian is corrected
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
        costates: Multipliers of the dynamics (H, p): of a prediction, a proposed plan, and the solution behind it.
    """

    linearize: Callable[[Plan], Prediction]
    roll_out: Callable[[Plan, Prediction], Plan] | None
    cost: Callable[[Array, Array], float]
    curvature: Callable[[Array, Array], float]
    price: Callable[[Rows, Array, float], float]
    multiplier: Callable[[QPSolution], float]
    costates: Callable[[Prediction, Plan, QPSolution], Array]


class FullStep:
    """Takes one program's solution as it is: the real-time iteration."""

    def correct(self, program: tuple[Array, ...], _: Plan) -> tuple[Array, ...]:
        """The program itself."""
        return program

    def __call__(self, at: Prediction, proposed: Plan, solution: QPSolution) -> tuple[Prediction, Status]:
        """The prediction with the proposed plan, which is the last one."""
        return at._replace(plan=proposed), solution.status


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
        self._defect_price, self._row_price = 0.0, 0.0
        self._size, self._rate, self._creeps = math.inf, 1.0, False
        self._pairs: deque[tuple[Array, Array]] = deque(maxlen=_MEMORY)
        self._last: tuple[Array, ...] | None = None  # inputs, gradient and multipliers of the last program

    def correct(self, program: tuple[Array, ...], plan: Plan) -> tuple[Array, ...]:
        """A program with the curvature of the Lagrangian that Gauss-Newton misses, where the iteration creeps.

        Damped BFGS updates (Nocedal and Wright, 2006, procedure 18.2) by the last steps and changes of the gradient.

        Args:
            program: P, q, G and the bounds, in the inputs.
            plan: Where it was made.
        """
        P, q, G, *bounds = program
        inputs = plan.inputs.ravel()
        slope = P @ inputs + q
        if self._last is not None:
            before, gradient, z = self._last
            if self._size < _NEAR and np.any(inputs != before):
                self._pairs.append((inputs - before, slope + G.T @ z - gradient))
        self._last = inputs, slope, G
        if not (self._pairs and self._creeps):
            return program
        P = P.copy()
        for step, change in self._pairs:
            _update(P, step, change)
        return P, slope - P @ inputs, G, *bounds

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
        reach = max(1.0, float(np.abs(plan.states).max()))
        size = max(math.sqrt(curvature / (cost + self._smallest)), float(defects.max()) / reach)
        self._size, self._rate = size, size / self._size if math.isfinite(self._size) else 1.0
        self._creeps = self._creeps or (self._rate > _CREEP and size < _NEAR)
        if self._last is not None:
            _, slope, G = self._last
            self._last = plan.inputs.ravel(), slope + G.T @ solution.z, solution.z
        slower = max(self._rate, last_rate)  # the solution is better than the plan by about the slower of two rates
        settled = self._rate >= 1.0 and size**2 <= _NOISE  # and what is left is round-off of the model
        if settled or size <= self._tolerance or size * slower <= self._tolerance * (1.0 - slower):
            return at._replace(plan=proposed), Status.SOLVED
        promised = of.cost(proposed.states, proposed.inputs) + of.price(at.rows, proposed.states, self._row_price)
        costates = np.abs(of.costates(at, proposed, solution)).max(axis=0)
        self._defect_price = np.maximum(self._defect_price, 1.5 * costates)
        merit = cost + float(defects.sum(axis=0) @ self._defect_price)
        slope = promised - curvature - merit
        length = 1.0
        while length >= _SHORTEST_STEP:
            bound = merit + _SUFFICIENT_DECREASE * length * min(slope, 0.0) + _ROUND_OFF * abs(merit)
            for trial in self._candidates(at, proposed if length == 1.0 else _between(plan, proposed, length)):
                defects = np.abs(trial.stages.next - trial.plan.states[1:]).sum(axis=0)
                if self._cost(trial, at.rows) + float(defects @ self._defect_price) <= bound:
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


@compiled
def _update(P, step, change):
    """Updates P so that P step = change, damped so that it stays positive definite (Powell, 1978)."""
    n = len(P)
    moved = np.zeros(n)
    curvature = found = 0.0
    for i in range(n):
        for j in range(n):
            moved[i] += P[i, j] * step[j]
        curvature += step[i] * moved[i]
        found += step[i] * change[i]
    share = 1.0
    if found < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - found)
        found = 0.2 * curvature
    for i in range(n):
        a = (share * change[i] + (1.0 - share) * moved[i]) / found
        for j in range(n):
            P[i, j] += a * (share * change[j] + (1.0 - share) * moved[j]) - moved[i] * moved[j] / curvature


def _between(plan: Plan, other: Plan, share: float) -> Plan:
    return Plan(*(a + share * (b - a) for a, b in zip(plan, other, strict=True)))
