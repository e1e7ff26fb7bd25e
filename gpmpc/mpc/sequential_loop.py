"""Problem: between two quadratic programs stands little, on few numbers; in Python that would cost more than both.

The loop of ``gpmpc.mpc.sequential``, compiled, with what it is told and what it finds in flat arrays
(``gpmpc.mpc.flat_arrays``).
"""

import math

import numpy as np
from numba import types

from gpmpc.compiled import borrowing, clock, compiled
from gpmpc.kernels.linalg import copy, copy_matrix
from gpmpc.mpc.chance_constraints import tighten, violation_price
from gpmpc.mpc.compiled_rollout import roll_out
from gpmpc.mpc.condense import (
    CondensedProgram,
    InputBounds,
    StateRows,
    write_gradient_and_bounds,
    write_hessian_and_rows,
)
from gpmpc.mpc.convergence import FEASIBLE, kkt_share
from gpmpc.mpc.flat_arrays import part
from gpmpc.mpc.linear_quadratic import References, Stages, TrackingCost, expand, tracking_cost
from gpmpc.mpc.quasi_newton import MEMORY, correct
from gpmpc.qp import record as layout
from gpmpc.qp.dual_kernels import solve

MODEL, GUIDED, PROGRAM = 1, 2, 3  # what is asked for
SOLVED, ITERATION_LIMIT, NUMERICAL_TROUBLE = layout.SOLVED, layout.ITERATION_LIMIT, layout.NUMERICAL_TROUBLE
HEADER, RECORD_STATUS = layout.HEADER, layout.STATUS

# What is known, in this order:
POINTS, SQUARES, LOG_SIGNAL, BETA, OFFSET, NOISE, FEEDBACK_Q, FEEDBACK_TERMINAL = range(8)  # of the rollout
INPUT_LOWER, INPUT_UPPER, RATE_LOWER, RATE_UPPER = range(8, 12)
WEIGHT, TERMINAL, INPUT_WEIGHT, BOX_LOWER, BOX_UPPER, RATES_LOWER, RATES_UPPER = range(12, 19)  # of the condenser
BOUNDED, SIGN, BOUND, PRICES, CONSTANT_ROWS, SETTINGS = range(19, 25)  # of the chance constraints; numbers
UNCERTAIN, FEEDBACK, DIFFERENCE, PENALIZED, KAPPA, LIMIT, TOLERANCE = range(7)  # settings

# The stages along a plan, the rows of their states and the bounds of these:
A_OF, B_OF, C_OF, COVARIANCES, PLAN, ROWS, LOW, HIGH = range(8)

# What comes out: the last program and its solution, the plan, the states and covariances that it leads to, the outcome.
P_OF, Q_OF, G_OF, LOWER, UPPER, RECORD, REACHED, STATES, PREDICTED, OUTCOME = range(10)
STATUS, SUBOPTIMAL, COUNT, BUILD, SOLVE, OUTCOMES = range(6)  # BUILD and SOLVE are times [s]

SUFFICIENT_DECREASE = 1e-4  # of what the program promised (Armijo)
SHORTEST_STEP = 2.0**-12
ROUND_OFF = 1e-8  # share of the cost below which a difference says nothing: posteriors with sf2 >> y^2 lose that much


FLAT, VECTOR, MATRIX, TABLE = types.float64[::1], types.float64[::1], types.float64[:, ::1], types.int64[:, ::1]
QUESTION = types.Tuple([VECTOR, MATRIX, VECTOR, MATRIX, MATRIX, VECTOR, MATRIX])
SIGNATURE = (
    *(types.boolean, types.boolean, types.float64[:, :, ::1], FLAT, TABLE, MATRIX),
    *(QUESTION, MATRIX, VECTOR, FLAT, TABLE, FLAT, TABLE),
)


