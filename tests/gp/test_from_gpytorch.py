"""Freezing trained GPyTorch models: SE-ARD ones, sparse ones, and those of any
kernel."""

import gpytorch
import numpy as np
import pytest
import torch
from gpytorch.kernels import (
    InducingPointKernel,
    LinearKernel,
    MaternKernel,
    PeriodicKernel,
    ProductKernel,
    RBFKernel,
    ScaleKernel,
)
from gpytorch.likelihoods import FixedNoiseGaussianLikelihood, GaussianLikelihood
from gpytorch.means import ConstantMean, LinearMean
from packaging.version import Version

from gpmpc.exceptions import SettingError, ShapeError, UnsupportedModel
from gpmpc.gaussian import Gaussian
from gpmpc.gp import (
    KernelPosterior,
    Transitions,
    exact_inference,
    from_gpytorch,
)
from gpmpc.gp.casadi_ import casadi_function
from gpmpc.models import Affine, ResidualModel, RollOut, linearize
from gpmpc.mpc import beyond_data
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MomentMatching,
    MonteCarlo,
    Unscented,
    best_propagator,
    differentiate,
)
from tests.gp.their_models import (
    Model,
    batch,
    data,
    matern_dynamics,
    sgpr,
    shaken,
)


def one_output(size, kernel, y=0, mean=None, **settings):
    x, targets = data(size)
    return shaken(Model(x, targets[y], kernel, mean, **settings), seed=y)


def theirs(model, query):
    """GPyTorch's own exact mean and variance (B, k)."""
    models = model if isinstance(model, list) else getattr(model, "models", [model])
    with exact_inference(), torch.no_grad():
        beliefs = [
            m.eval()(query.expand(*m.train_targets.shape[:-1], *query.shape))
            for m in models
        ]
    flat = [
        (b.mean.reshape(-1, len(query)), b.variance.reshape(-1, len(query)))
        for b in beliefs
    ]
    return tuple(torch.cat(parts).mT for parts in zip(*flat, strict=True))


def jacobian_of(gp, query):
    """Slopes of the mean by state and input."""
    slopes = linearize(gp, query[:, :2].numpy(), query[:, 2:].numpy())
    return torch.from_numpy(np.concatenate([slopes.A, slopes.B], axis=-1))


def their_jacobian(model, query):
    models = model if isinstance(model, list) else getattr(model, "models", [model])
    rows = []
    for m in models:
        with exact_inference():
            leaf = query.clone().requires_grad_()
            mean = m.eval()(
                leaf.expand(*m.train_targets.shape[:-1], *query.shape)
            ).mean.reshape(-1, len(query))
            rows += [
                torch.autograd.grad(each.sum(), leaf, retain_graph=True)[0]
                for each in mean
            ]
    return torch.stack(rows, dim=1)


SE_ARD = {
    "single": lambda size: one_output(size, ScaleKernel(RBFKernel(ard_num_dims=3))),
    "shared length-scale": lambda size: one_output(size, ScaleKernel(RBFKernel())),
    "no scale": lambda size: one_output(size, RBFKernel(ard_num_dims=3)),
    "constant mean": lambda size: one_output(
        size, ScaleKernel(RBFKernel()), mean=ConstantMean()
    ),
    "batch": batch,
    "batch with constant means": lambda size: batch(
        size, mean=ConstantMean(batch_shape=torch.Size([2]))
    ),
    "list": lambda size: [
        one_output(size, ScaleKernel(RBFKernel(ard_num_dims=3)), y) for y in (0, 1)
    ],
    "IndependentModelList": lambda size: gpytorch.models.IndependentModelList(
        one_output(size, ScaleKernel(RBFKernel(ard_num_dims=3)), 0),
        one_output(size, RBFKernel(), 1),
    ),
}


@pytest.mark.parametrize("kind", SE_ARD)
@pytest.mark.parametrize("size", [10, 189])
@pytest.mark.parametrize("freeze", [from_gpytorch, KernelPosterior.from_gpytorch])
def test_a_frozen_model_predicts_what_gpytorch_does(kind, size, freeze):
    assert_equal(SE_ARD[kind](size), freeze)


