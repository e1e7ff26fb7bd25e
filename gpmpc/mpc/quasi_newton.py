"""Problem: the Gauss-Newton Hessian misses the curvature of the Lagrangian; what its slope did says what is missing."""

from gpmpc.compiled import borrowing

MEMORY = 10  # pairs of a corrected Hessian


@borrowing
def correct(P, steps, changes, moved, change):
    """Updates P by BFGS for every step and change of slope (pairs, n), the oldest first.

    With Powell's damping, which keeps P positive definite (Nocedal and Wright, 2006, procedure 18.2). ``moved`` and
    ``change`` are scratch (n,).
    """
    n = len(P)
    for k in range(len(steps)):
        curvature, found = 0.0, 0.0
        for i in range(n):
            total, row = 0.0, P[i]
            for j in range(n):
                total += row[j] * steps[k, j]
            moved[i] = total
            curvature += steps[k, i] * total
            found += steps[k, i] * changes[k, i]
        share = 1.0
        if found < 0.2 * curvature:
            share = 0.8 * curvature / (curvature - found)
            found = 0.2 * curvature
        for i in range(n):
            change[i] = share * changes[k, i] + (1.0 - share) * moved[i]
        for i in range(n):
            a, b, row = change[i] / found, moved[i] / curvature, P[i]
            for j in range(n):
                row[j] += a * change[j] - b * moved[j]
