"""Every test runs in float64 from a fixed seed, on one torch thread; warnings are errors (see pyproject.toml)."""

import numpy as np
import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture(autouse=True)
def _reproducible_double_precision():
    default = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(0)
    yield
    torch.set_default_dtype(default)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)
