"""Problem: one quadratic program is a step towards the optimal plan; a sequence of them reaches it.

Sequential quadratic programming (Nocedal and Wright, 2006, chapter 18): linearise along the plan, solve the program, go
as far towards its solution as the true cost falls, and again, until the plan is a KKT point. The step length is found
by backtracking on the cost along the true rollout, with an exact penalty for the state bounds, and the Gauss-Newton
Hessian is corrected for what the Lagrangian's slope did over the last steps.

Between the model's and the solver's arithmetic stands little, on few numbers; in Python it would cost more than both,
and most of it where other work has emptied the caches between two control steps. So the sequence is one compiled loop.
What it cannot compute it asks for, by yielding ``MODEL`` or ``PROGRAM``, and goes on when its caller has answered: the
stages along a plan, where no compiled rollout gives them, and the solution of a program, where the solver is not
``DualActiveSet`` or ended otherwise than well.
"""

import math
from time import perf_counter
from typing import NamedTuple

import numpy as np

from gpmpc.compiled import borrowing, clock, compiled, direct
from gpmpc.control.chance_constraints import ChanceConstraints, tighten, violation_price
from gpmpc.control.compiled_rollout import NO_MODEL, NOTHING, Stages, roll_out
from gpmpc.control.condensing import Condenser, condense, respond, tracking_cost
from gpmpc.control.controller import Decision, Timing
from gpmpc.control.convergence import kkt_share
from gpmpc.control.prediction import Predictor
from gpmpc.control.quasi_newton import MEMORY, correct
from gpmpc.control.request import Request
from gpmpc.exceptions import DataError
from gpmpc.qp import DualActiveSet, QPSolution, QPSolver, QuadraticProgram
from gpmpc.qp import record as layout
from gpmpc.qp.dual_kernels import solve_lazy
from gpmpc.qp.soft_rows import SoftRows
from gpmpc.qp.solution import Terms
from gpmpc.status import Status

Array = np.ndarray

MODEL, PROGRAM = 1, 2  # what is asked for
STATUS, COUNT, BUILD, SOLVE, OUTCOME = 0, 1, 2, 3, 4  # places of what became of it
SOLVED, ITERATION_LIMIT, NUMERICAL_TROUBLE = layout.SOLVED, layout.ITERATION_LIMIT, layout.NUMERICAL_TROUBLE
HEADER = layout.HEADER

SUFFICIENT_DECREASE = 1e-4  # of what the program promised (Armijo)
SHORTEST_STEP = 2.0**-12
ROUND_OFF = 1e-8  # share of the cost below which a difference says nothing: posteriors with sf2 >> y^2 lose that much


class Asked(NamedTuple):
    """What the loop takes of a ``Prediction``, with the rows of states and their bounds."""

    stages: Stages
    rows: Array  # (H, r, p) or (1, r, p)
    low: Array  # (H, r)
    high: Array  # (H, r)


class Program(NamedTuple):
    """A quadratic program as its solver takes it, bounds on [U; G U]."""

    P: Array
    q: Array
    G: Array
    lower: Array
    upper: Array


class Reached(NamedTuple):
    """Where a sequence of programs ended.

    Attributes:
        status: ``SOLVED``, the status of a program that could not be solved, ``ITERATION_LIMIT``, or
            ``NUMERICAL_TROUBLE`` where no step lowers the cost any more.
        programs: How many.
        timing: Where the time went.
        program: The last one.
        solution: Of the last one.
        states: s_0 .. s_H under that solution, by the last stage models (H + 1, p).
        covariances: Sigma_0 .. Sigma_H that these were made at (H + 1, n, n).
    """

    status: Status
    programs: int
    timing: Timing
    program: QuadraticProgram
    solution: QPSolution
    states: Array
    covariances: Array


