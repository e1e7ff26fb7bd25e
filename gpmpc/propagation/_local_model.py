"""The belief's dynamics as a linear system, for convex controllers.

With the extended state s = [mu; vec(S)], S = Sigma^(1/2) the symmetric root, p = n +
n^2 (Cao, Lai and Alam, 2017, section 4.1),

    s+ = F(s, u)  ~  A s + B u + c,    A = dF/ds,  B = dF/du,  c = F(s, u) - A s - B u

Sigma = S S', so dSigma = dS S' + S dS'; the root's derivative solves dS S + S dS =
dSigma (``gaussian.square_root_differential``). Where Sigma = 0 (a measured state) the
columns of A for S vanish, because Sigma+ depends on S to second order only; where
Sigma+ is singular the root has no derivative, and its rows are zero in the null space.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array, check_next_states, tensors_for, to_array
from gpmpc.exceptions import ShapeError, check_kind, check_method
from gpmpc.gaussian import Gaussian, check_tensors
from gpmpc.propagation._propagator import Propagator, Sensitivity, differentiate


@dataclass(frozen=True, eq=False)
class LocalModel:
    """A model s+ = A s + B u + c near a belief and an input; maybe a batch of them."""

    A: Tensor  #: (*batch, p, p), p = n + n^2
    B: Tensor  #: (*batch, p, m)
    c: Tensor  #: (*batch, p)
    next: Gaussian  #: the next belief itself
    next_state: Tensor  #: the next belief as an extended state, F(s, u) (*batch, p)

    def __call__(self, s: Tensor, input: Tensor) -> Tensor:
        """Returns the next extended state (*batch, p)."""
        return (self.A @ s[..., None] + self.B @ input[..., None])[..., 0] + self.c


class Roots(NamedTuple):
    """Symmetric roots U diag(r) U' of covariances."""

    root: Array  # (*batch, n, n)
    r: Array  # eigenvalues of the roots (*batch, n)
    U: Array  # eigenvectors (*batch, n, n)


def square_roots(covariances: Array) -> Roots:
    """Returns the symmetric roots of covariances (*batch, n, n)."""
    eigenvalues, U = np.linalg.eigh(covariances)
    r = np.sqrt(np.maximum(eigenvalues, 0.0))
    return Roots(root=(U * r[..., None, :]) @ U.mT, r=r, U=U)


@explains_arguments
def linearize(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor | None = None
) -> LocalModel:
    """Linearises the next belief at a belief and an input, or along a plan.

    Along a plan both have a leading dimension H. A local model is a constant: no
    gradient flows through it, and torch's function transforms do not apply. Arguments
    are those of ``differentiate``.

    See Also:
        ``gpmpc.models.linearize``, at points; ``differentiate``.
    """
    check_method("propagator", propagator, "propagate", "Linearization()")
    check_method("model", model, "predict", "GPPosterior")
    check_kind("belief", belief, Gaussian, "a Gaussian")
    belief = replace(
        belief, mean=belief.mean.detach(), covariance=belief.covariance.detach()
    )
    if input is None:
        input = belief.mean[..., :0]
    check_tensors(input=input)
    input = input.detach()
    if model.output_dim != belief.dim:
        raise ShapeError(
            f"a local model needs an output a state; got {belief.dim} states, "
            f"{model.output_dim} outputs"
        )
    check_next_states(model)
    with torch.no_grad():
        expansion = expand_belief(propagator, model, belief, input)
    A = expansion.A
    B = expansion.B
    s = _extended_state(belief.mean, expansion.root)
    u = to_array(input.expand(*belief.mean.shape[:-1], -1))
    c = expansion.next_state - (A @ s[..., None] + B @ u[..., None])[..., 0]
    tensors = tensors_for(model, A, B, c, expansion.next_state)
    return LocalModel(
        A=tensors[0],
        B=tensors[1],
        c=tensors[2],
        next=expansion.next,
        next_state=tensors[3],
    )


class BeliefExpansion(NamedTuple):
    """The next extended state at a belief and an input, with its derivatives."""

    next: Gaussian
    next_state: Array  # F(s, u) (*batch, p)
    A: Array  # dF/ds (*batch, p, p)
    B: Array  # dF/du (*batch, p, m)
    root: Array  # of the belief's covariance (*batch, n, n)


def expand_belief(
    propagator: Propagator, model: Any, belief: Gaussian, input: Tensor
) -> BeliefExpansion:
    """Returns the next belief as an extended state, with its derivatives.

    Arguments are those of ``differentiate``, constants of torch.
    """
    propagation, sensitivity = differentiate(propagator, model, belief, input)
    after = propagation.belief
    covariance = to_array(belief.covariance)[None]
    next_covariance = to_array(after.covariance)[None]
    # of the belief and of the next one; ``np.stack`` takes five times as long
    roots = square_roots(np.concatenate([covariance, next_covariance]))
    A, B = _extended_derivatives(
        sensitivity, root=roots.root[0], next_r=roots.r[1], next_U=roots.U[1]
    )
    return BeliefExpansion(
        next=after,
        next_state=_extended_state(after.mean, roots.root[1]),
        A=A,
        B=B,
        root=roots.root[0],
    )


