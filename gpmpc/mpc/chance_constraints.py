"""Problem: bounds on an uncertain state, each to hold with probability eta, as rows of a quadratic program.

P(x_j <= upper_j) >= eta is mu_j + kappa sd_j <= upper_j for a Gaussian, and mu_j - kappa sd_j >= lower_j on the other
side. Where the standard deviations are part of the state they are in the row: sd_j itself, or with s = [mu; vec S] the
norm of row j of S, linearised at the predicted S (it is homogeneous, so the row has no constant). (The paper writes
S_jj for it, which is right for a diagonal S only.) The norm is convex: the row asks for no more than the bound itself.
Where covariances are predicted beside the program, the bounds move inwards by kappa sd_j.
"""

import math

import numpy as np

from gpmpc.compiled import compiled
from gpmpc.mpc.prediction import Covariance, Prediction
from gpmpc.mpc.tracking import StateBounds
from gpmpc.qp import SoftRows

Array = np.ndarray


class ChanceConstraints:
    """The rows E_k of l_k <= E_k s_k <= h_k, k = 1 .. H, one for each finite bound.

    Args:
        bounds: Of the states; none for no rows.
        state_dim: n.
        horizon: H.
        covariance: What s holds of the belief; see ``gpmpc.mpc.prediction``.

    Attributes:
        known: What ``tighten`` and ``violation_price`` take of it.
        constant: E (1, r, p) where it is the same whatever the prediction, None elsewhere.
    """

    def __init__(self, bounds: StateBounds | None, state_dim: int, horizon: int, covariance: Covariance):
        self._horizon, self._covariance, self._n = horizon, covariance, state_dim
        sides = [] if bounds is None else [(bounds.upper, 1.0), (bounds.lower, -1.0)]
        entries = [(j, sign, bound[j]) for bound, sign in sides for j in np.flatnonzero(np.isfinite(bound))]
        self.per_stage = len(entries)
        self._state = np.array([entry[0] for entry in entries], dtype=int)
        self._sign = np.array([entry[1] for entry in entries], dtype=float)
        self._bound = np.array([entry[2] for entry in entries], dtype=float)
        self._kappa = 0.0 if bounds is None or covariance == "none" else bounds.kappa
        # A violation pays l1 v + l2 v^2; SoftRows has one price a row, so two prices take two equal rows.
        prices = [] if bounds is None else [(bounds.l1, None), (None, bounds.l2)]
        self._prices = [price for price in prices if price != (None, None)]
        self._copies = max(1, len(self._prices))
        paid = [(l1 or 0.0, l2 or 0.0) for l1, l2 in self._prices] or [(np.inf, 0.0)]  # infinite: hard
        prices = np.repeat(np.array(paid), self.per_stage, axis=0)
        columns = [np.tile(part, self._copies) for part in (self._state, self._sign, self._bound)]
        self.known = *columns, float(self._kappa), np.ascontiguousarray(prices.T)
        moves = covariance == "full" and self.per_stage > 0
        self.constant = None if moves else self._rows(np.zeros((1, state_dim, state_dim)))

    @property
    def soft(self) -> bool:
        """Whether a violation has a price."""
        return bool(self._prices) and self.per_stage > 0

    def rows(self, prediction: Prediction) -> Array:
        """E_k (H, r, p), or (1, r, p) where it is the same for all k."""
        if self.constant is not None:
            return self.constant
        last = None if len(prediction.A) > 1 else 2  # a held model has one covariance for the stages 1 to H
        return self._rows(_row_directions(prediction.covariances[1:last]))

    def _rows(self, normals: Array) -> Array:
        """E_k, with the directions (K, n, n) of the rows of S where these are part of the state."""
        n, r = self._n, self.per_stage
        extended = {"full": n + n * n, "diagonal": 2 * n}.get(self._covariance, n)
        E, each = np.zeros((len(normals), r, extended)), np.arange(r)
        E[:, each, self._state] = 1.0
        if self._covariance == "diagonal":
            E[:, each, n + self._state] = self._sign * self._kappa
        elif self._covariance == "full":
            columns = n + self._state[:, None] * n + np.arange(n)
            E[:, each[:, None], columns] = (self._sign * self._kappa)[:, None] * normals[:, self._state]
        return np.concatenate([E] * self._copies, axis=1) if self._copies > 1 else E

    def limits(self, prediction: Prediction) -> tuple[Array, Array]:
        """l_k and h_k (H, r)."""
        if not self.per_stage:
            return np.empty((self._horizon, 0)), np.empty((self._horizon, 0))
        bound = np.tile(self._bound, (self._horizon, 1))
        if self._covariance == "zero_order":
            variance = np.diagonal(prediction.covariances[1:], axis1=1, axis2=2)[:, self._state]
            bound = bound - self._sign * self._kappa * np.sqrt(np.clip(variance, 0, None))
        lower, upper = np.where(self._sign > 0, -np.inf, bound), np.where(self._sign > 0, bound, np.inf)
        if self._copies > 1:
            lower, upper = np.concatenate([lower] * self._copies, 1), np.concatenate([upper] * self._copies, 1)
        return lower, upper

    def softness(self, hard_rows: int) -> SoftRows | None:
        """The prices of all rows of G, after ``hard_rows`` that have none."""
        if not self.soft:
            return None
        linear, quadratic = [], []
        for l1, l2 in self._prices:
            linear += [np.inf if l1 is None else l1] * self.per_stage
            quadratic += [np.inf if l2 is None else 2.0 * l2] * self.per_stage  # 1/2 rho v^2 = l2 v^2
        hard = np.full(hard_rows, np.inf)
        return SoftRows(
            np.concatenate([hard, np.tile(quadratic, self._horizon)]),
            np.concatenate([hard, np.tile(linear, self._horizon)]),
        )


@compiled
def tighten(known, covariances, low, high):
    """Writes ``ChanceConstraints.limits`` where the states' covariances (H + 1, n, n) are beside the program."""
    state, sign, bound, kappa, _ = known
    for k in range(len(low)):
        for e in range(len(state)):
            j = int(state[e])
            margin = kappa * math.sqrt(max(covariances[k + 1, j, j], 0.0))
            inside = bound[e] - sign[e] * margin
            low[k, e], high[k, e] = (-np.inf, inside) if sign[e] > 0.0 else (inside, np.inf)


@compiled
def violation_price(known, rows, states, low, high, hard_price):
    """What violations along states s_0 .. s_H cost: their declared price, or ``hard_price`` per unit without one."""
    prices, total = known[4], 0.0
    for k in range(len(low)):
        E, s = rows[min(k, len(rows) - 1)], states[k + 1]
        for e in range(len(E)):
            value = 0.0
            for i in range(len(s)):
                value += E[e, i] * s[i]
            outside = max(0.0, value - high[k, e], low[k, e] - value)
            linear = hard_price if prices[0, e] == np.inf else prices[0, e]
            total += (linear + prices[1, e] * outside) * outside
    return total


def _row_directions(covariances: Array) -> Array:
    """Rows of the symmetric roots (K, n, n), each divided by its norm; a row of zeros stays one."""
    eigenvalues, vectors = np.linalg.eigh(covariances)
    roots = (vectors * np.sqrt(np.clip(eigenvalues, 0, None))[:, None, :]) @ vectors.mT
    norms = np.linalg.norm(roots, axis=-1, keepdims=True)
    return np.divide(roots, norms, out=np.zeros_like(roots), where=norms > 0)
