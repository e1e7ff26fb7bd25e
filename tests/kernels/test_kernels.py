"""The compiled moments against torch's closed form and its derivatives, 50 digits, and
finite differences."""

import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import mpmath
import numba
import numpy as np
import pytest
import torch

import gpmpc._compiled
from gpmpc import _kernels as kernels
from gpmpc._kernels import _gp_point, _simd, pack
from gpmpc._kernels._rows import (
    add_variance_reductions_by_substitution,
    largest_size,
    largest_square,
    variance_reduction_by_inverse,
)
from gpmpc._kernels._simd import NEAR_ZERO, load, store
from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.propagation._moments import moments, moments_with_jacobian
from tests.propagation.test_moment_matching import belief, by_mpmath, model

#: as ``compiled``, which alone finds what the parts of kernels call; not cached
kernel = numba.njit(**gpmpc._compiled._KERNEL_OPTIONS)


def packed(gp):
    parts = (gp.features, gp.lengthscales, gp.signal_variance, gp.cholesky, gp.weights)
    return pack(*(part.numpy() for part in parts), gp.state_dim)


def at_one(kernel, gps, *at, **settings):
    """A kernel's results at one point."""
    results = kernel(
        gps, *(np.asarray(part, dtype=float)[None] for part in at), **settings
    )
    return type(results)(*(part[0] for part in results))


def valued(gps, *at, **settings):
    return at_one(kernels.gp_moments, gps, *at, **settings)[:3]


def differentiated(gps, *at, **settings):
    return at_one(kernels.gp_moments, gps, *at, derivatives=True, **settings)


def control(m):
    return torch.linspace(-0.3, 0.4, m)


def numbers(*tensors):
    return [tensor.numpy() for tensor in tensors]


def close(mine, other, tolerance):
    other = np.asarray(other)
    assert mine.shape == other.shape
    assert np.abs(mine - other).max(initial=0) <= tolerance * max(
        np.abs(other).max(initial=0), 1e-300
    )


def symmetric(derivative):
    return (derivative + derivative.mT) / 2


CASES = [
    ("ordinary", {}, {}, 0.0),
    ("one state and no control", {"n": 1, "m": 0}, {}, 0.0),
    ("three states, two controls", {"n": 3, "m": 2, "size": 33}, {}, 0.0),
    ("four states and no control", {"n": 4, "m": 0, "size": 9}, {}, 0.0),
    ("little noise", {"noise": 1e-6}, {}, 0.0),
    ("tiny covariance", {"noise": 1e-6}, {"spread": 1e-4}, 0.0),
    ("large covariance", {}, {"spread": 5.0}, 0.0),
    ("rank-deficient covariance", {}, {"rank": 1}, 0.0),
    ("no covariance", {"n": 3}, {"n": 3, "spread": 0.0}, 0.0),
    ("short length-scales", {"lengthscale": 0.05}, {}, 0.0),
    ("ignored inputs", {"lengthscale": 1e8, "noise": 1e-2}, {}, 0.0),
    ("far from the data", {}, {}, 6.0),
    (
        "joint exponents",
        {"lengthscale": 0.02, "size": 12},
        {"spread": 1.0, "seed": 3},
        0.0,
    ),
]


def case(arguments, at, shift):
    gp = model(**arguments)
    at = belief(**{"n": gp.state_dim} | at)
    return gp, Gaussian(at.mean + shift, at.covariance), control(gp.input_dim)


