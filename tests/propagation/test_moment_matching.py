"""Exact moment matching against brute force: Monte Carlo, 50 digits, finite
differences, and its own limits."""

import mpmath
import pytest
import torch

from gpmpc.exceptions import ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.gp._posterior import AffineForm
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.propagation._moments import moments


def model(
    size=20, n=2, m=1, noise=1e-3, lengthscale=1.0, predicts="next_state", seed=0
):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator)

    inputs = 4 * draw(size, n + m) - 2
    targets = torch.stack(
        [
            torch.sin(inputs[:, 0] * (a + 1)) + inputs[:, -1] * inputs[:, a]
            for a in range(n)
        ],
        dim=1,
    )
    return GPPosterior.from_hyperparameters(
        inputs,
        targets,
        lengthscales=lengthscale * (0.6 + draw(n, n + m)),
        signal_variance=0.7 + draw(n),
        noise_variance=torch.full((n,), noise) * (0.7 + draw(n)),
        input_dim=m,
        predicts=predicts,
    )


def belief(n=2, spread=0.3, seed=1, rank=None):
    generator = torch.Generator().manual_seed(seed)
    root = spread * torch.randn(n, rank or n, generator=generator)
    return Gaussian(0.5 * torch.randn(n, generator=generator), root @ root.T)


def by_mpmath(gp, at, control):
    """The textbook formulas of the module in 50 digits, from the same hyperparameters
    and data."""
    with mpmath.workdps(50):
        n = gp.state_dim
        size = len(gp)
        x = mpmath.matrix(gp.features.tolist())
        mu = at.mean.tolist()
        u = control.tolist()
        S = mpmath.matrix(at.covariance.tolist())
        length = [[mpmath.mpf(v) for v in row] for row in gp.lengthscales.tolist()]
        sf2 = gp.signal_variance.tolist()
        sn2 = gp.noise_variance.tolist()
        mean = []
        cross = mpmath.matrix(n, n)
        q = []
        beta = []
        precision = []
        for a in range(n):
            K = mpmath.matrix(size, size)
            for i in range(size):
                for j in range(size):
                    squares = sum(
                        ((x[i, d] - x[j, d]) / length[a][d]) ** 2 for d in range(x.cols)
                    )
                    K[i, j] = sf2[a] * mpmath.exp(-squares / 2) + (
                        sn2[a] if i == j else 0
                    )
            precision.append(K**-1)
            beta.append(precision[a] * mpmath.matrix(gp.targets[:, a].tolist()))
            Lam = mpmath.diag([v**2 for v in length[a][:n]])
            inverse = (S + Lam) ** -1
            det = mpmath.det(S * Lam**-1 + mpmath.eye(n))
            qs = []
            for i in range(size):
                nu = mpmath.matrix([x[i, d] - mu[d] for d in range(n)])
                certain = sum(
                    ((x[i, n + d] - u[d]) / length[a][n + d]) ** 2
                    for d in range(len(u))
                )
                qs.append(
                    sf2[a]
                    / mpmath.sqrt(det)
                    * mpmath.exp(-((nu.T * inverse * nu)[0] + certain) / 2)
                )
                step = S * inverse * nu * (beta[a][i] * qs[i])
                for d in range(n):
                    cross[d, a] += step[d]
            q.append(qs)
            mean.append(sum(beta[a][i] * qs[i] for i in range(size)))
        covariance = mpmath.matrix(n, n)
        for a in range(n):
            for b in range(n):
                inverse_a = mpmath.diag([1 / v**2 for v in length[a][:n]])
                inverse_b = mpmath.diag([1 / v**2 for v in length[b][:n]])
                R = S * (inverse_a + inverse_b) + mpmath.eye(n)
                RS = R**-1 * S
                det = mpmath.det(R)

                def k(c, i):
                    state = sum(
                        ((x[i, d] - mu[d]) / length[c][d]) ** 2 for d in range(n)
                    )
                    certain = sum(
                        ((x[i, n + d] - u[d]) / length[c][n + d]) ** 2
                        for d in range(len(u))
                    )
                    return sf2[c] * mpmath.exp(-(state + certain) / 2)

                total = mpmath.mpf(0)
                reduction = mpmath.mpf(0)
                for i in range(size):
                    for j in range(size):
                        z = inverse_a * mpmath.matrix(
                            [x[i, d] - mu[d] for d in range(n)]
                        )
                        z += inverse_b * mpmath.matrix(
                            [x[j, d] - mu[d] for d in range(n)]
                        )
                        Q = (
                            k(a, i)
                            * k(b, j)
                            / mpmath.sqrt(det)
                            * mpmath.exp((z.T * RS * z)[0] / 2)
                        )
                        total += beta[a][i] * Q * beta[b][j]
                        reduction += precision[a][i, j] * Q
                covariance[a, b] = (
                    total - mean[a] * mean[b] + ((sf2[a] - reduction) if a == b else 0)
                )
        to_tensor = torch.tensor
        return (
            to_tensor([float(v) for v in mean]),
            to_tensor([[float(covariance[a, b]) for b in range(n)] for a in range(n)]),
            to_tensor([[float(cross[a, b]) for b in range(n)] for a in range(n)]),
        )