@pytest.mark.parametrize("freeze", [from_gpytorch, KernelPosterior.from_gpytorch])
@pytest.mark.parametrize("size", [900, 2000])
def test_a_frozen_model_is_exact_where_gpytorch_by_itself_is_not(size, freeze):
    assert_equal(SE_ARD["single"](size), freeze)


def assert_equal(model, freeze):
    gp = freeze(model, input_dim=1, predicts="value")
    query = data(7, seed=5)[0]
    belief = gp.predict(query[:, :2], query[:, 2:])
    mean, variance = theirs(model, query)
    assert torch.allclose(belief.mean, mean, rtol=0, atol=1e-10)
    assert torch.allclose(belief.variance, variance, rtol=0, atol=1e-10)
    jacobian = jacobian_of(gp, query)
    assert torch.allclose(jacobian, their_jacobian(model, query), rtol=0, atol=1e-10)


ANY_KERNEL = {
    "Matern 3/2": lambda: MaternKernel(nu=1.5, ard_num_dims=3),
    "Matern 5/2": lambda: ScaleKernel(MaternKernel(nu=2.5)),
    "sum": lambda: ScaleKernel(RBFKernel(ard_num_dims=3)) + LinearKernel(),
    "product": lambda: ScaleKernel(ProductKernel(RBFKernel(), MaternKernel(nu=2.5))),
    "periodic on one": lambda: (
        ScaleKernel(PeriodicKernel(active_dims=[0])) + MaternKernel(nu=2.5)
    ),
}


@pytest.mark.parametrize("size", [30, 900])
@pytest.mark.parametrize("kind", ANY_KERNEL)
def test_any_kernel_predicts_what_gpytorch_does(kind, size):
    model = one_output(size, ANY_KERNEL[kind](), mean=LinearMean(3))
    gp = KernelPosterior.from_gpytorch(model, input_dim=1, predicts="value")
    query = data(6, seed=5)[0]
    belief = gp.predict(query[:, :2], query[:, 2:])
    mean, variance = theirs(model, query)
    assert torch.allclose(belief.mean, mean, rtol=0, atol=1e-10)
    assert torch.allclose(belief.variance, variance, rtol=0, atol=1e-10)
    jacobian = jacobian_of(gp, query)
    step = 1e-5
    for d in range(3):
        shift = step * torch.eye(3)[d]
        ahead = query + shift
        behind = query - shift
        slope = (
            gp.predict(ahead[:, :2], ahead[:, 2:]).mean
            - gp.predict(behind[:, :2], behind[:, 2:]).mean
        )
        expected = slope / (2 * step)
        assert torch.allclose(jacobian[..., d], expected, rtol=1e-6, atol=1e-6)


def test_predicting_leaves_gpytorchs_settings_to_the_process(monkeypatch):
    """Other threads read them at the same time."""
    gp = matern_dynamics()
    forward = gp.parts[0].model.forward
    sizes = []

    def watched(points):
        sizes.append(gpytorch.settings.max_cholesky_size.value())
        return forward(points)

    monkeypatch.setattr(gp.parts[0].model, "forward", watched)
    gp.predict(torch.zeros(2), torch.zeros(1))
    assert sizes == [gpytorch.settings.max_cholesky_size.value()]


def test_leading_batch_dimensions_are_those_of_the_query():
    gp = matern_dynamics()
    x = torch.rand(2, 3, 2)
    u = torch.rand(2, 3, 1)
    whole = gp.predict(x, u)
    assert whole.covariance.shape == (2, 3, 2, 2)
    single = gp.predict(x[1, 2], u[1, 2])
    assert torch.allclose(whole.mean[1, 2], single.mean, atol=1e-13)
    assert torch.allclose(whole.covariance[1, 2], single.covariance, atol=1e-13)
    _, slopes = differentiate(MeanEquivalence(), gp, Gaussian.certain(x), u)
    assert slopes.mean_by_mean.shape == (2, 3, 2, 2)
    assert slopes.mean_by_input.shape == (2, 3, 2, 1)


