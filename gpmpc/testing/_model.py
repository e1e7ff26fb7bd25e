"""Check of a dynamics model of your own: ``check_model``."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import Array, DynamicsModel, Linearized
from gpmpc.gaussian import Gaussian
from gpmpc.testing._promise import require, require_close, require_covariance


class _Points(NamedTuple):
    """Points at which a model is evaluated, and how exact it can be there."""

    states: Tensor  # (K, n)
    inputs: Tensor  # (K, m)
    exact: float  # tolerance of what is the same computation
    numeric: float  # tolerance of finite differences


@explains_arguments
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
    _check_dimensions(model)
    _check_noise(model)
    points = _points(model, states, inputs, seed)

    batch = _check_predict(model, points)
    _check_batches(model, points, batch)

    linearized = _check_linearize(model, points)
    _check_against_predict(model, points, linearized, batch)
    _check_without_covariance(model, points, linearized)
    _check_single_point(model, points, linearized)


def _points(
    model: DynamicsModel, states: Tensor | None, inputs: Tensor | None, seed: int
) -> _Points:
    """Returns a caller's points, by default standard normal ones of a seed."""
    generator = torch.Generator().manual_seed(seed)
    if states is None:
        states = torch.randn(4, model.state_dim, generator=generator)
    if inputs is None:
        inputs = torch.randn(len(states), model.input_dim, generator=generator)
    is_single_precision = torch.finfo(model.dtype).eps > 1e-10
    return _Points(
        states=states.to(dtype=model.dtype, device=model.device),
        inputs=inputs.to(dtype=model.dtype, device=model.device),
        exact=1e-4 if is_single_precision else 1e-9,
        numeric=3e-2 if is_single_precision else 1e-5,
    )


def _check_dimensions(model: DynamicsModel) -> None:
    """Checks the numbers of states, inputs and outputs, the type and the device."""
    for name, least in (("state_dim", 1), ("input_dim", 0), ("output_dim", 1)):
        value = getattr(model, name, None)
        require(
            isinstance(value, int) and value >= least,
            f"{name} is a whole number, {least} or more",
            f"got {value!r}",
        )
    require(
        isinstance(getattr(model, "dtype", None), torch.dtype),
        "dtype is a torch.dtype",
        "it is missing or not",
    )
    require(
        hasattr(model, "device"), "device says where the model lives", "it is missing"
    )


def _check_noise(model: DynamicsModel) -> None:
    """Checks the covariance of the observations' noise."""
    k = model.output_dim
    noise = getattr(model, "noise_covariance", None)
    dtype = getattr(noise, "dtype", "")
    shape = tuple(getattr(noise, "shape", ()))
    is_covariance = (
        isinstance(noise, Tensor) and shape == (k, k) and dtype == model.dtype
    )
    require(
        is_covariance,
        f"noise_covariance is a {model.dtype} tensor of shape ({k}, {k})",
        f"got {type(noise).__name__} {dtype} {shape}",
    )
    require_covariance("noise_covariance", model.noise_covariance)


def _check_predict(model: DynamicsModel, points: _Points) -> Gaussian:
    """Checks the prediction of all points at once, and returns it (K,)."""
    states = points.states
    inputs = points.inputs
    states_before = states.clone()
    inputs_before = inputs.clone()
    batch = model.predict(states, inputs)
    require(
        torch.equal(states_before, states) and torch.equal(inputs_before, inputs),
        "predict: the caller's state and input are left as they are",
        "one was modified",
    )
    _check_belief("predict at a batch", model, batch, (len(states),))
    repeated = model.predict(states, inputs)
    same_mean = torch.equal(repeated.mean, batch.mean)
    same_covariance = torch.equal(repeated.covariance, batch.covariance)
    require(
        same_mean and same_covariance,
        "predict: the same arguments give the same result",
        "the second differs from the first",
    )
    return batch


def _check_batches(model: DynamicsModel, points: _Points, batch: Gaussian) -> None:
    """Compares a batch with its members, other batch dimensions and other layouts."""
    states = points.states
    inputs = points.inputs
    members = [model.predict(x, u) for x, u in zip(states, inputs, strict=True)]
    _check_belief("predict at one state", model, members[0], ())
    stacked_members = Gaussian(
        torch.stack([member.mean for member in members]),
        torch.stack([member.covariance for member in members]),
    )
    _check_same(
        "predict: a batch is the loop over its members",
        batch,
        stacked_members,
        points.exact,
    )

    nested = model.predict(states[None, :, None], inputs[None, :, None])
    _check_belief(
        "predict at two more batch dimensions", model, nested, (1, len(states), 1)
    )
    flat = Gaussian(nested.mean[0, :, 0], nested.covariance[0, :, 0])
    _check_same(
        "predict: more batch dimensions change nothing", flat, batch, points.exact
    )

    _check_same(
        "predict: every other element of a larger array will do",
        model.predict(_strided(states), _strided(inputs)),
        batch,
        points.exact,
    )


def _strided(tensor: Tensor) -> Tensor:
    """Copies a tensor into every other element of a larger one."""
    return torch.stack([tensor, tensor + 1], dim=-1)[..., 0]