def _extended_state(mean: Tensor, root: Array) -> Array:
    """Returns s = [mu; vec(S)] (*batch, p)."""
    n = mean.shape[-1]
    vectors = root.reshape(*mean.shape[:-1], n * n)
    return np.concatenate([to_array(mean), vectors], axis=-1)


def _extended_derivatives(
    sensitivity: Sensitivity, root: Array, next_r: Array, next_U: Array
) -> tuple[Array, Array]:
    """Returns A (*batch, p, p) and B (*batch, p, m), for roots in place of covariances.

    ``root`` (*batch, n, n) is the belief's, next_U diag(next_r) next_U' the next one's.
    """
    batch = root.shape[:-2]
    n = root.shape[-1]
    p = n + n**2
    # dSigma = E S + S E for a change E of the root S: a derivative D by Sigma becomes
    # 2 D S, since D is symmetric, and so is every E that occurs
    twice = 2 * root[..., None, :, :]
    mean_by_root = to_array(sensitivity.mean_by_covariance) @ twice
    by_root = to_array(sensitivity.covariance_by_covariance) @ twice[..., None, :, :]
    covariance_by = np.concatenate(
        [
            to_array(sensitivity.covariance_by_mean),
            by_root.reshape(*batch, n, n, n * n),
            to_array(sensitivity.covariance_by_input),
        ],
        axis=-1,
    )
    # in the basis U of the next root, entry ij of its derivative is that of dSigma+
    # over r_i + r_j
    total = next_r[..., :, None] + next_r[..., None, :]
    inverse = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0)
    rotated = _congruence(next_U.mT, covariance_by)
    root_by = _congruence(next_U, rotated * inverse[..., None])
    root_by = root_by.reshape(*batch, n * n, covariance_by.shape[-1])
    mean_by_mean = to_array(sensitivity.mean_by_mean)
    mean_by_root = mean_by_root.reshape(*batch, n, n * n)
    mean_by_state = np.concatenate([mean_by_mean, mean_by_root], axis=-1)
    mean_by_input = to_array(sensitivity.mean_by_input)
    A = np.concatenate([mean_by_state, root_by[..., :p]], axis=-2)
    B = np.concatenate([mean_by_input, root_by[..., p:]], axis=-2)
    return A, B


def _congruence(U: Array, X: Array) -> Array:
    """Returns U X U' for each X along the last dimension (*batch, n, n, j)."""
    *leading, n, j = X.shape  # leading: the batch, and n
    from_left = (U @ X.reshape(*leading, n * j)).reshape(X.shape)
    return U[..., None, :, :] @ from_left


@explains_arguments
def rollout(
    propagator: Propagator, model: Any, belief: Gaussian, inputs: Tensor
) -> Gaussian:
    """Returns the beliefs at steps 1 to H, from one at step 0 (*batch).

    Args:
        propagator: The way to propagate them.
        model: A ``DynamicsModel``.
        belief: Mean (*batch, n), covariance (*batch, n, n).
        inputs: (*batch, H, m); an autonomous model takes (*batch, H, 0).

    Returns:
        Mean (*batch, H, n), covariance (*batch, H, n, n).

    Raises:
        ShapeError: The inputs have no step.
        SettingError: The propagator is none, the inputs are no tensor, or the model
            predicts something else than next states.

    >>> import torch
    >>> from gpmpc.gaussian import Gaussian
    >>> from gpmpc.models import KnownModel
    >>> from gpmpc.propagation import Linearization
    >>> model = KnownModel(lambda x, u: x + u, state_dim=1, input_dim=1)
    >>> belief = Gaussian(torch.zeros(1).double(), torch.eye(1).double())
    >>> beliefs = rollout(Linearization(), model, belief, torch.ones(3, 1).double())
    >>> beliefs.mean.flatten().tolist()
    [1.0, 2.0, 3.0]

    See Also:
        ``gpmpc.calibration.calibrate``, which compares such beliefs with a log.
    """
    check_method("propagator", propagator, "propagate", "Linearization()")
    check_next_states(model)
    check_tensors(inputs=inputs)
    if inputs.dim() < 2 or not inputs.shape[-2]:
        raise ShapeError(
            "inputs must be (*batch, H, m) with H of 1 or more; got "
            f"{tuple(inputs.shape)}"
        )
    beliefs = []
    for control in inputs.unbind(-2):
        belief = propagator.propagate(model, belief, control).belief
        beliefs.append(belief)
    return Gaussian(
        mean=torch.stack([belief.mean for belief in beliefs], dim=-2),
        covariance=torch.stack([belief.covariance for belief in beliefs], dim=-3),
    )
