"""What Gram mode needs to know about P and G, laid out in one array for the kernel.

K = C P^-1 C' with C = [I; G] says how each constraint's value answers to each multiplier. The kernel reads one flat
array: K (M, M), P (n, n), G (m, n).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from gpmpc.qp.solution import Terms

Array = NDArray[np.float64]


def gram_system(terms: Terms) -> tuple[Array, Array]:
    """The array for ``gpmpc.qp.dual_kernels.solve_gram``, and the traits (5, M) of ``gpmpc.qp.working_set``."""
    P, G, softness = terms
    C = np.vstack([np.eye(len(P)), G])
    responses = cho_solve(cho_factor(P, lower=True), C.T)  # P^-1 C'
    K = C @ responses
    K = 0.5 * (K + K.T)
    diagonal = np.diagonal(K)
    weights = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    ends = ((C != 0) * np.arange(1, len(P) + 1)).max(axis=1)
    traits = np.vstack([np.linalg.norm(C, axis=1), weights, softness, ends])
    system = np.zeros((2 * len(C), len(C)))
    system[: len(C)] = K
    system[len(C) :, : len(P)] = np.vstack([P, G])
    return system, traits
