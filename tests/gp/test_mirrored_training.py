"""Nothing in the training of sparse GPs prefers a direction: turned data give the
turned model."""

import pytest
import torch

from gpmpc.gp import SparseTrainer


@pytest.mark.parametrize("inducing", [4, 5])
def test_training_on_a_mirrored_feature_is_the_mirrored_training(inducing):
    """Points may leave the data by a tenth of its range, on either side alike."""
    generator = torch.Generator().manual_seed(0)
    x = 4 * torch.rand(120, 1, generator=generator) - 2
    y = torch.exp(-2 * x) / 10 + 0.1 * torch.randn(x.shape, generator=generator)
    trained, mirrored = (
        SparseTrainer(inducing, iterations=60).fit(side * x, y, 0, "value")
        for side in (1.0, -1.0)
    )
    assert mirrored.objective == pytest.approx(trained.objective, abs=1e-2)
    ours, theirs = (
        training.posterior.features[:, 0].sort().values
        for training in (trained, mirrored)
    )
    assert torch.allclose(ours, -theirs.flip(0), atol=1e-2)
    margin = 0.1 * float(x.max() - x.min())
    assert float(ours.min()) >= float(x.min()) - margin - 1e-6
    assert float(ours.max()) <= float(x.max()) + margin + 1e-6
