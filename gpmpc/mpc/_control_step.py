"""The control step: from the problem at a first guess to a decision.

A round solves the quadratic program of the problem at a plan and takes its step, which
leads to the next plan. ``ControlStep.run`` is the loop.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from time import perf_counter
from typing import NamedTuple

import numpy as np

from gpmpc.mpc._condense import condense, condense_with_feedback
from gpmpc.mpc._controller import FEASIBLE, KEPT, Decision, Request, Timing
from gpmpc.mpc._cost import FunctionNotFinite
from gpmpc.mpc._linear_quadratic import CondensedProgram, Plan
from gpmpc.mpc._linearization import LocalProblem, PredictionModel
from gpmpc.mpc._novelty import DataScales, novelty_of, novelty_when_read
from gpmpc.mpc._priced_solver import PricedSolver
from gpmpc.mpc._roll_out import MISS_RATIO, close_defects
from gpmpc.mpc._sqp import FAILURES, Globalization, Iterate, measure_continuity
from gpmpc.qp import QPSolution, QPSolver, QuadraticProgram
from gpmpc.status import Status

_loads_rare_kernels = ContextVar("_loads_rare_kernels", default=False)


@contextmanager
def rare_kernels_loaded() -> Iterator[None]:
    """Lets decisions inside load the kernels, too, that few programs need.

    Else the first decision of an unstable plan waits for them, ten seconds or more
    where they are not compiled yet.
    """
    before = _loads_rare_kernels.set(True)
    try:
        yield
    finally:
        _loads_rare_kernels.reset(before)


Array = np.ndarray


class Stopwatch:
    """Sums the wall time of the parts of a decision.

    Args:
        budget: Of all of it [s]; None for no limit.
        seconds_before: What it took before the stopwatch was started [s].
    """

    def __init__(self, budget: float | None = None, seconds_before: float = 0.0):
        self._budget = budget
        self._last = perf_counter() - seconds_before
        self._start = self._last
        self._seconds = {"model": 0.0, "build": 0.0, "solve": 0.0}

    def lap(self, part: str) -> None:
        """Adds the time since the last lap to a part."""
        now = perf_counter()
        self._seconds[part] += now - self._last
        self._last = now

    def is_late(self) -> bool:
        """Whether the budget is spent."""
        if self._budget is None:
            return False
        return perf_counter() - self._start > self._budget

    @property
    def timing(self) -> Timing:
        """The sums so far."""
        seconds = self._seconds
        return Timing(
            model=seconds["model"], build=seconds["build"], solve=seconds["solve"]
        )


class StepSettings(NamedTuple):
    """What a controller's steps have in common."""

    prediction: PredictionModel
    solver: QPSolver
    tolerance: float  #: of more than one program
    #: whether a step takes as many programs as it needs, the user having set no number
    number_is_open: bool
    data_scales: DataScales | None  #: what novelty is measured by


class _Ending(NamedTuple):
    """What a round led to: its plan is the last one where the next round fails."""

    problem: LocalProblem  # with the plan
    program: CondensedProgram
    solution: QPSolution


