"""Does a dynamics model keep its promises?

``check_model(model)`` queries it alone and in batches, twice, with arrays in awkward layouts, and holds its Jacobians
against finite differences. It raises an ``AssertionError`` that names the broken promise and the numbers, and
returns nothing if all is well.
"""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from gpmpc.dynamics import DynamicsModel, linearize, to_array
from gpmpc.gaussian import Gaussian
from gpmpc.testing.promise import require, require_close, require_covariance


def check_model(
    model: DynamicsModel, states: Tensor | None = None, inputs: Tensor | None = None, seed: int = 0
) -> None:
    """Checks ``model`` against the protocol ``gpmpc.dynamics.DynamicsModel``.

    Args:
        model: The object to check.
        states: Where to query it (B, n), B of 2 or more; standard normal numbers by default, so give some of yours
            where the states are of another size.
        inputs: Likewise (B, m).
        seed: Of the default queries.

    Raises:
        AssertionError: The model breaks a promise; the message says which.
    """
    _check_attributes(model)
    n, m = model.state_dim, model.input_dim
    generator = torch.Generator().manual_seed(seed)
    like = {"dtype": model.dtype, "device": model.device}
    states = torch.randn(4, n, generator=generator) if states is None else states
    inputs = torch.randn(len(states), m, generator=generator) if inputs is None else inputs
    states, inputs = states.to(**like), inputs.to(**like)
    single = torch.finfo(model.dtype).eps > 1e-10
    exact, numeric = (1e-4, 3e-2) if single else (1e-9, 1e-5)

    one = _untouched(model.predict, "predict", states[0], inputs[0])
    _check_belief("predict at one state", model, one, ())
    together = _untouched(model.predict, "predict", states, inputs)
    _check_belief("predict at a batch", model, together, (len(states),))
    require(
        torch.equal(model.predict(states, inputs).mean, together.mean)
        and torch.equal(model.predict(states, inputs).covariance, together.covariance),
        "predict: the same query has the same answer",
        "the second answer differs from the first",
    )
    alone = [model.predict(x, u) for x, u in zip(states, inputs, strict=True)]
    _check_same("predict: a batch is the loop over its members", together, _stacked(alone), exact)
    nested = model.predict(states[None, :, None], inputs[None, :, None])
    _check_belief("predict at two more batch dimensions", model, nested, (1, len(states), 1))
    flat = Gaussian(nested.mean[0, :, 0], nested.covariance[0, :, 0])
    _check_same("predict: more batch dimensions change nothing", flat, together, exact)
    strided = (torch.stack([states, states + 1], dim=-1)[..., 0], torch.stack([inputs, inputs + 1], dim=-1)[..., 0])
    _check_same("predict: every other element of a larger array will do", model.predict(*strided), together, exact)
    if m == 0:
        _check_same("predict: without inputs u may be left out", model.predict(states), together, exact)

    x, u = to_array(states), to_array(inputs)
    at = linearize(model, x, u)
    expected = _numeric_jacobian(model, states, inputs)
    wanted = {
        "mean": (together.mean, exact),
        "A": (expected[..., :n], numeric),
        "B": (expected[..., n:], numeric),
        "covariance": (together.covariance, exact),
    }
    for name, (numbers, tolerance) in wanted.items():
        got = getattr(at, name)
        promise = f"linearize: {name} is a C-contiguous float64 array of shape {tuple(numbers.shape)}"
        right = isinstance(got, np.ndarray) and got.dtype == np.float64 and got.flags.c_contiguous
        require(right and got.shape == tuple(numbers.shape), promise, f"got {type(got).__name__} {np.shape(got)}")
        source = "the finite differences of predict" if name in "AB" else "the prediction of predict"
        promise, floor = f"linearize: {name} agrees with {source}", 1e-4 if tolerance < 1e-6 else 1.0
        require_close(promise, torch.from_numpy(got), numbers.cpu().double(), tolerance, name, floor)
    one_out, without = linearize(model, x[1:2], u[1:2]), linearize(model, x, u, covariance=False)
    require(without.covariance is None, "linearize: without covariance it is None", f"got {without.covariance!r}")
    for name in ("mean", "A", "B"):
        parts = [torch.from_numpy(getattr(found, name)) for found in (at, one_out, without)]
        promise = f"linearize: a batch is the loop over its points ({name})"
        require_close(promise, parts[1][0], parts[0][1], exact)
        require_close(
            f"linearize: {name} does not depend on whether the covariance is wanted", parts[2], parts[0], exact
        )
    unchanged = np.array_equal(x, to_array(states)) and np.array_equal(u, to_array(inputs))
    require(unchanged, "linearize: the caller's states and inputs are left as they are", "one was modified")


