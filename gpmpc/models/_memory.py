"""What a model of a log remembers of the rows before the present one.

An actuator, a filter or an estimator lies between an input and what is measured of its
effect, so that one row does not say where a system goes. A memory is a linear filter of
the past features z and outputs y of a model: features of the last rows, and exponential
means of features and of outputs,

    s[k] = (z[k-1], .., z[k-p], e[k]),     e[k+1] = a e[k] + (1 - a) (z or y)[k],

a filter bank of fixed poles (Heuberger, Van den Hof and Wahlberg, 2005). All of it is
known from what was measured, so that nothing has to be estimated; in a rollout it is
filled with what is predicted. Means of outputs are what a disturbance is estimated by.

A linear term may see products of the last rows as well (polynomial NARX; Leontaritis
and Billings, 1985). Their factors are clipped to the ranges of the data, so that
outside of them nothing grows but what is linear.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.exceptions import SettingError, check_number


@dataclass(frozen=True)
class Products:
    """Products of the features of the last rows.

    Raises:
        SettingError: There are no rows or no factors, or the ranges do not fit.
    """

    rows: int  #: of which the features are factors, that of now among them
    degree: int  #: most factors of a product; two or more
    low: tuple[float, ...]  #: of each feature in the data (d,)
    high: tuple[float, ...]  #: likewise

    def __post_init__(self) -> None:
        check_number("rows", self.rows, least=1, whole=True)
        check_number("degree", self.degree, least=2, whole=True)
        is_range = len(self.low) == len(self.high)
        if not is_range or any(a > b for a, b in zip(self.low, self.high, strict=True)):
            got = f"{self.low} and {self.high}"
            raise SettingError("low", f"must be as many as high, none above; got {got}")

    @cached_property
    def factors(self) -> list[tuple[int, ...]]:
        """Indices of the factors of each product among the rows' features."""
        variables = range(self.rows * len(self.low))
        return [
            product
            for degree in range(2, self.degree + 1)
            for product in combinations_with_replacement(variables, degree)
        ]

    @cached_property
    def _steps(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """How the products of each degree come from those of one less.

        For each degree from two on, the indices of these and of the last factors.
        """
        variables = self.rows * len(self.low)
        shorter: list[tuple[int, ...]] = [(i,) for i in range(variables)]
        steps = []
        for degree in range(2, self.degree + 1):
            longer = [one for one in self.factors if len(one) == degree]
            places = {factors: i for i, factors in enumerate(shorter)}
            first = np.array([places[one[:-1]] for one in longer])
            steps.append((first, np.array([one[-1] for one in longer])))
            shorter = longer
        return steps

    def __call__(self, rows: Array) -> Array:
        """Computes the products (..., p).

        Args:
            rows: Features of the last rows, that of now first (..., rows d).
        """
        scaled = self._scaled(rows)
        columns = [scaled]
        for first, last in self._steps:
            columns.append(columns[-1][..., first] * scaled[..., last])
        return np.concatenate(columns[1:], axis=-1)

    def slopes(self, rows: Array) -> Array:
        """Computes the derivatives (..., p, rows d) of the products by the rows."""
        scaled = self._scaled(rows)
        half, _ = self._scale
        is_inside = np.abs(scaled) < 1
        identity = np.eye(rows.shape[-1]) * (is_inside / half)[..., None]
        values = [scaled]
        slopes = [identity]
        for first, last in self._steps:
            by_first = slopes[-1][..., first, :] * scaled[..., last, None]
            by_last = values[-1][..., first, None] * identity[..., last, :]
            slopes.append(by_first + by_last)
            values.append(values[-1][..., first] * scaled[..., last])
        return np.concatenate(slopes[1:], axis=-2)

    def _scaled(self, rows: Array) -> Array:
        """Returns features within [-1, 1]."""
        half, middle = self._scale
        return np.clip((rows - middle) / half, -1.0, 1.0)

    @cached_property
    def _scale(self) -> tuple[Array, Array]:
        """Half the ranges, and their middles, of the features of all rows (rows d,)."""
        low = np.tile(self.low, self.rows)
        high = np.tile(self.high, self.rows)
        half = (high - low) / 2
        return np.where(half > 0, half, 1.0), (high + low) / 2


@dataclass(frozen=True)
class Memory:
    """A filter bank over d features and o outputs.

    Raises:
        SettingError: A number of rows is negative, a decay is not within [0, 1), or
            products are of rows that are not remembered.
    """

    rows: int = 0  #: p, of which the features are remembered as they were
    #: a of each exponential mean of the features; a mean reaches over 1 / (1 - a) rows
    decays: tuple[float, ...] = ()
    output_decays: tuple[float, ...] = ()  #: likewise of the outputs
    products: Products | None = None  #: of the last rows, for the linear term alone

    def __post_init__(self) -> None:
        check_number("rows", self.rows, least=0, whole=True)
        if self.products is not None and self.products.rows > self.rows + 1:
            rule = f"must be of {self.rows + 1} rows at most"
            raise SettingError("products", f"{rule}; got {self.products.rows}")
        for decay in (*self.decays, *self.output_decays):
            if not 0 <= decay < 1:
                raise SettingError("decays", f"must be within [0, 1); got {decay}")

    @property
    def copies(self) -> int:
        """Number of copies of the features that are remembered."""
        return self.rows + len(self.decays)

    @property
    def empty(self) -> bool:
        """Whether nothing is remembered."""
        return not self.copies and not self.output_decays

    @property
    def rows_back(self) -> int:
        """Number of past rows from which it is filled; older ones hardly count."""
        if self.empty:
            return 0
        slowest = max((*self.decays, *self.output_decays, 0.0))
        return max(self.rows, round(2 / (1 - slowest)))

    def dim(self, features: int, outputs: int) -> int:
        """Returns the number of remembered numbers, for d features and o outputs."""
        return self.copies * features + len(self.output_decays) * outputs

    def regressor_dim(self, features: int, outputs: int) -> int:
        """Returns the number of regressors (see ``regressors``)."""
        products = 0 if self.products is None else len(self.products.factors)
        return features + self.dim(features, outputs) + products + 1

    def begin(self, features: Array, outputs: Array) -> Array:
        """Fills the memory with measured rows; means begin at the first one.

        Args:
            features: Of the rows before the present one (..., P, d), P of one or more.
            outputs: Likewise (..., P, o).

        Returns:
            What is remembered at the row after them (..., s).
        """
        P = features.shape[-2]
        columns = []
        for row in range(1, self.rows + 1):
            columns.append(features[..., max(P - row, 0), :])
        for decay in self.decays:
            columns.append(_exponential_mean(features, decay))
        for decay in self.output_decays:
            columns.append(_exponential_mean(outputs, decay))
        batch = features.shape[:-2]
        return np.concatenate(columns or [np.empty((*batch, 0))], axis=-1)

    def step(self, memory: Array, features: Array, outputs: Array) -> Array:
        """Returns what is remembered a row later (..., s).

        Args:
            memory: What is remembered now (..., s).
            features: Of the present row (..., d).
            outputs: Likewise (..., o).
        """
        d = features.shape[-1]
        o = outputs.shape[-1]
        end = 0
        columns = []
        if self.rows:
            end = self.rows * d
            columns += [features, memory[..., : end - d]]
        for decay in self.decays:
            mean = memory[..., end : end + d]
            columns.append(decay * mean + (1 - decay) * features)
            end += d
        for decay in self.output_decays:
            mean = memory[..., end : end + o]
            columns.append(decay * mean + (1 - decay) * outputs)
            end += o
        if not columns:
            return memory
        return np.concatenate(columns, axis=-1)

    def regressors(self, features: Array, memory: Array) -> Array:
        """Returns the regressors (..., r) of a linear term.

        They are the features, their differences from those that are remembered, the
        means of the outputs, the products, and one.
        """
        d = features.shape[-1]
        copies = memory[..., : self.copies * d]
        copies = copies.reshape(*memory.shape[:-1], self.copies, d)
        differences = features[..., None, :] - copies
        flat = differences.reshape(*memory.shape[:-1], self.copies * d)
        output_means = memory[..., self.copies * d :]
        columns = [features, flat, output_means]
        if self.products is not None:
            columns.append(self.products(self._factors(features, memory)))
        columns.append(np.ones((*memory.shape[:-1], 1)))
        return np.concatenate(columns, axis=-1)

    def regressor_names(
        self, features: Sequence[str], outputs: Sequence[str]
    ) -> list[str]:
        """Names the regressors but for the last one, by the names of what they are of.

        >>> Memory(rows=2).regressor_names(["angle"], ["d_angle"])
        ['angle', 'change of angle over 1 row', 'change of angle over 2 rows']
        """
        spans = ["1 row", *(f"{row} rows" for row in range(2, self.rows + 1))]
        names = [*features]
        for span in spans[: self.rows]:
            names += [f"change of {name} over {span}" for name in features]
        for decay in self.decays:
            rows = round(1 / (1 - decay))
            names += [f"{name} less its mean over {rows} rows" for name in features]
        for decay in self.output_decays:
            rows = round(1 / (1 - decay))
            names += [f"mean of {name} over {rows} rows" for name in outputs]
        products = 0 if self.products is None else len(self.products.factors)
        return names + [f"product {number + 1}" for number in range(products)]

    def product_slopes(self, features: Array, memory: Array) -> tuple[Array, Array]:
        """Computes the derivatives of the products, where the memory has some.

        Args:
            features: Of the present row (..., d).
            memory: What is remembered (..., s).

        Returns:
            Those by the features (..., p, d) and by what is remembered (..., p, s).
        """
        assert self.products is not None
        d = features.shape[-1]
        slopes = self.products.slopes(self._factors(features, memory))
        by_memory = np.zeros((*slopes.shape[:-1], memory.shape[-1]))
        by_memory[..., : slopes.shape[-1] - d] = slopes[..., d:]
        return slopes[..., :d], by_memory

    def _factors(self, features: Array, memory: Array) -> Array:
        """Returns the features of the last rows, that of now first (..., rows d)."""
        assert self.products is not None
        earlier = (self.products.rows - 1) * features.shape[-1]
        return np.concatenate([features, memory[..., :earlier]], axis=-1)


def _exponential_mean(rows: Array, decay: float) -> Array:
    """Computes the exponential mean (..., d) of rows (..., P, d) after the last one."""
    P = rows.shape[-2]
    weights = (1 - decay) * decay ** np.arange(P - 1, -1, -1.0)
    weights[0] += decay**P  # the mean begins at the first row
    return np.einsum("p,...pd->...d", weights, rows)


NO_MEMORY = Memory()
