"""The programs of one step, solved under the prices of their soft rows.

An elastic row that a program cannot keep gets another price than the exact one, which
later programs of the step keep. ``_elastic`` has the rule.
"""

import math

import numpy as np

from gpmpc.mpc._controller import KEPT, Request
from gpmpc.mpc._elastic import (
    NO_PRICE,
    TRIALS,
    ElasticLimits,
    are_kept_again,
    elastic_limits,
)
from gpmpc.mpc._linear_quadratic import CondensedProgram
from gpmpc.mpc._linearization import LocalProblem, PredictionModel
from gpmpc.mpc._roll_out import cost_when_followed
from gpmpc.mpc._sqp import FAILURES
from gpmpc.mpc._stopwatch import Stopwatch
from gpmpc.qp import DualActiveSet, QPSolution, QPSolver, QuadraticProgram

Array = np.ndarray


class PricedSolver:
    """Solves the programs of one step and finds what their elastic rows are worth.

    Args:
        prediction: Of the controller.
        solver: Of quadratic programs.
        request: Of the decision.
        stopwatch: No price is tried once it is late.
    """

    def __init__(
        self,
        prediction: PredictionModel,
        solver: QPSolver,
        request: Request,
        stopwatch: Stopwatch,
    ):
        self._prediction = prediction
        self._solver = solver
        self._request = request
        self._stopwatch = stopwatch
        self._price_is_due = True  # of elastic rows, by the next program
        self._is_first = True  # whether the next program is the first of the step
        #: prices of the rows of a stage (r,); infinite ones are hard
        self.row_prices = prediction.constraints.prices

    def look_again(self) -> None:
        """Lets the next program price its elastic rows, since a promise was broken.

        A plan has missed them by more than programs under the exact price promised.
        What they are worth is then the safe price.
        """
        self._price_is_due = True

    def solve(
        self,
        program: CondensedProgram,
        local: LocalProblem,
        warm_start: QPSolution | None,
    ) -> QPSolution:
        """Returns the solution of a program; ``row_prices`` are those it is solved at.

        Args:
            program: The program.
            local: The problem that it was condensed from.
            warm_start: Of a program before.
        """
        solution = self._solve_at(program, warm_start, self.row_prices)
        constraints = self._prediction.constraints
        if self._price_is_due and constraints.any_elastic and solution.status.solved:
            self._price_is_due = False
            planned = local.with_solution(program, solution.x, self._request)
            violations = planned.row_violations()
            is_exact = self.row_prices == constraints.prices
            is_missed = violations.max(axis=0) > KEPT
            gives_way = constraints.elastic & is_exact & is_missed
            if gives_way.any():
                solution = self._solve_elastic(
                    program, local, solution, gives_way, violations
                )
        self._is_first = False
        return solution

    def _solve_at(
        self,
        program: CondensedProgram,
        warm_start: QPSolution | None,
        row_prices: Array,
    ) -> QPSolution:
        """Returns the solution of a program, its violations priced by row (r,)."""
        solver = self._solver
        if isinstance(solver, DualActiveSet):
            prices = None
            if self._prediction.constraints.soft:
                # The rows of the states are the last ones; all others are hard.
                prices = np.full(len(program.G), np.inf)
                soft = np.tile(row_prices, self._prediction.horizon)
                prices[len(prices) - len(soft) :] = soft
            problem = QuadraticProgram.unchecked(
                program.P, program.q, program.G, program.lower, program.upper
            )
            return solver.solve(problem, warm_start, prices)
        if warm_start is not None and warm_start.arrays[2].shape != program.G.shape:
            warm_start = None
        problem = QuadraticProgram.from_stacked(
            P=program.P,
            q=program.q,
            G=program.G,
            lower=program.lower,
            upper=program.upper,
        )
        return solver.solve(problem, warm_start)

    def _solve_elastic(
        self,
        program: CondensedProgram,
        local: LocalProblem,
        exact: QPSolution,
        gives_way: Array,
        violations: Array,
    ) -> QPSolution:
        """Returns the solution under the price that elastic rows are worth.

        A plan that goes on along the last one is rolled out, to see what a price costs.
        A first plan, whose guess says little about costs, takes the safe price.

        Args:
            program: The program.
            local: The problem that it was condensed from.
            exact: Its solution under the exact prices.
            gives_way: The elastic rows that this solution misses (r,).
            violations: By how much it misses all rows (H, r).
        """
        request = self._request
        free = self._solve_at(program, exact, self._lowered(gives_way, NO_PRICE))
        if not free.status.solved:
            return exact
        free_problem = local.with_solution(program, free.x, request)
        limits = elastic_limits(
            free_problem,
            free_cost=float(free_problem.stage_costs(request.references).sum()),
            guess_cost=float(local.stage_costs(request.references).sum()),
            rows=gives_way,
            are_kept_again=are_kept_again(violations[:, gives_way]),
            Q=self._prediction.problem.cost.Q,
            largest_weight=self._prediction.problem.largest_weight,
        )
        if limits.lowest_trial_price >= self._highest_exact_price(gives_way):
            return exact
        is_on_the_way = self._is_first and request.last_plan is not None
        if is_on_the_way and not self._stopwatch.is_late:
            free_cost = self._cost_when_followed(program, local, free)
            if math.isfinite(free_cost + limits.affordable_extra_cost):
                return self._solve_at_highest_price(
                    program, local, exact, gives_way, limits, free_cost
                )
        return self._solve_cheaper(program, exact, gives_way, limits.safe_price)

    def _solve_at_highest_price(
        self,
        program: CondensedProgram,
        local: LocalProblem,
        exact: QPSolution,
        gives_way: Array,
        limits: ElasticLimits,
        free_cost: float,
    ) -> QPSolution:
        """Returns the solution under the highest price whose plan is affordable.

        It is the exact price where that is affordable; else it is found by bisection of
        its logarithm, and is the lowest trial price where no other will do.
        ``free_cost`` is what the plan without the elastic rows costs the model.
        """
        affordable_cost = free_cost + limits.affordable_extra_cost
        if self._cost_when_followed(program, local, exact) <= affordable_cost:
            return exact
        unaffordable_price = self._highest_exact_price(gives_way)
        affordable_price = limits.lowest_trial_price
        best = None
        for _ in range(TRIALS):
            if self._stopwatch.is_late:
                break
            price = math.sqrt(affordable_price * unaffordable_price)
            prices = self._lowered(gives_way, price)
            solution = self._solve_at(program, best or exact, prices)
            cost = self._cost_when_followed(program, local, solution)
            if solution.status.solved and cost <= affordable_cost:
                affordable_price = price
                best = solution
            else:
                unaffordable_price = price
        if best is None:
            return self._solve_cheaper(program, exact, gives_way, affordable_price)
        self.row_prices = self._lowered(gives_way, affordable_price)
        return best

    def _solve_cheaper(
        self,
        program: CondensedProgram,
        exact: QPSolution,
        gives_way: Array,
        price: float,
    ) -> QPSolution:
        """Returns the solution under a lower price, which later programs keep.

        Where that is not solved, the solution under the exact prices stays.
        """
        prices = self._lowered(gives_way, price)
        cheaper = self._solve_at(program, exact, prices)
        if not cheaper.status.solved:
            return exact
        self.row_prices = prices
        return cheaper

    def _lowered(self, gives_way: Array, price: float) -> Array:
        """Returns prices (r,) of which some rows have a lower one than the exact."""
        exact_prices = self._prediction.constraints.prices
        lowered = np.minimum(price, exact_prices)
        return np.where(gives_way, lowered, self.row_prices)

    def _highest_exact_price(self, gives_way: Array) -> float:
        """Returns the highest exact price of some rows."""
        return float(self._prediction.constraints.prices[gives_way].max())

    def _cost_when_followed(
        self, program: CondensedProgram, local: LocalProblem, solution: QPSolution
    ) -> float:
        """Returns what the plan of a solution costs the model, rolled out along it."""
        planned = local.with_solution(program, solution.x, self._request)
        try:
            return cost_when_followed(
                self._prediction, planned, local, program.feedback, self._request
            )
        except FAILURES:
            return math.inf
