r"""Problem: a controller that learns while it runs has to forget too, or every step costs more than the last.

A ``Budget`` lets a posterior see new transitions and drops points until it holds no more than it may. Which:

``"oldest"``: those that came first: a sliding window, for dynamics that change.

``"least_informative"``: one after the other the point whose removal changes the posterior over functions least, in
Kullback-Leibler divergence. With and without y_i the two posteriors differ by one factor of the likelihood, which
depends on f(x~_i) alone; so their divergence is that of two one-dimensional Gaussians, and the leave-one-out formulas
(Rasmussen and Williams, 2006, eq. (5.12)) give it from P = (K + sn2 I)^-1 and beta = P (y - offset):

    KL_i = 1/2 sum_a [ e_ai - 1 - log e_ai + beta_ai^2 (1 / P_aii - sn2_a) ],     e_ai = sn2_a P_aii

(e is the variance of f(x~_i) with y_i over that without.) Csato and Opper (2002, section 3.3) score |beta_i| / P_ii
instead, the change of the mean, for one output; this one counts the variance too and adds up over outputs of any unit.
The pseudo-observations of a frozen sparse model have correlated noise: of it the variances are counted only, so that
there the score is an approximation.
"""

import logging
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gpmpc.exceptions import SettingError, UnsupportedModel, check_number
from gpmpc.gp.posterior import GPPosterior
from gpmpc.gp.transitions import Transitions

log = logging.getLogger(__name__)
Rule = Literal["oldest", "least_informative"]


@dataclass(frozen=True)
class Budget:
    """Conditions a posterior on new points and holds it to a number of them.

    What just came stays under either rule, unless it is more than the budget by itself; the log then says so.

    Attributes:
        points: How many points the posterior may hold.
        rule: Which go first. ``"oldest"`` costs O(N^2) a point; ``"least_informative"`` needs the inverse of the kernel
            matrix, O(N^3) a call.

    Raises:
        SettingError: Fewer than one point, or an unknown rule.
    """

    points: int
    rule: Rule = "oldest"

    def __post_init__(self) -> None:
        check_number("points", self.points, least=1, whole=True)
        if self.rule not in ("oldest", "least_informative"):
            raise SettingError("rule", f"must be 'oldest' or 'least_informative'; got {self.rule!r}")

    def __call__(self, posterior: GPPosterior, transitions: Transitions) -> GPPosterior:
        """The posterior that has seen the transitions and holds at most ``points`` points.

        Raises:
            ShapeError: The transitions have other dimensions.
            UnsupportedModel: Of another model.
        """
        if not isinstance(posterior, GPPosterior):
            got = type(posterior).__name__
            raise UnsupportedModel(f"a budget is for a GPPosterior (ResidualModel.condition_on takes one); got {got}")
        targets = posterior.learned(transitions)
        return self.condition(posterior, transitions.features, targets)

    def condition(self, posterior: GPPosterior, features: Tensor, targets: Tensor) -> GPPosterior:
        """The same for points x~ (p, n + m) and what the GPs learn of them (p, k)."""
        larger = posterior.condition_on_targets(features, targets)
        excess = len(larger) - self.points
        if excess <= 0:
            return larger
        droppable = len(posterior)
        if len(features) > self.points:
            log.warning(
                "%d new points exceed the budget of %d: some of them are dropped too", len(features), self.points
            )
            larger, excess = larger.drop(range(len(posterior))), len(features) - self.points
            droppable = len(larger)
        if self.rule == "oldest":
            return larger.drop(range(excess))
        return larger.drop(least_informative(larger, excess, droppable))


def least_informative(posterior: GPPosterior, count: int, candidates: int | None = None) -> list[int]:
    """Which points to drop, each being the least informative one when those before it are gone.

    Args:
        posterior: With N points.
        count: How many are to go.
        candidates: Only the first this many may go; all by default.

    Returns:
        Their indices, in the order of their choice.
    """
    P, beta = posterior.precision.clone(), posterior.weights.clone()
    noise = _noise_variances(posterior)
    allowed = torch.zeros(len(posterior), dtype=torch.bool, device=posterior.device)
    allowed[:candidates] = True
    chosen = []
    for _ in range(count):
        score = _divergence(P.diagonal(dim1=-2, dim2=-1), beta, noise)
        i = int(torch.where(allowed, score, torch.inf).argmin())
        chosen.append(i)
        allowed[i] = False
        # Leaving i out is conditioning the precision matrix: the block inverse of what remains.
        column, pivot = P[:, :, i].clone(), P[:, i, i].clone()
        beta -= column * (beta[:, i] / pivot)[:, None]
        P -= column[:, :, None] * (column / pivot[:, None])[:, None, :]
        P[:, i, i] = 1.0  # gone: any positive number
    return chosen


def information(posterior: GPPosterior) -> Tensor:
    """How much each point tells, KL_i of the module's text (N,): that of the posteriors with and without it [nat]."""
    return _divergence(posterior.precision.diagonal(dim1=-2, dim2=-1), posterior.weights, _noise_variances(posterior))


def _divergence(P: Tensor, beta: Tensor, noise: Tensor) -> Tensor:
    e = (noise * P).clamp(max=1.0)
    return (e - 1 - e.log() + beta**2 * (1 - e) / P).sum(0) / 2


def _noise_variances(posterior: GPPosterior) -> Tensor:
    """Of the targets (k, N): sn2, or what the factor of pseudo-observations has on its diagonal beyond the kernel."""
    nominal = posterior.noise_variance[:, None].expand_as(posterior.weights)
    if posterior.exact:
        return nominal
    diagonal = posterior.cholesky.square().sum(-1) - posterior.signal_variance[:, None]
    return diagonal.clamp_min(torch.finfo(posterior.dtype).eps)
