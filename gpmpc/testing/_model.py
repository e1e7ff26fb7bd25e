"""Check of a dynamics model of your own: ``check_model``."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gpmpc._dynamics import DynamicsModel
from gpmpc.gaussian import Gaussian
from gpmpc.testing._promise import require, require_close, require_covariance


def check_model(
    model: DynamicsModel,
    states: Tensor | None = None,
    inputs: Tensor | None = None,
    seed: int = 0,
) -> None:
    """Checks a model against the protocol ``gpmpc.models.DynamicsModel``.

    ``predict`` is called alone and in batches, twice, with arrays in awkward layouts;
    ``linearize`` is compared with it and with its finite differences: at states (K, n)
    and inputs (K, m), K of 2 or more, by default standard normal numbers of a seed, so
    give some of yours where they are of another size.

    Raises:
        AssertionError: The model breaks a promise; the message says which, and by how
            much.
    """
    _check_attributes(model)
    generator = torch.Generator().manual_seed(seed)
    like: dict[str, Any] = {"dtype": model.dtype, "device": model.device}
    x = (
        torch.randn(4, model.state_dim, generator=generator)
        if states is None
        else states
    ).to(**like)
    u = (
        torch.randn(len(x), model.input_dim, generator=generator)
        if inputs is None
        else inputs
    ).to(**like)
    exact, numeric = (
        (1e-4, 3e-2) if torch.finfo(model.dtype).eps > 1e-10 else (1e-9, 1e-5)
    )
    _check_predict(model, x, u, exact)
    _check_linearize(model, x, u, exact, numeric)


def _check_attributes(model: DynamicsModel) -> None:
    for name, least in (("state_dim", 1), ("input_dim", 0), ("output_dim", 1)):
        value = getattr(model, name, None)
        right = isinstance(value, int) and value >= least
        require(right, f"{name} is a whole number, {least} or more", f"got {value!r}")
    require(
        isinstance(getattr(model, "dtype", None), torch.dtype),
        "dtype is a torch.dtype",
        "it is missing or not",
    )
    require(
        hasattr(model, "device"), "device says where the model lives", "it is missing"
    )
    noise = getattr(model, "noise_covariance", None)
    k = model.output_dim
    right = (
        isinstance(noise, Tensor)
        and tuple(noise.shape) == (k, k)
        and noise.dtype == model.dtype
    )
    dtype = getattr(noise, "dtype", "")
    shape = tuple(getattr(noise, "shape", ()))
    got = f"got {type(noise).__name__} {dtype} {shape}"
    require(
        right, f"noise_covariance is a {model.dtype} tensor of shape ({k}, {k})", got
    )
    require_covariance("noise_covariance", model.noise_covariance)


def _check_predict(model: DynamicsModel, x: Tensor, u: Tensor, exact: float) -> None:
    before = x.clone(), u.clone()
    together = model.predict(x, u)
    same = torch.equal(before[0], x) and torch.equal(before[1], u)
    require(
        same,
        "predict: the caller's state and input are left as they are",
        "one was modified",
    )
    _check_belief("predict at a batch", model, together, (len(x),))
    again = model.predict(x, u)
    same = torch.equal(again.mean, together.mean) and torch.equal(
        again.covariance, together.covariance
    )
    require(
        same,
        "predict: the same arguments give the same result",
        "the second differs from the first",
    )

    alone = [model.predict(state, input) for state, input in zip(x, u, strict=True)]
    _check_belief("predict at one state", model, alone[0], ())
    stacked = Gaussian(
        torch.stack([b.mean for b in alone]), torch.stack([b.covariance for b in alone])
    )
    _check_same(
        "predict: a batch is the loop over its members", together, stacked, exact
    )
    nested = model.predict(x[None, :, None], u[None, :, None])
    _check_belief("predict at two more batch dimensions", model, nested, (1, len(x), 1))
    flat = Gaussian(nested.mean[0, :, 0], nested.covariance[0, :, 0])
    _check_same("predict: more batch dimensions change nothing", flat, together, exact)
    strided = [torch.stack([part, part + 1], dim=-1)[..., 0] for part in (x, u)]
    _check_same(
        "predict: every other element of a larger array will do",
        model.predict(*strided),
        together,
        exact,
    )


def _check_linearize(
    model: DynamicsModel, x: Tensor, u: Tensor, exact: float, numeric: float
) -> None:
    n = model.state_dim
    m = model.input_dim
    k = model.output_dim
    states, inputs = (part.double().cpu().numpy().copy() for part in (x, u))
    before = states.copy(), inputs.copy()
    found = model.linearize(states, inputs)
    same = np.array_equal(before[0], states) and np.array_equal(before[1], inputs)
    require(
        same,
        "linearize: the caller's states and inputs are left as they are",
        "one was modified",
    )
    shapes = {"mean": (k,), "A": (k, n), "B": (k, m), "covariance": (k, k)}
    for name, shape in shapes.items():
        got = getattr(found, name)
        expected = (len(x), *shape)
        right = (
            isinstance(got, np.ndarray)
            and got.dtype == np.float64
            and got.flags.c_contiguous
        )
        promise = (
            f"linearize: {name} is a C-contiguous float64 array of shape {expected}"
        )
        require(
            right and got.shape == expected,
            promise,
            f"got {getattr(got, 'dtype', type(got))} {np.shape(got)}",
        )
    means = model.linearize(states, inputs, covariance=False)
    require(
        means.covariance is None,
        "linearize: no covariance where it is not wanted",
        f"got {means.covariance}",
    )
    together = model.predict(x, u)
    mean, A, B, covariance = (torch.from_numpy(getattr(found, name)) for name in shapes)
    _check_same(
        "linearize: its mean and covariance are predict's",
        Gaussian(mean, covariance),
        together,
        exact,
    )
    differences = _numeric_jacobian(model, x, u)
    for name, got, expected in (
        ("A", A, differences[..., :n]),
        ("B", B, differences[..., n:]),
    ):
        require_close(
            f"linearize: {name} agrees with finite differences of predict",
            got,
            expected,
            numeric,
        )
        promise = f"linearize: {name} is the same without the covariance"
        require_close(promise, torch.from_numpy(getattr(means, name)), got, exact)
    one = model.linearize(states[1:2], inputs[1:2])
    for name in shapes:
        alone = torch.from_numpy(getattr(one, name)[0])
        among = torch.from_numpy(getattr(found, name)[1])
        require_close(
            f"linearize: K points are the loop over them ({name})", alone, among, exact
        )


def _check_belief(
    name: str, model: DynamicsModel, belief: Gaussian, batch: tuple[int, ...]
) -> None:
    k = model.output_dim
    require(
        isinstance(belief, Gaussian),
        f"{name}: the result is a gpmpc.gaussian.Gaussian",
        f"got {type(belief)}",
    )
    expected = (*batch, k), (*batch, k, k)
    got = tuple(belief.mean.shape), tuple(belief.covariance.shape)
    promise = f"{name}: mean (*batch, k) and covariance (*batch, k, k)"
    require(got == expected, promise, f"got {got}, should be {expected}")
    for part in (belief.mean, belief.covariance):
        right = (
            part.dtype == model.dtype
            and part.device == torch.zeros(0, device=model.device).device
        )
        promise = (
            f"{name}: type and device are the model's, {model.dtype} on {model.device}"
        )
        require(right, promise, f"got {part.dtype} on {part.device}")
    require(
        bool(torch.isfinite(belief.mean).all()),
        f"{name}: the mean is finite",
        f"got {belief.mean.tolist()}",
    )
    require_covariance(name, belief.covariance)


def _check_same(
    promise: str, got: Gaussian, expected: Gaussian, tolerance: float
) -> None:
    require_close(promise, got.mean, expected.mean, tolerance, "the mean")
    floor = 1e-4 if tolerance < 1e-6 else 1.0
    require_close(
        promise, got.covariance, expected.covariance, tolerance, "the covariance", floor
    )


def _numeric_jacobian(model: DynamicsModel, x: Tensor, u: Tensor) -> Tensor:
    """Central differences of the mean by (x, u) (K, k, n + m)."""
    joint = torch.cat([x, u], dim=1)
    n = model.state_dim
    columns = []
    for j in range(joint.shape[1]):
        size = torch.finfo(model.dtype).eps ** (1 / 3) * max(
            1.0, float(joint[:, j].abs().max())
        )
        shift = (
            size * torch.eye(joint.shape[1], dtype=joint.dtype, device=joint.device)[j]
        )
        above, below = (
            model.predict(moved[:, :n], moved[:, n:]).mean
            for moved in (joint + shift, joint - shift)
        )
        columns.append((above - below) / (2 * size))
    return torch.stack(columns, dim=-1)