@pytest.mark.parametrize(
    ("name", "arguments", "at", "shift"), CASES, ids=[c[0] for c in CASES]
)
def test_values_and_derivatives_agree_with_torch(name, arguments, at, shift):
    gp, at, u = case(arguments, at, shift)
    mu = at.mean
    S = at.covariance

    def by_torch(mu, S, u):
        return moments(gp, Gaussian(mu, S), u)

    M, V, J = by_torch(mu, S, u)
    dM, dV, _ = torch.func.jacrev(by_torch, argnums=(0, 1, 2))(mu, S, u)
    mine = differentiated(packed(gp), *numbers(mu, S, u))
    close(mine.M, M, 1e-10)
    close(mine.V, V, 1e-10)
    close(mine.J, J, 1e-10)
    close(mine.J, dM[0], 1e-9)
    close(mine.dM_dS, symmetric(dM[1]), 1e-9)
    close(mine.dM_du, dM[2], 1e-9)
    close(mine.dV_dmu, dV[0], 1e-9)
    close(mine.dV_dS, symmetric(dV[1]), 1e-9)
    close(mine.dV_du, dV[2], 1e-9)

    def J(mu, S, u):
        return torch.func.jacrev(lambda mu: by_torch(mu, S, u)[0])(mu)

    dJ = torch.func.jacrev(J, argnums=(0, 1, 2))(mu, S, u)
    close(2 * mine.dM_dS, dJ[0], 1e-9)
    close(mine.dJ_dS, symmetric(dJ[1]), 1e-9)
    close(mine.dJ_du, dJ[2], 1e-9)
    for value, with_jacobian in zip(
        valued(packed(gp), *numbers(mu, S, u)), mine[:3], strict=True
    ):
        close(value, with_jacobian, 1e-12)
    latent_moments, latent_derivatives = moments_with_jacobian(gp, at, u)
    by_formulas = (*latent_moments, *latent_derivatives)
    for fast, plain in zip(mine, by_formulas, strict=True):
        close(fast, plain, 1e-9)


@pytest.mark.parametrize(
    ("arguments", "at", "shift", "tolerance"),
    [
        ({}, {}, 0.0, 1e-11),
        ({"noise": 1e-6}, {}, 0.0, 1e-9),
        ({"noise": 1e-10, "lengthscale": 0.7}, {}, 0.0, 1e-7),
        ({"noise": 1e-6}, {"spread": 1e-4}, 0.0, 1e-9),
        ({}, {"spread": 5.0}, 0.0, 1e-10),
        ({}, {"rank": 1}, 0.0, 1e-11),
        ({"lengthscale": 0.05}, {}, 0.0, 1e-10),
        ({}, {"seed": 5}, 6.0, 1e-11),
    ],
)
def test_the_moments_agree_with_a_fifty_digit_evaluation(
    arguments, at, shift, tolerance
):
    gp, at, u = case({"size": 7} | arguments, at, shift)
    exact_M, exact_V, exact_cross = (exact.numpy() for exact in by_mpmath(gp, at, u))
    by_torch = [part.numpy() for part in moments(gp, at, u)]
    for M, V, J in (valued(packed(gp), *numbers(at.mean, at.covariance, u)), by_torch):
        assert np.abs(V - exact_V).max() < tolerance * np.abs(exact_V).max()
        assert np.abs(M - exact_M).max() < tolerance * max(1e-3, np.abs(exact_M).max())
        cross = at.covariance.numpy() @ J.T
        assert np.abs(cross - exact_cross).max() < tolerance * max(
            1e-3, np.abs(exact_cross).max()
        )


@pytest.mark.parametrize("size", [1, 7, 8, 9, 189, 500])
@pytest.mark.parametrize("diagonal", [False, True])
def test_padding_and_tiles_change_nothing(size, diagonal):
    gp = model(size=size, n=3, m=1, noise=1e-2)
    at = belief(3)
    u = control(1)
    M, V, J = moments(gp, at, u)
    mine = differentiated(
        packed(gp), *numbers(at.mean, at.covariance, u), diagonal=diagonal
    )
    close(mine.M, M, 1e-10)
    close(mine.V, torch.diag(V.diagonal()) if diagonal else V, 1e-10)
    close(mine.J, J, 1e-10)
    dV = torch.func.jacrev(lambda mu: moments(gp, Gaussian(mu, at.covariance), u)[1])(
        at.mean
    )
    close(mine.dV_dmu, dV * torch.eye(3)[..., None] if diagonal else dV, 1e-9)
    for value, with_jacobian in zip(
        valued(packed(gp), *numbers(at.mean, at.covariance, u), diagonal=diagonal),
        mine[:3],
        strict=True,
    ):
        close(value, with_jacobian, 1e-12)