@pytest.mark.parametrize(
    ("case", "arguments", "at", "tolerance"),
    [
        ("ordinary", {}, {}, 1e-11),
        ("little noise", {"noise": 1e-6}, {}, 1e-9),
        ("nearly noise-free", {"noise": 1e-10, "lengthscale": 0.7}, {}, 1e-7),
        ("tiny covariance", {"noise": 1e-6}, {"spread": 1e-4}, 1e-9),
        ("large covariance", {}, {"spread": 5.0}, 1e-10),
        ("rank-deficient covariance", {}, {"rank": 1}, 1e-11),
        ("short length-scales", {"lengthscale": 0.05}, {}, 1e-10),
        ("far from the data", {}, {"spread": 0.3, "seed": 5}, 1e-11),
    ],
)
def test_the_moments_agree_with_a_fifty_digit_evaluation(
    case, arguments, at, tolerance
):
    gp = model(size=7, **arguments)
    control = torch.tensor([0.4])
    at = belief(**at)
    if case == "far from the data":
        at = Gaussian(at.mean + 6.0, at.covariance)
    mean, covariance, slope = moments(gp, at, control)
    cross = at.covariance @ slope.mT
    exact_mean, exact_covariance, exact_cross = by_mpmath(gp, at, control)
    scale = float(exact_covariance.abs().max())
    assert float((covariance - exact_covariance).abs().max()) < tolerance * scale
    assert float((mean - exact_mean).abs().max()) < tolerance * max(
        1e-3, float(exact_mean.abs().max())
    )
    assert float((cross - exact_cross).abs().max()) < tolerance * max(
        1e-3, float(exact_cross.abs().max())
    )


