"""Closed-form derivatives against torch autograd through the torch evaluation, for
every model that has them."""

from dataclasses import replace

import casadi
import pytest
import torch

from gpmpc.exceptions import DataError, SettingError, ShapeError
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, backend, remove_points
from gpmpc.models import (
    Affine,
    CasadiFunction,
    DelayedModel,
    DisturbedModel,
    KnownModel,
    NoisyModel,
    ResidualModel,
)
from gpmpc.propagation import (
    Linearization,
    MeanEquivalence,
    MomentMatching,
    MonteCarlo,
    Unscented,
    differentiate,
    linearize,
    rollout,
)
from tests.propagation.test_moment_matching import belief, model

generator = torch.Generator().manual_seed(1)


def _name(value):
    return type(value).__name__


def draw(*shape):
    return torch.randn(*shape, generator=generator)


def residual_model():
    f = GPPosterior.from_hyperparameters(
        draw(30, 3),
        draw(30, 2),
        1 + draw(2, 3).abs(),
        torch.ones(2),
        torch.full((2,), 1e-2),
        1,
        "value",
        draw(2),
    )
    return ResidualModel(
        Affine(draw(3, 3), draw(3, 2), draw(3)), f, draw(3, 2), [2, 0], [1], 2
    )


MODELS = {
    "next state": model(n=3, m=2),
    "difference": model(n=3, m=2, predicts="difference"),
    "autonomous": model(n=3, m=0, predicts="difference"),
    "residual": residual_model(),
}


class Opaque:
    """Propagates as another does, and has no derivatives of its own."""

    def __init__(self, propagator):
        self.propagate = propagator.propagate


def by_autograd(propagator, *arguments):
    return differentiate(Opaque(propagator), *arguments)


class IndependentOutputs(Linearization):
    diagonal = True


class IndependentPoints(Unscented):
    diagonal = True


PROPAGATORS = [
    MeanEquivalence(),
    Linearization(),
    Linearization(process_noise=True),
    MomentMatching(),
    MomentMatching(diagonal=True),
    MomentMatching(process_noise=True),
    Unscented(),
    Unscented(alpha=0.5, beta=2.0, kappa=1.0, process_noise=True),
    IndependentOutputs(),
    IndependentPoints(),
]


@pytest.mark.parametrize("choice", ["auto", "torch"])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize(
    "propagator",
    PROPAGATORS,
    ids=lambda p: f"{type(p).__name__}{sorted(vars(p).items())}",
)
def test_closed_forms_are_autograds_derivatives(propagator, name, batch, choice):
    gp = MODELS[name]
    at = belief(3)
    at = Gaussian(
        at.mean + 0.3 * draw(*batch, 3), at.covariance.expand(*batch, 3, 3).clone()
    )
    control = draw(*batch, gp.input_dim)
    with backend(choice):
        propagation, closed_form = differentiate(propagator, gp, at, control)
    with backend("torch"):
        expected, automatic = by_autograd(propagator, gp, at, control)
    pairs = [
        (getattr(closed_form, part), getattr(automatic, part))
        for part in vars(automatic)
    ]
    pairs += [
        (propagation.belief.mean, expected.belief.mean),
        (propagation.belief.covariance, expected.belief.covariance),
        (propagation.cross_covariance, expected.cross_covariance),
        (propagation.deficit, expected.deficit),
    ]
    for mine, other in pairs:
        assert mine.shape == other.shape
        assert torch.allclose(
            mine,
            other,
            rtol=1e-9,
            atol=1e-10 * max(1.0, float(other.abs().max()) if other.numel() else 1),
        )


class ModelWithoutGradients:
    """Predicts by numbers alone, as a model of NumPy does."""

    state_dim = output_dim = 2
    input_dim = 1
    dtype = torch.float64
    device = torch.device("cpu")
    noise_covariance = torch.zeros(2, 2)

    def predict(self, state, input):
        mean = 0.9 * state.detach()
        return Gaussian(mean, torch.diag_embed(0.1 + mean**2))


class KnownWithoutGradients(ModelWithoutGradients):
    """Has no covariance, which alone would tell that derivatives are lost."""

    def predict(self, state, input):
        mean = 0.9 * state.detach()
        return Gaussian(mean, torch.zeros(*mean.shape, 2))


