"""Declares the problem of a controller: a cost, bounds of inputs, and constraints.

    minimise    sum_{i=1..H} E|x_i - r_i|^2_Q + |v_{i-1}|^2_R
                + sum_j E|y_j(x_i, u_{i-1}, p_i) - c_j|^2_W
    subject to  bounds on u_i and on u_i - u_{i-1}, and the constraints of the states
                x_1 .. x_H

v is the input itself, its deviation from the reference input, or its increment (Cao,
Lai and Alam, 2017, sections 3.2-3.3). Weights, bounds, references c and parameters p
may differ by stage; stage i pairs a state with the input that led to it. For a Gaussian
x_i, E|x - r|^2_Q = |mu - r|^2_Q + tr(Q Sigma).

A constraint g'x <= f of a Gaussian state holds with probability eta where
g'mu + kappa sqrt(g'Sigma g) <= f, kappa = Phi^-1(eta); smooth ones, h(x, u, p) <= 0,
are linearised along the plan. By default a constraint is soft: a violation pays a
price, so that a program always has a solution. The penalty is exact (Fletcher, 1987,
section 14.3): as long as the price exceeds what the cost can gain by a violation, no
plan that can keep the constraint pays it. It is 1e6 largest weights per distance by
which a state is beyond the bound; multipliers are twice a weight times how far the cost
would go beyond it. Where it cannot be kept, an elastic one gives way: its price falls
to what cannot outweigh the cost (``gpmpc.mpc._elastic``).
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from statistics import NormalDist
from typing import Any, Literal, NamedTuple

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import SettingError, check_kind, check_number
from gpmpc.mpc._cost import (
    Expansion,
    FunctionNotFinite,
    LeastSquares,
    Tracking,
    by_stage,
    expand_function,
    of_first_states,
    read_numbers,
)
from gpmpc.qp._problem import ABSENT

Array = np.ndarray

# The exact price of a distance of 1, in the cost's largest weight: more than the
# multiplier of any bound that is less than half of this from what the cost asks for.
EXACT = 1e6


class ConstraintSides(NamedTuple):
    """Rows lower <= F x <= upper of a constraint, of which each has one side only."""

    F: Array  # (r, n)
    lower: Array  # (H, r)
    upper: Array  # (H, r)


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """A constraint of the states: how surely it holds, at what price, at which stages.

    Raises:
        SettingError: A probability outside (0.5, 1), a negative kappa, a price that is
            not positive, or stages below 1.
    """

    #: eta in (0.5, 1), with which each side is to hold at each stage; None: the mean
    #: keeps it
    probability: float | None = None
    #: standard deviations between the mean and a side; Phi^-1(eta) unless given (the
    #: paper takes 2 for 0.95)
    kappa: float | None = None
    #: price of a violation per unit and stage; ``"exact"``: one that no plan pays which
    #: can keep the constraint, unless the cost asks for states some 1e5 units beyond
    #: it; slopes of ``Inequality`` and ``LeastSquares`` are to be near 1;
    #: ``"elastic"``: the exact one, and where the constraint cannot be kept one for
    #: which the plan costs at most five times what it costs without
    #: (``gpmpc.mpc._elastic``); None: hard
    penalty: float | Literal["elastic", "exact"] | None = "elastic"
    #: those of 1 .. H that it holds at, such as ``range(5, 11)``; all by default
    stages: Iterable[int] | None = None
    #: whether eta is for all sides and stages together, by Boole's inequality: each
    #: gets its part of 1 - eta
    joint: bool = False

    def __post_init__(self) -> None:
        if self.probability is not None:
            check_number("probability", self.probability)
            if not 0.5 < self.probability < 1:
                rule = "must lie in (0.5, 1)"
                raise SettingError("probability", f"{rule}; got {self.probability}")
        elif self.joint:
            raise SettingError("joint", "needs a probability")
        if self.kappa is not None:
            check_number("kappa", self.kappa, least=0)
        if self.penalty is not None and self.penalty not in ("elastic", "exact"):
            check_number("penalty", self.penalty, above=0)
        if self.stages is not None:
            object.__setattr__(self, "stages", self._read_stages())

    def _read_stages(self) -> tuple[int, ...]:
        """Returns the stages as a tuple of whole numbers from 1 on."""
        stages = ()
        if isinstance(self.stages, Iterable):
            stages = tuple(np.asarray(list(self.stages)).tolist())
        whole = all(type(stage) is int and stage > 0 for stage in stages)
        if not (stages and whole):
            rule = "must be whole numbers from 1 on"
            raise SettingError("stages", f"{rule}; got {self.stages!r}")
        return stages

    def rows(self, horizon: int) -> ConstraintSides:
        """Returns the rows of all stages."""
        raise NotImplementedError

    def over(self, n: int, states: int) -> "Constraint":
        """Returns the constraint of the first n of more states."""
        raise NotImplementedError

    def standard_deviations(self, sides: int = 1) -> float:
        """Returns kappa of each of a number of sides, all stages counted."""
        if self.kappa is not None or self.probability is None or sides == 0:
            return float(self.kappa or 0.0)
        risk = 1.0 - self.probability
        return NormalDist().inv_cdf(1.0 - risk / (sides if self.joint else 1))


@explains_arguments
@dataclass(frozen=True)
class Box(Constraint):
    """Bounds lower <= x <= upper of states, inputs or increments.

    Those of inputs and increments come without the keywords.

    Raises:
        SettingError: Crossed bounds, or as for ``Constraint``.

    Of a state with a probability p it is E[x] + kappa std(x) <= upper, kappa the
    quantile of the normal distribution at p, and likewise below.

    >>> Box([-1.0, -math.inf], [1.0, math.inf], probability=0.95).size
    2

    See Also:
        ``Halfspaces`` and ``Inequality``; ``Problem``, whose inputs, rates and
        constraints they are.
    """

    #: list or array (d,), or (H, d) by stage, kept as an array; -inf where there is
    #: none; None: none at all
    lower: Any = None
    upper: Any = None  #: likewise; inf where there is none

    def __post_init__(self) -> None:
        super().__post_init__()
        lower_side = None if self.lower is None else read_numbers("lower", self.lower)
        upper_side = None if self.upper is None else read_numbers("upper", self.upper)
        shape: tuple[int, ...] = (0,)
        if lower_side is not None:
            shape = lower_side.shape
        elif upper_side is not None:
            shape = upper_side.shape
        lower = self._check_side("lower", lower_side, shape, absent=-math.inf)
        upper = self._check_side("upper", upper_side, shape, absent=math.inf)
        crossed = np.argwhere(lower > upper)
        if len(crossed):
            index = tuple(crossed[0])
            got = f"entry {index[-1]} has {lower[index]:g} above {upper[index]:g}"
            raise SettingError("lower, upper", f"must not cross; {got}")
        object.__setattr__(self, "lower", lower)
        object.__setattr__(self, "upper", upper)

    def _check_side(
        self, key: str, side: Array | None, shape: tuple[int, ...], absent: float
    ) -> Array:
        """Returns one side as an array of the shape of both."""
        value = getattr(self, key)
        array = np.full(shape, absent) if side is None else side
        fits = array.ndim in (1, 2) and array.shape == shape
        if not fits or np.isnan(array).any():
            rule = f"must be a list of {shape[-1]} numbers, or one by stage"
            raise SettingError(key, f"{rule}; got {value!r}")
        if (-np.sign(absent) * array >= ABSENT).any():
            rule = f"no number keeps it: a bound of size {ABSENT:g} or more is none"
            raise SettingError(key, f"{rule}; got {value!r}")
        return array

    @property
    def size(self) -> int:
        """Number of bounded entries, d; 0 where both sides are None."""
        return self.lower.shape[-1]

    @cached_property
    def finite(self) -> bool:
        """Whether there is any bound."""
        return bool(np.isfinite(self.lower).any() or np.isfinite(self.upper).any())

    @cached_property
    def sides(self) -> tuple[Array, Array]:
        """Lower and upper bounds (K, d), of every stage or of one for all."""
        return self.lower.reshape(-1, self.size), self.upper.reshape(-1, self.size)

    @property
    def first(self) -> tuple[Array, Array]:
        """Lower and upper bounds (d,) of the first stage."""
        return self.sides[0][0], self.sides[1][0]

    def by_stage(self, horizon: int) -> tuple[Array, Array]:
        """Returns lower and upper bounds of every stage (H, d)."""
        lower = by_stage("lower", self.lower, horizon, 1)
        upper = by_stage("upper", self.upper, horizon, 1)
        return lower, upper

    def over(self, n: int, states: int) -> "Box":
        """Returns the bounds of the first n of more states."""
        further = [(0, 0)] * (self.lower.ndim - 1) + [(0, states - n)]
        return replace(
            self,
            lower=np.pad(self.lower, further, constant_values=-math.inf),
            upper=np.pad(self.upper, further, constant_values=math.inf),
        )

    def rows(self, horizon: int) -> ConstraintSides:
        """Returns one row for each entry with a bound, upper ones first."""
        lower, upper = self.by_stage(horizon)
        above = np.flatnonzero(np.isfinite(upper).any(axis=0))
        below = np.flatnonzero(np.isfinite(lower).any(axis=0))
        none = np.full((horizon, self.size), math.inf)
        return ConstraintSides(
            F=np.eye(self.size)[np.concatenate([above, below])],
            lower=np.hstack([-none[:, above], lower[:, below]]),
            upper=np.hstack([upper[:, above], none[:, below]]),
        )


@explains_arguments
@dataclass(frozen=True)
class Halfspaces(Constraint):
    """Linear constraints F x <= f of the states.

    Raises:
        SettingError: Shapes that do not belong together, numbers that are not finite, a
            zero row, or as for ``Constraint``.

    With a probability p it is F E[x] + kappa sqrt(diag(F Cov[x] F')) <= f.

    >>> Halfspaces(F=[[1.0, 1.0]], f=[2.0], probability=0.95).size  # x_1 + x_2 <= 2
    2

    See Also:
        ``Box`` for bounds of single states, ``Inequality`` for smooth functions.
    """

    F: Any  #: (r, n)
    f: Any  #: (r,), or (H, r) by stage

    def __post_init__(self) -> None:
        super().__post_init__()
        F = read_numbers("F", self.F)
        f = read_numbers("f", self.f)
        if F.ndim != 2 or f.ndim not in (1, 2) or f.shape[-1] != len(F):
            rule = "must be (r, n) and (r,) or (H, r)"
            raise SettingError("F, f", f"{rule}; got {F.shape} and {f.shape}")
        if not (np.isfinite(F).all() and np.isfinite(f).all() and F.any(axis=1).all()):
            rule = "must be finite, each row of F with an entry that is not zero"
            raise SettingError("F, f", rule)
        object.__setattr__(self, "F", F)
        object.__setattr__(self, "f", f)

    @property
    def size(self) -> int:
        """Number of states, n."""
        return self.F.shape[1]

    def over(self, n: int, states: int) -> "Halfspaces":
        """Returns the constraints of the first n of more states."""
        return replace(self, F=np.pad(self.F, ((0, 0), (0, states - n))))

    def rows(self, horizon: int) -> ConstraintSides:
        """Returns F, no lower bounds, and f of every stage."""
        upper = by_stage("f", self.f, horizon, 1)
        return ConstraintSides(self.F, np.full_like(upper, -math.inf), upper)


@explains_arguments
@dataclass(frozen=True)
class Inequality(Constraint):
    """Smooth constraints h(x_i, u_{i-1}, p_i) <= 0, such as obstacles.

    They are linearised along the plan. Their standard deviation is the one along the
    gradient, sqrt(dh Sigma dh'). A gradient that vanishes says nothing of where to go:
    prefer ``radius - distance`` to ``radius**2 - distance**2``.

    Raises:
        SettingError: h is no function, or as for ``Constraint``.

    >>> import torch
    >>> def too_near(x, u, p):  # inside a disc of radius 0.3 around p
    ...     return 0.3 - torch.linalg.vector_norm(x - p, dim=-1)
    >>> Inequality(too_near, probability=0.95).count
    1

    See Also:
        ``Box`` and ``Halfspaces``, which are linear; ``ControlLoop.input``, which takes
        the parameters p.
    """

    #: a function of tensors or in CasADi, like y of ``LeastSquares``, that gives
    #: (H, count)
    h: Any
    count: int = 1  #: number of values of h at a stage

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("count", self.count, least=1, whole=True)
        if not callable(self.h):
            raise SettingError("h", f"must be a function; got {type(self.h).__name__}")

    def over(self, n: int, states: int) -> "Inequality":
        """Returns the constraints of the first n of more states."""
        return replace(self, h=of_first_states(self.h, n, states))

    def rows(self, horizon: int) -> ConstraintSides:
        """Returns the places of its rows: gradients without columns, bounds of 0."""
        upper = np.zeros((horizon, self.count))
        lower = np.full_like(upper, -math.inf)
        return ConstraintSides(np.zeros((self.count, 0)), lower, upper)

    def expand(
        self, states: Array, inputs: Array, parameters: Array | None
    ) -> Expansion:
        """Returns h and its gradients along a plan; see ``expand_function``."""
        return expand_function("h", self.h, self.count, states, inputs, parameters)


@explains_arguments
@dataclass(frozen=True)
class Problem:
    """A cost, bounds of the inputs, and constraints of the states.

    Raises:
        SettingError: A part is of another kind or length than the cost asks for.

    >>> problem = Problem(
    ...     Tracking(Q=[10.0, 1.0], R=[0.1]),
    ...     inputs=Box([-2.0], [2.0]),
    ...     constraints=[Box([-1.0, -math.inf], [1.0, math.inf])],
    ... )
    >>> problem.state_dim, problem.input_dim
    (2, 1)

    See Also:
        ``GPMPC`` and the other controllers, which take it.
    """

    cost: Tracking  #: of states and inputs; its Q may be zero
    inputs: Box = field(default_factory=Box)  #: bounds of the inputs; none by default
    #: bounds of u_i - u_{i-1} per step; none by default
    input_rates: Box = field(default_factory=Box)
    #: of the states, ``Box``, ``Halfspaces`` or ``Inequality``; none by default
    constraints: Sequence[Constraint] = ()
    #: costs of outputs, ``LeastSquares``, beside ``cost``; none by default
    outputs: Sequence[LeastSquares] = ()

    def __post_init__(self) -> None:
        if not isinstance(self.cost, Tracking):
            got = type(self.cost).__name__
            raise SettingError("cost", f"must be Tracking(...); got {got}")
        object.__setattr__(self, "inputs", self._read_box("inputs"))
        object.__setattr__(self, "input_rates", self._read_box("input_rates"))
        constraints = self._read_parts(
            "constraints",
            Constraint,
            "Box(...), Halfspaces(...) or Inequality(...)",
        )
        object.__setattr__(self, "constraints", constraints)
        outputs = self._read_parts("outputs", LeastSquares, "LeastSquares(...)")
        object.__setattr__(self, "outputs", outputs)

    def with_angles(self, angles: Sequence[int]) -> "Problem":
        """Returns the problem with a model's angles, where its cost names none."""
        if self.cost.angles is not None:
            return self
        return replace(self, cost=replace(self.cost, angles=tuple(angles)))

    def over(self, states: int) -> "Problem":
        """Returns the problem of more states, of which these are the first.

        Further ones cost nothing and are not bounded; functions do not see them.
        """
        n = self.state_dim
        if states == n:
            return self
        further = states - n
        cost = self.cost
        weight = ((0, further), (0, further))
        stage_axis = ((0, 0),) * (cost.Q.ndim - 2)
        return replace(
            self,
            cost=replace(
                cost,
                Q=np.pad(cost.Q, (*stage_axis, *weight)),
                terminal=np.pad(cost.terminal, weight),
            ),
            constraints=[part.over(n, states) for part in self.constraints],
            outputs=[
                replace(output, y=of_first_states(output.y, n, states))
                for output in self.outputs
            ],
        )

    def _read_box(self, key: str) -> Box:
        """Returns bounds of inputs or increments, infinite where there are none."""
        value = getattr(self, key)
        box = Box() if value is None else value
        if not isinstance(box, Box):
            got = type(box).__name__
            raise SettingError(key, f"must be Box(lower, upper); got {got}")
        keywords = (box.probability, box.kappa, box.penalty, box.stages)
        if keywords != (None, None, "elastic", None):
            rule = "has bounds that are always kept: no probability, penalty or stages"
            raise SettingError(key, rule)
        if not box.size:
            box = Box(np.full(self.input_dim, -math.inf))
        if box.size != self.input_dim:
            rule = f"must bound {self.input_dim} inputs"
            raise SettingError(key, f"{rule}; got {box.size}")
        return box

    def _read_parts(self, key: str, kind: type, examples: str) -> tuple[Any, ...]:
        """Returns constraints or outputs as a tuple, given as some, one or None."""
        value = getattr(self, key)
        if value is None:
            return ()
        values = (value,)
        if isinstance(value, Iterable) and not isinstance(value, str | Mapping):
            values = tuple(value)
        for each in values:
            check_kind(key, each, kind, examples)
            size = getattr(each, "size", None)
            if size not in (None, self.state_dim):
                rule = f"must bound {self.state_dim} states"
                raise SettingError(key, f"{rule}; got {size}")
        return values

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return self.cost.Q.shape[-1]

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return self.cost.R.shape[-1]

    def check_plain(self, name: str) -> None:
        """Raises ``SettingError`` where there are functions to linearise.

        A controller of this name does not linearise them.
        """
        smooth = any(isinstance(part, Inequality) for part in self.constraints)
        if self.outputs or smooth:
            rule = f"{name} takes Box and Halfspaces"
            others = "Inequality and LeastSquares are for GPMPC"
            raise SettingError("problem", f"{rule}; {others}")

    def check_start(self, state: Array, input: Array) -> None:
        """Raises ``SettingError`` where a function is not finite at the start.

        Neither may its gradient be. The start is a state (n,) and an input (m,).
        """
        states = state[None]
        inputs = input[None]
        try:
            for output in self.outputs:
                count = output.weight.shape[-1]
                expand_function("y", output.y, count, states, inputs, None)
            for constraint in self.constraints:
                if isinstance(constraint, Inequality):
                    constraint.expand(states, inputs, None)
        except FunctionNotFinite as error:
            rule = f"{error}, where the flight starts"
            raise SettingError("controller.problem", rule) from None

    @cached_property
    def largest_weight(self) -> float:
        """The largest eigenvalue of a weight of the cost."""
        cost = self.cost
        weights = [cost.Q, cost.terminal, cost.R]
        weights += [output.weight for output in self.outputs]
        return float(max(np.linalg.eigvalsh(W).max() for W in weights))

    def prices(self, constraint: Constraint, F: Array) -> Array:
        """Returns the prices of violating the rows of a constraint (r,).

        They are infinite for a hard one. An exact price is one of the distance by which
        a state is beyond the bound: a row with a gradient of another length than 1 has
        another one per unit, so that rows may be scaled.

        Args:
            constraint: One of the problem.
            F: Its rows (r, n); without columns where gradients are not known before
                there is a plan, which count as 1.
        """
        rows = len(F)
        if constraint.penalty is None:
            return np.full(rows, math.inf)
        if constraint.penalty not in ("elastic", "exact"):
            return np.full(rows, float(constraint.penalty))
        lengths = np.ones(rows)
        if F.shape[1] > 0:
            lengths = np.linalg.norm(F, axis=1)
        return EXACT * self.largest_weight / lengths
