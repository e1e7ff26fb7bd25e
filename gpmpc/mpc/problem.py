"""Declares what a controller makes small and what it keeps: one problem for all controllers.

    minimise    sum_{i=1..H} E|x_i - r_i|^2_Q + sum_{i=0..H-1} |v_i|^2_R       (the last state's weight may be another)
    subject to  bounds on u_i and on u_i - u_{i-1}, and the constraints of the states x_1 .. x_H

where v is the input itself, its deviation from the reference input, or its increment (Cao, Lai and Alam, 2017,
sections 3.2-3.3). For a Gaussian x_i, E|x - r|^2_Q = |mu - r|^2_Q + tr(Q Sigma).

A constraint g'x <= f of a Gaussian state holds with probability eta where g'mu + kappa sqrt(g'Sigma g) <= f,
kappa = Phi^-1(eta); smooth ones, h(x, p) <= 0, are linearised along the plan. By default a constraint is soft: a
violation pays a price, so that a program always has a solution. The penalty is exact (Fletcher, 1987, section 14.3): as
long as the price exceeds what the cost can gain by a violation, no plan that can keep the constraint pays it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from statistics import NormalDist
from typing import Any, Literal

import numpy as np
import torch

from gpmpc.dynamics import batched_jacobian, to_array
from gpmpc.exceptions import DataError, SettingError, ShapeError, check_number
from gpmpc.qp.problem import ABSENT

Array = np.ndarray

Penalized = Literal["inputs", "deviations", "increments"]
PENALIZED = ("inputs", "deviations", "increments")

_EXACT = 1e6  # the exact price, in the cost's largest weight: more than any multiplier that a bound is worth


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """What every constraint of the states has beside its sides.

    Attributes:
        probability: eta in (0.5, 1), with which each side is to hold at each stage; None: the mean keeps it.
        kappa: Standard deviations between the mean and a side; Phi^-1(eta) unless given (the paper takes 2 for 0.95).
        penalty: Price of a violation per unit and stage; ``"exact"``: one that no plan pays which can keep the
            constraint; None: hard.
        stages: Those of 1 .. H that it holds at, such as ``range(5, 11)``; all by default.
        joint: Whether eta is for all sides and stages together, by Boole's inequality: each gets its part of 1 - eta.

    Raises:
        SettingError: A probability outside (0.5, 1), a negative kappa, a price that is not positive, or stages below 1.
    """

    probability: float | None = None
    kappa: float | None = None
    penalty: float | Literal["exact"] | None = "exact"
    stages: Iterable[int] | None = None
    joint: bool = False

    def __post_init__(self) -> None:
        if self.probability is not None:
            check_number("probability", self.probability)
            if not 0.5 < self.probability < 1:
                raise SettingError("probability", f"must lie in (0.5, 1); got {self.probability}")
        elif self.joint:
            raise SettingError("joint", "needs a probability")
        if self.kappa is not None:
            check_number("kappa", self.kappa, least=0)
        if self.penalty is not None and self.penalty != "exact":
            check_number("penalty", self.penalty, above=0)
        if self.stages is not None:
            stages = tuple(self.stages) if isinstance(self.stages, Iterable) else ()
            if not stages or not all(isinstance(stage, int) and stage > 0 for stage in stages):
                raise SettingError("stages", f"must be whole numbers from 1 on; got {self.stages!r}")
            object.__setattr__(self, "stages", stages)

    @property
    def size(self) -> int | None:
        """Number of states that it is for; None where any will do."""
        return None

    def rows(self, horizon: int) -> tuple[Array, Array, Array]:
        """Returns F (r, n), lower and upper (H, r) of rows lower <= F x <= upper, of which each has one side only."""
        raise NotImplementedError

    def standard_deviations(self, sides: int = 1) -> float:
        """Returns kappa of each of a number of sides, all stages counted."""
        if self.kappa is not None or self.probability is None:
            return float(self.kappa or 0.0)
        return NormalDist().inv_cdf(1.0 - (1.0 - self.probability) / (sides if self.joint else 1))


@dataclass(frozen=True)
class Box(Constraint):
    """Bounds lower <= x <= upper: of the states, and (without the keywords) of inputs or their increments.

    Attributes:
        lower: List or array (d,), or (H, d) by stage, kept as an array; -inf where there is none; None: none at all.
        upper: Likewise; inf where there is none.

    Raises:
        SettingError: Crossed bounds, or as for ``Constraint``.
    """

    lower: Any = None
    upper: Any = None

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [("lower", self.lower), ("upper", self.upper)]
        sides = [None if side is None else _numbers(key, side) for key, side in given]
        shape = next((side.shape for side in sides if side is not None), (0,))
        for (key, value), side, absent in zip(given, sides, (-math.inf, math.inf), strict=True):
            array = np.full(shape, absent) if side is None else side
            if array.ndim not in (1, 2) or array.shape != shape:
                raise SettingError(key, f"must be a list of {shape[-1]} numbers, or one by stage; got {value!r}")
            if (-np.sign(absent) * array >= ABSENT).any():
                raise SettingError(
                    key, f"no number keeps it: a bound of size {ABSENT:g} or more is none; got {value!r}"
                )
            object.__setattr__(self, key, array)
        for at in np.argwhere(self.lower > self.upper)[:1]:
            entry, at = at[-1], tuple(at)
            raise SettingError(
                "lower, upper", f"must not cross; entry {entry} has {self.lower[at]:g} above {self.upper[at]:g}"
            )

    @property
    def size(self) -> int:
        """Number of bounded entries, d; 0 where both sides are None."""
        return self.lower.shape[-1]

    @cached_property
    def finite(self) -> bool:
        """Whether there is any bound."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    def by_stage(self, horizon: int) -> tuple[Array, Array]:
        """Returns lower and upper bounds of every stage (H, d)."""
        return by_stage("lower", self.lower, horizon, 1), by_stage("upper", self.upper, horizon, 1)

    def rows(self, horizon: int) -> tuple[Array, Array, Array]:
        """Returns one row for each entry with a bound, upper ones first."""
        lower, upper = self.by_stage(horizon)
        above, below = (np.flatnonzero(np.isfinite(side).any(axis=0)) for side in (upper, lower))
        F, none = np.eye(self.size)[np.concatenate([above, below])], np.full((horizon, self.size), math.inf)
        return F, np.hstack([-none[:, above], lower[:, below]]), np.hstack([upper[:, above], none[:, below]])