def _noisy(inner):
    gp = value_model(inner.state_dim, 1, 1)
    return NoisyModel(inner, gp, [0])


@pytest.mark.parametrize(
    "wrap",
    [
        lambda inner: inner,
        lambda inner: DelayedModel(inner, 0.5),
        lambda inner: DelayedModel(DelayedModel(inner, 1.0), 1.0),
        lambda inner: DisturbedModel(inner, torch.ones(2, 1), [0.1]),
        lambda inner: _noisy(DelayedModel(inner, 0.5)),
        _noisy,
    ],
)
@pytest.mark.parametrize(
    "propagator",
    [MeanEquivalence(), Linearization(), Unscented(), MonteCarlo(20)],
    ids=_name,
)
def test_what_a_wrapper_adds_hides_no_lost_derivatives(propagator, wrap):
    model = wrap(KnownWithoutGradients())
    n = model.state_dim
    at = Gaussian(draw(n), 0.1 * torch.eye(n))
    rule = "model: .* derivatives are lost .*, or have a linearize.*'zero_order'"
    with pytest.raises(SettingError, match=rule):
        differentiate(propagator, model, at, draw(1))


@pytest.mark.parametrize("batch", [(), (1,), (3,)], ids=str)
@pytest.mark.parametrize(
    "propagator",
    [MeanEquivalence(), Linearization(), Unscented(), MonteCarlo(20)],
    ids=_name,
)
def test_casadi_functions_with_lost_derivatives_are_refused(propagator, batch):
    x = casadi.SX.sym("x", 2)
    u = casadi.SX.sym("u")
    next_state = casadi.vertcat(casadi.sin(x[0]) * u, x[0] * x[1] + 1.0)
    effect = casadi.vertcat(x[1] ** 2, x[0])
    gp = value_model(2, 1, 1)
    in_casadi, in_torch = (
        ResidualModel(nominal, gp, B, [0, 1], [0], input_dim=1, noise=torch.zeros(2, 2))
        for nominal, B in (
            (
                CasadiFunction(casadi.Function("f", [x, u], [next_state])),
                CasadiFunction(casadi.Function("b", [x], [effect])),
            ),
            (
                lambda x, u: torch.stack(
                    [x[..., 0].sin() * u[..., 0], x[..., 0] * x[..., 1] + 1.0], dim=-1
                ),
                lambda x: torch.stack([x[..., 1] ** 2, x[..., 0]], dim=-1),
            ),
        )
    )
    at = Gaussian(draw(*batch, 2), 0.1 * torch.eye(2).expand(*batch, 2, 2))
    control = draw(*batch, 1)
    propagation, mine = differentiate(propagator, in_casadi, at, control)
    _, expected = differentiate(propagator, in_torch, at, control)
    for part, value in vars(expected).items():
        assert torch.allclose(getattr(mine, part), value, rtol=1e-9, atol=1e-12)
    direct = propagator(in_casadi, at, control).covariance
    assert torch.allclose(propagation.belief.covariance, direct, atol=1e-12)
    with pytest.raises(SettingError, match="model: .* derivatives are lost"):
        differentiate(propagator, ModelWithoutGradients(), at, control)


@pytest.mark.parametrize(
    "propagator",
    [MeanEquivalence(), Linearization(), MomentMatching(), Unscented()],
    ids=_name,
)
def test_closed_forms_by_torch_can_be_differentiated_again(propagator):
    gp = MODELS["difference"]
    at = belief(3)
    control = torch.zeros(2)
    step = torch.tensor([1e-5, 0.0, 0.0])

    def slope(mean):
        return differentiate(propagator, gp, Gaussian(mean, at.covariance), control)[
            1
        ].covariance_by_mean.sum()

    mean = at.mean.clone().requires_grad_()
    (curvature,) = torch.autograd.grad(slope(mean), mean)
    numeric = (slope(at.mean + step) - slope(at.mean - step)) / 2e-5
    assert torch.allclose(curvature[0], numeric, rtol=1e-6, atol=1e-7)


def test_a_root_without_derivative_is_constant_in_closed_form():
    gp = MODELS["difference"]
    flat = draw(3, 1)
    for covariance in (torch.zeros(3, 3), flat @ flat.T):
        at = Gaussian(draw(3), covariance)
        _, closed_form = differentiate(Unscented(), gp, at, torch.zeros(2))
        _, automatic = by_autograd(Unscented(), gp, at, torch.zeros(2))
        for part, value in vars(automatic).items():
            assert torch.allclose(getattr(closed_form, part), value, atol=1e-8)


