"""Problem: bring a plan to where no first-order change of it helps: a KKT point of the shooting problem.

    minimise f(U) + price of soft margins    subject to  box on U, rates of U, hard margins g(U) <= 0

Both methods judge a plan by one and the same quadratic program, the projected Newton step in the metric of the
Gauss-Newton Hessian M,

    d = argmin 1/2 d'M d + grad f'd (+ price)   subject to the constraints, linearised at U

d = 0 exactly at the KKT points (Nocedal and Wright, 2006, section 18.1), and |d|_M, relative to sqrt(f + |U|^2_M), is
the accuracy reached, whatever the units. A method's own flag decides nothing.

``sqp`` takes such steps, with a line search on the exact penalty function (Han, 1977; Gauss-Newton: Bock, 1983). M
knows nothing of how covariances bend; where they weigh, Gauss-Newton alone took up to eight times the iterations.
So the steps' metric is M with the last pairs of steps and gradient changes put in by damped BFGS updates (Powell,
1978).
``slsqp`` hands the problem to SciPy's SLSQP (Kraft, 1988), in the variables w = L'(U - U_0), M = L L', in which the
curvature is nearly the identity that its BFGS update starts from; it starts again from a fresh M until d is small.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize

from gpmpc.exceptions import DataError
from gpmpc.mpc.request import Request
from gpmpc.mpc.shooting import Shooting, Shot
from gpmpc.qp import DualActiveSet, QPSolution, QuadraticProgram, SoftRows
from gpmpc.status import Status

HALVINGS = 20  # of a step, before the line search gives up
NOISE = 1e-10  # round-off of the objective, as a share of its scale: posteriors with sf2 >> y^2 lose that much
ELASTIC = 1e4  # weight of hard margins whose linearisations contradict each other, in units of the scale of f
MEMORY = 10  # pairs of a BFGS-corrected metric
NEAR = 0.03  # size of a step from which pairs are kept
CREEP = 0.25  # ratio of two Gauss-Newton steps' sizes above which the metric is corrected
ROUNDS = 8  # fresh starts of SLSQP
FAILURES = (DataError, np.linalg.LinAlgError, RuntimeError)  # of a model led out of its numbers by a trial plan


Pair = tuple[np.ndarray, np.ndarray]  # a change of U, and that of the Lagrangian's gradient (H m,)


@dataclass(frozen=True)
class Step:
    """The projected Newton step at a plan.

    Attributes:
        change: d (H m,).
        size: |d|_M / sqrt(f + |U|^2_M).
        decrease: Of the objective, by its linearisation at U + d; negative where bounds have to be met first.
        violation: Of rates and hard margins that is left, by their linearisation at U + d.
        multiplier: The largest of those of the rates and hard margins, in size.
        margin_prices: Multipliers of the margins (c,), over their copies.
        consistent: Whether the linearised constraints can be met together.
        solution: The quadratic program's; None where it has none.
    """

    change: np.ndarray
    size: float
    decrease: float
    violation: float
    multiplier: float
    margin_prices: np.ndarray
    consistent: bool
    solution: QPSolution | None


@dataclass
class Program:
    """The functions of one request; remembers the last plan it was asked about.

    Attributes:
        shooting: Cost and margins.
        request: The step's question.
        model_seconds: Spent in the model so far [s].
        evaluations: Plans evaluated so far.
    """

    shooting: Shooting
    request: Request
    model_seconds: float = 0.0  # [s]
    evaluations: int = 0
    _last: Shot | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        problem, H = self.shooting.problem, self.shooting.horizon
        self.lower, self.upper = np.tile(problem.input_lower, H), np.tile(problem.input_upper, H)
        self.rates = self.shooting.differences if problem.rate_limited else np.zeros((0, len(self.lower)))
        count = H if problem.rate_limited else 0
        start = self.shooting.start(self.request)[: len(self.rates)]
        self.rate_lower, self.rate_upper = (
            start + np.tile(problem.rate_lower, count),
            start + np.tile(problem.rate_upper, count),
        )
        limits = problem.state_bounds
        self.soft = limits is not None and limits.soft
        self.l1, self.l2 = (limits.l1 or 0.0, limits.l2 or 0.0) if self.soft else (0.0, 0.0)

    def __call__(self, plan: np.ndarray) -> Shot:
        """A plan's cost, margins and derivatives."""
        if self._last is None or not np.array_equal(plan, self._last.plan):
            self._last, seconds = self.shooting(np.array(plan), self.request)
            self.model_seconds += seconds
            self.evaluations += 1
        return self._last

    def objective(self, shot: Shot) -> float:
        """f, and the price of violated soft margins."""
        over = shot.margins.clip(0) if self.soft else np.zeros(0)
        return shot.cost + float(self.l1 * over.sum() + self.l2 * over @ over)

    def gradient(self, shot: Shot) -> np.ndarray:
        """Of the objective (H m,); at a kink, that of the side where the margin is kept."""
        if not self.soft:
            return shot.gradient
        over = shot.margins.clip(0)
        return shot.gradient + shot.margin_jacobian.T @ (self.l1 * (over > 0) + 2 * self.l2 * over)

    def violation(self, shot: Shot) -> float:
        """Sum of the violations of rates and hard margins, each in its own unit."""
        return self._beyond_rates(shot.plan) + (0.0 if self.soft else float(shot.margins.clip(0).sum()))

    def _beyond_rates(self, plan: np.ndarray) -> float:
        rates = self.rates @ plan
        return float(np.maximum(rates - self.rate_upper, self.rate_lower - rates).clip(0).sum())

    def metric(self, shot: Shot) -> tuple[np.ndarray, float]:
        """M and the scale f + |U|^2_M that steps are measured against."""
        M = self.shooting.curvature(shot)
        return M, max(abs(self.objective(shot)) + shot.plan @ M @ shot.plan, np.finfo(float).tiny)

    def step(self, shot: Shot, last: QPSolution | None = None, pairs: Sequence[Pair] = ()) -> Step:
        """The projected Newton step at a plan.

        Args:
            shot: The plan.
            last: A warm start.
            pairs: Steps and gradient changes that M is to be corrected by, the oldest first.
        """
        M, scale = self.metric(shot)
        for pair in pairs:
            M = _updated(M, *pair)
        unit = 1 / np.sqrt(M.diagonal())  # the QP in inputs of unit curvature
        P, q = M * unit * unit[:, None], shot.gradient * unit
        copies = len(self._prices) if self.soft else 1  # a row that pays both prices is written twice
        G = np.concatenate([self.rates, *[shot.margin_jacobian] * copies]) * unit
        rates, margins = self.rates @ shot.plan, np.tile(-shot.margins, copies)
        lower = np.concatenate(
            [(self.lower - shot.plan) / unit, self.rate_lower - rates, np.full(len(margins), -np.inf)]
        )
        upper = np.concatenate([(self.upper - shot.plan) / unit, self.rate_upper - rates, margins])
        solver, soft, consistent = DualActiveSet(), None, True
        if self.soft and len(margins):
            soft = self._softened(self._prices)
        solution = solver.solve(QuadraticProgram.unchecked(P, q, G, lower, upper), last, soft)
        if solution.status is Status.INFEASIBLE and not self.soft and len(margins):
            consistent = False
            solution = solver.solve(
                QuadraticProgram.unchecked(P, q, G, lower, upper), None, self._softened([(ELASTIC * scale, np.inf)])
            )
        if not solution.status.solved:
            consistent = consistent and solution.status is not Status.INFEASIBLE
            return Step(np.zeros_like(unit), math.inf, 0.0, 0.0, 0.0, np.zeros(len(shot.margins)), consistent, None)
        d = solution.x * unit
        hard = solution.z[: len(self.rates)] if self.soft else solution.z
        beyond = (shot.margins + shot.margin_jacobian @ d).clip(0)
        linearised = shot.cost + shot.gradient @ d + self.l1 * beyond.sum() + self.l2 * beyond @ beyond
        return Step(
            change=d,
            size=math.sqrt(max(d @ M @ d, 0.0) / scale),
            decrease=self.objective(shot) - float(linearised),
            violation=self._beyond_rates(shot.plan + d) + (0.0 if self.soft else float(beyond.sum())),
            multiplier=float(np.abs(hard).max(initial=0.0)),
            margin_prices=solution.z[len(self.rates) :].reshape(copies, len(shot.margins)).sum(axis=0),
            consistent=consistent,
            solution=solution,
        )

    @property
    def _prices(self) -> list[tuple[float, float]]:
        """The linear and the quadratic weight (of 1/2 v^2) of every copy of the soft margins; infinite where absent."""
        return [price for price in ((self.l1, np.inf), (np.inf, 2 * self.l2)) if 0 < min(price) < np.inf]

    def _softened(self, copies: list[tuple[float, float]]) -> SoftRows:
        """Hard rates, and margins with a linear and a quadratic weight for every copy."""
        hard, c = np.full(len(self.rates), np.inf), self.shooting.margin_count
        linear, quadratic = (np.concatenate([hard, *[np.full(c, w[k]) for w in copies]]) for k in (0, 1))
        return SoftRows(quadratic=quadratic, linear=linear)


