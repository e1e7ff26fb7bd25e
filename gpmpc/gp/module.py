"""A learned model as a torch module, for torch.export, ONNX or a C++ runtime.

With ``onnx`` and ``onnxscript`` installed,

    torch.onnx.export(PosteriorModule(posterior), (state, input), "gp.onnx",
    dynamo=True)
"""

import torch
from torch import Tensor

from gpmpc.exceptions import UnsupportedModel
from gpmpc.gp._posterior import GPPosterior


class PosteriorModule(torch.nn.Module):
    """``GPPosterior.predict`` as a module.

    It maps state (*batch, n) and input (*batch, m) to mean and variance (*batch, k).
    Its type and device are the posterior's.

    Raises:
        UnsupportedModel: The model is no ``GPPosterior``.
    """

    features: Tensor
    inverse_lengthscales: Tensor
    inverse_factor: Tensor
    signal_variance: Tensor
    offset: Tensor
    weights: Tensor

    def __init__(self, posterior: GPPosterior):
        super().__init__()
        if not isinstance(posterior, GPPosterior):
            got = type(posterior).__name__
            raise UnsupportedModel(
                "PosteriorModule takes a GPPosterior, such as a model's .residual; "
                f"got {got}"
            )
        eye = torch.eye(len(posterior), dtype=posterior.dtype, device=posterior.device)
        # ONNX has no triangular solve. |L^-1 k|^2 loses fewer digits than
        # k' (K + sn2 I)^-1 k.
        inverse = torch.linalg.solve_triangular(posterior.cholesky, eye, upper=False)
        self._add("inverse_factor", inverse)
        self._add(
            "inverse_lengthscales", posterior.lengthscales.reciprocal()[:, None, :]
        )
        for name in ("features", "signal_variance", "offset", "weights"):
            self._add(name, getattr(posterior, name))
        self.adds_state = posterior.predicts == "difference"

    def _add(self, name: str, value: Tensor) -> None:
        """Registers a copy: a file of weights wants memory of its own for each."""
        self.register_buffer(
            name, value.detach().clone(memory_format=torch.contiguous_format)
        )

    def forward(self, state: Tensor, input: Tensor) -> tuple[Tensor, Tensor]:
        """Computes mean and variance of the latent next state, in physical units."""
        query = torch.cat([state, input], dim=-1)
        difference = self.features - query[..., None, :]
        z = difference[..., None, :, :] * self.inverse_lengthscales
        k = self.signal_variance[:, None] * torch.exp((z * z).sum(-1) * -0.5)
        mean = (k * self.weights).sum(-1) + self.offset
        whitened = (self.inverse_factor @ k[..., None])[..., 0]
        variance = (self.signal_variance - (whitened * whitened).sum(-1)).clamp_min(0)
        if self.adds_state:
            mean = mean + state
        return mean, variance
