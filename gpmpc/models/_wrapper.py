"""What models around another model, with further states, have in common."""

import torch
from torch import Tensor

from gpmpc.dynamics import DynamicsModel


class Wrapper:
    """A model with the inputs, the type and the device of the model that it holds, and with further states.

    Attributes:
        model: The model that is wrapped.
    """

    model: DynamicsModel

    @property
    def state_dim(self) -> int:
        """Number of states, the further ones included."""
        raise NotImplementedError

    @property
    def input_dim(self) -> int:
        """Number of inputs, m."""
        return self.model.input_dim

    @property
    def output_dim(self) -> int:
        """Number of outputs: the next state."""
        return self.state_dim

    @property
    def dtype(self) -> torch.dtype:
        """Of the model that is wrapped."""
        return self.model.dtype

    @property
    def device(self) -> torch.device:
        """Of the model that is wrapped."""
        return self.model.device


def padded(covariance: Tensor, size: int) -> Tensor:
    """A covariance (*batch, n, n) with zeros for further, certain variables (*batch, size, size)."""
    more = size - covariance.shape[-1]
    return torch.nn.functional.pad(covariance, (0, more, 0, more))