@dataclass(frozen=True)
class Halfspaces(Constraint):
    """Linear constraints F x <= f of the states.

    Attributes:
        F: (r, n).
        f: (r,), or (H, r) by stage.

    Raises:
        SettingError: Shapes that do not belong together, numbers that are not finite, a zero row, or as for
            ``Constraint``.
    """

    F: Any
    f: Any

    def __post_init__(self) -> None:
        super().__post_init__()
        F, f = _numbers("F", self.F), _numbers("f", self.f)
        if F.ndim != 2 or f.ndim not in (1, 2) or f.shape[-1] != len(F):
            raise SettingError("F, f", f"must be (r, n) and (r,) or (H, r); got {F.shape} and {f.shape}")
        if not (np.isfinite(F).all() and np.isfinite(f).all() and F.any(axis=1).all()):
            raise SettingError("F, f", "must be finite, each row of F with an entry that is not zero")
        object.__setattr__(self, "F", F)
        object.__setattr__(self, "f", f)

    @property
    def size(self) -> int:
        """Number of states, n."""
        return self.F.shape[1]

    def rows(self, horizon: int) -> tuple[Array, Array, Array]:
        """Returns F, no lower bounds, and f of every stage."""
        upper = by_stage("f", self.f, horizon, 1)
        return self.F, np.full_like(upper, -math.inf), upper


