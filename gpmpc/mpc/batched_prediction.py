"""Problem: one question to a Gaussian process on a GPU costs as much as a hundred; so many controllers ask together.

``predict_many`` answers what ``Predictor.predict`` answers to each of T requests. The belief, the plan and the stage
models of all of them go through torch as one batch on the model's device, stage by stage; to host memory come the first
stage (for the feedback gains) and, at the end, what the quadratic programs need. Where compiled loops answer for a
single request, they answer for many, one by one: nothing batched is faster there.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gpmpc.gaussian import Gaussian
from gpmpc.gp.posterior import GPPosterior
from gpmpc.mpc.controller import Decision
from gpmpc.mpc.prediction import Prediction, Predictor
from gpmpc.mpc.request import Request
from gpmpc.mpc.stage_models import StageModel, disturbed, stage_model
from gpmpc.propagation import Linearization, MeanEquivalence, MomentMatching, Unscented
from gpmpc.propagation._composition import Composition

Array = np.ndarray

BELIEF = ("means", "covariances")  # of a decision
# What the torch expressions hold at a time for one belief, at most, counted at their peak and rounded up:
SQUARES = 7  # N x N matrices, in exact moments
PAIRED = 4  # arrays (pairs of outputs, N, n + 1), in exact moments
ROWS = 3  # arrays (outputs, N, n + m + 1), at every point where the model is asked
MOVES = 4  # arrays (points, outputs, n + n^2 + m), in the unscented transform


def predict_many(
    predictor: Predictor, requests: Sequence[Request], previous: Sequence[Decision | None]
) -> list[Prediction]:
    """The stage models of many steps, one of each request.

    Args:
        predictor: Of all of them.
        requests: T of them, with finite beliefs.
        previous: The decision before each, or None.

    Raises:
        DataError: A belief of one of them left the finite numbers.
    """
    if predictor.compiled or not requests:
        return [predictor.predict(request, before) for request, before in zip(requests, previous, strict=True)]
    states, covariances = (np.stack([getattr(r, key) for r in requests]) for key in ("state", "covariance"))
    if predictor.form == "trajectory":
        return _along(predictor, requests, previous, states, covariances)
    about = np.stack([predictor.about(request) for request in requests])
    belief = _belief(predictor, states, covariances)
    disturbances = _disturbances(predictor, requests)
    stage = _stage(predictor, belief, _tensor(predictor, about), disturbances)
    now, after, starts = _array(belief.covariance), _array(stage.next.covariance), predictor.state(states, covariances)
    A, B, c = (_array(part) for part in stage[:3])
    V = [None] * len(requests) if stage.V is None else _array(stage.V)
    held = [predictor.hold(starts[t], about[t], A[t], B[t], c[t], now[t], after[t], V[t]) for t in range(len(requests))]
    if predictor.form == "increment":
        solved = [t for t, before in enumerate(previous) if before is not None and before.applicable]
        if solved:
            before = predictor.state(*(np.stack([getattr(previous[t], key)[0] for t in solved]) for key in BELIEF))
            for t, s in zip(solved, before, strict=True):
                held[t] = predictor.incremented(requests[t], held[t], s)
    return held


def _along(
    predictor: Predictor,
    requests: Sequence[Request],
    previous: Sequence[Decision | None],
    states: Array,
    covariances: Array,
) -> list[Prediction]:
    """``Predictor.along`` for the shifted plans of all requests."""
    sides = ("input_lower", "input_upper", "rate_lower", "rate_upper")
    lower, upper, *rates = (_tensor(predictor, getattr(predictor.problem, side)) for side in sides)
    plan = list(_tensor(predictor, np.stack([request.shifted for request in requests])).unbind(1))
    follow, gain = None, None
    if predictor.feedback:
        followed = [predictor.followed(request, before) for request, before in zip(requests, previous, strict=True)]
        follow = _tensor(predictor, np.stack(followed))
    belief, stages, disturbances = _belief(predictor, states, covariances), [], _disturbances(predictor, requests)
    spreads = [belief.covariance]
    for k, input in enumerate(plan):
        if gain is not None:
            moved = input + (gain @ (belief.mean - follow[:, k])[..., None])[..., 0]
            moved = moved.clamp(plan[k - 1] + rates[0], plan[k - 1] + rates[1])
            plan[k] = input = moved.clamp(lower, upper)
        stage = _stage(predictor, belief, input, disturbances)
        if predictor.feedback and gain is None:
            gain = _gains(predictor, stage)
        belief = stage.next
        if gain is not None and stage.V is not None:
            closed = stage.A + stage.B @ gain
            S = closed @ spreads[-1] @ closed.mT + stage.V
            belief = Gaussian(belief.mean, (S + S.mT) / 2)
        spreads.append(belief.covariance)
        stages.append(stage[:3])
    parts = [_array(torch.stack(part, dim=1)) for part in (*zip(*stages, strict=True), spreads, plan)]
    starts = predictor.state(states, parts[3][:, 0])
    return [Prediction(A, B, c, start, S, inputs) for A, B, c, S, inputs, start in zip(*parts, starts, strict=True)]


def _stage(predictor: Predictor, belief: Gaussian, input: Tensor, disturbances: Tensor | None) -> StageModel:
    stage = stage_model(predictor.covariance, predictor.propagator, predictor.model, belief, input)
    return stage if disturbances is None else disturbed(stage, disturbances)


def _disturbances(predictor: Predictor, requests: Sequence[Request]) -> Tensor | None:
    """Of all requests (T, n), where they are estimated."""
    if not predictor.disturbance_gain:
        return None
    return _tensor(predictor, np.stack([request.disturbance for request in requests]))


def _gains(predictor: Predictor, stage: StageModel) -> Tensor:
    """K of every request's ancillary feedback (T, m, n), from its first stage."""
    n = predictor.problem.state_dim
    slopes = _array(stage.A[:, :n, :n]), _array(stage.B[:, :n])
    return _tensor(predictor, np.stack([predictor.gain(A, B) for A, B in zip(*slopes, strict=True)]))