class SequentialPrograms:
    """The sequence of programs of one controller.

    Args:
        predictor: Of the form ``"trajectory"``.
        condenser: Of its problem.
        chance: Of its problem.
        solver: Of the programs.
        soft: Prices of the rows of G.
        limit: Programs at most.
        tolerance: Of ``convergence.kkt_share``, estimated from the slower of the last two rates of convergence.
    """

    def __init__(
        self,
        predictor: Predictor,
        condenser: Condenser,
        chance: ChanceConstraints,
        solver: QPSolver,
        soft: SoftRows | None,
        limit: int,
        tolerance: float,
    ):
        self._predictor, self._chance, self._solver, self._soft = predictor, chance, solver, soft
        H, n, m = predictor.horizon, predictor.problem.state_dim, predictor.problem.input_dim
        r, self._rows = len(chance.known[0]), condenser.rate_rows + predictor.horizon * len(chance.known[0])
        self._shape = H, n, m, r, n * len(predictor.extended(predictor.problem.Q))
        self._ours = isinstance(solver, DualActiveSet)
        owner = solver if self._ours else DualActiveSet()
        self._softness, work = owner.workspace(self._rows, H * m, soft)
        rates = tuple(
            np.ascontiguousarray(side) for side in (predictor.problem.rate_lower, predictor.problem.rate_upper)
        )
        self._known = condenser.known, chance.known, rates, work, (limit, float(tolerance))

    def __call__(self, request: Request, previous: Decision | None, warm: QPSolution | None) -> Reached:
        """Goes from the request's plan to an optimal one.

        Args:
            request: With a finite belief.
            previous: The last decision, whose means the first rollout follows.
            warm: The last solution; None starts from nothing.

        Raises:
            DataError: The first rollout left the finite numbers.
            ProblemError: A program is malformed, numerically.
        """
        began = perf_counter()
        H, n, m, r, p = self._shape
        size, M, predictor = H * m, H * m + self._rows, self._predictor
        follow = predictor.followed(request, previous)
        compiled = predictor.compiled
        plan = request.shifted.copy()
        stages = Stages(np.empty((H, p, p)), np.empty((H, p, m)), np.empty((H, p)), np.zeros((H + 1, n, n)), plan)
        rows = np.empty((H, r, p)) if self._chance.constant is None else self._chance.constant
        asked = Asked(stages, rows, np.empty((H, r)), np.empty((H, r)))
        program = Program(
            np.empty((size, size)), np.empty(size), np.empty((self._rows, size)), np.empty(M), np.empty(M)
        )
        record, states, outcome = np.empty(layout.record_size(size, M)), np.empty((H + 1, p)), np.empty(OUTCOME)
        start = predictor.state(request.state, request.covariance)
        guess = layout.NO_RECORD if warm is None or not self._ours else warm.record
        sequence = _run(
            compiled,
            self._ours,
            predictor.rollout.known if compiled else NO_MODEL,
            self._known,
            (start, request.covariance, request.targets, request.wanted, request.last),
            NOTHING if follow is None else np.ascontiguousarray(follow),
            guess,
            asked,
            program,
            record,
            states,
            outcome,
        )
        solution, first = None, True
        for wish in sequence:
            if wish == MODEL:
                self._linearise(request, asked, follow, first)
                first, follow = False, None
            else:
                solution = self._solve(program, warm if solution is None else solution)
                record[:] = solution.record[: len(record)]
        total, build, solve = perf_counter() - began, float(outcome[BUILD]), float(outcome[SOLVE])
        if self._ours:
            terms, x = Terms(program.P, program.G, self._softness), record[HEADER : HEADER + size]
            solution = QPSolution(x, terms, program.q, program.lower, program.upper, record, 0.0, solve)
        return Reached(
            layout.STATUSES[int(outcome[STATUS])],
            int(outcome[COUNT]),
            Timing(total - build - solve, build, solve),
            QuadraticProgram.unchecked(*program),
            solution,
            states,
            stages.covariances,
        )

    def _linearise(self, request: Request, asked: Asked, follow: Array | None, first: bool) -> None:
        """The stages along a plan, from the model itself."""
        stages = asked.stages
        try:
            found = self._predictor.along(request, stages.inputs, follow)
        except DataError:  # the rollout left the finite numbers; from the second one on a shorter step may not
            if first:
                raise
            stages.c[:] = np.nan
            return
        parts = found.A, found.B, found.c, found.covariances, found.inputs
        for part, place in zip(parts, stages, strict=True):
            place[:] = part
        asked.low[:], asked.high[:] = self._chance.limits(found)
        if self._chance.constant is None:
            asked.rows[:] = self._chance.rows(found)

    def _solve(self, program: Program, warm: QPSolution | None) -> QPSolution:
        if self._ours:
            return self._solver.solve_stacked(*program, warm, self._soft)
        fits = warm is not None and len(warm.q) == len(program.q) and len(warm.lower) == len(program.lower)
        return self._solver.solve(QuadraticProgram.from_stacked(*program), warm if fits else None)