def test_a_difference_model_adds_the_state():
    x = torch.rand(4, 2)
    u = torch.rand(4, 1)
    plain = matern_dynamics()
    difference = matern_dynamics("difference")
    assert torch.allclose(difference.predict(x, u).mean, plain.predict(x, u).mean + x)
    expansions = [linearize(gp, x.numpy(), u.numpy()) for gp in (plain, difference)]
    slopes, of_difference = (expansion.A for expansion in expansions)
    np.testing.assert_allclose(of_difference - slopes, [np.eye(2)] * 4, rtol=1e-5)


@pytest.mark.parametrize(
    "propagator", [MeanEquivalence(), Linearization(), Unscented(), MonteCarlo(500)]
)
def test_sampling_and_expanding_propagators_take_any_kernel(propagator):
    gp = matern_dynamics()
    at = Gaussian(torch.tensor([0.2, -0.4]), 0.01 * torch.eye(2))
    control = torch.rand(1)
    sampled = MonteCarlo(20_000, seed=3)(gp, at, control)
    belief = propagator(gp, at, control)
    assert torch.allclose(belief.mean, sampled.mean, atol=0.05)
    if not isinstance(propagator, MeanEquivalence):
        assert torch.allclose(belief.covariance, sampled.covariance, atol=0.01)
    propagation, sensitivity = differentiate(propagator, gp, at, control)
    step = 1e-5
    shifted = [
        propagator(gp, Gaussian(at.mean, at.covariance), control + s * step).mean
        for s in (1, -1)
    ]
    assert torch.allclose(propagation.belief.mean, belief.mean)
    assert torch.allclose(
        sensitivity.mean_by_input[:, 0],
        (shifted[0] - shifted[1]) / (2 * step),
        atol=1e-5,
    )


def test_moment_matching_says_what_other_kernels_allow():
    with pytest.raises(
        UnsupportedModel,
        match="got KernelPosterior. Possible with any model: MeanEquivalence, Linear",
    ):
        MomentMatching()(
            matern_dynamics(), Gaussian(torch.zeros(2), torch.eye(2)), torch.zeros(1)
        )


def test_a_residual_of_any_kernel_is_rolled_out_as_one():
    model = ResidualModel(
        nominal=Affine.identity(2, 1),
        residual=matern_dynamics("value"),
        B=torch.eye(2),
        states=[0, 1],
        inputs=[0],
        input_dim=1,
    )
    assert isinstance(best_propagator(model), Unscented)
    RollOut(model)
    x = np.array([[0.2, -0.4]])
    u = np.array([[0.1]])
    assert beyond_data(model, [100.0, 0.0]) == []
    data = Transitions(x, u, x)
    with pytest.raises(UnsupportedModel, match="GPPosterior; got KernelPosterior"):
        model.append(data)
    with pytest.raises(UnsupportedModel, match="nominal Affine and a KernelPosterior"):
        casadi_function(model)


def test_a_frozen_model_knows_its_sizes_noise_type_and_moves():
    gp = matern_dynamics()
    assert (gp.state_dim, gp.input_dim, gp.output_dim, gp.dtype, gp.device.type) == (
        2,
        1,
        2,
        torch.float64,
        "cpu",
    )
    assert gp.noise_covariance.shape == (2, 2)
    single = gp.to(dtype=torch.float32)
    x = torch.rand(5, 2)
    u = torch.rand(5, 1)
    assert single.dtype == torch.float32
    assert torch.allclose(
        single.predict(x.float(), u.float()).mean.double(),
        gp.predict(x, u).mean,
        atol=1e-3,
    )
    assert gp.dtype == torch.float64
    for shape in ((0,), (2, 0), (0, 3)):
        belief = gp.predict(torch.zeros(*shape, 2), torch.zeros(*shape, 1))
        assert belief.mean.shape == (*shape, 2)
        assert belief.covariance.shape == (*shape, 2, 2)
    with pytest.raises(
        ShapeError, match=r"an input \(\*batch, 1\); got \(5, 2\) and \(5, 2\)"
    ):
        gp.predict(x, torch.zeros(5, 2))


