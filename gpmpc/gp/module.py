"""A learned model as a torch module, for places without gpmpc: torch.export, ONNX, a C++ runtime.

``PosteriorModule`` is the posterior as a ``torch.nn.Module`` of buffers, with a forward pass of multiplications, sums
and one exponential. ONNX has no triangular solve, so the inverse of the factor takes its place; the variance stays
sf2 - |L^-1 k|^2, which loses fewer digits than k' (K + sn2 I)^-1 k. With ``onnx`` and ``onnxscript`` installed,

    torch.onnx.export(PosteriorModule(posterior), (state, input), "gp.onnx", dynamo=True)
"""

import torch
from torch import Tensor

from gpmpc.exceptions import UnsupportedModel
from gpmpc.gp._posterior import GPPosterior


class PosteriorModule(torch.nn.Module):
    """``GPPosterior.predict`` as a module: (state (*batch, n), input (*batch, m)) to mean and variance (*batch, k).

    Args:
        posterior: The model; its type and device are the module's.

    Raises:
        UnsupportedModel: It is no ``GPPosterior``.
    """

    features: Tensor
    inverse_lengthscales: Tensor
    signal_variance: Tensor
    offset: Tensor
    weights: Tensor
    inverse_factor: Tensor

    def __init__(self, posterior: GPPosterior):
        super().__init__()
        if not isinstance(posterior, GPPosterior):
            got = type(posterior).__name__
            raise UnsupportedModel(f"PosteriorModule takes a GPPosterior, such as a model's .residual; got {got}")
        eye = torch.eye(len(posterior), dtype=posterior.dtype, device=posterior.device)
        buffers = {
            "features": posterior.features,
            "inverse_lengthscales": posterior.lengthscales.reciprocal()[:, None, :],
            "signal_variance": posterior.signal_variance,
            "offset": posterior.offset,
            "weights": posterior.weights,
            "inverse_factor": torch.linalg.solve_triangular(posterior.cholesky, eye, upper=False),
        }
        for name, value in buffers.items():  # copies: a file of weights wants memory of its own for each
            self.register_buffer(name, value.detach().clone(memory_format=torch.contiguous_format))
        self.adds_state = posterior.predicts == "difference"

    def forward(self, state: Tensor, input: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of the latent next state, in physical units."""
        query = torch.cat([state, input], dim=-1)
        z = (self.features - query[..., None, :])[..., None, :, :] * self.inverse_lengthscales
        k = self.signal_variance[:, None] * torch.exp((z * z).sum(-1) * -0.5)
        mean = (k * self.weights).sum(-1) + self.offset
        whitened = (self.inverse_factor @ k[..., None])[..., 0]
        variance = (self.signal_variance - (whitened * whitened).sum(-1)).clamp_min(0)
        return (mean + state if self.adds_state else mean), variance
