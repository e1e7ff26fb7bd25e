"""Bounds on an uncertain state, each to hold with probability eta, as linear rows of the extended state.

P(x_j <= upper_j) >= eta is mu_j + kappa sd_j <= upper_j for a Gaussian, and mu_j - kappa sd_j >= lower_j on the other
side. Where the standard deviations are part of the state they are in the row: sd_j itself, or with s = [mu; vec S] the
norm of row j of S, linearised at the plan's S (it is homogeneous, so the row has no constant). (The paper writes S_jj
for it, which is right for a diagonal S only.) The norm is convex: the row asks for no more than the bound itself. In
the mode ``zero_order`` the bounds move inwards by kappa sd_j of the covariances predicted beside the program.
"""

import math

import numpy as np

from gpmpc.compiled import call_unchecked, compiled
from gpmpc.mpc.condense import StateRows
from gpmpc.mpc.problem import StateBounds
from gpmpc.mpc.stages import Covariance
from gpmpc.qp import SoftRows

Array = np.ndarray


class ChanceConstraints:
    """The rows of the bounded states, one for each finite bound, twice where its violation pays two prices.

    Args:
        bounds: Of the states; none for no rows.
        state_dim: n.
        horizon: H.
        covariance: What s holds of the belief; see ``gpmpc.mpc.stages``.

    Attributes:
        per_stage: Number of finite bounds.
        soft: Whether a violation has a price.
        prices: Linear and quadratic price of each of the r rows (2, r); infinite and zero where they are hard.
    """

    def __init__(self, bounds: StateBounds | None, state_dim: int, horizon: int, covariance: Covariance):
        self._horizon, self._covariance, self._n = horizon, covariance, state_dim
        sides = [] if bounds is None else [(bounds.upper, 1.0), (bounds.lower, -1.0)]
        entries = [(j, sign, bound[j]) for bound, sign in sides for j in np.flatnonzero(np.isfinite(bound))]
        self.per_stage = len(entries)
        kappa = 0.0 if bounds is None or covariance == "none" else bounds.kappa
        # A violation pays l1 v + l2 v^2; SoftRows has one price a row, so two prices take two equal rows.
        given = [] if bounds is None else [(bounds.l1, None), (None, bounds.l2)]
        self._given = [price for price in given if price != (None, None)]
        self.soft = bool(self._given) and self.per_stage > 0
        prices = [(l1 or 0.0, l2 or 0.0) for l1, l2 in self._given] or [(np.inf, 0.0)]
        self.prices = np.ascontiguousarray(np.repeat(np.array(prices), self.per_stage, axis=0).T)
        state, sign, bound = (np.array([entry[i] for entry in entries] * len(prices), dtype=float) for i in range(3))
        self._state, self._sign, self._bound = state.astype(int), sign, bound
        self._kappa = float(kappa)
        self._margin = self._kappa if covariance == "zero_order" else 0.0
        moves = covariance == "full" and self.per_stage > 0
        self._constant = None if moves else self._rows(np.zeros((1, state_dim, state_dim)))
        nothing = np.empty((horizon, 0))
        self._unbounded = None if self._constant is None or entries else StateRows(self._constant, nothing, nothing)

    def at(self, covariances: Array, stages: int) -> StateRows:
        """The rows, tightened, at covariances of the states Sigma_0 .. Sigma_H (H + 1, n, n), of H stages or one."""
        if self._unbounded is not None:
            return self._unbounded
        lower, upper = np.empty((2, self._horizon, len(self._bound)))
        call_unchecked(_tighten, self._state, self._sign, self._bound, self._margin, covariances, lower, upper)
        return StateRows(
            self._rows(covariances[1 : stages + 1]) if self._constant is None else self._constant, lower, upper
        )

    def softness(self, hard_rows: int) -> SoftRows | None:
        """The prices of all rows of a program's G, after ``hard_rows`` that have none; None where all are hard."""
        if not self.soft:
            return None
        linear, quadratic = [], []
        for l1, l2 in self._given:
            linear += [np.inf if l1 is None else l1] * self.per_stage
            quadratic += [np.inf if l2 is None else 2.0 * l2] * self.per_stage  # 1/2 rho v^2 = l2 v^2
        hard = np.full(hard_rows, np.inf)
        of_rows = [np.concatenate([hard, np.tile(part, self._horizon)]) for part in (quadratic, linear)]
        return SoftRows(*of_rows)

    def _rows(self, covariances: Array) -> Array:
        """E (K, r, p) at covariances of the states (K, n, n)."""
        n, r = self._n, len(self._state)
        extended = {"full": n + n * n, "diagonal": 2 * n}.get(self._covariance, n)
        E, each = np.zeros((len(covariances), r, extended)), np.arange(r)
        E[:, each, self._state] = 1.0
        if self._covariance == "diagonal":
            E[:, each, n + self._state] = self._sign * self._kappa
        elif self._covariance == "full" and r:
            columns = n + self._state[:, None] * n + np.arange(n)
            E[:, each[:, None], columns] = (self._sign * self._kappa)[:, None] * _directions(covariances)[
                :, self._state
            ]
        return E


@compiled
def _tighten(state, sign, bound, kappa, covariances, lower, upper):
    """Writes the bounds of the rows (H, r), moved inwards by kappa standard deviations."""
    for k in range(len(lower)):
        for e in range(len(state)):
            margin = kappa * math.sqrt(max(covariances[k + 1, state[e], state[e]], 0.0))
            inside = bound[e] - sign[e] * margin
            lower[k, e], upper[k, e] = (-np.inf, inside) if sign[e] > 0.0 else (inside, np.inf)


@compiled
def price_violations(prices, rows, states, hard_price):
    """What violations along states s_0 .. s_H cost: their declared price, or ``hard_price`` per unit without one."""
    E, lower, upper = rows
    total = 0.0
    for k in range(len(lower)):
        at, s = min(k, len(E) - 1), states[k + 1]
        for e in range(len(prices[0])):
            value = 0.0
            for i in range(len(s)):
                value += E[at, e, i] * s[i]
            outside = max(0.0, value - upper[k, e], lower[k, e] - value)
            linear = hard_price if prices[0, e] == np.inf else prices[0, e]
            total += (linear + prices[1, e] * outside) * outside
    return total


def _directions(covariances: Array) -> Array:
    """Rows of the symmetric roots (K, n, n), each divided by its norm; a row of zeros stays one."""
    eigenvalues, vectors = np.linalg.eigh(covariances)
    roots = (vectors * np.sqrt(np.clip(eigenvalues, 0, None))[:, None, :]) @ vectors.mT
    norms = np.linalg.norm(roots, axis=-1, keepdims=True)
    return np.divide(roots, norms, out=np.zeros_like(roots), where=norms > 0)
