"""Propagation through a model's expansion at the belief's mean, as in an EKF.

With A = dm/dx at (mu, u) and the model's own variance there,

    mu+ = m(mu, u),   Sigma+ = A S A' + Var[f(mu, u)],   Cov[x, x+] = S A'

Mean equivalence leaves A S A' out (Hewing, Kabzan and Zeilinger, 2020).
"""

from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import predict_with_jacobian
from gpmpc._functions import call
from gpmpc.gaussian import Gaussian
from gpmpc.gp._backend import host_arrays
from gpmpc.gp._posterior import AffineForm
from gpmpc.propagation._propagator import (
    NextMoments,
    NoisyPropagator,
    Propagation,
    Sensitivity,
    checked_arguments,
    claim_holds,
)


class SecondOrderExpansion(NamedTuple):
    """A model around certain states and inputs.

    The mean is expanded to second order, the variance to first.
    """

    belief: Gaussian  # the prediction there
    A: Tensor  # the mean's derivative by the state (*batch, k, n)
    B: Tensor  # by the input (*batch, k, m)
    variance_by_state: Tensor  # (*batch, k, n)
    variance_by_input: Tensor  # (*batch, k, m)
    mean_by_state2: Tensor  # second derivatives (*batch, k, n, n)
    mean_by_state_input: Tensor  # (*batch, k, n, m)


def expand_to_second_order(
    model: Any, state: Tensor, input: Tensor
) -> SecondOrderExpansion | None:
    """Expands GPs alone by the compiled loops, at states (*batch, n) and inputs.

    Returns None for other models, and where those loops cannot evaluate.
    """
    form = getattr(model, "affine_form", None)
    if form is None or not _is_gp_alone(form):
        return None
    gp = form.f
    arrays = host_arrays(state, input, gps_on_host=gp.on_host)
    if arrays is None:
        return None
    from gpmpc import _kernels as kernels  # loads numba

    batch = state.shape[:-1]
    states, inputs = arrays
    states = states.reshape(-1, gp.state_dim)
    inputs = inputs.reshape(len(states), gp.input_dim)
    expansion = kernels.expand_gps(gp.packed, states, inputs)

    def tensor(rows: kernels.Array) -> Tensor:
        return torch.from_numpy(rows.reshape(*batch, *rows.shape[1:]))

    mean = tensor(expansion.M) + gp.offset
    A = tensor(expansion.J)
    if form.A is not None:
        mean = mean + state @ form.A.mT
        A = A + form.A
    return SecondOrderExpansion(
        belief=Gaussian(mean, torch.diag_embed(tensor(expansion.variance))),
        A=A,
        B=tensor(expansion.dM_du),
        variance_by_state=tensor(expansion.dvariance_dx),
        variance_by_input=tensor(expansion.dvariance_du),
        mean_by_state2=tensor(expansion.d2M_dx2),
        mean_by_state_input=tensor(expansion.d2M_dxdu),
    )


def _is_gp_alone(form: AffineForm) -> bool:
    """Whether x+ = f(x, u), or A x + f(x, u), where f sees all states and inputs."""
    further = (form.B, form.G, form.c, form.states, form.inputs, form.tape)
    return not form.angles and all(part is None for part in further)


@explains_arguments
class Linearization(NoisyPropagator):
    """First order, with the model's noise unless ``process_noise=False``.

    From N(mu, S) with an input u, the model's mean m, its Jacobian A at (mu, u) and its
    variance V there, with the learned noise Sn::

        mean = m(mu, u),     covariance = A S A' + V(mu, u) + Sn

    >>> Linearization(process_noise=False).process_noise
    False

    See Also:
        ``MomentMatching``, ``Unscented`` and ``MonteCarlo``, which also see curvature.
    """

    @property
    def first_order(self) -> bool:
        """Whether the model's numbers at the belief's mean are all that is needed.

        Not of a subclass that propagates in another way, or the variances alone.
        """
        return not self.diagonal and claim_holds(self, "first_order")

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """Propagates with all derivatives in closed form; None where there is none."""
        input = checked_arguments(model, belief, input)
        expansion = expand_to_second_order(model, belief.mean, input)
        if expansion is None:
            return None
        A = expansion.A
        moments = _linear_moments(belief, expansion.belief, A)
        # of A S A': A changes with the mean and the input
        AS = A @ belief.covariance
        by_mean = torch.einsum("...ip,...jpc->...ijc", AS, expansion.mean_by_state2)
        by_input = torch.einsum(
            "...ip,...jpc->...ijc", AS, expansion.mean_by_state_input
        )
        by_covariance = torch.einsum("...ic,...jd->...ijcd", A, A)
        sensitivity = Sensitivity(
            mean_by_mean=A,
            mean_by_covariance=torch.zeros_like(expansion.mean_by_state2),
            mean_by_input=expansion.B,
            covariance_by_mean=by_mean
            + by_mean.transpose(-3, -2)
            + on_diagonal(expansion.variance_by_state),
            covariance_by_covariance=(by_covariance + by_covariance.mT) / 2,
            covariance_by_input=by_input
            + by_input.transpose(-3, -2)
            + on_diagonal(expansion.variance_by_input),
        )
        return self._complete_step(model, moments, sensitivity)

    def _next_moments(self, model: Any, belief: Gaussian, input: Tensor) -> NextMoments:
        prediction, A, _ = predict_with_jacobian(model, belief.mean, input)
        return _linear_moments(belief, prediction, A)


@explains_arguments
class MeanEquivalence(NoisyPropagator):
    """The prediction at the belief's mean, without the uncertainty of the state.

    State and next state come out uncorrelated.

    >>> MeanEquivalence().process_noise
    True

    See Also:
        ``Linearization``, which carries the state's uncertainty along.
    """

    def differentiate(
        self, model: Any, belief: Gaussian, input: Tensor | None = None
    ) -> tuple[Propagation, Sensitivity] | None:
        """Propagates with all derivatives in closed form; None where there is none."""
        input = checked_arguments(model, belief, input)
        certain = Gaussian(belief.mean, torch.zeros_like(belief.covariance))
        linearization = Linearization(self.process_noise)
        linearization.diagonal = self.diagonal
        result = linearization.differentiate(model, certain, input)
        if result is None:
            return None
        propagation, sensitivity = result
        zeros = torch.zeros_like(sensitivity.covariance_by_covariance)
        return propagation, replace(sensitivity, covariance_by_covariance=zeros)

    def _next_moments(self, model: Any, belief: Gaussian, input: Tensor) -> NextMoments:
        prediction = call("model", model.predict, belief.mean, input)
        covariance = prediction.covariance
        return NextMoments(
            mean=prediction.mean,
            covariance=covariance,
            cross_covariance=covariance.new_zeros(*belief.mean.shape, prediction.dim),
        )


def on_diagonal(variance: Tensor) -> Tensor:
    """Returns derivatives of variances (*batch, k, j) as of a diagonal covariance's.

    The result is (*batch, k, k, j).
    """
    return torch.diag_embed(variance.mT).movedim(-3, -1)


def _linear_moments(belief: Gaussian, prediction: Gaussian, A: Tensor) -> NextMoments:
    """Returns the moments after a prediction at the belief's mean, with slope A."""
    S = belief.covariance
    return NextMoments(
        mean=prediction.mean,
        covariance=prediction.covariance + A @ S @ A.mT,
        cross_covariance=S @ A.mT,
    )
