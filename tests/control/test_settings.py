"""Every controller's settings build what they name."""

from pathlib import Path

import numpy as np
import pytest
import torch

from gpmpc.control.controller import Reference
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.plants import Integrated, Translational

FOLDER = Path(__file__).resolve().parents[2] / "conf"


@pytest.mark.parametrize(
    ("name", "subject"),
    [
        ("nmpc", "plant"),
        ("nonlinear", "model"),
        ("lqr", "model"),
        ("convex", "model"),
        ("paper", "model"),
        ("state_form", "model"),
    ],
)
def test_the_settings_of_a_controller_build_one_that_decides(name, subject):
    from hydra import compose, initialize_config_dir
    from hydra.utils import instantiate

    generator = torch.Generator().manual_seed(0)
    features = torch.randn(15, 9, generator=generator)
    posterior = GPPosterior.from_hyperparameters(
        features, 0.1 * features[:, :6], 3 * torch.ones(6, 9), torch.ones(6), 1e-2 * torch.ones(6), 3, "difference"
    )
    parts = {"plant": Integrated(Translational(), time_step=0.5), "model": posterior}
    with initialize_config_dir(str(FOLDER), version_base=None):
        settings = compose(overrides=[f"+controller={name}", "controller.horizon=2"]).controller
    controller = instantiate(settings, _convert_="all")(parts[subject])
    decision = controller.control(Gaussian.certain(np.zeros(6)), Reference(np.full((3, 6), 0.1)))
    assert decision.status.solved
    assert decision.inputs.shape == (2, 3)