class ControlStep:
    """One decision's programs, from a first guess to a plan that is good enough.

    Args:
        settings: Of the controller.
        request: Of the decision.
        stopwatch: Of the decision, with its budget.
        most_programs: That may be solved.
    """

    def __init__(
        self,
        settings: StepSettings,
        request: Request,
        stopwatch: Stopwatch,
        most_programs: int,
    ):
        self._settings = settings
        self._prediction = settings.prediction
        self._request = request
        self._stopwatch = stopwatch
        self._most_programs = most_programs
        self._programs = 0  # solved so far
        self._solver = PricedSolver(
            prediction=self._prediction,
            solver=settings.solver,
            request=request,
            is_late=stopwatch.is_late,
        )
        self._globalization: Globalization | None = None
        self._squared_lengths: list[float] = []  # of the programs' steps
        self._ending: _Ending | None = None  # of the rounds before
        self._warm_start: QPSolution | None = None
        if request.last_plan is not None:
            self._warm_start = request.last_plan.solution

    def run(self, local: LocalProblem) -> Decision:
        """Returns the decision that programs lead to from the problem at a guess.

        Where a later round leaves the numbers of model or solver, the plan of the round
        before is the last one.
        """
        guess = local.plan
        try:
            return self._run_rounds(local, guess)
        except FAILURES as error:
            if self._ending is None:
                raise
            problem, program, solution = self._ending
            last_problem = self._close_defects(problem, problem, program)
            return self._conclude(last_problem, guess, solution, status_of(error))

    def _run_rounds(self, local: LocalProblem, guess: Plan) -> Decision:
        """Returns the decision of ``run``.

        Each round solves the program of ``local`` and takes its step, which leads to
        the next ``local``. The last round is the one whose program fails, whose step
        says so by a status, or behind which a limit allows no other. Its plan is rolled
        out where it may not obey the dynamics. Where that misses a bound by more than
        the program promised, one more round starts at the plan that was rolled out.
        """
        while True:
            self._stopwatch.lap("model")
            program = self._condense(local)
            self._stopwatch.lap("build")
            solution = self._solve(program, local)
            self._stopwatch.lap("solve")
            if not _solution_is_usable(program, solution, local.plan):
                # The plan of the round before is the last one.
                has_left_guess = local.plan is not guess
                if has_left_guess:
                    local = self._close_defects(local, local, program)
                return self._conclude(local, guess, solution, solution.status)
            iterate = self._take_step(local, program, solution)
            if iterate.status is None and self._may_go_on:
                local = iterate.local
                has_left_guess = local.plan is not guess
                if has_left_guess:
                    self._ending = _Ending(local, program, solution)
                continue
            last_problem = self._rolled_out_where_needed(iterate, local, program)
            status = iterate.status
            is_rolled_out = last_problem is not iterate.local
            has_moved = iterate.local is not local  # else a program more says the same
            may_be_mended = is_rolled_out and has_moved
            if may_be_mended and self._breaks_promise(status, last_problem, solution):
                if self._may_go_on:
                    # A bound lies elsewhere than the program saw it.
                    self._ending = _Ending(last_problem, program, solution)
                    plan = last_problem.plan
                    local = self._prediction.linearize(plan, self._request)
                    self._solver.look_again()
                    continue
                if self._takes_plan_back(last_problem):
                    status = None
            if status is None:
                status = self._limit_reached
            return self._conclude(last_problem, guess, solution, status)

    @property
    def _may_go_on(self) -> bool:
        """Whether one more program may be solved."""
        return self._programs < self._most_programs and not self._stopwatch.is_late()

    @property
    def _limit_reached(self) -> Status:
        """The limit that keeps the iteration from one more program."""
        if self._programs < self._most_programs:
            return Status.TIME_LIMIT
        return Status.ITERATION_LIMIT

    def _condense(self, local: LocalProblem) -> CondensedProgram:
        """Returns the quadratic program in the inputs."""
        bounds = self._prediction.program_bounds
        start = local.plan.states[0]
        references = self._request.references
        if _loads_rare_kernels.get():  # its result is not used
            condense_with_feedback.unchecked(
                local.cost, bounds, local.stages, start, references, local.rows
            )
        program = condense(
            cost=local.cost,
            bounds=bounds,
            stages=local.stages,
            start=start,
            references=references,
            rows=local.rows,
        )
        if self._globalization is not None:
            program = self._globalization.correct(program, local)
        return program

    def _solve(self, program: CondensedProgram, local: LocalProblem) -> QPSolution:
        """Returns the solution of a program, warm-started from the last one."""
        prices_before = self._solver.row_prices
        solution = self._solver.solve(program, local, self._warm_start)
        prices = self._solver.row_prices
        if prices is not prices_before and not np.array_equal(prices, prices_before):
            self._globalization = None  # it weighs by the prices before
        self._programs += 1
        self._warm_start = solution
        return solution

    def _take_step(
        self, local: LocalProblem, program: CondensedProgram, solution: QPSolution
    ) -> Iterate:
        """Takes a program's step: whole where that is enough, else globalised."""
        planned = local.with_solution(program, solution.x, self._request)
        if self._most_programs == 1:
            return Iterate(planned, solution.status)
        if self._may_stop_after_one:
            continuity = measure_continuity(
                self._prediction, self._request, local, planned.plan
            )
            if continuity.goes_on:
                # The next decision compares the length of its step with this one.
                self._squared_lengths.append(continuity.squared_length)
                return Iterate(planned, solution.status)
        if self._globalization is None:
            self._globalization = Globalization(
                self._prediction,
                self._request,
                self._settings.tolerance,
                self._solver.row_prices,
            )
        globalization = self._globalization
        iterate = globalization.take_step(local, program, solution, planned.plan)
        self._squared_lengths.append(globalization.squared_length)
        is_solved = iterate.status is Status.SOLVED
        # Where the number of programs is open, the tolerance is loose.
        needs_roll_out = not is_solved or self._settings.number_is_open
        return iterate._replace(needs_roll_out=needs_roll_out)

    @property
    def _may_stop_after_one(self) -> bool:
        """Whether the step may be taken whole, as in the real-time iteration.

        It may be by the first program of a decision that has a last plan to compare
        with, where it starts from another plan that was handed over, too: what counts
        is how far the last decision's step led. Under curved rows first plans may as
        well: a program is judged by the plan it leads to.
        """
        is_first_program = self._programs == 1
        number_is_open = self._settings.number_is_open
        has_last_plan = self._request.last_plan is not None
        is_curved = self._prediction.constraints.smooth
        return is_first_program and number_is_open and (has_last_plan or is_curved)

    def _rolled_out_where_needed(
        self, iterate: Iterate, local: LocalProblem, program: CondensedProgram
    ) -> LocalProblem:
        """Returns the problem of the plan that a step led to, rolled out where needed.

        Args:
            iterate: What the step led to.
            local: The problem that the step started from.
            program: Of that problem.
        """
        if iterate.needs_roll_out or self._prediction.rolls_out:
            return self._close_defects(iterate.local, local, program)
        return iterate.local

    def _close_defects(
        self, ending: LocalProblem, local: LocalProblem, program: CondensedProgram
    ) -> LocalProblem:
        """Returns a problem whose plan obeys the dynamics.

        It is the ending itself where that leads out of the model's numbers.
        """
        try:
            return close_defects(
                self._prediction, ending, local, program.feedback, self._request
            )
        except FAILURES:
            return ending

    def _breaks_promise(
        self, status: Status | None, ending: LocalProblem, solution: QPSolution
    ) -> bool:
        """Returns whether a solved plan misses bounds by more than its program.

        A program sees curved bounds, and the dynamics that lead to any, as they are at
        the plan before.
        """
        if not self._prediction.constraints.per_stage:
            return False
        if status is None or not status.solved:
            return False
        missed = ending.row_violations()
        row_promises = solution.violation()[-missed.size :].reshape(missed.shape)
        promised = row_promises.max(axis=0)
        return bool((missed.max(axis=0) > MISS_RATIO * promised + KEPT).any())

    def _takes_plan_back(self, ending: LocalProblem) -> bool:
        """Returns whether SOLVED becomes a limit, as a plan breaks its promise.

        It stays where a single program was asked for, and where a hard row is missed:
        as unsolved that plan would not be applied, and it is to be, as
        ``HARD_BOUND_MISSED``.
        """
        if self._most_programs == 1:
            return False
        return not self._prediction.misses_hard_rows(ending, FEASIBLE)

    def _violation(self, local: LocalProblem) -> float:
        """Returns by how much a plan misses a bound, at most."""
        last_input = self._request.references.previous_input
        return local.violation(self._prediction.program_bounds, last_input)

    def _conclude(
        self,
        local: LocalProblem,
        guess: Plan,
        solution: QPSolution,
        status: Status,
    ) -> Decision:
        """Returns the decision for a plan: failed if it is the guess or infeasible.

        A guess that was rolled out obeys the dynamics and counts as a plan.
        """
        self._stopwatch.lap("model")
        plan = local.plan
        suboptimal = False
        if not status.solved:
            misses = self._prediction.misses_hard_rows(local, FEASIBLE)
            has_left_guess = plan is not guess
            suboptimal = has_left_guess and not misses
            if not suboptimal:
                return self._failed_decision(solution, status)
        violation = self._violation(local)
        if status is Status.SOLVED:
            status = self._prediction.end_of_solved(local, violation)
            suboptimal = not status.solved
        means, covariances = self._prediction.linearizer.moments(
            plan.states, local.covariances
        )
        stage_costs = local.stage_costs(self._request.references)
        inputs = plan.inputs.copy()
        return Decision(
            input=inputs[0],
            inputs=inputs,
            means=means,
            covariances=covariances,
            status=status,
            iterations=self._programs,
            timing=self._stopwatch.timing,
            problem=QuadraticProgram._make(solution.arrays),
            solution=solution,
            disturbance=self._request.disturbance,
            suboptimal=suboptimal,
            plan_novelty=self._novelty(local, means, inputs, covariances),
            stage_costs=stage_costs,
            violation=violation,
            steps=tuple(self._squared_lengths),
        )

    def _failed_decision(self, solution: QPSolution, status: Status) -> Decision:
        """Returns the decision of a step that found no plan to apply."""
        failed = self._request.failed_decision(
            status, self._programs, self._stopwatch.timing
        )
        problem = QuadraticProgram._make(solution.arrays)
        return replace(failed, problem=problem, solution=solution)

    def _novelty(
        self, local: LocalProblem, means: Array, inputs: Array, covariances: Array
    ) -> float | Callable[[], float]:
        """Returns how far a plan is from the data.

        Where its stages hold no variances, it is to be measured when it is read.
        """
        scales = self._settings.data_scales
        if scales is None:
            return math.nan
        linearizer = self._prediction.linearizer
        if linearizer.covariance == "zero_order":
            V = local.stages.V
            return novelty_of(V, linearizer.noise, covariances, scales)
        model = self._prediction.model
        return novelty_when_read(model, means, inputs, covariances, scales)