def sequence(compiled, ours, columns, known, places, work, question, follow, guess, along, table, answer, parts):
    """The loop, a generator: yields ``MODEL`` to have the stages along the plan, or ``PROGRAM`` for the record.

    ``GUIDED`` asks for them, too: along a rollout that follows the states in the answer by the ancillary feedback.

    Args:
        compiled: Whether the rollout is.
        ours: Whether ``solve`` solves the programs.
        columns: Of the Cholesky factors, where the compiled rollout takes them.
        known: What stays, flat.
        places: Its table.
        work: Workspace of ``solve``.
        question: s_0, and covariance, disturbance, targets, reference inputs, last input and shifted plan of a
            ``Request``.
        follow: Means that the first rollout follows, or nothing.
        guess: Record of a solution to start from.
        along: The stages along the plan in it, flat.
        table: Its table.
        answer: What comes out, flat.
        parts: Its table.
    """
    model, (weights, bounds), chance, (rate_lower, rate_upper), constant, (limit, tolerance) = told(
        known, places, columns
    )
    start, covariance, disturbance, targets, wanted, last, shifted = question
    H, m = wanted.shape
    kept = np.empty_like(along)  # of the plan that was reached; ``along`` is of the one that is tried
    stages, rows, low, high = linearised(along, table)
    (A, B, c, _, _), E, low_here, high_here = linearised(kept, table)
    A_tried, B_tried, c_tried, spread, trial = stages
    P, q, G = part(answer, parts[P_OF]), part(answer, parts[Q_OF])[0], part(answer, parts[G_OF])
    lower, upper, record = part(answer, parts[LOWER])[0], part(answer, parts[UPPER])[0], part(answer, parts[RECORD])[0]
    states, outcome = part(answer, parts[STATES]), part(answer, parts[OUTCOME])[0]
    size, M, bounded, limited = len(q), len(lower), low.shape[1] > 0, bounds.rate_lower.size
    references, plain = References(targets, wanted, last), np.empty((0, m, A.shape[1] + m + 1))
    program, warm, solved = CondensedProgram(P, q, G, lower, upper, plain), guess, np.empty_like(record)
    solution, z = record[HEADER : HEADER + size], record[HEADER + size + size : HEADER + size + M]
    vectors, pairs, count = np.empty((6, size)), np.empty((2, MEMORY, size)), 0
    slope, diagonal, step, before = vectors[0], vectors[1], vectors[2], vectors[3]
    scratch, change, plan = vectors[4], vectors[5], part(answer, parts[REACHED])[0]
    inputs, proposed, moved = plan.reshape(H, m), solution.reshape(H, m), trial.reshape(size)
    status, price, share, rate, taken = ITERATION_LIMIT, 0.0, np.inf, 1.0, False
    outcome[:], spread[:] = 0.0, 0.0
    copy_matrix(shifted, trial)
    if constant.shape[0] > 0:
        copy_matrix(constant, part(along, table[ROWS]))
    if compiled:
        roll_out(model, start, covariance, disturbance, follow, stages)
        tighten(chance, spread, low, high)
    else:
        yield MODEL
    respond(A_tried, B_tried, c_tried, start, trial, states)
    cost = tracking_cost(weights, states, trial, references)
    copy(along, kept)
    copy(moved, plan)
    for number in range(limit):
        now = clock()
        outcome[COUNT] = number + 1
        affine, bounded_rows = Stages(A, B, c), StateRows(E, low_here, high_here)
        write_hessian_and_rows(weights, bounds, affine, bounded_rows, program)
        write_gradient_and_bounds(weights, bounds, affine, start, references, bounded_rows, program)
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
                        for of in range(2):
                            copy(pairs[of, k + 1], pairs[of, k])
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
        ended = solve(P, q, G, lower, upper, warm, work, record) if ours else NUMERICAL_TROUBLE
        if ended != SOLVED:
            yield PROGRAM
            ended = int(record[RECORD_STATUS])
        outcome[SOLVE] += clock() - then
        if ended != SOLVED:
            status = ended
            break
        copy(record, solved)
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
            violated = violation_price(chance, E, states, low_here, high_here, price)
            respond(A, B, c, start, proposed, states)
            promised = violation_price(chance, E, states, low_here, high_here, price) - violated
        for i in range(size):
            step[i] = solution[i] - plan[i]
            promised += slope[i] * step[i]
        whole = limited > 0 and not keeps_rates(inputs, last, rate_lower, rate_upper)  # left in one step
        # The whole step is tried first along a rollout that follows the states which the program predicts: where the
        # open loop is unstable, the inputs alone lead elsewhere, and only steps of no use would lower the cost.
        respond(A, B, c, start, proposed, states)
        guided, length, lower_cost = model[1] and not whole, 1.0, False
        while length >= SHORTEST_STEP and not lower_cost:
            for i in range(size):
                moved[i] = solution[i] if length == 1.0 else plan[i] + length * step[i]
            if compiled:
                roll_out(model, start, covariance, disturbance, states[: H if guided else 0], stages)
                tighten(chance, spread, low, high)
            elif guided:
                yield GUIDED
            else:
                yield MODEL
            respond(A_tried, B_tried, c_tried, start, trial, states)
            reached = tracking_cost(weights, states, trial, references)
            merit = reached
            if bounded:  # the tightening of zero_order stays during the search
                merit += violation_price(chance, rows, states, low_here, high_here, price)
            if whole and not math.isfinite(reached):
                break
            allowed = SUFFICIENT_DECREASE * length * promised + ROUND_OFF * abs(cost + violated)
            lower_cost = whole or merit <= cost + violated + allowed
            length /= 1.0 if guided else 2.0
            guided = False
        if not lower_cost:  # share^2 of the cost is what an input could gain
            status = SOLVED if share**2 <= ROUND_OFF else NUMERICAL_TROUBLE
            break
        cost, taken = reached, True
        pull(G, z, before)
        for i in range(size):
            step[i] = moved[i] - plan[i]
            before[i] += slope[i]
        copy(along, kept)
        copy(moved, plan)
    if status == SOLVED:
        copy(solution, plan)
    respond(A, B, c, start, inputs, states)
    copy_matrix(part(kept, table[COVARIANCES]), part(answer, parts[PREDICTED]))
    missed = 0.0  # of hard bounds, by the last plan that the line search took
    if bounded:
        missed = violation_price(chance, E, states, low_here, high_here, 1.0)
        missed -= violation_price(chance, E, states, low_here, high_here, 0.0)
    outcome[STATUS], outcome[SUBOPTIMAL] = status, status != SOLVED and taken and missed <= FEASIBLE