def _check_attributes(model: DynamicsModel) -> None:
    for name, least in (("state_dim", 1), ("input_dim", 0), ("output_dim", 1)):
        value = getattr(model, name, None)
        right = isinstance(value, int) and value >= least
        require(right, f"{name} is a whole number, {least} or more", f"got {value!r}")
    require(isinstance(getattr(model, "dtype", None), torch.dtype), "dtype is a torch.dtype", "it is missing or not")
    require(hasattr(model, "device"), "device says where the model lives", "it is missing")
    noise, k = getattr(model, "noise_covariance", None), model.output_dim
    require(
        isinstance(noise, Tensor) and tuple(noise.shape) == (k, k) and noise.dtype == model.dtype,
        f"noise_covariance is a {model.dtype} tensor of shape ({k}, {k})",
        f"got {type(noise).__name__} {getattr(noise, 'dtype', '')} {tuple(getattr(noise, 'shape', ()))}",
    )
    require_covariance("noise_covariance", noise)


def _untouched(function: Callable, name: str, state: Tensor, control: Tensor):
    x, u = state.clone(), control.clone()
    result = function(state, control)
    unchanged = torch.equal(x, state) and torch.equal(u, control)
    require(unchanged, f"{name}: the caller's state and input are left as they are", "one was modified")
    return result


def _check_belief(name: str, model: DynamicsModel, belief: Gaussian, batch: tuple[int, ...]) -> None:
    k = model.output_dim
    require(isinstance(belief, Gaussian), f"{name}: the answer is a gpmpc.gaussian.Gaussian", f"got {type(belief)}")
    expected = (*batch, k), (*batch, k, k)
    got = tuple(belief.mean.shape), tuple(belief.covariance.shape)
    require(
        got == expected, f"{name}: mean (*batch, k) and covariance (*batch, k, k)", f"got {got}, should be {expected}"
    )
    for part in (belief.mean, belief.covariance):
        require(
            part.dtype == model.dtype and part.device == torch.zeros(0, device=model.device).device,
            f"{name}: type and device are the model's, {model.dtype} on {model.device}",
            f"got {part.dtype} on {part.device}",
        )
    require(bool(torch.isfinite(belief.mean).all()), f"{name}: the mean is finite", f"got {belief.mean.tolist()}")
    require_covariance(name, belief.covariance)


def _check_same(promise: str, got: Gaussian, expected: Gaussian, tolerance: float) -> None:
    require_close(promise, got.mean, expected.mean, tolerance, "the mean")
    require_close(
        promise,
        got.covariance,
        expected.covariance,
        tolerance,
        "the covariance",
        floor=1e-4 if tolerance < 1e-6 else 1.0,
    )


def _stacked(beliefs: list[Gaussian]) -> Gaussian:
    return Gaussian(torch.stack([b.mean for b in beliefs]), torch.stack([b.covariance for b in beliefs]))


def _numeric_jacobian(model: DynamicsModel, states: Tensor, inputs: Tensor) -> Tensor:
    """Central differences of the mean by (x, u) (B, k, n + m)."""
    joint, n = torch.cat([states, inputs], dim=1), model.state_dim
    step = torch.finfo(model.dtype).eps ** (1 / 3)
    columns = []
    for j in range(joint.shape[1]):
        size = step * max(1.0, float(joint[:, j].abs().max()))
        shift = size * torch.eye(joint.shape[1], dtype=joint.dtype, device=joint.device)[j]
        above, below = (model.predict(moved[:, :n], moved[:, n:]).mean for moved in (joint + shift, joint - shift))
        columns.append((above - below) / (2 * size))
    return torch.stack(columns, dim=-1)