def _check_linearize(model: DynamicsModel, points: _Points) -> Linearized:
    """Checks what ``linearize`` returns for all points, and returns it."""
    states = _to_numpy(points.states)
    inputs = _to_numpy(points.inputs)
    states_before = states.copy()
    inputs_before = inputs.copy()
    linearized = model.linearize(states, inputs)
    same_states = np.array_equal(states_before, states)
    same_inputs = np.array_equal(inputs_before, inputs)
    require(
        same_states and same_inputs,
        "linearize: the caller's states and inputs are left as they are",
        "one was modified",
    )
    n = model.state_dim
    m = model.input_dim
    k = model.output_dim
    K = len(states)
    shapes = {"mean": (K, k), "A": (K, k, n), "B": (K, k, m), "covariance": (K, k, k)}
    for name, shape in shapes.items():
        array = getattr(linearized, name)
        is_plain = (
            isinstance(array, np.ndarray)
            and array.dtype == np.float64
            and array.flags.c_contiguous
        )
        require(
            is_plain and array.shape == shape,
            f"linearize: {name} is a C-contiguous float64 array of shape {shape}",
            f"got {getattr(array, 'dtype', type(array))} {np.shape(array)}",
        )
    return linearized


def _check_against_predict(
    model: DynamicsModel, points: _Points, linearized: Linearized, batch: Gaussian
) -> None:
    """Compares a linearisation with ``predict`` and its finite differences."""
    assert linearized.covariance is not None
    _check_same(
        "linearize: its mean and covariance are predict's",
        Gaussian(
            torch.from_numpy(linearized.mean), torch.from_numpy(linearized.covariance)
        ),
        batch,
        points.exact,
    )
    n = model.state_dim
    jacobian = _numeric_jacobian(model, points)
    numeric = {"A": jacobian[..., :n], "B": jacobian[..., n:]}
    for name, expected in numeric.items():
        require_close(
            f"linearize: {name} agrees with finite differences of predict",
            torch.from_numpy(getattr(linearized, name)),
            expected,
            points.numeric,
        )


def _check_without_covariance(
    model: DynamicsModel, points: _Points, linearized: Linearized
) -> None:
    """Checks that the derivatives are the same where no covariance is computed."""
    mean_only = model.linearize(
        _to_numpy(points.states), _to_numpy(points.inputs), covariance=False
    )
    require(
        mean_only.covariance is None,
        "linearize: no covariance where it is not wanted",
        f"got {mean_only.covariance}",
    )
    for name in ("A", "B"):
        require_close(
            f"linearize: {name} is the same without the covariance",
            torch.from_numpy(getattr(mean_only, name)),
            torch.from_numpy(getattr(linearized, name)),
            points.exact,
        )


def _check_single_point(
    model: DynamicsModel, points: _Points, linearized: Linearized
) -> None:
    """Compares the linearisation at the second point alone with that among others."""
    single = model.linearize(
        _to_numpy(points.states)[1:2], _to_numpy(points.inputs)[1:2]
    )
    for name in Linearized._fields:
        require_close(
            f"linearize: K points are the loop over them ({name})",
            torch.from_numpy(getattr(single, name)[0]),
            torch.from_numpy(getattr(linearized, name)[1]),
            points.exact,
        )


def _to_numpy(tensor: Tensor) -> Array:
    """Copies a tensor into a float64 array."""
    return tensor.double().cpu().numpy().copy()


def _check_belief(
    name: str, model: DynamicsModel, belief: Gaussian, batch: tuple[int, ...]
) -> None:
    """Checks the shapes, type, device and values of a predicted belief."""
    k = model.output_dim
    require(
        isinstance(belief, Gaussian),
        f"{name}: the result is a gpmpc.gaussian.Gaussian",
        f"got {type(belief)}",
    )
    shapes = (tuple(belief.mean.shape), tuple(belief.covariance.shape))
    expected_shapes = ((*batch, k), (*batch, k, k))
    require(
        shapes == expected_shapes,
        f"{name}: mean (*batch, k) and covariance (*batch, k, k)",
        f"got {shapes}, should be {expected_shapes}",
    )
    # Of a tensor there, since "cuda" and "cuda:0" differ.
    model_device = torch.zeros(0, device=model.device).device
    for tensor in (belief.mean, belief.covariance):
        require(
            tensor.dtype == model.dtype and tensor.device == model_device,
            f"{name}: type and device are the model's, {model.dtype} on {model.device}",
            f"got {tensor.dtype} on {tensor.device}",
        )
    require(
        bool(torch.isfinite(belief.mean).all()),
        f"{name}: the mean is finite",
        f"got {belief.mean.tolist()}",
    )
    require_covariance(name, belief.covariance)


def _check_same(
    promise: str, result: Gaussian, expected: Gaussian, tolerance: float
) -> None:
    """Raises unless the moments of two beliefs agree."""
    require_close(promise, result.mean, expected.mean, tolerance, "the mean")
    floor = 1e-4 if tolerance < 1e-6 else 1.0
    require_close(
        promise,
        result.covariance,
        expected.covariance,
        tolerance,
        "the covariance",
        floor,
    )


def _numeric_jacobian(model: DynamicsModel, points: _Points) -> Tensor:
    """Returns central differences of the mean by states and inputs (K, k, n + m)."""
    n = model.state_dim
    joint = torch.cat([points.states, points.inputs], dim=1)
    directions = torch.eye(joint.shape[1], dtype=joint.dtype, device=joint.device)
    root_of_precision = torch.finfo(model.dtype).eps ** (1 / 3)

    def mean(joint: Tensor) -> Tensor:
        return model.predict(joint[:, :n], joint[:, n:]).mean

    columns = []
    for j, direction in enumerate(directions):
        largest = float(joint[:, j].abs().max())
        size = root_of_precision * max(1.0, largest)
        above = mean(joint + size * direction)
        below = mean(joint - size * direction)
        columns.append((above - below) / (2 * size))
    return torch.stack(columns, dim=-1)