def bytes_per_request(predictor: Predictor) -> int | None:
    """What ``predict_many`` and a quadratic program take for one request at most [bytes]; None where it is not known.

    It is known for GPs whose propagation has derivatives in closed form. Exact moments take ``SQUARES`` matrices over
    the training points, whatever the horizon: one pair of outputs at one stage has its matrix at a time.
    """
    n, m, H, mode = predictor.problem.state_dim, predictor.problem.input_dim, predictor.horizon, predictor.covariance
    p = len(predictor.extended(predictor.problem.Q)) * n
    numbers = 3 * H * (p * (p + m + 1) + n * n + m)  # the stages: on the device, stacked, and in host memory
    numbers += 3 * (H * m) ** 2 + 4 * n * H * m * H  # the program: P, its factor, the rows of states
    if mode != "none":
        numbers += 4 * n * n * (n * n + n + m)  # derivatives of the covariance
    if predictor.compiled:
        return 8 * numbers
    composition, propagator = Composition.of(predictor.model), predictor.propagator
    exact = mode != "none" and isinstance(propagator, MomentMatching)
    at_points = isinstance(propagator, Linearization | MeanEquivalence | Unscented)
    at_points = at_points and not getattr(propagator, "hessian", False)
    closed_form = mode == "none" or exact or (at_points and isinstance(predictor.model, GPPosterior))
    if composition is None or not closed_form:
        return None
    f = composition.f
    N, k, d = len(f), f.output_dim, f.state_dim + f.input_dim
    points = 2 * n + 1 if mode != "none" and isinstance(propagator, Unscented) else 1
    numbers += points * k * (ROWS * N * (d + 1) + MOVES * (points > 1) * (n + n * n + m))
    if exact:
        pairs = k if propagator.diagonal else k * (k + 1) // 2
        numbers += SQUARES * N * N + PAIRED * pairs * N * (f.state_dim + 1)
    return 8 * numbers


def _belief(predictor: Predictor, means: Array, covariances: Array) -> Gaussian:
    known = np.zeros_like(covariances) if predictor.covariance == "none" else covariances
    return Gaussian(_tensor(predictor, means), _tensor(predictor, known))


def _tensor(predictor: Predictor, array: Array) -> Tensor:
    return torch.as_tensor(array, dtype=predictor.model.dtype, device=predictor.model.device)


def _array(tensor: Tensor) -> Array:
    """A tensor as a contiguous float64 array in host memory."""
    return np.ascontiguousarray(tensor.detach().cpu().numpy(), dtype=np.float64)