@dataclass(frozen=True)
class Inequality(Constraint):
    """Smooth constraints h(x, p) <= 0 of the states, such as obstacles, linearised along the plan.

    Its standard deviation is the one along the gradient, sqrt(dh Sigma dh'). A gradient that vanishes says nothing of
    where to go: prefer ``radius - distance`` to ``radius**2 - distance**2``.

    Attributes:
        h: A function of tensors, states (H, n) and, where ``parameters`` are handed to the controller, these (H, q),
            that gives (H, count), each row of its own state; or a CasADi function of one state and one vector of
            parameters.
        count: Number of values of h at a state.

    Raises:
        SettingError: h is no function, or as for ``Constraint``.
    """

    h: Any
    count: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("count", self.count, least=1, whole=True)
        if not callable(self.h):
            raise SettingError("h", f"must be a function; got {type(self.h).__name__}")

    def rows(self, horizon: int) -> tuple[Array, Array, Array]:
        """Returns the places of its rows: gradients zero, no lower bounds, and upper ones 0."""
        upper = np.zeros((horizon, self.count))
        return np.zeros((self.count, 0)), np.full_like(upper, -math.inf), upper

    def linearize(self, states: Array, parameters: Array | None) -> tuple[Array, Array]:
        """Returns h (H, count) and its gradients (H, count, n) at states (H, n).

        Raises:
            ShapeError: h gives another shape.
            DataError: h or a gradient is not finite.
        """
        arguments = [states] if parameters is None else [states, parameters]
        if hasattr(self.h, "n_in"):
            values, gradients = _linearize_casadi(self.h, arguments)
        else:
            x, *rest = (torch.as_tensor(argument) for argument in arguments)

            def h(x: torch.Tensor) -> tuple[torch.Tensor]:
                value = self.h(x, *rest)
                return (value.unsqueeze(-1) if value.dim() == 1 else value,)

            (value,), (gradient,) = batched_jacobian(h, (x,))
            values, gradients = to_array(value), to_array(gradient)
        if values.shape != (len(states), self.count):
            raise ShapeError(f"h must give ({len(states)}, {self.count}); got {values.shape}")
        if not (np.isfinite(values).all() and np.isfinite(gradients).all()):
            raise DataError("h or its gradient is not finite along the plan")
        return values, gradients


@lru_cache(maxsize=64)
def _casadi_expansion(function: Any, points: int) -> Any:
    x, y = function.name_in(0), function.name_out(0)
    return function.factory("expansion", function.name_in(), [y, f"jac:{y}:{x}"]).map(points)


def _linearize_casadi(function: Any, arguments: Sequence[Array]) -> tuple[Array, Array]:
    (K, n), expansion = arguments[0].shape, _casadi_expansion(function, len(arguments[0]))
    value, jacobian = expansion(*[argument.T for argument in arguments])
    return value.full().T.copy(), jacobian.full().reshape(-1, K, n).transpose(1, 0, 2).copy()


@dataclass(frozen=True)
class Tracking:
    """Costs of the distance to a reference and of the inputs.

    Attributes:
        Q: State weights, the diagonal (n,) or the matrix (n, n).
        R: Input weights, the diagonal (m,) or the matrix (m, m).
        terminal: Weight of the last predicted state, like Q; Q itself by default.
        penalized: What R weighs: ``"inputs"``, ``"deviations"`` from the reference inputs, or ``"increments"``.
        angles: Indices of states whose error is modulo 2 pi: their references move by full turns towards the plan.

    Raises:
        SettingError: A weight is not symmetric positive semidefinite, R is zero in a direction, or a length is wrong.
    """

    Q: Any
    R: Any
    terminal: Any = None
    penalized: Penalized = "increments"
    angles: Sequence[int] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "Q", _weight("Q", self.Q))
        object.__setattr__(self, "R", _weight("R", self.R))
        lowest = np.linalg.eigvalsh(self.R)[0]
        if lowest <= 0:
            raise SettingError("R", f"must be positive definite; its smallest eigenvalue is {lowest:.3g}")
        terminal = self.Q if self.terminal is None else _weight("terminal", self.terminal)
        object.__setattr__(self, "terminal", terminal)
        if terminal.shape != self.Q.shape:
            raise SettingError("terminal", f"must be a weight of {len(self.Q)} states; got {len(terminal)}")
        if self.penalized not in PENALIZED:
            raise SettingError("penalized", f"must be one of {', '.join(map(repr, PENALIZED))}; got {self.penalized!r}")
        angles = tuple(self.angles)
        if not all(isinstance(index, int) and 0 <= index < len(self.Q) for index in angles):
            raise SettingError("angles", f"must be indices of {len(self.Q)} states; got {self.angles!r}")
        object.__setattr__(self, "angles", angles)

    @property
    def largest_weight(self) -> float:
        """Returns the largest eigenvalue of all weights."""
        return float(max(np.linalg.eigvalsh(weight)[-1] for weight in (self.Q, self.terminal, self.R)))