Outcome = tuple[Shot, Status, int]  # the last plan, how it ended, iterations


def sqp(program: Program, shot: Shot, tolerance: float, limit: int) -> Outcome:
    """BFGS-corrected Gauss-Newton steps from a plan, until the next Gauss-Newton step would be small."""
    penalty, last, size, pairs = 0.0, None, math.inf, deque(maxlen=MEMORY)
    for iteration in range(limit + 1):
        judged = program.step(shot, last)
        if judged.solution is None:
            return shot, _trouble(judged), iteration
        if judged.size <= tolerance:
            return shot, Status.SOLVED if judged.consistent else Status.INFEASIBLE, iteration
        if iteration == limit:
            break
        # Pairs from far away mislead (eleven times the evaluations were seen); near by they help a creeping method.
        creeps = judged.size > CREEP * size
        size = judged.size
        step = program.step(shot, judged.solution, pairs) if pairs and creeps else judged
        step = judged if step.solution is None else step
        last, penalty = step.solution, max(penalty, 1.5 * step.multiplier)
        found = _line_search(program, shot, step, penalty)
        if found is None:
            return shot, _trouble(step), iteration
        if judged.size < NEAR:
            bend = (found.margin_jacobian - shot.margin_jacobian).T @ step.margin_prices
            pairs.append((found.plan - shot.plan, found.gradient - shot.gradient + bend))
        shot = found
    return shot, Status.ITERATION_LIMIT, limit