def test_later_changes_of_the_model_leave_the_frozen_one_alone():
    model = one_output(20, ScaleKernel(MaternKernel()))
    query = torch.rand(4, 3)
    gp = KernelPosterior.from_gpytorch(model, input_dim=0, predicts="value")
    before = gp.predict(query).mean
    shaken(model, seed=7)
    assert torch.equal(gp.predict(query).mean, before)


class DoubledScale(ScaleKernel):
    def forward(self, x1, x2, **settings):
        return 2 * super().forward(x1, x2, **settings)


class SlopedMean(ConstantMean):
    def forward(self, x):
        return super().forward(x) + x[..., 0]


def with_transform():
    model = one_output(10, ScaleKernel(RBFKernel()))
    model.outcome_transform = torch.nn.Identity()
    return model


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (
            lambda: one_output(10, ScaleKernel(MaternKernel())),
            UnsupportedModel,
            "got MaternKernel. KernelPosterior takes any kernel",
        ),
        (
            lambda: one_output(10, RBFKernel(active_dims=[0])),
            UnsupportedModel,
            "got RBFKernel on some dimensions",
        ),
        (
            lambda: one_output(10, RBFKernel(), mean=LinearMean(3)),
            UnsupportedModel,
            "zero or constant; got LinearMean",
        ),
        (
            lambda: one_output(
                10,
                RBFKernel(),
                likelihood=FixedNoiseGaussianLikelihood(torch.full((10,), 0.1)),
            ),
            UnsupportedModel,
            "must be a GaussianLikelihood; got FixedNoiseGaussianLikelihood",
        ),
        (
            lambda: one_output(10, ScaleKernel(RBFKernel(), active_dims=(0,))),
            UnsupportedModel,
            "got ScaleKernel on some dimensions",
        ),
        (
            lambda: one_output(10, DoubledScale(RBFKernel())),
            UnsupportedModel,
            "got DoubledScale",
        ),
        (
            lambda: one_output(10, RBFKernel(), mean=SlopedMean()),
            UnsupportedModel,
            "zero or constant; got SlopedMean",
        ),
        (with_transform, UnsupportedModel, "carries an outcome_transform"),
        (
            lambda: Model(*(t.float() for t in data(9, 1)), RBFKernel()),
            SettingError,
            "must be in float64",
        ),
        (
            lambda: [one_output(10, RBFKernel()), one_output(11, RBFKernel())],
            ShapeError,
            "all outputs must have the same training inputs",
        ),
        (
            lambda: torch.nn.Linear(1, 1),
            UnsupportedModel,
            "only ExactGP models .* got Linear",
        ),
    ],
)
def test_models_that_cannot_be_frozen_are_refused_by_reason(make, error, message):
    with pytest.raises(error, match=message):
        from_gpytorch(make(), input_dim=0, predicts="value")


def test_numbers_that_do_not_go_together_are_refused():
    with pytest.raises(
        ShapeError,
        match="features must have n .* 1 controls; got 3 columns and 1 outputs",
    ):
        KernelPosterior.from_gpytorch(one_output(10, MaternKernel()), input_dim=1)
    with pytest.raises(
        ShapeError, match="each model needs one likelihood; got 1 models and 2"
    ):
        KernelPosterior.from_gpytorch(
            one_output(10, RBFKernel()), [GaussianLikelihood()] * 2, input_dim=1
        )
    with pytest.raises(
        SettingError, match="'next_state', 'difference', 'value'; got 'delta'"
    ):
        KernelPosterior.from_gpytorch(
            one_output(10, RBFKernel()), input_dim=1, predicts="delta"
        )
    with pytest.raises(SettingError, match="signals: must be Signals"):
        KernelPosterior.from_gpytorch(
            one_output(10, RBFKernel()), input_dim=1, predicts="value", signals="x"
        )