@dataclass(frozen=True)
class Problem:
    """A cost, bounds of the inputs, and constraints of the states; see the module's text.

    Attributes:
        cost: What is made small.
        inputs: Bounds of the inputs; none by default.
        input_rates: Bounds of u_i - u_{i-1} per step; none by default.
        constraints: Of the states, ``Box``, ``Halfspaces`` or ``Inequality``; none by default.

    Raises:
        SettingError: A part is of another kind or length than the cost asks for.
    """

    cost: Tracking
    inputs: Box = field(default_factory=Box)
    input_rates: Box = field(default_factory=Box)
    constraints: Sequence[Constraint] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.cost, Tracking):
            raise SettingError("cost", f"must be Tracking(...); got {type(self.cost).__name__}")
        for key in ("inputs", "input_rates"):
            box = Box() if getattr(self, key) is None else getattr(self, key)
            if not isinstance(box, Box):
                raise SettingError(key, f"must be Box(lower, upper); got {type(box).__name__}")
            if (box.probability, box.kappa, box.penalty, box.stages) != (None, None, "exact", None):
                raise SettingError(key, "has bounds that are always kept: no probability, penalty or stages")
            box = box if box.size else Box(np.full(self.input_dim, -math.inf))
            if box.lower.ndim > 1:
                raise SettingError(key, "must be one list for all stages")
            if box.size != self.input_dim:
                raise SettingError(key, f"must bound {self.input_dim} inputs; got {box.size}")
            object.__setattr__(self, key, box)
        constraints = () if self.constraints is None else self.constraints
        given = [constraints] if isinstance(constraints, Constraint) else list(constraints)
        for constraint in given:
            if not isinstance(constraint, Constraint):
                kind = type(constraint).__name__
                raise SettingError("constraints", f"must be Box(...), Halfspaces(...) or Inequality(...); got {kind}")
            if constraint.size not in (None, self.state_dim):
                raise SettingError("constraints", f"must bound {self.state_dim} states; got {constraint.size}")
        object.__setattr__(self, "constraints", tuple(given))

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return len(self.cost.Q)

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return len(self.cost.R)

    def price(self, constraint: Constraint) -> float:
        """Returns the price of violating a constraint, infinite for a hard one."""
        if constraint.penalty == "exact":
            return _EXACT * self.cost.largest_weight
        return math.inf if constraint.penalty is None else float(constraint.penalty)


def by_stage(key: str, values: Array, horizon: int, dims: int) -> Array:
    """Returns values of every stage, given of every stage or of one (whose array has ``dims`` axes).

    Raises:
        SettingError: Of another number of stages.
    """
    if values.ndim == dims:
        return np.ascontiguousarray(np.broadcast_to(values, (horizon, *values.shape)))
    if len(values) != horizon:
        raise SettingError(key, f"must be given for one stage or all {horizon}; got {len(values)}")
    return np.ascontiguousarray(values)


def _numbers(key: str, value: Any) -> Array:
    """An array from a list."""
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(())
    if array.ndim == 0 or not array.size or np.isnan(array).any():
        raise SettingError(key, f"must be a list of numbers, infinite where unbounded; got {value!r}")
    return array


def _weight(key: str, value: Any) -> Array:
    """A weight from its diagonal or its matrix."""
    try:
        weight = np.array(value, dtype=float)
    except (TypeError, ValueError):
        weight = np.empty(0)
    weight = np.diag(weight) if weight.ndim == 1 else weight
    if weight.ndim != 2 or len(weight) != len(weight.T) or not weight.size:
        raise SettingError(key, f"must be the diagonal of a weight or a square matrix; got {value!r}")
    if not np.isfinite(weight).all():
        raise SettingError(key, f"must be finite; got {value!r}")
    if not np.allclose(weight, weight.T, rtol=1e-12, atol=0):
        raise SettingError(key, "must be symmetric")
    lowest = np.linalg.eigvalsh(weight)[0]
    if lowest < -1e-12 * max(1.0, np.abs(weight).max()):
        raise SettingError(key, f"must be positive semidefinite; its smallest eigenvalue is {lowest:.3g}")
    return weight
