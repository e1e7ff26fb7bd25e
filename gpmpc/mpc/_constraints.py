"""Rows of the states' constraints, tightened by covariances and linearised along plans.

P(g'x <= f) >= eta is g'mu + kappa sd <= f for a Gaussian, sd = sqrt(g'Sigma g), and
g'mu - kappa sd >= f on the other side. Where s holds the covariance, sd is in the row:
|S g|, or |diag(g) sd|, linearised at the plan (both are homogeneous, so the row has no
constant). (The paper writes S_jj for it, which is right for a diagonal S only.) Both
are convex: the row asks for no more than the constraint itself. In the mode
``zero_order`` the bounds move inwards by kappa sd of the covariances predicted beside
the program.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpmpc._compiled import compiled
from gpmpc._kernels.linalg import dot
from gpmpc.exceptions import SettingError
from gpmpc.mpc._linear_quadratic import Covariance, Plan, StageRows
from gpmpc.mpc.problem import Constraint, Inequality, Problem
from gpmpc.propagation._local_model import square_roots

Array = np.ndarray


class _Rows(NamedTuple):
    """The rows of one constraint, or of all of them stacked."""

    F: Array  # gradients by the mean (r, n), zero for smooth constraints
    lower: Array  # (H, r)
    upper: Array  # (H, r)
    kappa: Array  # standard deviations between means and sides (r,)
    prices: Array  # of violations (r,), infinite where rows are hard
    elastic: Array  # whether a row gives way where it cannot be kept (r,)


class _SmoothRows(NamedTuple):
    """An ``Inequality`` and the columns of its rows among all of them."""

    constraint: Inequality
    columns: slice


class ConstraintRows:
    """The rows of a problem's constraints, r a stage.

    A box has one row for each entry with a bound, upper ones first.

    Attributes:
        soft: Whether a violation of any has a price.
        prices: Of the rows (r,), infinite where they are hard.
        elastic: Whether a row gives way where it cannot be kept (r,).
        any_elastic: Whether any does.
        signs: 1 where a row has upper bounds, -1 where it has lower ones (r,).
        applies: Whether a row has a bound at a stage (H, r).
        smooth: Whether there is any ``Inequality``.
        smooth_rows: These, and the columns of their rows.
        per_stage: r.
        linear: The rows as they are declared, untightened.
        kappas: Deviations that bounds move inwards by (H, r): those declared in the
            mode ``zero_order``, else zero.
    """

    def __init__(self, problem: Problem, horizon: int, covariance: Covariance):
        parts = [
            _rows_of(constraint, problem, horizon, covariance)
            for constraint in problem.constraints
        ]
        rows = _stack(parts, problem.state_dim, horizon)
        self.linear = rows
        self.smooth_rows = _find_smooth(problem.constraints, parts)
        self.prices = rows.prices
        self.elastic = rows.elastic
        self.any_elastic = bool(rows.elastic.any())
        self.signs = np.where(np.isfinite(rows.upper).any(axis=0), 1.0, -1.0)
        self.applies = np.isfinite(rows.lower) | np.isfinite(rows.upper)
        self.per_stage = len(rows.kappa)
        self.soft = bool(np.isfinite(rows.prices).any())
        self.smooth = bool(self.smooth_rows)
        kappas = rows.kappa if covariance == "zero_order" else np.zeros(self.per_stage)
        self.kappas = np.tile(kappas, (horizon, 1))
        self._covariance: Covariance = covariance
        self._signed_kappa = self.signs * rows.kappa
        self._no_inputs = np.zeros((0, 0, problem.input_dim))
        holds_covariance = self.per_stage > 0 and covariance in ("full", "diagonal")
        self._fixed: StageRows | None = None
        if not (self.smooth or kappas.any() or holds_covariance):
            self._fixed = self._rows_that_stay()

    def _rows_that_stay(self) -> StageRows:
        """Returns the rows where no plan and no covariance moves them."""
        linear = self.linear
        n = linear.F.shape[1]
        E = _by_belief(
            linear.F[None], np.zeros((1, n, n)), self._covariance, self._signed_kappa
        )
        return StageRows(E, self._no_inputs, linear.lower, linear.upper)

    def at(
        self,
        plan: Plan,
        covariances: Array,
        stage_count: int,
        parameters: Array | None = None,
        kappas: Array | None = None,
    ) -> StageRows:
        """Returns the rows at a plan, tightened by covariances.

        Args:
            plan: Where smooth constraints are linearised.
            covariances: Of the states (H + 1, n, n).
            stage_count: Of stage models, H or 1.
            parameters: Of smooth constraints by stage (H, q).
            kappas: By stage (H,), in the place of those of the constraints.
        """
        if self._fixed is not None:
            return self._fixed
        lower = self.linear.lower.copy()
        upper = self.linear.upper.copy()
        F = self.linear.F[None]
        D = self._no_inputs
        if self.smooth:
            F, D = self._linearize_smooth(plan, parameters, upper)
        row_kappas = self.kappas
        if kappas is not None:
            row_kappas = np.where(self.kappas > 0, kappas[:, None], 0.0)
        _tighten.unchecked(F, row_kappas, covariances, lower, upper)
        E = _by_belief(
            F, covariances[1 : stage_count + 1], self._covariance, self._signed_kappa
        )
        return StageRows(np.ascontiguousarray(E), D, lower, upper)

    def _linearize_smooth(
        self, plan: Plan, parameters: Array | None, upper: Array
    ) -> tuple[Array, Array]:
        """Returns gradients of all rows by state and input; moves the smooth bounds."""
        linear = self.linear.F
        H, r = upper.shape
        means = np.ascontiguousarray(plan.states[1:, : linear.shape[1]])
        F = np.repeat(linear[None], H, axis=0)
        D = np.zeros((H, r, plan.inputs.shape[1]))
        for constraint, columns in self.smooth_rows:
            values, by_state, by_input = constraint.expand(
                means, plan.inputs, parameters
            )
            F[:, columns] = by_state
            D[:, columns] = by_input
            upper[:, columns] += np.einsum("kri,ki->kr", by_state, means) - values
            upper[:, columns] += np.einsum("kri,ki->kr", by_input, plan.inputs)
        return F, D


def _by_belief(
    F: Array, covariances: Array, mode: Covariance, signed_kappa: Array
) -> Array:
    """Returns the gradients E (K, r, p) of rows by s.

    Args:
        F: Gradients by the mean (K, r, n), or one for all stages (1, r, n).
        covariances: Of the states (K, n, n), or one for all stages.
        mode: What s holds of the covariance.
        signed_kappa: Deviations of the rows (r,), negative for lower bounds.
    """
    if mode not in ("full", "diagonal"):
        return F
    K = max(len(F), len(covariances))
    F = np.broadcast_to(F, (K, *F.shape[1:]))
    covariances = np.broadcast_to(covariances, (K, *covariances.shape[1:]))
    if mode == "diagonal":
        variances = np.diagonal(covariances, axis1=1, axis2=2).clip(0)
        by_deviations = _slopes_by_deviations(F, np.sqrt(variances))
        return np.concatenate([F, signed_kappa[:, None] * by_deviations], axis=2)
    by_root = _slopes_by_root(F, square_roots(covariances).root)
    by_root = signed_kappa[:, None, None] * by_root
    n = F.shape[2]
    return np.concatenate([F, by_root.reshape(K, -1, n * n)], axis=2)


def _slopes_by_deviations(F: Array, deviations: Array) -> Array:
    """Returns derivatives (K, r, n) of |diag(g) sd| by sd (K, n), g the rows of F."""
    weighed = F * deviations[:, None]
    norms = np.linalg.norm(weighed, axis=-1, keepdims=True)
    return np.divide(F * weighed, norms, out=np.abs(F), where=norms > 0)


def _slopes_by_root(F: Array, roots: Array) -> Array:
    """Returns derivatives (K, r, n, n) of |S g| by S (K, n, n), g the rows of F."""
    weighed = F @ roots
    norms = np.linalg.norm(weighed, axis=-1, keepdims=True)
    zero = np.zeros_like(weighed)
    directions = np.divide(weighed, norms, out=zero, where=norms > 0)  # S g / |S g|
    return F[..., None] * directions[:, :, None, :]


def _rows_of(
    constraint: Constraint, problem: Problem, horizon: int, covariance: Covariance
) -> _Rows:
    """Returns the rows of one constraint."""
    F, lower, upper = constraint.rows(horizon)
    if constraint.stages is not None:
        lower = lower.copy()  # either may be a view of what the constraint holds
        upper = upper.copy()
        _leave_out_other_stages(tuple(constraint.stages), lower, upper)
    r = len(F)
    kappa = 0.0
    if covariance != "none":
        sides = int(np.isfinite(lower).sum() + np.isfinite(upper).sum())
        kappa = constraint.standard_deviations(sides)
    prices = problem.prices(constraint, F)
    if isinstance(constraint, Inequality):
        F = np.zeros((r, problem.state_dim))
    return _Rows(
        F=F,
        lower=lower,
        upper=upper,
        kappa=np.full(r, kappa),
        prices=prices,
        elastic=np.full(r, constraint.penalty == "elastic"),
    )


def _leave_out_other_stages(stages: Sequence[int], lower: Array, upper: Array) -> None:
    """Removes the bounds (H, r) of all stages but some of 1 .. H."""
    horizon = len(lower)
    if max(stages) > horizon:
        rule = f"must be of 1 .. {horizon}"
        raise SettingError("stages", f"{rule}; got {max(stages)}")
    others = [k for k in range(horizon) if k + 1 not in stages]
    lower[others] = -np.inf
    upper[others] = np.inf


def _stack(parts: Sequence[_Rows], n: int, horizon: int) -> _Rows:
    """Returns the rows of all constraints, one below the other."""
    if not parts:
        return _Rows(
            F=np.empty((0, n)),
            lower=np.empty((horizon, 0)),
            upper=np.empty((horizon, 0)),
            kappa=np.empty(0),
            prices=np.empty(0),
            elastic=np.empty(0, dtype=bool),
        )
    return _Rows(
        # kernels ignore strides, and stacked arrays may lie column by column
        F=np.ascontiguousarray(np.concatenate([part.F for part in parts])),
        lower=np.ascontiguousarray(np.hstack([part.lower for part in parts])),
        upper=np.ascontiguousarray(np.hstack([part.upper for part in parts])),
        kappa=np.concatenate([part.kappa for part in parts]),
        prices=np.concatenate([part.prices for part in parts]),
        elastic=np.concatenate([part.elastic for part in parts]),
    )


def _find_smooth(
    constraints: Sequence[Constraint], parts: Sequence[_Rows]
) -> list[_SmoothRows]:
    """Returns the smooth constraints with their places among all rows."""
    smooth = []
    first = 0
    for constraint, part in zip(constraints, parts, strict=True):
        end = first + len(part.F)
        if isinstance(constraint, Inequality):
            smooth.append(_SmoothRows(constraint, slice(first, end)))
        first = end
    return smooth


@compiled
def _tighten(F, kappa, covariances, lower, upper):
    """Moves the bounds of the rows (H, r) inwards by kappa (H, r) deviations."""
    count, r, n = F.shape
    for k in range(len(lower)):
        stage = min(k, count - 1)
        for e in range(r):
            variance = 0.0
            for i in range(n):
                if F[stage, e, i] != 0.0:
                    spread = dot(covariances[k + 1, i], F[stage, e], n)
                    variance += F[stage, e, i] * spread
            margin = kappa[k, e] * math.sqrt(max(variance, 0.0))
            lower[k, e] += margin
            upper[k, e] -= margin


@compiled
def price_violations(prices, rows, plan):
    """Returns what violations along a plan cost at finite prices of the rows (r,)."""
    E, D, lower, upper = rows
    total = 0.0
    for k in range(len(lower)):
        stage = min(k, len(E) - 1)
        s = plan.states[k + 1]
        u = plan.inputs[k]
        for e in range(len(prices)):
            value = dot(E[stage, e], s, len(s)) + (
                dot(D[k, e], u, len(u)) if len(D) > 0 else 0.0
            )
            outside = max(0.0, value - upper[k, e], lower[k, e] - value)
            total += prices[e] * outside
    return total


@compiled
def largest_violation(rows, bounds, plan, previous_input):
    """Returns by how much a plan misses a bound of states, inputs or increments."""
    E, D, lower, upper = rows
    largest = 0.0
    for k in range(len(plan.inputs)):
        s = plan.states[k + 1]
        u = plan.inputs[k]
        for e in range(lower.shape[1]):
            value = dot(E[min(k, len(E) - 1), e], s, len(s))
            if len(D) > 0:
                value += dot(D[k, e], u, len(u))
            largest = max(largest, value - upper[k, e], lower[k, e] - value)
        for j in range(len(u)):
            largest = max(largest, u[j] - bounds.upper[k, j], bounds.lower[k, j] - u[j])
            if len(bounds.rate_lower) > 0:
                last = plan.inputs[k - 1, j] if k > 0 else previous_input[j]
                rate = u[j] - last
                largest = max(
                    largest,
                    rate - bounds.rate_upper[k, j],
                    bounds.rate_lower[k, j] - rate,
                )
    return largest


@compiled
def keep_rates(inputs, previous_input, lower, upper):
    """Moves inputs (H, m), one after the other, to within rates from the one before."""
    for k in range(len(inputs)):
        stage = min(k, len(lower) - 1)
        for j in range(len(previous_input)):
            last = inputs[k - 1, j] if k > 0 else previous_input[j]
            inputs[k, j] = min(
                max(inputs[k, j], last + lower[stage, j]), last + upper[stage, j]
            )
