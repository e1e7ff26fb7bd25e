"""Problem: an outsider whose part fails a check wants to read which promise it breaks, and by how much."""

import torch
from torch import Tensor


def require(condition: bool, promise: str, got: str) -> None:
    """Raises ``AssertionError`` with the promise and what was got instead, unless the condition holds."""
    if not condition:
        raise AssertionError(f"{promise}; {got}")


def require_close(
    promise: str, got: Tensor, expected: Tensor, tolerance: float, what: str = "it", floor: float = 1.0
) -> None:
    """Raises unless two tensors differ by at most a part of the expected one's size (of ``floor`` if that is more)."""
    require(
        got.shape == expected.shape, promise, f"{what} has shape {tuple(got.shape)}, should be {tuple(expected.shape)}"
    )
    if not got.numel():
        return
    error = float((got.detach().double() - expected.detach().double()).abs().max())
    bound = tolerance * max(floor, float(expected.detach().abs().max()))
    require(
        error <= bound,  # false for NaN as well
        promise,
        f"{what} is off by {error:.2e} (allowed {bound:.1e}):\ngot      {_text(got)}\nexpected {_text(expected)}",
    )


def require_covariance(name: str, covariance: Tensor) -> None:
    """Raises unless covariances (*batch, k, k) are finite, symmetric and positive semidefinite up to round-off."""
    require(
        bool(torch.isfinite(covariance).all()), f"{name}: the covariance is finite", f"it holds {_text(covariance)}"
    )
    size = max(float(covariance.abs().max()), 1e-300) if covariance.numel() else 1.0
    round_off = torch.finfo(covariance.dtype).eps * size
    lopsided = float((covariance - covariance.mT).abs().max())
    require(
        lopsided <= 100 * round_off,
        f"{name}: the covariance is symmetric",
        f"an entry and its mirror image differ by {lopsided:.2e}: {_text(covariance)}",
    )
    lowest = float(torch.linalg.eigvalsh(covariance.double()).min())
    require(
        lowest >= -1000 * round_off,
        f"{name}: the covariance is positive semidefinite",
        f"its lowest eigenvalue is {lowest:.2e}, its largest entry {size:.2e}",
    )


def _text(tensor: Tensor) -> str:
    tensor = tensor.detach()
    return str(tensor.tolist()) if tensor.numel() <= 20 else f"{tensor.ravel()[:20].tolist()} and more"