def _updated(B: np.ndarray, change: np.ndarray, gradient_change: np.ndarray) -> np.ndarray:
    """B after a BFGS update, damped so that it stays positive definite (Powell, 1978)."""
    Bs, y = B @ change, gradient_change
    curvature, sy = change @ Bs, change @ y
    if not curvature > 0:
        return B
    if sy < 0.2 * curvature:
        share = 0.8 * curvature / (curvature - sy)
        y = share * y + (1 - share) * Bs
    return B - np.outer(Bs, Bs) / curvature + np.outer(y, y) / (change @ y)


def _trouble(step: Step) -> Status:
    """What a method says that cannot go on from a plan."""
    return Status.NUMERICAL_TROUBLE if step.consistent else Status.INFEASIBLE


def _line_search(program: Program, shot: Shot, step: Step, penalty: float) -> Shot | None:
    """The first of the points at 1, 1/2, 1/4 .. of a step that lowers the exact penalty function as it should."""

    def merit(at: Shot) -> float:
        return program.objective(at) + penalty * program.violation(at)

    before, (_, scale) = merit(shot), program.metric(shot)
    expected = max(step.decrease + penalty * (program.violation(shot) - step.violation), 0.0)
    length = 1.0
    for _ in range(HALVINGS):
        plan = (shot.plan + length * step.change).clip(program.lower, program.upper)
        try:
            trial = program(plan)
        except FAILURES:
            trial = None
        if trial is not None and merit(trial) <= before - 1e-4 * length * expected + NOISE * scale:
            return trial
        length /= 2
    return None


