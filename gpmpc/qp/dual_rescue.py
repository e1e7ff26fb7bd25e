"""What is tried when a solve did not convince: anew, equilibrated, by the primal method; then give up honestly.

A claimed infeasibility is believed only with Farkas' proof, a solution only with its residuals. Bad scaling is the
usual cause of either failing, so one try has a unit diagonal in P and rows of unit length: x = D x', rows
divided by their norms E.
"""

import numpy as np
from numpy.typing import NDArray

from gpmpc.qp import record as layout
from gpmpc.qp.dual_kernels import solve_lazy
from gpmpc.qp.farkas import proves_infeasibility
from gpmpc.qp.primal_active_set import PrimalActiveSet
from gpmpc.qp.problem import ABSENT, QuadraticProgram
from gpmpc.qp.solution import QPSolution, Terms
from gpmpc.qp.workspace import TOLERANCE, lazy_workspace

Array = NDArray[np.float64]


@np.errstate(over="ignore", invalid="ignore", divide="ignore")  # what is not finite does not convince
def rescue(terms: Terms, q: Array, lower: Array, upper: Array, record: Array, settings: Array) -> Array:
    """The first convincing record; the one with the smallest residuals, as ``NUMERICAL_TROUBLE``, if none convinces."""
    lower, upper = np.where(lower <= -ABSENT, -np.inf, lower), np.where(upper >= ABSENT, np.inf, upper)
    candidates = []
    for attempt in (_given, _from_nothing, _equilibrated, _by_algorithm_1):
        record = attempt(terms, q, lower, upper, record, settings)
        x = record[layout.HEADER : layout.HEADER + len(q)]
        solution = QPSolution(x, terms, q, lower, upper, record, 0.0, 0.0)
        if record[layout.STATUS] == layout.INFEASIBLE:
            if proves_infeasibility(solution.multipliers, terms.G, lower, upper):
                return record
        else:
            residual = max(map(_finite, solution.residuals()))
            if residual <= settings[TOLERANCE]:
                record[layout.STATUS] = layout.SOLVED
                return record
            candidates.append((residual, len(candidates), record))
    if candidates:
        record = min(candidates)[2]
    limited = record[layout.STATUS] == layout.ITERATION_LIMIT
    record[layout.STATUS] = layout.ITERATION_LIMIT if limited else layout.NUMERICAL_TROUBLE
    return record


def _finite(residual: float) -> float:
    return residual if np.isfinite(residual) else np.inf


def _given(terms, q, lower, upper, record, settings) -> Array:
    return record


def _from_nothing(terms, q, lower, upper, record, settings) -> Array:
    result, work = np.empty_like(record), lazy_workspace(settings, terms.softness)
    status = solve_lazy(terms.P, q, terms.G, lower, upper, layout.NO_RECORD, work, result)
    return record if status == layout.MISUSE else result  # numerically singular: nothing was written


def _equilibrated(terms, q, lower, upper, record, settings) -> Array:
    n = len(q)
    D = 1.0 / np.sqrt(np.diagonal(terms.P))
    norms = np.linalg.norm(terms.G * D, axis=1)
    scale = np.concatenate([1.0 / D, np.where(norms > 0.0, 1.0 / np.where(norms > 0.0, norms, 1.0), 1.0)])
    P = np.ascontiguousarray(terms.P * np.outer(D, D))
    G = np.ascontiguousarray(terms.G * D * scale[n:, None])
    softness = np.vstack([terms.softness[0] * scale**2, terms.softness[1] / scale])
    result, work = np.empty_like(record), lazy_workspace(settings, softness)
    status = solve_lazy(P, q * D, G, lower * scale, upper * scale, layout.NO_RECORD, work, result)
    if status == layout.MISUSE:  # the scaling overflowed
        return record
    result[layout.HEADER : layout.HEADER + n] *= D
    result[layout.HEADER + n : layout.HEADER + n + len(lower)] *= scale
    return result


def _by_algorithm_1(terms, q, lower, upper, record, settings) -> Array:
    """The primal method, whose QR bears rows that are all but parallel; it knows hard rows only."""
    softness, caps = terms.softness
    if softness.any() or np.isfinite(caps).any():
        return record
    problem = QuadraticProgram.from_stacked(terms.P, q, terms.G, lower, upper)
    return PrimalActiveSet(tolerance=settings[TOLERANCE]).solve(problem).record
