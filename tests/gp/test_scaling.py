import logging

import pytest
import torch

from gpmpc.exceptions import SettingError, ShapeError
from gpmpc.gp import Scaling, identity, min_max, standardize

NAMES = ["a", "b", "c"]
COLUMNS = torch.stack(
    [torch.linspace(-3, 5, 20), torch.full((20,), 7.0), 1e-6 * torch.randn(20)], dim=1
)


@pytest.mark.parametrize("make", [identity, standardize, min_max])
def test_restoring_undoes_scaling(make):
    scaling = make(COLUMNS, NAMES)
    assert torch.allclose(
        scaling.restore(scaling.scale(COLUMNS)), COLUMNS, rtol=1e-14, atol=1e-20
    )


def test_standardized_columns_have_mean_zero_and_deviation_one():
    scaled = standardize(COLUMNS, NAMES).scale(COLUMNS)[:, [0, 2]]
    assert torch.allclose(scaled.mean(0), torch.zeros(2), atol=1e-14)
    assert torch.allclose(scaled.std(0, correction=0), torch.ones(2))
    tiny = torch.tensor([[0.0], [1e-170]])  # its square is no number
    assert standardize(tiny, ["d"]).factor.tolist() == [1.0]


def test_min_max_fills_the_interval_constants_its_middle():
    scaled = min_max(COLUMNS, NAMES).scale(COLUMNS)
    assert torch.allclose(scaled.amin(0), torch.tensor([0.1, 0.5, 0.1]))
    assert torch.allclose(scaled.amax(0), torch.tensor([0.9, 0.5, 0.9]))


def test_motion_below_the_resolution_is_constant_and_noted(caplog):
    with caplog.at_level(logging.INFO, "gpmpc"):
        scaled = min_max(COLUMNS, NAMES, resolution=1e-4).scale(COLUMNS)
    assert torch.allclose(scaled[:, 2], torch.full((20,), 0.5), atol=1e-5)
    assert float(scaled[:, 2].max() - scaled[:, 2].min()) == pytest.approx(
        float(COLUMNS[:, 2].max() - COLUMNS[:, 2].min())
    )
    assert (
        "constant columns are centred, not scaled: b (moves by 0e+00), c (moves by"
        in caplog.text
    )


def test_misuse_is_refused_with_the_rule():
    with pytest.raises(SettingError, match="low must be below high; got 0.9, 0.1"):
        min_max(COLUMNS, NAMES, low=0.9, high=0.1)
    with pytest.raises(ShapeError, match="need d names"):
        standardize(COLUMNS, ["a"])
    with pytest.raises(SettingError, match="positive in every column"):
        Scaling(torch.zeros(2), torch.tensor([1.0, 0.0]))
    with pytest.raises(ShapeError, match=r"both be \(d,\)"):
        Scaling(torch.zeros(2), torch.ones(3))