def status_of(error: Exception) -> Status:
    """Returns how a decision ends whose numbers were not finite."""
    if isinstance(error, FunctionNotFinite):
        return Status.FUNCTION_NOT_FINITE
    return Status.NUMERICAL_TROUBLE


def _solution_is_usable(
    program: CondensedProgram, solution: QPSolution, plan: Plan
) -> bool:
    """Returns whether a solution leads to a plan that is no worse.

    It does where it was solved, or where the solver stopped at a limit at a feasible
    point that costs no more than the plan. In feedback coordinates the plan has no
    unknowns of its own: there the point is compared with v = 0, the optimum without
    bounds, which costs least, so that it is used only where that breaks a hard row.
    """
    status = solution.status
    if status.solved:
        return True
    at_limit = status in (Status.ITERATION_LIMIT, Status.TIME_LIMIT)
    if not (at_limit and np.isfinite(solution.x).all()):
        return False
    if _hard_violation(solution) > FEASIBLE:
        return False
    unknowns = plan.inputs.ravel()
    if len(program.feedback):
        unknowns = 0.0 * solution.x
    alternative = solution._replace(x=unknowns)
    is_infeasible = _hard_violation(alternative) > FEASIBLE
    return is_infeasible or solution.objective <= alternative.objective


def _hard_violation(solution: QPSolution) -> float:
    """Returns the largest violation of a hard row."""
    hard = np.isinf(solution.caps)
    return float(solution.violation()[hard].max(initial=0.0))
