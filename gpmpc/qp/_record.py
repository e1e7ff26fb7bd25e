"""The layout of the one flat array that holds the whole result of a solve.

At two microseconds a solve, every array that crosses between Python and compiled code
costs a tenth of the time. The dual active set therefore writes all it found into a
single record, which the next solve reads as its warm start:

    [status, iterations, n, M, number of working constraints, tag, age
     | x (n) | multipliers (M) | working set (M)]

Constraints are stacked, box first: ``C = [I; G]``, M = n + m. A multiplier is positive
at an upper and negative at a lower bound, so that ``P x + q + C' multipliers = 0``. The
working set lists labels: ``+(p + 1)`` for constraint p at its upper bound, ``-(p + 1)``
at its lower one; what comes after them is undefined. The record of a
prepared program ends with the factor of the working set, by rows; the tag says of which
program it is (zero: none), the age how many constraints have entered or left since the
factor was computed.
"""

import numpy as np
from numpy.typing import NDArray

from gpmpc.status import Status

STATUS, ITERATIONS, VARIABLES, CONSTRAINTS, WORKING, TAG, AGE, HEADER = range(8)

SOLVED, INFEASIBLE, ITERATION_LIMIT, TIME_LIMIT, NUMERICAL_TROUBLE = range(5)
STATUSES = (
    Status.SOLVED,
    Status.INFEASIBLE,
    Status.ITERATION_LIMIT,
    Status.TIME_LIMIT,
    Status.NUMERICAL_TROUBLE,
)
# Returned by a kernel, and in no record: the caller constructs a QuadraticProgram,
# whose error says what is wrong.
MISUSE = 5

NO_RECORD: NDArray[np.float64] = np.zeros(0)


def record_size(variables: int, constraints: int, working: int = 0) -> int:
    """Returns the length of a record for M stacked constraints.

    With ``working`` it holds a factor of up to as many rows.
    """
    return (
        HEADER + variables + 2 * constraints + working * (working + 1) // 2 + 8
    )  # kernels write whole registers


def warm_record(active_set: NDArray, variables: int) -> NDArray[np.float64]:
    """Returns a record of n variables with nothing but an active set (M,).

    The active set is -1 at a lower bound and +1 at an upper one.
    """
    constraints = len(active_set)
    record = np.zeros(record_size(variables, constraints))
    members = np.flatnonzero(active_set)
    record[[VARIABLES, CONSTRAINTS, WORKING]] = variables, constraints, len(members)
    record[HEADER + variables + constraints :][: len(members)] = np.sign(
        active_set[members]
    ) * (members + 1)
    return record


def working_labels(
    record: NDArray, variables: int, constraints: int
) -> NDArray[np.float64]:
    """Returns the working set of a record, without what is no bound."""
    labels = record[HEADER + variables + constraints :][
        : int(np.clip(np.nan_to_num(record[WORKING]), 0, constraints))
    ]
    return labels[(np.abs(labels) >= 1.0) & (np.abs(labels) <= constraints)]