# --- a forward of its own -------------------------------------------------------------


def its_prior(model, mean_points, points, added=0.0, factor=1.0):
    return gpytorch.distributions.MultivariateNormal(
        model.mean_module(mean_points) + added, factor * model.covar_module(points)
    )


FORWARDS = {
    "scales its inputs": lambda model, x: its_prior(model, x, x / 3),
    "scales both": lambda model, x: its_prior(model, (x - 0.3) / 2, (x - 0.3) / 2),
    "warps": lambda model, x: its_prior(model, x, torch.tanh(x)),
    "clamps": lambda model, x: its_prior(model, x, x.clamp(-1.7, 1.7)),
    "adds to the mean": lambda model, x: its_prior(model, x, x, added=x.sum(-1)),
    "scales the kernel": lambda model, x: its_prior(model, x, x, factor=2.0),
    "is a logarithm's": lambda model, x: its_prior(model, x, (x + 2).log()),
}


def with_forward(model, forward):
    """A model whose last part has a ``forward`` of its own."""
    models = model if isinstance(model, list) else [*getattr(model, "models", [model])]
    of_its_own = {"forward": lambda self, x: forward(self, x)}
    models[-1].__class__ = type("Warped", (Model,), of_its_own)
    return model


@pytest.mark.parametrize("kind", SE_ARD)
@pytest.mark.parametrize("name", FORWARDS)
def test_a_changed_forward_is_left_to_kernel_posterior(kind, name):
    model = with_forward(SE_ARD[kind](20), FORWARDS[name])
    with pytest.raises(UnsupportedModel, match="forward is not the distribution") as e:
        from_gpytorch(model, input_dim=1, predicts="value")
    assert "KernelPosterior.from_gpytorch takes an exact model's forward" in str(
        e.value
    )
    gp = KernelPosterior.from_gpytorch(model, input_dim=1, predicts="value")
    query = data(7, seed=5)[0]
    mean, variance = theirs(model, query)
    belief = gp.predict(query[:, :2], query[:, 2:])
    assert torch.allclose(belief.mean, mean, rtol=0, atol=1e-11)
    assert torch.allclose(belief.variance, variance, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", FORWARDS)
def test_a_sparse_model_with_a_forward_of_its_own_is_refused_too(name):
    model = with_forward(sgpr(60, 8), FORWARDS[name])
    with pytest.raises(UnsupportedModel, match="train on transformed data"):
        from_gpytorch(model, input_dim=1, predicts="value")


class DeepKernel(gpytorch.models.ExactGP):
    """The form of GPyTorch's example of deep kernel learning."""

    def __init__(self, x, y):
        super().__init__(x, y, GaussianLikelihood())
        self.mean_module = ConstantMean()
        self.covar_module = ScaleKernel(RBFKernel(ard_num_dims=2))
        layers = torch.nn.Linear(3, 5), torch.nn.Tanh(), torch.nn.Linear(5, 2)
        self.network = torch.nn.Sequential(*layers)
        self.lower = torch.full((2,), torch.inf)
        self.upper = torch.full((2,), -torch.inf)

    def forward(self, x):
        seen = self.network(x)
        if self.training:  # as GPyTorch's ScaleToBounds
            self.lower = seen.amin(0).detach()
            self.upper = seen.amax(0).detach()
        seen = (seen - self.lower) / (self.upper - self.lower)
        return gpytorch.distributions.MultivariateNormal(
            self.mean_module(seen), self.covar_module(seen)
        )


def test_a_deep_kernel_is_refused_by_name_and_taken_as_a_kernel():
    torch.manual_seed(0)
    x, y = data(30)
    model = DeepKernel(x, y[0]).double().train()
    model(x)
    before = model.eval().lower.clone()
    with pytest.raises(UnsupportedModel, match="prior's mean is another one"):
        from_gpytorch(model, input_dim=1, predicts="value")
    gp = KernelPosterior.from_gpytorch(model, input_dim=1, predicts="value")
    query = data(7, seed=5)[0]
    mean, variance = theirs(model, query)
    belief = gp.predict(query[:, :2], query[:, 2:])
    assert torch.allclose(belief.mean, mean, rtol=0, atol=1e-11)
    assert torch.allclose(belief.variance, variance, rtol=0, atol=1e-11)
    assert torch.equal(model.lower, before)


def test_a_forward_that_moves_all_points_alike_is_the_same_model():
    model = with_forward(
        SE_ARD["single"](20), lambda model, x: its_prior(model, x, x + 5)
    )
    assert_equal(model, from_gpytorch)


def test_a_prior_that_depends_on_the_points_beside_is_none():
    def ranged(model, x):
        low = x.amin(-2, keepdim=True)
        high = x.amax(-2, keepdim=True)
        return its_prior(model, x, (x - low) / (high - low))

    model = with_forward(SE_ARD["single"](20), ranged)
    with pytest.raises(UnsupportedModel, match="another prior beside other points"):
        KernelPosterior.from_gpytorch(model, input_dim=1, predicts="value")
    with pytest.raises(UnsupportedModel, match="forward is not the distribution"):
        from_gpytorch(model, input_dim=1, predicts="value")


def test_a_model_of_other_parts_is_refused_by_what_is_missing():
    model = one_output(10, RBFKernel())
    model.kernel = model.covar_module
    del model.covar_module
    with pytest.raises(UnsupportedModel, match="the model has no covar_module"):
        from_gpytorch(model, input_dim=1, predicts="value")


def test_a_model_that_has_predicted_is_frozen_as_before():
    model = SE_ARD["batch"](20)
    query = data(4, seed=5)[0]
    model(query.expand(2, -1, -1)).mean.sum()
    assert_equal(model, from_gpytorch)


# --- sparse --------------------------------------------------------------------------


@pytest.mark.parametrize(("corrected", "method"), [(False, "sgpr"), (True, "fitc")])
def test_a_frozen_sparse_model_predicts_what_gpytorch_does(corrected, method):
    model = sgpr()
    query = data(7, seed=5)[0]
    with gpytorch.settings.sgpr_diagonal_correction(corrected):
        mean, variance = theirs(model, query)
        gp = from_gpytorch(model, input_dim=1, predicts="value")
    belief = gp.predict(query[:, :2], query[:, 2:])
    leaves_out = Version(gpytorch.__version__) >= Version("1.15.2")
    if (
        method == "sgpr" and leaves_out
    ):  # GPyTorch leaves out what the inducing points do not explain: kxx - qxx
        kernel = model.covar_module.base_kernel
        Z = model.covar_module.inducing_points.detach()
        with torch.no_grad():
            across = kernel(Z, query).to_dense()
            variance = variance + gp.signal_variance
            variance -= (
                (across * torch.linalg.solve(kernel(Z).to_dense(), across)).sum(-2).mT
            )
    assert len(gp) == 12
    assert not gp.has_observation_noise
    assert torch.allclose(belief.mean, mean, rtol=0, atol=1e-8)
    assert torch.allclose(belief.variance, variance, rtol=0, atol=1e-8)


def test_sparse_models_over_other_points_are_refused():
    x, y = data(20)
    exact = Model(x, y[1], RBFKernel()).double().eval()
    models = []
    for a in range(2):
        likelihood = GaussianLikelihood()
        kernel = InducingPointKernel(RBFKernel(), x[a : a + 5].clone(), likelihood)
        models.append(Model(x, y[a], kernel, likelihood=likelihood).double().eval())
    with pytest.raises(ShapeError, match="the same inducing points"):
        from_gpytorch(models, input_dim=1)
    with pytest.raises(ShapeError, match="all outputs must be sparse"):
        from_gpytorch([models[0], exact], input_dim=1)
    with pytest.raises(UnsupportedModel, match="freeze it by from_gpytorch"):
        KernelPosterior.from_gpytorch(models[0], input_dim=1, predicts="value")