def _run(*arguments):
    """``programs``, without numba's look at the arguments: there are many, of types that never change."""
    global _entry
    if _entry is None:
        programs(*arguments)
        _entry = direct(programs)
    return _entry(*arguments)


_entry = None


@compiled(locked=True)  # its programs share the solver's workspace
def programs(compiled, ours, model, known, question, follow, guess, asked, program, record, states, outcome):
    """The loop, a generator; answers are expected in ``asked``, for its inputs, or ``record``."""
    condenser, chance, (rate_lower, rate_upper), work, (limit, tolerance) = known
    start, covariance, targets, wanted, last = question
    stages, trial = asked.stages, asked.stages.inputs
    P, q, G, lower, upper = program
    (H, m), size, M, bounded, limited = trial.shape, len(q), len(lower), asked.low.shape[1] > 0, len(condenser[1][1])
    here, warm, solved = copied(asked), guess, np.empty_like(record)
    solution, z = record[HEADER : HEADER + size], record[HEADER + size + size : HEADER + size + M]
    vectors, pairs, count = np.empty((7, size)), np.empty((2, MEMORY, size)), 0
    plan, slope, diagonal, step, before = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    scratch, change = vectors[5], vectors[6]
    inputs, proposed, moved = plan.reshape(H, m), solution.reshape(H, m), trial.reshape(size)
    status, price, share, rate, taken = ITERATION_LIMIT, 0.0, np.inf, 1.0, False
    outcome[:] = 0.0
    if compiled:
        roll_out(model, start, covariance, follow, stages)
        tighten(chance, stages.covariances, asked.low, asked.high)
    else:
        yield MODEL
    respond(stages.A, stages.B, stages.c, start, trial, states)
    cost = tracking_cost(condenser, states, trial, targets, wanted, last)
    take_over(asked, here)
    plan[:] = moved
    for number in range(limit):
        now = clock()
        outcome[COUNT] = number + 1
        A, B, c = here.stages.A, here.stages.B, here.stages.c
        condense(condenser, (A, B, c, here.rows, here.low, here.high), start, targets, wanted, last, program)
        apply(P, plan, scratch)
        for i in range(size):
            slope[i], diagonal[i] = q[i] + scratch[i], P[i, i]
        if taken:  # how the Lagrangian's slope changed over the last step, at its multipliers
            apply(P, step, scratch)
            curvature = 0.0
            for i in range(size):
                curvature += step[i] * scratch[i]
            if curvature > ROUND_OFF * cost:
                if count == MEMORY:
                    for k in range(MEMORY - 1):
                        pairs[:, k] = pairs[:, k + 1]
                    count -= 1
                pull(G, z, scratch)
                for i in range(size):
                    pairs[0, count, i], pairs[1, count, i] = step[i], slope[i] + scratch[i] - before[i]
                count += 1
            correct(P, pairs[0, :count], pairs[1, :count], scratch, change)
            apply(P, plan, scratch)
            for i in range(size):
                q[i] = slope[i] - scratch[i]
        then = clock()
        outcome[BUILD] += then - now
        ended = solve_lazy(P, q, G, lower, upper, warm, work, record) if ours else NUMERICAL_TROUBLE
        if ended != SOLVED:
            yield PROGRAM
            ended = int(record[layout.STATUS])
        outcome[SOLVE] += clock() - then
        if ended != SOLVED:
            status = ended
            break
        solved[:] = record
        warm = solved
        before_this = share
        share = kkt_share(diagonal, slope, G, z, plan, solution, lower, upper, cost)
        # The program's plan is better by about the slower of two rates (Hairer and Wanner, 1996, eq. (IV.8.10)).
        last_rate = rate
        rate = share / before_this if taken else 1.0
        slower = max(rate, last_rate)
        if share <= tolerance or share * slower <= tolerance * (1.0 - slower):
            status = SOLVED
            break
        for e in range(limited, len(z)):
            price = max(price, 2.0 * abs(z[e]))
        violated, promised = 0.0, 0.0
        if bounded:  # the stages are exact along the plan that they were made at: there these are the true violations
            respond(A, B, c, start, inputs, states)
            violated = violation_price(chance, here.rows, states, here.low, here.high, price)
            respond(A, B, c, start, proposed, states)
            promised = violation_price(chance, here.rows, states, here.low, here.high, price) - violated
        for i in range(size):
            step[i] = solution[i] - plan[i]
            promised += slope[i] * step[i]
        whole = limited > 0 and not keeps_rates(inputs, last, rate_lower, rate_upper)  # left in one step
        length, lower_cost = 1.0, False
        while length >= SHORTEST_STEP and not lower_cost:
            for i in range(size):
                moved[i] = solution[i] if length == 1.0 else plan[i] + length * step[i]
            if compiled:
                roll_out(model, start, covariance, NOTHING, stages)
                tighten(chance, stages.covariances, asked.low, asked.high)
            else:
                yield MODEL
            respond(stages.A, stages.B, stages.c, start, trial, states)
            reached = tracking_cost(condenser, states, trial, targets, wanted, last)
            merit = reached
            if bounded:  # the tightening of zero_order stays during the search
                merit += violation_price(chance, asked.rows, states, here.low, here.high, price)
            if whole and not math.isfinite(reached):
                break
            allowed = SUFFICIENT_DECREASE * length * promised + ROUND_OFF * abs(cost + violated)
            lower_cost = whole or merit <= cost + violated + allowed
            length /= 2.0
        if not lower_cost:  # share^2 of the cost is what an input could gain
            status = SOLVED if share**2 <= ROUND_OFF else NUMERICAL_TROUBLE
            break
        cost, taken = reached, True
        pull(G, z, before)
        for i in range(size):
            step[i] = moved[i] - plan[i]
            before[i] += slope[i]
        take_over(asked, here)
        plan[:] = moved
    respond(here.stages.A, here.stages.B, here.stages.c, start, proposed, states)
    stages.covariances[:] = here.stages.covariances
    outcome[STATUS] = status


