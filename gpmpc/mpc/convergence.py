"""Problem: when is a plan as good as optimal? Gradients have units, and vanish with the cost where it can vanish."""

import numpy as np

from gpmpc.compiled import compiled

SMALL = 1e-3  # share of an input's size
FEASIBLE = 1e-3  # hard bounds may be missed by so much, in their units, by a plan that a next step would mend


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