@pytest.mark.parametrize("spread", [0.3, 1e-3])
def test_derivatives_agree_with_finite_differences(spread):
    gp = model(n=3, m=2)
    at = belief(3, spread=spread)
    u = control(2).numpy()
    mu = at.mean.numpy()
    S = at.covariance.numpy()
    gps = packed(gp)
    rng = np.random.default_rng(0)
    d_mu = rng.normal(size=3)
    d_S = rng.normal(size=(3, 3))
    d_u = rng.normal(size=2)
    d_S = d_S @ d_S.T * spread**2
    step = 1e-5

    def moments_at(t):
        return valued(gps, mu + t * d_mu, S + t * d_S, u + t * d_u)

    numeric = [
        (after - before) / (2 * step)
        for after, before in zip(moments_at(step), moments_at(-step), strict=True)
    ]
    d = differentiated(gps, mu, S, u)
    close(d.J @ d_mu + np.tensordot(d.dM_dS, d_S) + d.dM_du @ d_u, numeric[0], 1e-7)
    close(
        d.dV_dmu @ d_mu + np.tensordot(d.dV_dS, d_S) + d.dV_du @ d_u, numeric[1], 1e-7
    )
    close(
        2 * d.dM_dS @ d_mu + np.tensordot(d.dJ_dS, d_S) + d.dJ_du @ d_u,
        numeric[2],
        1e-7,
    )


def test_derivatives_in_the_covariance_are_symmetric():
    gp, at, u = case({"n": 3, "m": 2}, {}, 0.0)
    d = differentiated(packed(gp), *numbers(at.mean, at.covariance, u))
    for derivative in (d.dM_dS, d.dV_dS, d.dJ_dS):
        assert (derivative == derivative.swapaxes(-1, -2)).all()
    assert (d.V == d.V.T).all()
    assert (d.dV_dS == d.dV_dS.swapaxes(0, 1)).all()


def test_kernels_are_handed_doubles():
    """Their machine code would take numbers of another type for them."""
    gp = model(n=3, m=1).to(dtype=torch.float32)
    states = np.zeros((2, 3))
    inputs = np.zeros((2, 1))
    doubles = gp.to(dtype=torch.float64)
    got = kernels.linearize_gps(
        gp.packed, states, inputs, True, gp.offset.numpy(), False
    )
    offset = doubles.offset.numpy()
    expected = kernels.linearize_gps(
        doubles.packed, states, inputs, True, offset, False
    )
    for ours, theirs in zip(got, expected, strict=True):
        close(ours, theirs, 1e-12)
    window = kernels.Window.empty(
        gp.lengthscales.numpy(), gp.signal_variance.numpy(), state_dim=3, capacity=2
    )
    assert (
        window.arrays.inverse_squares.dtype == window.arrays.log_signal.dtype == float
    )


def test_gps_that_cannot_predict_are_refused():
    gp = model(n=3, m=1)
    states = np.zeros((2, 3))
    inputs = np.zeros((2, 1))
    with pytest.raises(ShapeError, match="3 GPs have as many prior means"):
        kernels.linearize_gps(gp.packed, states, inputs, True, np.zeros(2), False)
    few = pack(
        gp.features.numpy(),
        gp.lengthscales[:2].numpy(),
        gp.signal_variance[:2].numpy(),
        gp.cholesky[:2].numpy(),
        gp.weights[:2].numpy(),
        state_dim=3,
    )
    with pytest.raises(ShapeError, match="2 GPs .* got .* 3 states"):
        kernels.linearize_gps(few, states, inputs, True, np.zeros(2), True)
    empty = kernels.Window.empty(np.ones((1, 4)), np.ones(1), state_dim=3, capacity=3)
    one = empty.append(np.zeros(4), np.zeros(1), np.ones(1))
    two = one.append(np.ones(4), np.ones(1), np.ones(1))
    for window in (empty, two.without([0])):
        with pytest.raises(SettingError, match="rows of its factor"):
            kernels.linearize_gps(window, states, inputs, True, np.zeros(1), False)


def test_outputs_need_not_be_as_many_as_states():
    gp = model(n=4, m=1)
    at = belief(4)
    u = control(1)
    whole = differentiated(packed(gp), *numbers(at.mean, at.covariance, u))
    rows = [2, 0]
    few = pack(
        *(
            v.numpy()
            for v in (gp.features, gp.lengthscales[rows], gp.signal_variance[rows])
        ),
        gp.cholesky[rows].numpy(),
        gp.weights[rows].numpy(),
        4,
    )
    part = differentiated(few, *numbers(at.mean, at.covariance, u))
    for name in ("M", "J", "dM_dS", "dM_du", "dJ_dS", "dJ_du"):
        close(getattr(part, name), getattr(whole, name)[rows], 1e-13)
    for name in ("V", "dV_dmu", "dV_dS", "dV_du"):
        close(getattr(part, name), getattr(whole, name)[rows][:, rows], 1e-11)


