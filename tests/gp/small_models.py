"""Untrained models with random data, for tests that do not care what they predict."""

import torch

from gpmpc.gp import GPPosterior, load_posterior, save_posterior
from gpmpc.models import Affine, ResidualModel, load_model, save_model
from tests.gp.model_files import parts_of, write_npz

SAVE = {GPPosterior: save_posterior, ResidualModel: save_model}
LOAD = {GPPosterior: load_posterior, ResidualModel: load_model}


def posterior(size=12, n=2, m=1, predicts="next_state", seed=0):
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    return GPPosterior.from_hyperparameters(
        3 * draw(size, n + m) - 1.5,
        draw(size, n) - 0.5,
        0.5 + draw(n, n + m),
        0.5 + draw(n),
        1e-4 + 1e-2 * draw(n),
        m,
        predicts,
        offset=draw(n),
    )


def residual_model():
    gp = posterior(n=1, m=1, predicts="value")
    nominal = Affine(
        torch.tensor([[1.0, 0.1], [-0.2, 0.9]]),
        torch.tensor([[0.0, 0.1], [0.1, 0.0]]),
        torch.ones(2),
    )
    return ResidualModel(nominal, gp, torch.tensor([[0.0], [1.0]]), [1], [0], 2)


def as_before(model, path):
    """Writes a model as gpmpc 1 did: arrays in an .npz archive.

    Nothing said whether targets are observations.
    """
    new = path.with_suffix(".new")
    SAVE[type(model)](model, new)
    header, arrays = parts_of(new)
    header = {
        key: value
        for key, value in header.items()
        if key not in ("checksum", "metadata", "targets")
    }
    header.get("residual", {}).pop("targets", None)
    arrays = {
        name: array
        for name, array in arrays.items()
        if not name.endswith("observation_noise")
    }
    write_npz(path, header | {"format_version": 1}, arrays)
