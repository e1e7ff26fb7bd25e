"""What Gram mode needs to know about P and G, laid out in one array for the kernel.

K = C P^-1 C' with C = [I; G] says how each constraint's value answers to each multiplier. The kernel reads one array:
K (M rows), then the constraints' traits (norms, selection weights, softness and caps, a row each), then P (n rows)
and G (m rows); every row is M wide.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from gpmpc.qp.solution import Terms


def gram_system(terms: Terms) -> NDArray[np.float64]:
    """The array of shape (2 M + 4, M) for ``gpmpc.qp.dual_kernels.solve_gram``."""
    P, G, (softness, caps) = terms
    n, m = len(P), len(G)
    M = n + m
    C = np.vstack([np.eye(n), G])
    responses = cho_solve(cho_factor(P, lower=True), C.T)  # P^-1 C'
    K = C @ responses
    K = 0.5 * (K + K.T)
    diagonal = np.diagonal(K).copy()
    system = np.zeros((2 * M + 4, M))
    system[:M] = K
    system[M] = np.linalg.norm(C, axis=1)
    system[M + 1] = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    system[M + 2 : M + 4] = softness, caps
    system[M + 4 : M + 4 + n, :n] = P
    system[M + 4 + n :, :n] = G
    return system
