"""The programs of one step, solved under the prices of their soft rows.

An elastic row that a program cannot keep gets another price than the exact one, which
later programs of the step keep: but for a first plan's, where they can keep the row.
``_elastic`` has the rule.
"""

import math
from collections.abc import Callable

import numpy as np

from gpmpc.mpc._controller import Request
from gpmpc.mpc._elastic import (
    NO_PRICE,
    TRIALS,
    ElasticLimits,
    ElasticRows,
    elastic_limits,
    elastic_rows,
)
from gpmpc.mpc._linear_quadratic import CondensedProgram
from gpmpc.mpc._linearization import LocalProblem, PredictionModel
from gpmpc.mpc._roll_out import cost_when_followed
from gpmpc.mpc._sqp import FAILURES
from gpmpc.qp import DualActiveSet, QPSolution, QPSolver, QuadraticProgram

Array = np.ndarray


class PricedSolver:
    """Solves the programs of one step and finds what their elastic rows are worth.

    Args:
        prediction: Of the controller.
        solver: Of quadratic programs.
        request: Of the decision.
        is_late: Says whether the budget is spent: then no further price is tried.
    """

    def __init__(
        self,
        prediction: PredictionModel,
        solver: QPSolver,
        request: Request,
        is_late: Callable[[], bool],
    ):
        self._prediction = prediction
        self._solver = solver
        self._request = request
        self._is_late = is_late
        self._price_is_due = True  # of elastic rows, by the next program
        # Whether the next program is the first of the step, the only one whose prices
        # are searched by roll-outs.
        self._is_first = True
        constraints = prediction.constraints
        #: prices of the rows of a stage (r,); infinite ones are hard
        self.row_prices = constraints.prices
        # Rows that may get their exact price back, once a step (r,). Along the last
        # plan none may: there the price was found by rolling the model out.
        self._may_be_restored = constraints.elastic
        if constraints.any_elastic and request.continues_last_plan:
            self._may_be_restored = np.zeros_like(constraints.elastic)

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
            is_exact = self.row_prices == constraints.prices
            rows = elastic_rows(
                planned.row_violations(),
                planned.row_lengths(),
                may_give_way=constraints.elastic & is_exact,
            )
            if rows.gives_way.any():
                solution = self._solve_elastic(program, local, solution, rows)
        elif self._has_lowered_prices and solution.status.solved:
            solution = self._restore_prices(program, local, solution)
        self._is_first = False
        return solution

    @property
    def _has_lowered_prices(self) -> bool:
        """Whether a row that is not at its exact price may get it back."""
        exact_prices = self._prediction.constraints.prices
        if self.row_prices is exact_prices:
            return False  # as in nearly every step, and quick
        is_lowered = self.row_prices < exact_prices
        return bool((is_lowered & self._may_be_restored).any())

    def _restore_prices(
        self, program: CondensedProgram, local: LocalProblem, solution: QPSolution
    ) -> QPSolution:
        """Returns the solution with exact prices of rows that these do keep.

        A later program may keep what the first one, linearised along a mere guess,
        could not.
        """
        if self._is_late():
            return solution
        exact_prices = self._prediction.constraints.prices
        is_lowered = self._may_be_restored & (self.row_prices < exact_prices)
        prices = np.where(is_lowered, exact_prices, self.row_prices)
        exact_solution = self._solve_at(program, solution, prices)
        if not exact_solution.status.solved:
            return solution
        planned = local.with_solution(program, exact_solution.x, self._request)
        rows = elastic_rows(
            planned.row_violations(), planned.row_lengths(), may_give_way=is_lowered
        )
        is_kept = is_lowered & ~rows.gives_way
        if not is_kept.any():
            return solution
        restored_prices = np.where(is_kept, exact_prices, self.row_prices)
        if rows.gives_way.any():
            restored = self._solve_at(program, exact_solution, restored_prices)
        else:
            restored = exact_solution
        if not restored.status.solved:
            return solution
        self._may_be_restored = self._may_be_restored & ~is_kept
        self.row_prices = restored_prices
        return restored

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
        exact_solution: QPSolution,
        rows: ElasticRows,
    ) -> QPSolution:
        """Returns the solution under the price that elastic rows are worth.

        A plan that goes on along the last one is rolled out, to see what a price costs.
        A first plan, whose guess says little about costs, takes the safe price.

        Args:
            program: The program.
            local: The problem that it was condensed from.
            exact_solution: Its solution under the exact prices.
            rows: The elastic rows that this solution misses.
        """
        request = self._request
        prediction = self._prediction
        exact_prices = prediction.constraints.prices
        no_prices = np.where(rows.gives_way, NO_PRICE * exact_prices, self.row_prices)
        free_solution = self._solve_at(program, exact_solution, no_prices)
        if not free_solution.status.solved:
            return exact_solution
        free = local.with_solution(program, free_solution.x, request)
        limits = elastic_limits(
            free,
            programmed_free_cost=float(free.stage_costs(request.references).sum()),
            guess_cost=float(local.stage_costs(request.references).sum()),
            rows=rows,
            exact_prices=exact_prices,
            Q=prediction.problem.cost.Q,
            largest_weight=prediction.problem.largest_weight,
        )
        if limits.lowest_trial_price >= limits.exact_price:
            return exact_solution
        is_on_the_way = self._is_first and request.continues_last_plan
        if is_on_the_way and not self._is_late():
            followed_free_cost = self._cost_when_followed(program, local, free_solution)
            affordable_cost = followed_free_cost + limits.affordable_extra_cost
            if math.isfinite(affordable_cost):
                return self._solve_at_highest_price(
                    program, local, exact_solution, rows, limits, affordable_cost
                )
        return self._solve_cheaper(program, exact_solution, rows, limits.safe_price)

    def _solve_at_highest_price(
        self,
        program: CondensedProgram,
        local: LocalProblem,
        exact_solution: QPSolution,
        rows: ElasticRows,
        limits: ElasticLimits,
        affordable_cost: float,
    ) -> QPSolution:
        """Returns the solution under the highest price whose plan is affordable.

        It is the exact price where that is affordable; else it is found by bisection of
        its logarithm, and is the lowest trial price where no other will do. Where there
        is no time to look for it, it is the safe price. ``affordable_cost`` is what a
        plan may cost the model.
        """
        if self._cost_when_followed(program, local, exact_solution) <= affordable_cost:
            return exact_solution
        unaffordable_price = limits.exact_price
        affordable_price = limits.lowest_trial_price
        best = None
        for _ in range(TRIALS):
            if self._is_late():
                break
            price = math.sqrt(affordable_price * unaffordable_price)
            trial_prices = self._lowered(rows, price)
            solution = self._solve_at(program, best or exact_solution, trial_prices)
            cost = self._cost_when_followed(program, local, solution)
            if solution.status.solved and cost <= affordable_cost:
                affordable_price = price
                best = solution
            else:
                unaffordable_price = price
        if best is not None:
            self.row_prices = self._lowered(rows, affordable_price)
            return best
        price = limits.lowest_trial_price
        if self._is_late():
            price = limits.safe_price
        return self._solve_cheaper(program, exact_solution, rows, price)

    def _solve_cheaper(
        self,
        program: CondensedProgram,
        exact_solution: QPSolution,
        rows: ElasticRows,
        price: float,
    ) -> QPSolution:
        """Returns the solution under a lower price, which later programs keep.

        Where that is not solved, the solution under the exact prices stays.
        """
        prices = self._lowered(rows, price)
        cheaper = self._solve_at(program, exact_solution, prices)
        if not cheaper.status.solved:
            return exact_solution
        self.row_prices = prices
        return cheaper

    def _lowered(self, rows: ElasticRows, price: float) -> Array:
        """Returns prices (r,), those of rows that give way by a price of distances."""
        exact_prices = self._prediction.constraints.prices
        lowered = np.minimum(price / rows.lengths, exact_prices)
        return np.where(rows.gives_way, lowered, self.row_prices)

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
