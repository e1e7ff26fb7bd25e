"""Problem: what one GP linearisation costs, beside the automatic differentiation that most people would use.

Groups of calls that answer one question: the first of each is the compiled one, and each returns what can be compared.
"""

from collections.abc import Callable

import gpytorch
import torch

from gpmpc import kernels
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.gp.gpytorch_ import exact_inference, to_gpytorch
from gpmpc.propagation.moment_matching import moments

Group = dict[str, Callable[[], list | tuple]]


def linearisation_groups(gp: GPPosterior, belief: Gaussian, control: torch.Tensor, reverse_mode: bool) -> list[Group]:
    """Everything that predicts one step of the latent functions, by what is predicted.

    Args:
        gp: The GPs.
        belief: Where; points take its mean.
        control: The input (m,).
        reverse_mode: Includes torch's reverse mode through the closed form of the moments, which keeps all N x N
            products of all pairs of outputs.
    """
    n, packed = gp.state_dim, gp.packed
    mu, S, u = belief.mean.numpy(), belief.covariance.numpy(), control.numpy()
    query = torch.cat([belief.mean, control])

    def by_torch(mean, covariance, control):
        return moments(gp, Gaussian(mean, covariance), control)[:2]

    def jacobian_by_torch():
        dM, dV = torch.func.jacrev(by_torch, argnums=(0, 1, 2))(belief.mean, belief.covariance, control)
        return [dM[0], (dM[1] + dM[1].mT) / 2, dM[2], dV[0], (dV[1] + dV[1].mT) / 2, dV[2]]

    def jacobian():
        d = kernels.moments_with_jacobian(packed, mu, S, u)
        return [d.J, d.dM_dS, d.dM_du, d.dV_dmu, d.dV_dS, d.dV_du]

    frozen = to_gpytorch(gp).requires_grad_(False)
    trained = to_gpytorch(gp)  # as it comes from training

    def by_gpytorch():
        with exact_inference(), gpytorch.settings.skip_posterior_variances():  # the mean alone, from its cache
            return torch.autograd.functional.jacobian(lambda x: frozen(x[None]).mean[:, 0], query).split(n, dim=1)

    def by_gpytorch_as_usual():
        return torch.autograd.functional.jacobian(lambda x: trained(x[None]).mean[:, 0], query).split(n, dim=1)

    def by_jacrev():
        adds = torch.eye(n, len(query), dtype=query.dtype) * (gp.predicts == "difference")
        whole = torch.func.jacrev(lambda x: gp.predict(x[:n], x[n:]).mean)(query)
        return (whole - adds).split(n, dim=1)

    groups: list[Group] = [
        {
            "moments": lambda: kernels.moments(packed, mu, S, u)[:2],
            "moments, torch": lambda: by_torch(belief.mean, belief.covariance, control),
        },
        {"moments with Jacobians": jacobian},
        {"moments, diagonal": lambda: kernels.moments(packed, mu, S, u, diagonal=True)},
        {"diagonal with Jacobians": lambda: kernels.moments_with_jacobian(packed, mu, S, u, diagonal=True)[:8]},
        {"linearised": lambda: kernels.point_with_jacobian(packed, mu, u)[:8]},
        {
            "mean with Jacobian": lambda: kernels.mean_with_jacobian(packed, mu, u)[1:],
            "mean with Jacobian, torch jacrev": by_jacrev,
            "mean with Jacobian, GPyTorch, frozen": by_gpytorch,
            "mean with Jacobian, GPyTorch": by_gpytorch_as_usual,
        },
    ]
    if reverse_mode:
        groups[1]["moments with Jacobians, torch jacrev"] = jacobian_by_torch
    return groups
