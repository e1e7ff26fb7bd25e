"""Linearises models of logs, with all that they carry on beside a state.

What is carried on moves on linearly: inputs through lags and delays, past rows through
the memory. So does the linear term, and GPs have their own derivatives. Features,
nominal part and kinematics are functions of a state and of the inputs as they act:
only they are differentiated by central differences, all points in one batch.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from gpmpc._angles import wrap
from gpmpc._dynamics import Array, Linearized
from gpmpc.models._log_model import LogModel, OutputGP

#: of central differences, relative to entries above one; angles differ by radians
#: whatever their turns
DIFFERENCE = 1e-5


class LogLinearizer:
    """Linearises one model of a log at many points.

    Args:
        model: Without context.
        input_dim: m.
        time_step: [s].
    """

    def __init__(self, model: LogModel, input_dim: int, time_step: float):
        self._model = model
        self._m = input_dim
        self._time_step = time_step
        self._n = model.kinematics.space.dim
        self._o = len(model.history)
        self._angles = list(model.kinematics.space.angles)
        self._maps = _linear_maps(model, input_dim, time_step)

    def __call__(self, states: Array, inputs: Array, covariance: bool) -> Linearized:
        """Linearises at K points.

        Args:
            states: With all that is carried on (K, n + ...).
            inputs: (K, m).
            covariance: Whether the covariances at the points are computed.
        """
        n = self._n
        maps = self._maps
        state_parts = self._model.parts(states, self._m)
        carried = states[:, n:]
        acting = carried @ maps.acting_by_carried.T + inputs @ maps.acting_by_input.T
        x = state_parts.states
        local = self._differentiate(x, acting)
        outputs = self._outputs(local, state_parts.memory, covariance)
        after = self._model.kinematics.step(x, outputs.mean, self._time_step)
        carried_after = (
            carried @ maps.carried_by_carried.T
            + inputs @ maps.carried_by_input.T
            + local.features @ maps.carried_by_features.T
            + outputs.learned @ maps.carried_by_learned.T
        )
        slopes = self._next_slopes(x, local, outputs)
        V = None
        if covariance:
            V = slopes.by_learned @ outputs.covariance @ slopes.by_learned.mT
        return Linearized(
            np.concatenate([after, carried_after], axis=1),
            self._by_state(slopes, outputs.by_memory),
            self._by_input(slopes),
            V,
        )

    def _next_slopes(
        self, x: Array, local: "_PointValues", outputs: "_LocalOutputs"
    ) -> "_NextSlopes":
        """Returns the derivatives of the next state, with all that it carries on."""
        maps = self._maps
        state_by_state, state_by_outputs = self._differentiate_step(x, outputs.mean)
        state_by_point = state_by_outputs @ outputs.by_point
        state_by_point[..., : self._n] += state_by_state
        carried_by_point = maps.carried_by_features @ local.features_by_point
        carried_by_point = (
            carried_by_point + maps.carried_by_learned @ outputs.learned_by_point
        )
        carried_by_outputs = np.broadcast_to(
            maps.carried_by_learned, (len(x), *maps.carried_by_learned.shape)
        )
        return _NextSlopes(
            by_point=np.concatenate([state_by_point, carried_by_point], axis=1),
            by_learned=np.concatenate([state_by_outputs, carried_by_outputs], axis=1),
        )

    def _by_state(self, slopes: "_NextSlopes", by_memory: Array) -> Array:
        """Returns A, the derivatives by the state and what is carried on (K, N, N)."""
        n = self._n
        maps = self._maps
        points, size, _ = slopes.by_point.shape
        A = np.empty((points, size, size))
        A[..., :n] = slopes.by_point[..., :n]
        A[..., n:] = slopes.by_point[..., n:] @ maps.acting_by_carried
        A[:, n:, n:] += maps.carried_by_carried
        s = by_memory.shape[-1]
        if s:
            A[..., -s:] += slopes.by_learned @ by_memory
        return A

    def _by_input(self, slopes: "_NextSlopes") -> Array:
        """Returns B, the derivatives by the input (K, N, m)."""
        B = slopes.by_point[..., self._n :] @ self._maps.acting_by_input
        B[:, self._n :] += self._maps.carried_by_input
        return np.ascontiguousarray(B)

    def _differentiate(self, x: Array, acting: Array) -> "_PointValues":
        """Evaluates features and nominal outputs, with their derivatives."""
        n = self._n
        model = self._model
        d = self._maps.carried_by_features.shape[1]

        def values(point: Array) -> Array:
            x, acting = point[..., :n], point[..., n:]
            no_context = np.empty((*point.shape[:-1], 0))
            features = model.features(x, acting, no_context)
            nominal = model.nominal_outputs(x, acting, no_context)
            return np.concatenate([features, nominal], axis=-1)

        point = np.concatenate([x, acting], axis=-1)
        value, slopes = _central_differences(values, point, self._angles)
        return _PointValues(
            features=value[:, :d],
            nominal=value[:, d:],
            features_by_point=slopes[:, :d],
            nominal_by_point=slopes[:, d:],
        )

    def _differentiate_step(self, x: Array, outputs: Array) -> tuple[Array, Array]:
        """Returns the derivatives of next states by states and by outputs."""
        n = self._n

        def values(point: Array) -> Array:
            state, outputs = point[..., :n], point[..., n:]
            return self._model.kinematics.step(state, outputs, self._time_step)

        point = np.concatenate([x, outputs], axis=-1)
        _, slopes = _central_differences(
            values, point, self._angles, wrapped_values=self._angles
        )
        return slopes[..., :n], slopes[..., n:]

    def _outputs(
        self, local: "_PointValues", memory: Array, covariance: bool
    ) -> "_LocalOutputs":
        """Returns the outputs at points, with their derivatives."""
        model = self._model
        K = len(memory)
        d = local.features.shape[1]
        s = memory.shape[1]
        o = self._o
        regressors = local.features
        if model.weights.size or s:
            regressors = model.memory.regressors(local.features, memory)
        learned = np.zeros((K, o))
        by_features = np.zeros((K, o, d))
        by_memory = np.zeros((K, o, s))
        V = np.zeros((K, o, o))
        regressor_slopes = self._regressor_slopes(local.features, memory)
        if model.weights.size:
            learned += regressors @ model.weights.T
            by_features += model.weights @ regressor_slopes.by_features
            by_memory += model.weights @ regressor_slopes.by_memory
        for gp in model.gps:
            prediction = _gp_prediction(gp, local.features, regressors, covariance)
            rows = list(gp.outputs)
            learned[:, rows] += prediction.mean
            if gp.sees_memory:
                # a GP sees all regressors but the constant
                seen_by_features = regressor_slopes.by_features[..., :-1, :]
                seen_by_memory = regressor_slopes.by_memory[..., :-1, :]
                by_features[:, rows] += prediction.A @ seen_by_features
                by_memory[:, rows] += prediction.A @ seen_by_memory
            else:
                by_features[:, rows] += prediction.A
            if prediction.covariance is not None:
                V[np.ix_(range(K), rows, rows)] += prediction.covariance
        learned_by_point = by_features @ local.features_by_point
        return _LocalOutputs(
            mean=local.nominal + learned,
            learned=learned,
            by_point=local.nominal_by_point + learned_by_point,
            learned_by_point=learned_by_point,
            by_memory=by_memory,
            covariance=V,
        )

    def _regressor_slopes(self, features: Array, memory: Array) -> "_RegressorSlopes":
        """Returns the derivatives of the regressors at features (K, d), s (K, s)."""
        by_features = self._maps.regressors_by_features
        by_memory = self._maps.regressors_by_memory
        products = self._maps.products
        if products.start == products.stop:
            return _RegressorSlopes(by_features, by_memory)
        K = len(features)
        slopes = _RegressorSlopes(
            np.tile(by_features, (K, 1, 1)), np.tile(by_memory, (K, 1, 1))
        )
        of_products = self._model.memory.product_slopes(features, memory)
        slopes.by_features[:, products] = of_products[0]
        slopes.by_memory[:, products] = of_products[1]
        return slopes


class _PointValues(NamedTuple):
    """Functions of a state and of the inputs as they act, at K points."""

    features: Array  # z (K, d)
    nominal: Array  # outputs of the nominal part (K, o)
    features_by_point: Array  # by x and the acting inputs (K, d, n + m)
    nominal_by_point: Array  # (K, o, n + m)


class _LocalOutputs(NamedTuple):
    """Outputs at K points, with their derivatives."""

    mean: Array  # (K, o)
    learned: Array  # what linear term and GPs add (K, o)
    by_point: Array  # of the outputs, by x and the acting inputs (K, o, n + m)
    learned_by_point: Array  # of what they add (K, o, n + m)
    by_memory: Array  # of both, by s (K, o, s)
    covariance: Array  # of the GPs (K, o, o)


class _RegressorSlopes(NamedTuple):
    """Derivatives of the regressors, at K points where there are products."""

    by_features: Array  # (r, d) or (K, r, d)
    by_memory: Array  # (r, s) or (K, r, s)


class _NextSlopes(NamedTuple):
    """Derivatives of the N entries of the next state, at K points."""

    by_point: Array  # by x and the acting inputs (K, N, n + m)
    by_learned: Array  # by what linear term and GPs add (K, N, o)


class _LinearMaps(NamedTuple):
    """How what is carried on, c = (lagged, pending, s), acts and moves on."""

    acting_by_carried: Array  # (m, c)
    acting_by_input: Array  # (m, m)
    carried_by_carried: Array  # (c, c)
    carried_by_input: Array  # (c, m)
    carried_by_features: Array  # (c, d)
    carried_by_learned: Array  # (c, o)
    regressors_by_features: Array  # (r, d); zero of the products
    regressors_by_memory: Array  # (r, s); likewise
    products: slice  # rows of the products among the regressors


class _MemoryMaps(NamedTuple):
    """How what is remembered, s, moves on, and what regressors show of it."""

    by_memory: Array  # next s by s (s, s)
    by_features: Array  # (s, d)
    by_learned: Array  # (s, o)
    regressors_by_features: Array  # (r, d); zero of the products
    regressors_by_memory: Array  # (r, s); likewise
    products: slice  # rows of the products among the regressors


def _linear_maps(model: LogModel, m: int, time_step: float) -> _LinearMaps:
    """Returns the linear maps of a model of m inputs."""
    o = len(model.history)
    d = len(model.features(model.kinematics.space.origin, np.zeros(m), np.empty(0)))
    lagged = len(model.time_constants)
    pending = model.lag * m
    c = model.carried_dim(m)
    s = c - lagged - pending
    # What is in the queue (pending, input) are entries of (lagged, pending, s, input)
    # themselves: ones select them.
    queue = np.zeros((pending + m, c + m))
    queue[:pending, lagged : lagged + pending] = np.eye(pending)
    queue[pending:, c:] = np.eye(m)
    command = queue[:m]
    acting = command
    after = np.zeros((c, c + m))
    if lagged:
        lags = model.lags(time_step)
        state = np.eye(lagged, c + m)
        acting = lags.acting(state.T, command.T).T
        after[:lagged] = lags.after(state.T, command.T).T
    after[lagged : lagged + pending] = queue[m:]
    first = lagged + pending
    memory = _memory_maps(model, features=d, size=s)
    after[first:, first:c] = memory.by_memory
    return _LinearMaps(
        acting_by_carried=acting[:, :c],
        acting_by_input=acting[:, c:],
        carried_by_carried=after[:, :c],
        carried_by_input=after[:, c:],
        carried_by_features=np.vstack([np.zeros((first, d)), memory.by_features]),
        carried_by_learned=np.vstack([np.zeros((first, o)), memory.by_learned]),
        regressors_by_features=memory.regressors_by_features,
        regressors_by_memory=memory.regressors_by_memory,
        products=memory.products,
    )


def _memory_maps(model: LogModel, features: int, size: int) -> _MemoryMaps:
    """Returns the linear maps of a memory of a size (s,) and of features (d,)."""
    o = len(model.history)
    d = features
    s = size
    if not (s or model.weights.size):
        return _MemoryMaps(
            by_memory=np.zeros((0, 0)),
            by_features=np.zeros((0, d)),
            by_learned=np.zeros((0, o)),
            regressors_by_features=np.eye(d),
            regressors_by_memory=np.zeros((d, 0)),
            products=slice(0, 0),
        )
    memory = replace(model.memory, products=None)
    one = memory.regressors(np.zeros(d), np.zeros(s))
    products = model.memory.regressor_dim(d, o) - len(one)
    # The memory is linear, so that its values at unit vectors are its matrices.
    return _MemoryMaps(
        by_memory=_matrix(
            lambda e: memory.step(e, np.zeros((s, d)), np.zeros((s, o))), s
        ),
        by_features=_matrix(
            lambda e: memory.step(np.zeros((d, s)), e, np.zeros((d, o))), d
        ),
        by_learned=_matrix(
            lambda e: memory.step(np.zeros((o, s)), np.zeros((o, d)), e), o
        ),
        regressors_by_features=_with_products(
            _matrix(lambda e: memory.regressors(e, np.zeros((d, s))) - one, d), products
        ),
        regressors_by_memory=_with_products(
            _matrix(lambda e: memory.regressors(np.zeros((s, d)), e) - one, s), products
        ),
        products=slice(d + s, d + s + products),
    )


def _with_products(by_others: Array, products: int) -> Array:
    """Inserts rows of zeros for products, before that of the constant."""
    zeros = np.zeros((products, by_others.shape[1]))
    return np.vstack([by_others[:-1], zeros, by_others[-1:]])


def _matrix(function: Callable[[Array], Array], size: int) -> Array:
    """Returns the matrix of a linear function of rows of a size."""
    return np.ascontiguousarray(function(np.eye(size)).T)


def _central_differences(
    function: Callable[[Array], Array],
    points: Array,
    angles: Sequence[int],
    wrapped_values: Sequence[int] = (),
) -> tuple[Array, Array]:
    """Returns the values (K, v) and the slopes (K, v, p) of a function.

    Args:
        function: Of points (..., K, p).
        points: (K, p).
        angles: Indices of the points' entries that are angles.
        wrapped_values: Indices of the values that are wrapped.
    """
    p = points.shape[1]
    sizes = np.maximum(np.abs(points), 1.0)
    sizes[:, list(angles)] = 1.0
    h = DIFFERENCE * sizes  # (K, p)
    directions = np.concatenate([np.zeros((1, p)), np.eye(p), -np.eye(p)])
    values = function(points + directions[:, None] * h)  # (1 + 2 p, K, v)
    differences = values[1 : 1 + p] - values[1 + p :]
    if wrapped_values:
        columns = list(wrapped_values)
        differences[..., columns] = wrap(differences[..., columns])
    slopes = differences / (2 * h.T[..., None])
    return values[0], np.moveaxis(slopes, 0, -1)


def _gp_prediction(
    gp: OutputGP, features: Array, regressors: Array, covariance: bool
) -> Linearized:
    """Linearises a GP by what it sees."""
    points = regressors[:, :-1] if gp.sees_memory else features
    no_inputs = np.empty((len(points), 0))
    return gp.posterior.linearize(np.ascontiguousarray(points), no_inputs, covariance)