# numba keeps a generator on disk with its Python function, by name where that name still means it: otherwise by value,
# with all that it calls, which every load would then compile anew. It is locked: programs share the solver's workspace.
programs = compiled(locked=True)(sequence)


@compiled
def respond(A, B, c, start, inputs, states):
    """Writes s_0 .. s_H (H + 1, p) under inputs (H, m) to ``states``."""
    (_, p, m), unknowns = B.shape, inputs.copy().reshape(inputs.size)
    copy_matrix(expand(Stages(A, B, c), start, np.empty((0, m, p + m + 1)), np.zeros(m), unknowns)[1], states)


@compiled
def told(known, places, columns):
    """What stays, as those take it who need it."""
    settings = part(known, places[SETTINGS])[0]
    Q, R, n = (
        part(known, places[FEEDBACK_Q]),
        part(known, places[INPUT_WEIGHT]),
        part(known, places[FEEDBACK_Q]).shape[0],
    )
    weight, terminal = part(known, places[WEIGHT]), part(known, places[TERMINAL])
    rates = part(known, places[RATE_LOWER])[0], part(known, places[RATE_UPPER])[0]
    model = (
        settings[UNCERTAIN] != 0.0,
        settings[FEEDBACK] != 0.0,
        (
            part(known, places[POINTS]),
            part(known, places[SQUARES]),
            part(known, places[LOG_SIGNAL])[0],
            part(known, places[BETA]),
        ),
        columns,
        (part(known, places[OFFSET])[0], settings[DIFFERENCE] != 0.0),
        (Q, R, part(known, places[FEEDBACK_TERMINAL])),
        (part(known, places[INPUT_LOWER])[0], part(known, places[INPUT_UPPER])[0], *rates),
        part(known, places[NOISE]),
    )
    condenser = (
        TrackingCost(weight.reshape(-1, n, n), terminal.reshape(-1, n, n), R, int(settings[PENALIZED])),
        InputBounds(
            part(known, places[BOX_LOWER]),
            part(known, places[BOX_UPPER]),
            part(known, places[RATES_LOWER]),
            part(known, places[RATES_UPPER]),
        ),
    )
    chance = (
        part(known, places[BOUNDED])[0],
        part(known, places[SIGN])[0],
        part(known, places[BOUND])[0],
        settings[KAPPA],
        part(known, places[PRICES]),
    )
    constant, stop = part(known, places[CONSTANT_ROWS]), (int(settings[LIMIT]), settings[TOLERANCE])
    return model, condenser, chance, rates, constant, stop


@compiled
def linearised(flat, table):
    """The stages along a plan, the rows of their states (K, r, p), and the bounds of these (H, r)."""
    c, plan, low = part(flat, table[C_OF]), part(flat, table[PLAN]), part(flat, table[LOW])
    (H, p), m, n = c.shape, plan.shape[1], part(flat, table[COVARIANCES]).shape[1]
    A, B = part(flat, table[A_OF]).reshape(H, p, p), part(flat, table[B_OF]).reshape(H, p, m)
    stages = A, B, c, part(flat, table[COVARIANCES]).reshape(H + 1, n, n), plan
    r, rows = low.shape[1], part(flat, table[ROWS])
    return stages, rows.reshape(rows.shape[0] // r if r > 0 else 1, r, p), low, part(flat, table[HIGH])


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