@compiled
def copied(asked):
    """Room for another ``Asked``."""
    A, B, c, covariances, inputs = asked.stages
    stages = Stages(np.empty_like(A), np.empty_like(B), np.empty_like(c), np.empty_like(covariances), inputs.copy())
    return Asked(stages, np.empty_like(asked.rows), np.empty_like(asked.low), np.empty_like(asked.high))


@compiled
def take_over(source, target):
    """Copies one ``Asked`` to another."""
    copy(source.stages.A.ravel(), target.stages.A.ravel())
    copy(source.stages.B.ravel(), target.stages.B.ravel())
    copy(source.stages.c.ravel(), target.stages.c.ravel())
    copy(source.stages.covariances.ravel(), target.stages.covariances.ravel())
    copy(source.rows.ravel(), target.rows.ravel())
    copy(source.low.ravel(), target.low.ravel())
    copy(source.high.ravel(), target.high.ravel())


@borrowing
def copy(source, target):
    """Target becomes the source."""
    for i in range(len(source)):
        target[i] = source[i]


@borrowing
def apply(P, x, out):
    """Writes P x."""
    for i in range(len(out)):
        total, row = 0.0, P[i]
        for j in range(len(row)):
            total += row[j] * x[j]
        out[i] = total


@borrowing
def pull(G, z, out):
    """Writes G'z."""
    out[:] = 0.0
    for r in range(len(G)):
        for j in range(len(out)):
            out[j] += z[r] * G[r, j]


@borrowing
def keeps_rates(plan, last, lower, upper):
    """Whether the increments of a plan (H, m) are within their bounds (m,), but for rounding."""
    for k in range(len(plan)):
        for j in range(len(last)):
            rate = plan[k, j] - (plan[k - 1, j] if k > 0 else last[j])
            if max(lower[j] - rate, rate - upper[j]) > 1e-9 * max(1.0, abs(plan[k, j]) + abs(rate)):
                return False
    return True
