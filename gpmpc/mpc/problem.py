"""Declares what a controller makes small and what it keeps: one problem for all controllers.

    minimise    sum_{i=1..H} E|x_i - r_i|^2_Q + |v_{i-1}|^2_R + sum_j E|y_j(x_i, u_{i-1}, p_i) - c_j|^2_W
    subject to  bounds on u_i and on u_i - u_{i-1}, and the constraints of the states x_1 .. x_H

v is the input itself, its deviation from the reference input, or its increment (Cao, Lai and Alam, 2017, sections
3.2-3.3). Weights, bounds, references c and parameters p may differ by stage; stage i pairs a state with the input that
led to it. For a Gaussian x_i, E|x - r|^2_Q = |mu - r|^2_Q + tr(Q Sigma).

A constraint g'x <= f of a Gaussian state holds with probability eta where g'mu + kappa sqrt(g'Sigma g) <= f,
kappa = Phi^-1(eta); smooth ones, h(x, u, p) <= 0, are linearised along the plan. By default a constraint is soft: a
violation pays a price, so that a program always has a solution. The penalty is exact (Fletcher, 1987, section 14.3): as
long as the price exceeds what the cost can gain by a violation, no plan that can keep the constraint pays it. Where it
cannot be kept, an elastic one gives way: its price falls to what cannot outweigh the cost (``gpmpc.mpc._elastic``).
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from gpmpc.exceptions import SettingError, check_number
from gpmpc.mpc._cost import (
    FunctionNotFinite,
    LeastSquares,
    Tracking,
    by_stage,
    expand_function,
    read_numbers,
)
from gpmpc.qp._problem import ABSENT

Array = np.ndarray

_EXACT = 1e6  # the exact price, in the cost's largest weight: more than any multiplier that a bound is worth


@dataclass(frozen=True, kw_only=True)
class Constraint:
    """What every constraint of the states has beside its sides.

    Raises:
        SettingError: A probability outside (0.5, 1), a negative kappa, a price that is not positive, or stages below 1.
    """

    #: eta in (0.5, 1), with which each side is to hold at each stage; None: the mean keeps it
    probability: float | None = None
    #: standard deviations between the mean and a side; Phi^-1(eta) unless given (the paper takes 2 for 0.95)
    kappa: float | None = None
    #: price of a violation per unit and stage; ``"exact"``: one that no plan pays which can keep the constraint;
    #: ``"elastic"``: the exact one, and where the constraint cannot be kept one for which the plan costs at most
    #: five times what it costs without (``gpmpc.mpc._elastic``); None: hard
    penalty: float | Literal["elastic", "exact"] | None = "elastic"
    stages: Iterable[int] | None = (
        None  #: those of 1 .. H that it holds at, such as ``range(5, 11)``; all by default
    )
    #: whether eta is for all sides and stages together, by Boole's inequality: each gets its part of 1 - eta
    joint: bool = False

    def __post_init__(self) -> None:
        if self.probability is not None:
            check_number("probability", self.probability)
            if not 0.5 < self.probability < 1:
                raise SettingError(
                    "probability", f"must lie in (0.5, 1); got {self.probability}"
                )
        elif self.joint:
            raise SettingError("joint", "needs a probability")
        if self.kappa is not None:
            check_number("kappa", self.kappa, least=0)
        if self.penalty is not None and self.penalty not in ("elastic", "exact"):
            check_number("penalty", self.penalty, above=0)
        if self.stages is not None:
            stages = tuple(self.stages) if isinstance(self.stages, Iterable) else ()
            if not stages or not all(
                isinstance(stage, int) and stage > 0 for stage in stages
            ):
                raise SettingError(
                    "stages", f"must be whole numbers from 1 on; got {self.stages!r}"
                )
            object.__setattr__(self, "stages", stages)

    def rows(self, horizon: int) -> tuple[Array, Array, Array]:
        """Returns F (r, n), lower and upper (H, r) of rows lower <= F x <= upper, of which each has one side only."""
        raise NotImplementedError

    def standard_deviations(self, sides: int = 1) -> float:
        """Returns kappa of each of a number of sides, all stages counted."""
        if self.kappa is not None or self.probability is None:
            return float(self.kappa or 0.0)
        return NormalDist().inv_cdf(
            1.0 - (1.0 - self.probability) / (sides if self.joint else 1)
        )


@dataclass(frozen=True)
class Box(Constraint):
    """Bounds lower <= x <= upper: of the states, and (without the keywords) of inputs or their increments.

    Raises:
        SettingError: Crossed bounds, or as for ``Constraint``.
    """

    #: list or array (d,), or (H, d) by stage, kept as an array; -inf where there is none; None: none at all
    lower: Any = None
    upper: Any = None  #: likewise; inf where there is none

    def __post_init__(self) -> None:
        super().__post_init__()
        given = [("lower", self.lower), ("upper", self.upper)]
        sides = [
            None if side is None else read_numbers(key, side) for key, side in given
        ]
        shape = next((side.shape for side in sides if side is not None), (0,))
        for (key, value), side, absent in zip(
            given, sides, (-math.inf, math.inf), strict=True
        ):
            array = np.full(shape, absent) if side is None else side
            if (
                array.ndim not in (1, 2)
                or array.shape != shape
                or np.isnan(array).any()
            ):
                raise SettingError(
                    key,
                    f"must be a list of {shape[-1]} numbers, or one by stage; got {value!r}",
                )
            if (-np.sign(absent) * array >= ABSENT).any():
                rule = f"no number keeps it: a bound of size {ABSENT:g} or more is none"
                raise SettingError(key, f"{rule}; got {value!r}")
            object.__setattr__(self, key, array)
        for at in np.argwhere(self.lower > self.upper)[:1]:
            got = f"entry {at[-1]} has {self.lower[tuple(at)]:g} above {self.upper[tuple(at)]:g}"
            raise SettingError("lower, upper", f"must not cross; {got}")

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
        """Lower and upper bounds (K, d), of every stage or of one that stands for all."""
        return self.lower.reshape(-1, self.size), self.upper.reshape(-1, self.size)

    @property
    def first(self) -> tuple[Array, Array]:
        """Lower and upper bounds (d,) of the first stage."""
        return self.sides[0][0], self.sides[1][0]

    def by_stage(self, horizon: int) -> tuple[Array, Array]:
        """Returns lower and upper bounds of every stage (H, d)."""
        return by_stage("lower", self.lower, horizon, 1), by_stage(
            "upper", self.upper, horizon, 1
        )

    def rows(self, horizon: int) -> tuple[Array, Array, Array]:
        """Returns one row for each entry with a bound, upper ones first."""
        lower, upper = self.by_stage(horizon)
        above, below = (
            np.flatnonzero(np.isfinite(side).any(axis=0)) for side in (upper, lower)
        )
        F = np.eye(self.size)[np.concatenate([above, below])]
        none = np.full((horizon, self.size), math.inf)
        return (
            F,
            np.hstack([-none[:, above], lower[:, below]]),
            np.hstack([upper[:, above], none[:, below]]),
        )


@dataclass(frozen=True)
class Halfspaces(Constraint):
    """Linear constraints F x <= f of the states.

    Raises:
        SettingError: Shapes that do not belong together, numbers that are not finite, a zero row, or as for
            ``Constraint``.
    """

    F: Any  #: (r, n)
    f: Any  #: (r,), or (H, r) by stage

    def __post_init__(self) -> None:
        super().__post_init__()
        F = read_numbers("F", self.F)
        f = read_numbers("f", self.f)
        if F.ndim != 2 or f.ndim not in (1, 2) or f.shape[-1] != len(F):
            raise SettingError(
                "F, f",
                f"must be (r, n) and (r,) or (H, r); got {F.shape} and {f.shape}",
            )
        if not (np.isfinite(F).all() and np.isfinite(f).all() and F.any(axis=1).all()):
            raise SettingError(
                "F, f", "must be finite, each row of F with an entry that is not zero"
            )
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
    """Smooth constraints h(x_i, u_{i-1}, p_i) <= 0, such as obstacles, linearised along the plan.

    Its standard deviation is the one along the gradient, sqrt(dh Sigma dh'). A gradient that vanishes says nothing of
    where to go: prefer ``radius - distance`` to ``radius**2 - distance**2``.

    Raises:
        SettingError: h is no function, or as for ``Constraint``.
    """

    h: Any  #: a function of tensors or in CasADi, like y of ``LeastSquares``, that gives (H, count)
    count: int = 1  #: number of values of h at a stage

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number("count", self.count, least=1, whole=True)
        if not callable(self.h):
            raise SettingError("h", f"must be a function; got {type(self.h).__name__}")

    def rows(self, horizon: int) -> tuple[Array, Array, Array]:
        """Returns the places of its rows: gradients zero, no lower bounds, and upper ones 0."""
        upper = np.zeros((horizon, self.count))
        return np.zeros((self.count, 0)), np.full_like(upper, -math.inf), upper

    def expand(
        self, states: Array, inputs: Array, parameters: Array | None
    ) -> tuple[Array, Array, Array]:
        """Returns h (H, r) and its gradients (H, r, n), (H, r, m) along a plan (H, n), (H, m)."""
        return expand_function("h", self.h, self.count, states, inputs, parameters)


@dataclass(frozen=True)
class Problem:
    """A cost, bounds of the inputs, and constraints of the states; see the module's text.

    Raises:
        SettingError: A part is of another kind or length than the cost asks for.
    """

    cost: Tracking  #: of states and inputs; its Q may be zero
    inputs: Box = field(default_factory=Box)  #: bounds of the inputs; none by default
    input_rates: Box = field(
        default_factory=Box
    )  #: bounds of u_i - u_{i-1} per step; none by default
    constraints: Sequence[
        Constraint
    ] = ()  #: of the states, ``Box``, ``Halfspaces`` or ``Inequality``; none by default
    outputs: Sequence[
        LeastSquares
    ] = ()  #: costs of outputs, ``LeastSquares``, beside ``cost``; none by default

    def __post_init__(self) -> None:
        if not isinstance(self.cost, Tracking):
            raise SettingError(
                "cost", f"must be Tracking(...); got {type(self.cost).__name__}"
            )
        for key in ("inputs", "input_rates"):
            box = Box() if getattr(self, key) is None else getattr(self, key)
            if not isinstance(box, Box):
                raise SettingError(
                    key, f"must be Box(lower, upper); got {type(box).__name__}"
                )
            if (box.probability, box.kappa, box.penalty, box.stages) != (
                None,
                None,
                "elastic",
                None,
            ):
                raise SettingError(
                    key,
                    "has bounds that are always kept: no probability, penalty or stages",
                )
            box = box if box.size else Box(np.full(self.input_dim, -math.inf))
            if box.size != self.input_dim:
                raise SettingError(
                    key, f"must bound {self.input_dim} inputs; got {box.size}"
                )
            object.__setattr__(self, key, box)
        examples = "Box(...), Halfspaces(...) or Inequality(...)"
        kinds = (
            ("constraints", Constraint, examples),
            ("outputs", LeastSquares, "LeastSquares(...)"),
        )
        for key, kind, examples in kinds:
            value = () if getattr(self, key) is None else getattr(self, key)
            parts = (value,) if isinstance(value, kind) else tuple(value)
            for part in parts:
                if not isinstance(part, kind):
                    raise SettingError(
                        key, f"must be {examples}; got {type(part).__name__}"
                    )
                size = getattr(part, "size", None)
                if size not in (None, self.state_dim):
                    raise SettingError(
                        key, f"must bound {self.state_dim} states; got {size}"
                    )
            object.__setattr__(self, key, parts)

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return self.cost.Q.shape[-1]

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return self.cost.R.shape[-1]

    def check_plain(self, name: str) -> None:
        """Raises ``SettingError`` where there are functions to linearise, which a controller of this name does not."""
        if self.outputs or any(
            isinstance(constraint, Inequality) for constraint in self.constraints
        ):
            raise SettingError(
                "problem",
                f"{name} takes Box and Halfspaces; Inequality and LeastSquares are for GPMPC",
            )

    def check_start(self, state: Array, input: Array) -> None:
        """Raises ``SettingError`` where a function, or its gradient, is not finite at a first state and input."""
        for part in (*self.outputs, *self.constraints):
            try:
                if isinstance(part, LeastSquares):
                    expand_function(
                        "y",
                        part.y,
                        part.weight.shape[-1],
                        state[None],
                        input[None],
                        None,
                    )
                elif isinstance(part, Inequality):
                    part.expand(state[None], input[None], None)
            except FunctionNotFinite as error:
                raise SettingError(
                    "controller.problem", f"{error}, where the flight starts"
                ) from None

    def price(self, constraint: Constraint) -> float:
        """Returns the price of violating a constraint, infinite for a hard one."""
        if constraint.penalty not in ("elastic", "exact"):
            return math.inf if constraint.penalty is None else float(constraint.penalty)
        weights = (
            self.cost.Q,
            self.cost.terminal,
            self.cost.R,
            *(part.weight for part in self.outputs),
        )
        return _EXACT * float(
            max(np.linalg.eigvalsh(weight).max() for weight in weights)
        )
