"""Problem: between the quadratic programs of a sequence stands arithmetic on few numbers, which calls cost more than.

What ``ConvexMPC`` does between two programs, compiled: how far a plan is from a KKT point, and the correction of the
Gauss-Newton Hessian by what the Lagrangian's slope did over the last steps.
"""

import numpy as np

from gpmpc.compiled import compiled

MEMORY = 10  # pairs of a corrected Hessian
SMALL = 1e-3  # share of an input's size


@compiled
def kkt_share(h, slope, G, z, plan, proposed, lower, upper, cost):
    """How far a plan is from a KKT point, with multipliers z of the rows: 0 there, a share of 1 elsewhere.

    The Lagrangian's gradient g = slope + G'z is projected onto the box (the middle of g, h (u - lower), h (u - upper))
    and divided by the largest that the gradient of such a cost can be, sqrt(2 h cost) (Cauchy and Schwarz): the cosine
    between the residuals and their change with an input (More, 1978, eq. (8.2)). Where the reference can be reached,
    gradient and root of the cost vanish together and their ratio does not. So the cost is counted with what moving the
    input by ``SMALL`` of its size adds to it, h (SMALL size)^2 / 2; the size is |u| or 1, whichever is more, but at
    most upper - lower. Where there are rows, also how far they are from where the program wants them, relative to the
    largest of them or 1.

    Args:
        h: Diagonal of the Gauss-Newton Hessian (n,).
        slope: Of the cost, at the plan (n,).
        G: (rows, n).
        z: (rows,).
        plan: (n,).
        proposed: The program's solution (n,).
        lower: Of the stacked constraints; the first n are the box.
        upper: Of the stacked constraints.
        cost: At the plan, a sum of squares.
    """
    largest, n = 0.0, len(plan)
    gradient = slope.copy()
    moved, reach = 0.0, 1.0
    for r in range(len(G)):
        value, change = 0.0, 0.0
        for j in range(n):
            gradient[j] += G[r, j] * z[r]
            value += G[r, j] * plan[j]
            change += G[r, j] * (proposed[j] - plan[j])
        moved, reach = max(moved, abs(change)), max(reach, abs(value))
    for j in range(n):
        size = min(max(1.0, abs(plan[j])), upper[j] - lower[j])
        counted = cost + 0.5 * h[j] * (SMALL * size) ** 2 + 1e-300
        left = max(h[j] * (plan[j] - upper[j]), min(gradient[j], h[j] * (plan[j] - lower[j])))
        if left != 0.0:
            largest = max(largest, abs(left) / np.sqrt(2.0 * h[j] * counted))
    return max(largest, moved / reach)


@compiled
def corrected(P, steps, changes):
    """P after one BFGS update for every step and change of slope (pairs, n), the oldest first.

    With Powell's damping, which keeps P positive definite (Nocedal and Wright, 2006, procedure 18.2).
    """
    n, P = len(P), P.copy()
    moved, change = np.empty(n), np.empty(n)
    for k in range(len(steps)):
        curvature, found = 0.0, 0.0
        for i in range(n):
            total = 0.0
            for j in range(n):
                total += P[i, j] * steps[k, j]
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
            a, b = change[i] / found, moved[i] / curvature
            for j in range(n):
                P[i, j] += a * change[j] - b * moved[j]
    return P