@pytest.mark.parametrize("predicts", ["next_state", "difference"])
@pytest.mark.parametrize(("n", "m"), [(1, 0), (2, 1), (3, 2)])
def test_the_moments_agree_with_monte_carlo(n, m, predicts):
    gp = model(size=15, n=n, m=m, noise=1e-2, predicts=predicts)
    at = belief(n)
    control = torch.full((m,), 0.3)
    samples = 1_000_000
    chunk = 20_000
    root = torch.linalg.cholesky(at.covariance)
    generator = torch.Generator().manual_seed(7)
    states = []
    samples_after = []
    for _ in range(samples // chunk):
        x = at.mean + torch.randn(chunk, n, generator=generator) @ root.T
        prediction = gp.predict(x, control.expand(chunk, m))
        states.append(x)
        samples_after.append(
            prediction.mean
            + prediction.variance.sqrt() * torch.randn(chunk, n, generator=generator)
        )
    states = torch.cat(states)
    samples_after = torch.cat(samples_after)
    exact = MomentMatching(process_noise=False).propagate(gp, at, control)
    assert float(exact.deficit) == 0

    z_mean = (samples_after.mean(0) - exact.belief.mean) / (
        samples_after.std(0) / samples**0.5
    )
    centred = samples_after - exact.belief.mean
    products = centred[:, :, None] * centred[:, None, :]
    z_covariance = (products.mean(0) - exact.belief.covariance) / (
        products.std(0) / samples**0.5
    )
    products = (states - at.mean)[:, :, None] * centred[:, None, :]
    z_cross = (products.mean(0) - exact.cross_covariance) / (
        products.std(0) / samples**0.5
    )
    for z in (z_mean, z_covariance, z_cross):
        assert float(z.abs().max()) < 4.5


@pytest.mark.parametrize("predicts", ["next_state", "difference"])
def test_without_covariance_it_is_the_plain_prediction(predicts):
    gp = model(predicts=predicts)
    for control in torch.linspace(-1, 1, 5)[:, None]:
        at = Gaussian(torch.tensor([0.3, -0.4]), torch.zeros(2, 2))
        plain = gp.predict(at.mean, control)
        matched = MomentMatching(process_noise=False).propagate(gp, at, control)
        assert torch.allclose(matched.belief.mean, plain.mean, rtol=0, atol=1e-10)
        assert torch.allclose(
            matched.belief.covariance, plain.covariance, rtol=0, atol=1e-10
        )
        assert not matched.cross_covariance.any()


def test_a_vanishing_covariance_linearly_nears_the_prediction():
    gp = model()
    at = belief()
    control = torch.tensor([0.2])
    plain = gp.predict(at.mean, control).mean
    gaps = [
        float(
            (moments(gp, Gaussian(at.mean, e * at.covariance), control)[0] - plain)
            .abs()
            .max()
        )
        for e in (1e-4, 1e-5)
    ]
    assert gaps[0] / gaps[1] == pytest.approx(10, rel=1e-2)


def test_a_batch_is_the_loop_over_its_members():
    gp = model()
    beliefs = [belief(seed=s) for s in range(4)]
    controls = torch.linspace(-1, 1, 4)[:, None]
    batch = Gaussian(
        torch.stack([b.mean for b in beliefs]),
        torch.stack([b.covariance for b in beliefs]),
    )
    together = MomentMatching().propagate(gp, batch, controls)
    for k, (at, control) in enumerate(zip(beliefs, controls, strict=True)):
        alone = MomentMatching().propagate(gp, at, control)
        assert torch.allclose(together.belief.mean[k], alone.belief.mean, atol=1e-13)
        assert torch.allclose(
            together.belief.covariance[k], alone.belief.covariance, atol=1e-13
        )
        assert torch.allclose(
            together.cross_covariance[k], alone.cross_covariance, atol=1e-13
        )


@pytest.mark.parametrize("spread", [0.3, 0.0])
def test_derivatives_by_torch_agree_with_finite_differences(spread):
    gp = model()
    at = belief(spread=spread)
    control = torch.tensor([0.2])
    direction = torch.tensor([[0.5, 0.2], [0.2, 0.3]])

    def along(t):
        shifted = Gaussian(
            at.mean + t * torch.tensor([0.3, -0.2]), at.covariance + t * direction
        )
        mean, covariance, cross = moments(gp, shifted, control + t)
        return torch.cat([mean, covariance.ravel(), cross.ravel()])

    step = 1e-6
    forward = torch.func.jacfwd(along)(torch.tensor(0.0))
    reverse = torch.func.jacrev(along)(torch.tensor(0.0))
    numeric = (along(torch.tensor(step)) - along(torch.tensor(-step))) / (2 * step)
    assert torch.allclose(forward, numeric, rtol=1e-6, atol=1e-7)
    assert torch.allclose(reverse, forward, rtol=1e-10, atol=1e-11)


def test_derivatives_exist_where_eigenvalues_are_equal():
    gp = model()
    gp = GPPosterior.from_hyperparameters(
        gp.features,
        gp.targets,
        gp.lengthscales,
        torch.ones(2),
        gp.noise_variance,
        gp.input_dim,
    )
    control = torch.zeros(1)

    def far(mean):
        return MomentMatching()(
            gp, Gaussian(mean, 0.1 * torch.eye(2)), control
        ).covariance

    jacobian = torch.func.jacrev(far)(torch.full((2,), 50.0))
    assert torch.isfinite(jacobian).all()
    near = torch.tensor([0.3, -0.4])
    step = torch.tensor([1e-6, 0.0])
    numeric = (far(near + step) - far(near - step)) / 2e-6
    assert torch.allclose(torch.func.jacrev(far)(near)[..., 0], numeric, atol=1e-7)


def test_vmap_maps_over_beliefs():
    gp = model()
    means = torch.randn(3, 2)
    S = belief().covariance
    control = torch.tensor([0.2])
    mapped = torch.func.vmap(lambda mean: moments(gp, Gaussian(mean, S), control)[1])(
        means
    )
    assert torch.allclose(
        mapped[2], moments(gp, Gaussian(means[2], S), control)[1], atol=1e-13
    )


def test_wide_beliefs_far_from_data_keep_the_prior():
    gp = model(lengthscale=0.05)
    for distance, spread in ((0.0, 1e3), (50.0, 10.0), (1e4, 1.0)):
        mean, covariance, _ = moments(
            gp,
            Gaussian(torch.full((2,), distance), spread**2 * torch.eye(2)),
            torch.zeros(1),
        )
        assert torch.isfinite(mean).all()
        assert torch.allclose(covariance.diagonal(), gp.signal_variance, rtol=1e-3)


def test_results_are_semidefinite_with_noise_unless_refused():
    gp = model(noise=1e-8)
    at = belief(spread=1e-3)
    control = torch.tensor([0.1])
    latent = MomentMatching(process_noise=False)(gp, at, control)
    noisy = MomentMatching()(gp, at, control)
    assert float(torch.linalg.eigvalsh(latent.covariance).min()) >= -1e-18
    assert torch.allclose(
        noisy.covariance - latent.covariance, torch.diag(gp.noise_variance), atol=1e-14
    )


def test_a_belief_of_another_dimension_is_refused():
    with pytest.raises(
        ShapeError,
        match=r"a state \(\*batch, 2\) and an input \(\*batch, 1\); "
        r"got \(3,\) and \(1,\)",
    ):
        MomentMatching()(model(), belief(3), torch.zeros(1))
    with pytest.raises(ShapeError, match=r"got \(2,\) and \(2,\)"):
        MomentMatching()(model(), belief(), torch.zeros(2))


class InAffineModel:
    """GPs inside an affine model, of which only the form is read."""

    def __init__(self, gp, **parts):
        self.gp = gp
        self.affine_form = AffineForm(gp, **parts)

    def __getattr__(self, name):
        return getattr(self.gp, name)


A_MATRIX = torch.tensor([[0.9, 0.4], [-0.3, 0.8]])
G_MATRIX = torch.tensor([[0.2], [0.7]])
C_VECTOR = torch.tensor([0.5, -1.0])


@pytest.mark.parametrize("diagonal", [False, True])
@pytest.mark.parametrize("parts", ["A", "AG", "Ac", "G", "c", "Gc"])
def test_a_missing_part_of_an_affine_form_is_zero(parts, diagonal):
    gp = model()
    at = belief()
    u = torch.tensor([0.7])
    values = {"A": A_MATRIX, "G": G_MATRIX, "c": C_VECTOR}
    some = {name: values[name] for name in parts}
    zeros = {name: torch.zeros_like(value) for name, value in values.items()}
    propagator = MomentMatching(diagonal=diagonal)
    result, slopes = propagator.differentiate(InAffineModel(gp, **some), at, u)
    expected, all_slopes = propagator.differentiate(
        InAffineModel(gp, **(zeros | some)), at, u
    )
    of_gps = propagator.propagate(gp, at, u)
    affine = {**zeros, **some}
    mean = of_gps.belief.mean + affine["A"] @ at.mean + affine["G"] @ u + affine["c"]
    assert torch.allclose(result.belief.mean, mean, atol=1e-14)
    assert torch.allclose(result.belief.mean, expected.belief.mean, atol=1e-14)
    assert torch.allclose(
        result.belief.covariance, expected.belief.covariance, atol=1e-14
    )
    for name, slope in vars(slopes).items():
        assert torch.allclose(slope, getattr(all_slopes, name), atol=1e-14)


def test_gps_with_a_matrix_a_alone_are_linearized_with_it():
    gp = model()
    at = belief()
    u = torch.tensor([0.7])
    result, slopes = Linearization().differentiate(InAffineModel(gp, A=A_MATRIX), at, u)
    alone, slopes_alone = Linearization().differentiate(gp, at, u)
    mean = alone.belief.mean + A_MATRIX @ at.mean
    assert torch.allclose(result.belief.mean, mean, atol=1e-14)
    by_mean = slopes_alone.mean_by_mean + A_MATRIX
    assert torch.allclose(slopes.mean_by_mean, by_mean, atol=1e-14)