@pytest.mark.parametrize(
    ("distance", "spread"), [(0.0, 1e3), (50.0, 10.0), (1e4, 1.0), (1e4, 1e4)]
)
def test_wide_beliefs_far_from_data_keep_the_prior(distance, spread):
    gp = model(lengthscale=0.05)
    at = Gaussian(torch.full((2,), distance), spread**2 * torch.eye(2))
    mine = differentiated(packed(gp), *numbers(at.mean, at.covariance), np.zeros(1))
    assert all(np.isfinite(array).all() for array in mine)
    close(mine.V.diagonal(), gp.signal_variance, 1e-3)
    close(mine.V, moments(gp, at, torch.zeros(1))[1], 1e-10)


def test_exponents_that_overflow_belong_to_nothing_that_counts():
    # Here log(q q) is at most -897, delta reaches 5958, and log(q q) + delta is nowhere
    # above -702.
    gp = model(lengthscale=0.02, size=12)
    at = Gaussian(torch.tensor([1.5, 1.5]), 2e-4 * torch.eye(2))
    V = moments(gp, at, torch.zeros(1))[1]
    mine = differentiated(packed(gp), *numbers(at.mean, at.covariance), np.zeros(1))
    assert all(np.isfinite(array).all() for array in mine)
    close(mine.V, V, 1e-12)
    assert np.abs(mine.dV_dS).max() < 1e-100


@pytest.mark.parametrize(
    ("n", "m", "size"), [(1, 0, 5), (2, 1, 20), (3, 4, 33), (6, 3, 50)]
)
def test_the_expansion_at_a_point_agrees_with_torch(n, m, size):
    gp = model(size=size, n=n, m=m)
    x = belief(n).mean
    u = control(m)

    def mean(x, u):
        return gp.predict(x, u).mean

    def variance(x, u):
        return gp.predict(x, u).covariance.diagonal()

    point = at_one(kernels.expand_gps, packed(gp), *numbers(x, u))
    jacrev = torch.func.jacrev
    both = (0, 1)
    close(point.M, mean(x, u), 1e-12)
    close(point.variance, variance(x, u), 1e-10)
    for mine, other in zip(
        (point.J, point.dM_du), jacrev(mean, both)(x, u), strict=True
    ):
        close(mine, other, 1e-10)
    for mine, other in zip(
        (point.dvariance_dx, point.dvariance_du),
        jacrev(variance, both)(x, u),
        strict=True,
    ):
        close(mine, other, 1e-9)
    for mine, other in zip(
        (point.d2M_dx2, point.d2M_dxdu), jacrev(jacrev(mean), both)(x, u), strict=True
    ):
        close(mine, other, 1e-10)
    offset = np.arange(float(n))
    for adds_state in (False, True):
        M, A, B, V = kernels.linearize_gps(
            packed(gp), *numbers(x[None], u[None]), True, offset, adds_state
        )
        close(M[0], point.M + offset + adds_state * x.numpy(), 1e-12)
        close(A[0], point.J + adds_state * np.eye(n), 1e-12)
        close(B[0], point.dM_du, 1e-12)
        close(V[0], np.diag(point.variance), 1e-11)


@pytest.mark.parametrize("covariance", [0.0, 1e-14])
def test_without_covariance_the_moments_expand_about_the_mean(covariance):
    gp = model(n=3, m=2)
    x = belief(3).mean
    u = control(2)
    d = differentiated(packed(gp), *numbers(x, covariance * torch.eye(3), u))
    point = at_one(kernels.expand_gps, packed(gp), *numbers(x, u))
    close(d.M, point.M, 1e-11)
    close(d.V, np.diag(point.variance), 1e-10)
    close(d.J, point.J, 1e-10)
    close(2 * d.dM_dS, point.d2M_dx2, 1e-10)
    diagonal = np.arange(3)
    close(d.dV_dmu[diagonal, diagonal], point.dvariance_dx, 1e-9)
    close(d.dV_du[diagonal, diagonal], point.dvariance_du, 1e-9)


