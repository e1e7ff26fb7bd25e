"""What Gram mode needs to know about P and G, laid out in one array for the kernel.

K = C P^-1 C' with C = [I; G] says how each constraint's value answers to each multiplier. The kernel reads one flat
array: K (M, M), P^-1 (n, n), P (n, n), G' (n, m), G (m, n), rows padded with zeros to whole lanes. P^-1 stands in the
corner of K as well, but with gaps between its rows; memory is faster where it has none.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from gpmpc.qp.solution import Terms
from gpmpc.qp.workspace import aligned, padded

Array = NDArray[np.float64]


@np.errstate(over="ignore", invalid="ignore")  # what is not finite is seen in each solve
def gram_system(terms: Terms) -> tuple[Array, Array, float]:
    """Lays out what does not change from solve to solve.

    Returns:
        The array for ``gpmpc.qp.dual_kernels.solve_gram``, the traits (4, M) of ``gpmpc.qp.working_set``, and the
        smallest pivot of P's factor as a share of P_ii.
    """
    P, G, softness = terms
    C = np.vstack([np.eye(len(P)), G])
    factor = cho_factor(P, lower=True)
    responses = cho_solve(factor, C.T)  # P^-1 C'
    K = C @ responses
    K = 0.5 * (K + K.T)
    diagonal = np.diagonal(K)
    scales = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    ends = ((C != 0) * np.arange(1, len(P) + 1)).max(axis=1)
    ends[len(P) :] = np.maximum.accumulate(ends[len(P) :])  # so that the last of several rows has the largest
    traits = np.vstack([scales, softness, ends])
    n = len(P)
    blocks = K, K[:n, :n], P, G.T, G
    system = aligned(1, sum(len(block) * padded(block.shape[1]) for block in blocks))[0]
    start = 0
    for block in blocks:
        rows, columns = block.shape
        end = start + rows * padded(columns)
        system[start:end].reshape(rows, padded(columns))[:, :columns] = block
        start = end
    if not np.isfinite(K).all():
        system[:] = np.nan  # else a row of infinite norm would count as kept: every solve is to fail, and to be rescued
    return system, traits, float((np.diagonal(factor[0]) ** 2 / np.diagonal(P)).min())