def test_derivatives_are_those_of_a_subclass_with_another_noise():
    class Doubled(Linearization):
        def _add_noise_and_project(self, model, moments):
            return super()._add_noise_and_project(
                model, moments._replace(covariance=2 * moments.covariance)
            )

    class WithoutCorrelations(MeanEquivalence):
        diagonal = True

    gp = MODELS["next state"]
    at = Gaussian(draw(3), torch.eye(3))
    for propagator in (Doubled(), WithoutCorrelations()):
        result, slopes = differentiate(propagator, gp, at, torch.zeros(2))
        expected, automatic = by_autograd(propagator, gp, at, torch.zeros(2))
        assert torch.allclose(result.belief.covariance, expected.belief.covariance)
        for part, value in vars(automatic).items():
            assert torch.allclose(getattr(slopes, part), value, atol=1e-8)


def test_nobody_has_derivatives_too():
    nobody = Gaussian(draw(0, 3), draw(0, 3, 3))
    with backend("torch"):
        for propagator in PROPAGATORS:
            _, d = differentiate(propagator, MODELS["difference"], nobody, draw(0, 2))
            assert d.covariance_by_covariance.shape == (0, 3, 3, 3, 3)


@pytest.mark.parametrize("in_graph", [True, False])
def test_gradients_of_hyperparameters_outlive_a_look_without_any(in_graph):
    gp = MODELS["next state"]
    nobody = Gaussian(torch.zeros(3), 0.1 * torch.eye(3))
    control = torch.zeros(2)

    def slopes(look_first):
        noise = gp.noise_variance.clone().requires_grad_(in_graph)
        again = GPPosterior.from_hyperparameters(
            gp.features,
            gp.targets,
            gp.lengthscales,
            gp.signal_variance,
            noise,
            input_dim=2,
        )
        leaf = noise if in_graph else again.weights
        if look_first:
            linearize(MomentMatching(), again, nobody, control)
        leaf.requires_grad_()
        moments = MomentMatching()(again, nobody, control)
        return torch.autograd.grad(moments.covariance.sum(), leaf)[0]

    assert torch.equal(slopes(look_first=True), slopes(look_first=False))


def test_a_forced_evaluation_refuses_what_it_cannot_do():
    gp = MODELS["next state"]
    state = torch.zeros(3)
    control = torch.zeros(2)
    with backend("torch"):
        by_torch = gp.predict_with_jacobian(state, control)
    with backend("compiled"):
        compiled = gp.linearize(state[None].numpy(), control[None].numpy())
        with pytest.raises(SettingError, match="part of a graph"):
            MomentMatching().propagate(
                gp, Gaussian(state.clone().requires_grad_(), torch.eye(3)), control
            )
    for mine, other in zip((compiled.A, compiled.B), by_torch[1:], strict=True):
        assert torch.allclose(torch.from_numpy(mine[0]), other, rtol=1e-12, atol=1e-13)
    covariance = torch.from_numpy(compiled.covariance[0])
    assert torch.allclose(covariance, by_torch[0].covariance, atol=1e-13)
    with (
        pytest.raises(
            SettingError,
            match="must be one of 'auto', 'compiled', 'torch'; got 'numba'",
        ),
        backend("numba"),
    ):
        pass


def test_transforms_and_forward_mode_fall_back_to_torch_unasked():
    gp = MODELS["next state"]
    control = torch.zeros(2)
    states = draw(3, 3)
    mapped = torch.func.vmap(lambda x: gp.predict_with_jacobian(x, control)[1])(states)
    assert torch.allclose(
        mapped, gp.predict_with_jacobian(states, control.expand(3, 2))[1], atol=1e-12
    )
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(states[0], torch.ones(3))
        mean = gp.predict_with_jacobian(dual, control)[0].mean
        tangent = torch.autograd.forward_ad.unpack_dual(mean).tangent
    assert torch.allclose(tangent, mapped[0].sum(-1), atol=1e-12)
    uncertain = Gaussian(states[0], 0.1 * torch.eye(3))

    def mean_of(lengthscales):
        other = replace(gp, lengthscales=lengthscales)
        return MomentMatching().propagate(other, uncertain, control).belief.mean

    step = torch.full_like(gp.lengthscales, 1e-5)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(gp.lengthscales, step)
        tangent = torch.autograd.forward_ad.unpack_dual(mean_of(dual)).tangent
    change = mean_of(gp.lengthscales + step) - mean_of(gp.lengthscales - step)
    assert torch.allclose(tangent, change / 2, rtol=1e-5, atol=1e-12)