@pytest.mark.parametrize("size", [3, 21])
def test_variances_at_several_points_are_reduced_as_each_alone(size):
    mine = packed(model(size=size))
    q = np.zeros((8, mine.arrays.points.shape[1]))
    q[:5, :size] = np.random.default_rng(0).normal(size=(5, size))

    @kernel
    def alone(triangle, row):
        return variance_reduction_by_inverse(triangle, row, np.empty_like(row))

    @kernel
    def together(columns, rows, totals):
        add_variance_reductions_by_substitution(columns, len(columns), rows, totals)

    expected = [alone(mine.variance_factors.inverse_cholesky[1], row) for row in q]
    totals = np.zeros(8)
    together(mine.columns[1], q, totals)
    assert np.allclose(totals, expected, rtol=1e-12, atol=0)


def test_many_points_are_the_loop_over_them():
    gps = packed(model(n=3, m=2))
    beliefs = [belief(3, seed=s) for s in range(4)]
    mu = np.stack([b.mean for b in beliefs])
    S = np.stack([b.covariance for b in beliefs])
    u = np.linspace(-1, 1, 8).reshape(4, 2)
    together = [
        kernels.linearize_gps(gps, mu, u, True, np.zeros(3), False),
        kernels.expand_gps(gps, mu, u),
        kernels.gp_moments(gps, mu, S, u, diagonal=True),
        kernels.gp_moments(gps, mu, S, u, derivatives=True),
    ]
    for h in range(4):
        alone = [
            [
                part[0]
                for part in kernels.linearize_gps(
                    gps, mu[h : h + 1], u[h : h + 1], True, np.zeros(3), False
                )
            ],
            at_one(kernels.expand_gps, gps, mu[h], u[h]),
            at_one(kernels.gp_moments, gps, mu[h], S[h], u[h], diagonal=True),
            differentiated(gps, mu[h], S[h], u[h]),
        ]
        for many, one in zip(together, alone, strict=True):
            assert all((a[h] == b).all() for a, b in zip(many, one, strict=True))


def test_covariances_of_many_points_are_made_in_parts():
    gps = packed(model(size=20, n=2, m=1, noise=1e-14))
    # at its points each variance is a little below zero
    gps = replace(gps, cholesky=(1 - 1e-6) * gps.cholesky)
    x = np.tile(gps.arrays.points[:2, :20].T, (100, 1))
    u = np.tile(gps.arrays.points[2:, :20].T, (100, 1))
    prior = np.zeros(gps.output_dim)
    tracemalloc.start()
    together = kernels.linearize_gps(gps, x, u, True, prior, False)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2**20  # a row of kernels each would be 1 MiB beside the results
    alone = kernels.linearize_gps(gps, x[:20], u[:20], True, prior, False)
    for many, few in zip(together, alone, strict=True):
        assert (many[-20:] == few).all()
    expansion = kernels.expand_gps(gps, x[:20], u[:20])
    for part in (expansion.variance, expansion.dvariance_dx, expansion.dvariance_du):
        assert not part.any()


def test_threads_do_not_disturb_each_other():
    gps = packed(model(size=60, n=3, m=1))
    S = 0.1 * np.eye(3)
    u = np.zeros(1)
    points = np.random.default_rng(0).normal(size=(16, 3))
    alone = [differentiated(gps, point, S, u).dV_dS for point in points]
    with ThreadPoolExecutor(4) as pool:
        together = list(
            pool.map(lambda point: differentiated(gps, point, S, u).dV_dS, points)
        )
    assert all((a == b).all() for a, b in zip(alone, together, strict=True))


def test_inputs_may_be_read_only_transposed_or_lists():
    gps = packed(model())
    at = belief()
    u = np.zeros(1)
    mu = at.mean.numpy().copy()
    S = np.asfortranarray(at.covariance.numpy())
    mu.flags.writeable = False
    for a, b in zip(
        valued(gps, mu, S, u), valued(gps, mu.tolist(), S.tolist(), [0.0]), strict=True
    ):
        assert (a == b).all()


