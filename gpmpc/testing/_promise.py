"""Errors of the checks: each names the promise that is broken and the numbers."""

import torch
from torch import Tensor


def require(condition: bool, promise: str, got: str) -> None:
    """Raises ``AssertionError`` unless the condition holds.

    The message has the promise and what was got instead.
    """
    if not condition:
        raise AssertionError(f"{promise}; {got}")


def require_close(
    promise: str,
    got: Tensor,
    expected: Tensor,
    tolerance: float,
    what: str = "it",
    floor: float = 1.0,
) -> None:
    """Raises unless two tensors differ by at most a share of the expected one's size.

    The share is of ``floor`` if that is more.
    """
    got = got.detach().double()
    expected = expected.detach().double()
    require(
        got.shape == expected.shape,
        promise,
        f"{what} has shape {[*got.shape]}, should be {[*expected.shape]}",
    )
    error = _largest(got - expected)
    bound = tolerance * max(floor, _largest(expected))
    text = (
        f"{what} is off by {error:.2e} (allowed {bound:.1e}):\n"
        f"got      {got}\nexpected {expected}"
    )
    require(error <= bound, promise, text)  # false for NaN as well


def require_covariance(name: str, covariance: Tensor) -> None:
    """Raises unless covariances (*batch, k, k) are what covariances are.

    That is finite, symmetric, and positive semidefinite up to round-off.
    """
    require(
        bool(torch.isfinite(covariance).all()),
        f"{name}: the covariance is finite",
        f"it holds {covariance}",
    )
    size = max(float(covariance.abs().max()), 1e-300) if covariance.numel() else 1.0
    round_off = torch.finfo(covariance.dtype).eps * size
    lopsided = float((covariance - covariance.mT).abs().max())
    text = f"an entry and its mirror image differ by {lopsided:.2e}: {covariance}"
    require(lopsided <= 100 * round_off, f"{name}: the covariance is symmetric", text)
    lowest = float(torch.linalg.eigvalsh(covariance.double()).min())
    text = f"its lowest eigenvalue is {lowest:.2e}, its largest entry {size:.2e}"
    require(
        lowest >= -1000 * round_off,
        f"{name}: the covariance is positive semidefinite",
        text,
    )


def _largest(tensor: Tensor) -> float:
    """Returns the largest size of an entry, zero if there is none."""
    return float(tensor.abs().amax()) if tensor.numel() else 0.0