def test_a_float32_model_is_answered_by_torch_in_float32():
    gp = MODELS["next state"].to(dtype=torch.float32)
    belief, A, _ = gp.predict_with_jacobian(
        torch.zeros(3, dtype=torch.float32), torch.zeros(2, dtype=torch.float32)
    )
    assert belief.mean.dtype == A.dtype == torch.float32


def value_model(n, m, k):
    features = draw(20, n + m)
    targets = draw(20, k)
    scales = 0.7 + draw(k, n + m).abs()
    return GPPosterior.from_hyperparameters(
        features,
        targets,
        scales,
        torch.ones(k),
        torch.full((k,), 1e-2),
        m,
        predicts="value",
    )


@pytest.mark.parametrize(("n", "k"), [(2, 3), (3, 2)])
@pytest.mark.parametrize(
    "propagator",
    [MeanEquivalence(), Linearization(), MomentMatching(), Unscented()],
    ids=_name,
)
def test_any_number_of_outputs_has_derivatives(propagator, n, k):
    gp = value_model(n, 1, k)
    at = belief(n)
    control = draw(1)
    propagation, d = differentiate(propagator, gp, at, control)
    step = 1e-6
    for c in range(n):
        shift = step * torch.eye(n)[c]
        up, down = (
            propagator(gp, Gaussian(at.mean + sign * shift, at.covariance), control)
            for sign in (1, -1)
        )
        assert torch.allclose(
            d.mean_by_mean[:, c], (up.mean - down.mean) / (2 * step), atol=1e-7
        )
        assert torch.allclose(
            d.covariance_by_mean[..., c],
            (up.covariance - down.covariance) / (2 * step),
            atol=1e-7,
        )
    assert d.covariance_by_covariance.shape == (k, k, n, n)
    assert propagation.cross_covariance.shape == (n, k)
    with pytest.raises(ShapeError, match=f"got {n} states, {k} outputs"):
        linearize(propagator, gp, at, control)


def test_no_gradient_flows_through_a_local_model():
    gp = MODELS["difference"]
    control = torch.zeros(2, requires_grad=True)
    at = Gaussian.certain([0.1, 0.2, 0.3])
    local = linearize(MomentMatching(), gp, at, control)
    weights = gp.weights.clone().requires_grad_()
    of_leaf = linearize(MomentMatching(), replace(gp, weights=weights), at, control)
    for part in (local.A, local.c, of_leaf.next.mean, of_leaf.next.covariance):
        assert not part.requires_grad


def test_lengthscales_alone_may_be_leaves():
    gp = MODELS["difference"]
    lengthscales = gp.lengthscales.clone().requires_grad_()
    followed = replace(gp, lengthscales=lengthscales)
    for propagator in (MomentMatching(), Linearization(), Unscented()):
        after = propagator(followed, belief(3), torch.zeros(2))
        (slope,) = torch.autograd.grad(after.mean.sum(), lengthscales)
        assert slope.any()
        expected = propagator(gp, belief(3), torch.zeros(2)).mean
        assert torch.allclose(after.mean, expected, atol=1e-12)


class DoubledVariance(Linearization):
    def _next_moments(self, model, belief, input):
        moments = super()._next_moments(model, belief, input)
        return moments._replace(covariance=2.0 * moments.covariance)


class WithoutAttributes:
    __slots__ = ()

    def propagate(self, model, belief, input=None):
        return Linearization().propagate(model, belief, input)

    def differentiate(self, model, belief, input=None):
        return Linearization().differentiate(model, belief, input)