def slsqp(program: Program, shot: Shot, tolerance: float, limit: int) -> Outcome:
    """SLSQP from a plan, in rounds that start from where the last one ended, until the Newton step is small."""
    iterations = 0
    for _ in range(ROUNDS):
        step = program.step(shot)
        if step.solution is None:
            return shot, _trouble(step), iterations
        if step.size <= tolerance:
            return shot, Status.SOLVED if step.consistent else Status.INFEASIBLE, iterations
        if iterations >= limit:  # where bounds contradict each other SLSQP wanders until then
            return shot, Status.ITERATION_LIMIT if step.consistent else Status.INFEASIBLE, iterations
        try:
            found, used = _round(program, shot, tolerance, limit - iterations)
        except FAILURES:
            break
        if np.array_equal(found.plan, shot.plan):
            break
        shot = found
        iterations += used
    return shot, _trouble(step), iterations


def _round(program: Program, shot: Shot, tolerance: float, limit: int) -> tuple[Shot, int]:
    """One run of SLSQP in w, followed by a slack variable for every soft margin."""
    M, scale = program.metric(shot)
    T = solve_triangular(np.linalg.cholesky(M), np.eye(len(M)), lower=True).T  # U = U_0 + T w
    origin, size, c = shot.plan, len(M), len(shot.margins) if program.soft else 0
    linear = np.concatenate([np.eye(size), program.rates])
    at_start = linear @ origin
    low = np.concatenate([program.lower, program.rate_lower]) - at_start
    high = np.concatenate([program.upper, program.rate_upper]) - at_start
    norm = np.linalg.norm(linear @ T, axis=1)
    fixed = (linear @ T) / norm[:, None]
    sides = [(fixed, low / norm, 1.0), (-fixed, -high / norm, 1.0)]
    kept = [(rows[np.isfinite(bound)], bound[np.isfinite(bound)]) for rows, bound, _ in sides]
    C, b = np.concatenate([rows for rows, _ in kept]), np.concatenate([bound for _, bound in kept])
    margin_norm = np.linalg.norm(shot.margin_jacobian @ T, axis=1)
    margin_norm = np.where(margin_norm > 1e-12 * margin_norm.max(initial=0.0), margin_norm, 1.0)
    C_wide = np.hstack([C, np.zeros((len(C), c))])

    def at(w: np.ndarray) -> Shot:
        return program(origin + T @ w[:size])

    def value(w: np.ndarray) -> float:
        e = margin_norm[:c] * w[size:]
        return at(w).cost + float(program.l1 * e.sum() + program.l2 * e @ e)

    def gradient(w: np.ndarray) -> np.ndarray:
        e = margin_norm[:c] * w[size:]
        return np.concatenate([T.T @ at(w).gradient, margin_norm[:c] * (program.l1 + 2 * program.l2 * e)])

    def kept_by(w: np.ndarray) -> np.ndarray:
        slack = w[size:] if c else 0.0
        return np.concatenate([C @ w[:size] - b, slack - at(w).margins / margin_norm])

    def kept_jacobian(w: np.ndarray) -> np.ndarray:
        margins = -(at(w).margin_jacobian @ T) / margin_norm[:, None]
        return np.vstack([C_wide, np.hstack([margins, np.eye(len(margins), c)])])

    first = np.concatenate([np.zeros(size), shot.margins.clip(0) / margin_norm if c else np.zeros(0)])
    constraints: list[dict[str, str | Callable]] = []
    if len(C) + len(shot.margins):
        constraints = [{"type": "ineq", "fun": kept_by, "jac": kept_jacobian}]
    result = minimize(
        value,
        first,
        jac=gradient,
        method="SLSQP",
        bounds=[(None, None)] * size + [(0, None)] * c if c else None,
        constraints=constraints,
        options={"ftol": 0.1 * tolerance**2 * scale, "maxiter": limit},
    )
    return program((origin + T @ result.x[:size]).clip(program.lower, program.upper)), int(result.nit)