def test_not_a_number_is_passed_on():
    gps = packed(model())
    d = differentiated(gps, [np.nan, 0.0], 0.1 * np.eye(2), [0.0])
    assert np.isnan(d.M).all()
    assert np.isnan(d.V).all()


def by_lanes(function):
    """A function of Lanes, for arrays of any length."""

    @kernel
    def write(x):
        for j in range(0, len(x), 8):
            store(x, j, function(load(x, j)))

    def evaluate(values):
        x = np.zeros(-(-len(values) // 8) * 8)
        x[: len(values)] = values
        with np.errstate(invalid="ignore"):
            write(x)
        return x[: len(values)]

    return evaluate


exp, expm1, expm1_near_zero = (
    by_lanes(f) for f in (_simd.exp, _simd.expm1, _simd.expm1_near_zero)
)


@pytest.mark.parametrize(
    ("low", "high"), [(-0.35, 0.35), (-1.1, 1.1), (-40, 30), (-1e-9, 1e-9), (-745, 709)]
)
def test_the_exponentials_are_those_of_fifty_digits(low, high):
    x = np.random.default_rng(0).uniform(low, high, 2000)
    y = exp(x)
    with mpmath.workdps(50):
        exact = np.array([float(mpmath.exp(v)) for v in x])
        assert np.abs(y - exact).max(where=exact < 3e-308, initial=0) <= 5e-324
        normal = exact >= 3e-308
        assert (np.abs(y - exact)[normal] <= 3e-16 * exact[normal]).all()
        x = x[x <= 300]
        exact = np.array([float(mpmath.expm1(v)) for v in x])
        y = expm1(x)
        assert (
            np.abs(y - exact) <= (4e-16 + 3.4e-17 * np.maximum(x, 0)) * np.abs(exact)
        ).all()


def test_unreduced_exponentials_near_zero_have_the_same_bits():
    x = np.random.default_rng(1).uniform(-NEAR_ZERO, NEAR_ZERO, 2000) * np.geomspace(
        1e-12, 1, 2000
    )
    x[:2] = -NEAR_ZERO, NEAR_ZERO
    assert np.array_equal(expm1(x), expm1_near_zero(x))


@pytest.mark.parametrize("dims", [1, 3, 6])
def test_sizes_over_points_are_the_largest_ones(dims):
    rows = np.random.default_rng(dims).standard_normal((dims, 48))
    # NaN is passed over: such a pair stays NaN in either way
    rows[0, 29] = -8.0
    rows[-1, 7] = np.nan

    @kernel
    def sizes(rows):
        return largest_square(rows), largest_size(rows[0])

    assert sizes(rows) == pytest.approx(
        (np.nanmax((rows**2).sum(axis=0)), 8.0), rel=1e-15
    )


def test_loops_over_points_may_use_the_widest_registers():
    gps = packed(model())
    kernels.linearize_gps(
        gps, np.zeros((1, 2)), np.zeros((1, 1)), False, np.zeros(2), False
    )
    anew = kernel(
        _gp_point.linearize_points.py_func
    )  # the kernel itself may have been loaded
    x = np.zeros((1, 2))
    u = np.zeros((1, 1))
    memory = np.empty(7 * gps.arrays.points.shape[1] + 8)
    none = np.zeros((0, 2, 2))
    out = _gp_point.LinearizedGPs(
        mean=np.zeros((1, 2)),
        A=np.zeros((1, 2, 2)),
        B=np.zeros((1, 2, 1)),
        covariance=none,
    )
    anew(gps.arrays, none, np.zeros(2), False, x, u, memory, out)
    assert '"prefer-vector-width"="512"' in anew.inspect_llvm(anew.signatures[0])


def test_nan_of_one_belief_does_not_reach_the_next():
    gps = packed(model())
    mu = np.array([[np.nan, 0.0], [0.2, -0.1]])
    S = np.stack([0.1 * np.eye(2)] * 2)
    u = np.zeros((2, 1))
    both = kernels.gp_moments(gps, mu, S, u, derivatives=True)
    alone = kernels.gp_moments(gps, mu[1:], S[1:], u[1:], derivatives=True)
    assert np.isnan(both.M[0]).all()
    for name in both._fields:
        value = getattr(both, name)[1]
        assert np.isfinite(value).all(), name
        assert np.array_equal(value, getattr(alone, name)[0]), name


def test_a_full_window_refuses_a_further_point():
    window = kernels.Window.empty(np.ones((1, 2)), np.ones(1), 1, capacity=16)
    for i in range(16):
        point = np.array([float(i), 0.0])
        window = window.append(point, np.zeros(1), np.full(1, 0.1))
    with pytest.raises(SettingError, match="capacity: of 16 points is used up"):
        window.append(np.array([16.0, 0.0]), np.zeros(1), np.full(1, 0.1))
    empty = kernels.Window.empty(np.ones((1, 2)), np.ones(1), 1, capacity=16)
    with pytest.raises(ShapeError, match=r"targets \(1,\) and noise \(1,\)"):
        empty.append(np.zeros(2), np.zeros(2), np.full(1, 0.1))


@pytest.mark.parametrize("part", range(3))
def test_a_window_refuses_a_point_that_is_not_finite(part):
    window = kernels.Window.empty(np.ones((1, 2)), np.ones(1), 1, capacity=16)
    new = [np.zeros(2), np.zeros(1), np.full(1, 0.1)]
    new[part][-1] = np.nan
    with pytest.raises(DataError, match="must be finite"):
        window.append(*new)
    new[part][-1] = 0.1
    assert window.append(*new).rows == 1


def test_the_exponentials_keep_the_limits():
    x = np.array(
        [0.0, -0.0, -1e9, -np.inf, 709.78, 710.0, 1e9, np.inf, np.nan, -745.2, -744.5]
    )
    y = exp(x)
    with np.errstate(over="ignore"):
        assert np.array_equal(y, np.exp(x), equal_nan=True) or np.allclose(
            y, np.exp(x), rtol=2e-16, equal_nan=True
        )
    assert expm1([0.0, -1e9, -np.inf, 1e-320]).tolist() == [0.0, -1.0, -1.0, 1e-320]
    large = expm1([1e9, np.inf, 300.0])
    assert large[0] == large[1] == large[2] == pytest.approx(np.exp(300.0), rel=2e-14)
    assert np.isnan(expm1([np.nan, 1.0])).tolist() == [True, False]


def test_what_does_not_fit_is_refused():
    gp = model()
    gps = packed(gp)
    with pytest.raises(
        ShapeError,
        match=r"states \(H, 2\) and inputs \(H, 1\); got \(1, 3\) and \(1, 1\)",
    ):
        at_one(kernels.expand_gps, gps, np.zeros(3), np.zeros(1))
    with pytest.raises(ShapeError, match=r"got \(1, 2\) and \(1, 2\)"):
        valued(gps, np.zeros(2), np.eye(2), np.zeros(2))
    with pytest.raises(
        ShapeError, match=r"S must have shape \(1, 2, 2\); got \(1, 3, 3\)"
    ):
        valued(gps, np.zeros(2), np.eye(3), np.zeros(1))
    with pytest.raises(
        ShapeError, match=r"beta \(k, N\) of points \(20, 3\); got .* \(2, 19\)\)"
    ):
        packed(replace(gp, weights=gp.weights[:, :-1]))


def test_the_kernels_load_no_torch_of_their_own():
    assert not [
        path
        for path in Path(kernels.__file__).parent.glob("*.py")
        if "import torch" in path.read_text()
    ]


def test_sine_and_cosine_of_lanes_are_exact_and_within_one(rng):
    sine = by_lanes(_simd.sine)
    cosine = by_lanes(_simd.cosine)
    for scale in (1.0, 100.0, 1e6):
        x = rng.uniform(-scale, scale, 8000)
        assert np.abs(sine(x) - np.sin(x)).max() < 4e-16
        assert np.abs(cosine(x) - np.cos(x)).max() < 4e-16
    x = np.array([0.0, 1e-300, -1e-9, 1e300, -1e17, np.inf, -np.inf, np.nan])
    assert np.abs(sine(10.0 ** np.arange(14, 24, 0.01))).max() <= 1.0
    assert sine(x)[:3].tolist() == x[:3].tolist()
    assert (np.abs([sine(x)[:5], cosine(x)[:5]]) <= 1.0).all()
    assert np.isnan([sine(x)[5:], cosine(x)[5:]]).all()