def test_a_propagator_of_ones_own_is_taken_by_its_word():
    gp = MODELS["difference"]
    control = torch.zeros(2)
    own = DoubledVariance(process_noise=False)
    assert Linearization().first_order
    assert not own.first_order
    assert not IndependentOutputs().first_order
    propagation, slopes = differentiate(own, gp, belief(3), control)
    expected, closed = differentiate(Linearization(False), gp, belief(3), control)
    covariance = 2.0 * expected.belief.covariance
    assert torch.allclose(propagation.belief.covariance, covariance)
    assert torch.allclose(slopes.covariance_by_mean, 2.0 * closed.covariance_by_mean)
    stepped, _ = differentiate(WithoutAttributes(), gp, belief(3), control)
    assert torch.equal(stepped.belief.mean, expected.belief.mean)
    inputs = torch.zeros(2, 2)
    beliefs = rollout(WithoutAttributes(), gp, belief(3), inputs)
    assert torch.equal(
        beliefs.mean, rollout(Linearization(), gp, belief(3), inputs).mean
    )


def test_misuse_is_refused_by_a_rule():
    with pytest.raises(SettingError, match="alpha: must be a number, 1e-07 or more"):
        Unscented(alpha=1e-200)
    values = value_model(2, 1, 2)
    with pytest.raises(SettingError, match="model: must predict the next state"):
        rollout(MomentMatching(), values, belief(2), torch.zeros(2, 1))
    broken = KnownModel(lambda x, u: x / x.sum(-1, keepdim=True), 2, 0)
    for propagator in (Linearization(), Unscented()):
        with pytest.raises(DataError, match="a predicted covariance must be finite"):
            propagator(broken, Gaussian(torch.zeros(2), torch.eye(2)))
    steep = KnownModel(lambda x, u: 1e200 * x, 1, 0)
    with pytest.raises(DataError, match=r"covariance must be finite; got \[\[inf\]\]"):
        Linearization()(steep, Gaussian(torch.zeros(1), torch.eye(1)))
    undefined = KnownModel(lambda x, u: x.log(), 1, 0)
    below = Gaussian(-torch.ones(1), 0.01 * torch.eye(1))
    for propagator in (MeanEquivalence(), Linearization()):
        with pytest.raises(
            DataError, match=r"a predicted mean must be finite; got \[nan"
        ):
            propagator(undefined, below)
    with pytest.raises(SettingError, match="next state; got GPs with predicts='value'"):
        linearize(MomentMatching(), values, belief(2), torch.zeros(1))
    nearly = torch.tensor([[1.0, 1 + 1e-9], [1 + 1e-9, 1.0]])
    with backend("torch"), pytest.raises(DataError, match="must be positive semidef"):
        MomentMatching()(model(m=0, lengthscale=1e-5), Gaussian(torch.zeros(2), nearly))


@pytest.mark.parametrize("choice", ["auto", "torch"])
@pytest.mark.parametrize("propagator", [*PROPAGATORS[:4], Unscented()], ids=_name)
def test_beliefs_and_inputs_belong_together_or_are_refused(propagator, choice):
    gp = MODELS["next state"]
    at = belief(3)
    batch = Gaussian(at.mean + draw(2, 3, 3), at.covariance.expand(2, 3, 3, 3))
    control = draw(2)
    with backend(choice):
        one_for_all = propagator(gp, batch, control)
        assert torch.allclose(
            one_for_all.mean,
            propagator(gp, batch, control.expand(2, 3, 2)).mean,
            atol=1e-13,
        )
        for wrong in (draw(3, 2, 2), draw(6, 2), draw(1, 2)):
            with pytest.raises(
                ShapeError,
                match=r"a state \(\*batch, 3\) and an input \(\*batch, 2\); got",
            ):
                propagator(gp, batch, wrong)
        with pytest.raises(
            ShapeError, match=r"a state \(\*batch, 3\) and an input \(\*batch, 2\); got"
        ):
            gp.predict_with_jacobian(batch.mean, draw(3, 2, 2))
        nobody = propagator(gp, Gaussian(draw(0, 3), draw(0, 3, 3)), draw(0, 2))
        assert nobody.mean.shape == (0, 3)


def test_a_covariance_that_is_not_symmetric_is_refused():
    lopsided = Gaussian(
        torch.zeros(3), torch.eye(3) + torch.diag(torch.full((2,), 0.3), 1)
    )
    with pytest.raises(
        DataError, match="must be symmetric; got entries that differ by 0.3"
    ):
        MomentMatching()(MODELS["next state"], lopsided, torch.zeros(2))


