"""The tracking problem of all controllers: weights and bounds.

    minimise    sum_{i=1..H} E|x_i - r_i|^2_Q + sum_{i=0..H-1} |v_i|^2_R       (the last state's weight may be another)
    subject to  input_lower <= u_i <= input_upper,   rate_lower <= u_i - u_{i-1} <= rate_upper,
                P(x_ij >= lower_j) >= eta,  P(x_ij <= upper_j) >= eta          for every bounded state j

where v is the input itself, its deviation from the reference input, or its increment (Cao, Lai and Alam, 2017,
sections 3.2-3.3). For a Gaussian x_i, E|x - r|^2_Q = |mu - r|^2_Q + tr(Q Sigma), and a chance constraint is mu_j within
the bounds by kappa(eta) sqrt(Sigma_jj), kappa(eta) = Phi^-1(eta).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from statistics import NormalDist
from typing import Any, Literal

import numpy as np

from gpmpc.exceptions import SettingError, check_number
from gpmpc.qp.problem import ABSENT

Penalized = Literal["inputs", "deviations", "increments"]


@dataclass(frozen=True)
class StateBounds:
    """Bounds on single states, each to hold with probability eta.

    Attributes:
        lower: List or array (n,), kept as an array; -inf where there is none.
        upper: (n,); inf where there is none.
        confidence: eta.
        kappa: Standard deviations kept from a bound; Phi^-1(eta) unless given (the paper takes 2 for eta = 0.95).
        l1: Exact penalty weight per unit of violation; where it is large enough, bounds that can be kept are kept.
        l2: Quadratic penalty weight of the violation. Without either, the bounds are hard.

    Raises:
        SettingError: Crossed bounds, eta outside (0.5, 1), or a weight that is not positive.
    """

    lower: Any
    upper: Any
    confidence: float = 0.95
    kappa: Any = None
    l1: float | None = None
    l2: float | None = None

    def __post_init__(self) -> None:
        for key in ("lower", "upper"):
            if np.ndim(getattr(self, key)) != 1:
                raise SettingError(
                    key, f"must be a list of n numbers, infinite where unbounded; got {getattr(self, key)!r}"
                )
        _set_bounds(self, "lower", "upper", len(self.lower))
        check_number("confidence", self.confidence)
        if not 0.5 < self.confidence < 1:
            raise SettingError("confidence", f"eta must lie in (0.5, 1); got {self.confidence}")
        if self.kappa is None:
            object.__setattr__(self, "kappa", NormalDist().inv_cdf(self.confidence))
        check_number("kappa", self.kappa, least=0)
        for key in ("l1", "l2"):
            if getattr(self, key) is not None:
                check_number(key, getattr(self, key), above=0)

    @property
    def soft(self) -> bool:
        """Whether a violation is priced instead of forbidden."""
        return self.l1 is not None or self.l2 is not None


@dataclass(frozen=True)
class TrackingProblem:
    """Weights and bounds; see the module's text.

    Attributes:
        Q: State weights, the diagonal (n,) or the matrix (n, n).
        R: Input weights, the diagonal (m,) or the matrix (m, m).
        penalized: What R weighs: ``"inputs"``, ``"deviations"`` from the reference inputs, or ``"increments"``.
        terminal: Weight of the last predicted state, like Q; Q itself by default.
        input_lower: List or array (m,), kept as an array as the others; none by default.
        input_upper: (m,).
        rate_lower: Bound on u_i - u_{i-1} (m,) per step; none by default.
        rate_upper: (m,).
        state_bounds: Chance constraints; none by default.

    Raises:
        SettingError: A weight is not symmetric positive semidefinite, R is zero in a direction, bounds are crossed, or
            a length is wrong.
    """

    Q: Any
    R: Any
    penalized: Penalized = "inputs"
    terminal: Any = None
    input_lower: Any = None
    input_upper: Any = None
    rate_lower: Any = None
    rate_upper: Any = None
    state_bounds: StateBounds | None = None

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
        if self.penalized not in ("inputs", "deviations", "increments"):
            raise SettingError("penalized", f"must be 'inputs', 'deviations' or 'increments'; got {self.penalized!r}")
        _set_bounds(self, "input_lower", "input_upper", self.input_dim)
        _set_bounds(self, "rate_lower", "rate_upper", self.input_dim)
        if not isinstance(self.state_bounds, StateBounds | None):
            raise SettingError("state_bounds", f"must be StateBounds(...); got {type(self.state_bounds).__name__}")
        if self.state_bounds is not None and len(self.state_bounds.lower) != self.state_dim:
            raise SettingError(
                "state_bounds", f"must bound {self.state_dim} states; got {len(self.state_bounds.lower)}"
            )

    @property
    def state_dim(self) -> int:
        """Number of states, n."""
        return len(self.Q)

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return len(self.R)

    @cached_property
    def rate_limited(self) -> bool:
        """Whether there is any bound on the increments."""
        return bool(np.isfinite(self.rate_lower).any() or np.isfinite(self.rate_upper).any())


def _weight(key: str, value: Any) -> np.ndarray:
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


def _set_bounds(owner: Any, lower_key: str, upper_key: str, length: int) -> None:
    """Replaces a pair of bounds of a frozen dataclass by arrays; None becomes infinite."""
    for key, absent in ((lower_key, -math.inf), (upper_key, math.inf)):
        value = getattr(owner, key)
        try:
            array = np.full(length, absent) if value is None else np.array(value, dtype=float)
        except (TypeError, ValueError):
            array = np.empty(0)
        if array.shape != (length,) or np.isnan(array).any():
            raise SettingError(key, f"must be a list of {length} numbers; got {value!r}")
        if (-np.sign(absent) * array >= ABSENT).any():
            raise SettingError(key, f"no number keeps it: a bound of size {ABSENT:g} or more is none; got {value!r}")
        object.__setattr__(owner, key, array)
    lower, upper = getattr(owner, lower_key), getattr(owner, upper_key)
    for j in np.flatnonzero(lower > upper)[:1]:
        raise SettingError(
            f"{lower_key}, {upper_key}", f"must not cross; entry {j} has {lower[j]:g} above {upper[j]:g}"
        )