def test_hyperparameters_with_gradients_are_left_to_torch():
    log_scale = torch.zeros(2, 3, requires_grad=True)
    features = draw(12, 3)
    targets = draw(12, 2)

    def mean(scale):
        gp = GPPosterior.from_hyperparameters(
            features, targets, scale.exp(), torch.ones(2), 0.1 * torch.ones(2), 1
        )
        dropped = remove_points(gp, [1])
        at = Gaussian(torch.zeros(2), 0.1 * torch.eye(2))
        answers = gp.predict_with_jacobian(at.mean, torch.zeros(1))[1].sum()
        return (
            answers
            + MomentMatching()(gp, at, torch.zeros(1)).mean.sum()
            + dropped.predict(at.mean, torch.zeros(1)).mean.sum()
        )

    (gradient,) = torch.autograd.grad(mean(log_scale), log_scale)
    shift = torch.zeros(2, 3)
    shift[0, 1] = 1e-6
    numeric = (
        mean(log_scale.detach() + shift) - mean(log_scale.detach() - shift)
    ) / 2e-6
    assert torch.allclose(gradient[0, 1], numeric, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("around", ["nothing", "a nominal model", "a delay"])
def test_linearised_beliefs_keep_gradients_by_hyperparameters(around):
    features = draw(12, 3)
    targets = draw(12, 2)
    u = torch.zeros(1)

    def loss(scale):
        model = GPPosterior.from_hyperparameters(
            features,
            targets,
            scale.exp(),
            torch.ones(2),
            0.1 * torch.ones(2),
            1,
            "value",
        )
        if around != "nothing":
            nominal = Affine.identity(2, 1)
            model = ResidualModel(nominal, model, torch.eye(2), [0, 1], [0], 1)
        if around == "a delay":
            model = DelayedModel(model, 1)
        n = model.state_dim
        at = Gaussian(0.1 * torch.ones(n), 0.1 * torch.eye(n))
        after, slopes = differentiate(Linearization(), model, at, u)
        covariance = Linearization()(model, at, u).covariance
        return after.belief.mean.sum() + covariance.sum() + slopes.mean_by_mean.sum()

    log_scale = torch.zeros(2, 3, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(log_scale), log_scale)
    shift = torch.zeros(2, 3)
    shift[0, 1] = 1e-6
    after = loss(log_scale.detach() + shift)
    numeric = (after - loss(log_scale.detach() - shift)) / 2e-6
    assert torch.allclose(gradient[0, 1], numeric, rtol=1e-6, atol=1e-8)


def test_linearised_beliefs_keep_gradients_by_a_nominal_model():
    leaves = [0.3 * draw(2, 2), draw(2, 1), draw(2), draw(2, 1)]
    for leaf in leaves:
        leaf.requires_grad_()
    A, B, c, effect = leaves
    gp = model(n=1, m=1, predicts="value")
    at = Gaussian(torch.zeros(2), 0.1 * torch.eye(2))
    u = torch.ones(1)
    around = ResidualModel(Affine(A, B, c), gp, effect, [1], [0], 1)
    for propagator in (Linearization(), MeanEquivalence(), MomentMatching()):
        after = propagator(around, at, u)
        total = after.mean.sum() + after.covariance.sum()
        gradients = torch.autograd.grad(total, leaves, allow_unused=True)
        has_slope = isinstance(propagator, Linearization | MomentMatching)
        assert all(gradient is not None for gradient in gradients)
        assert torch.allclose(gradients[1], u.expand(2, 1))
        assert has_slope == bool((gradients[0].abs() > 0).any())


def test_inference_mode_stops_no_derivative():
    gp = MODELS["next state"]
    at = belief(3)
    outside = linearize(Unscented(), gp, at, torch.zeros(2))
    with torch.inference_mode():
        inside = linearize(Unscented(), gp, belief(3), torch.zeros(2))
    assert torch.allclose(inside.A, outside.A, atol=1e-12)


def test_later_changes_of_its_tensors_leave_a_posterior_alone():
    features = draw(10, 3)
    gp = GPPosterior.from_hyperparameters(
        features, draw(10, 2), torch.ones(2, 3), torch.ones(2), 0.1 * torch.ones(2), 1
    )
    before = gp.predict(torch.zeros(2), torch.zeros(1)).mean
    features.add_(1.0)
    assert torch.equal(gp.predict(torch.zeros(2), torch.zeros(1)).mean, before)
