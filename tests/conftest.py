"""Every test runs in float64 from a fixed seed, on one thread.

Warnings are errors: see pyproject.toml.
"""

import os

for variable in (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
):  # read when the libraries load
    os.environ.setdefault(variable, "1")

import signal
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.pages import follow, forget_modules_of

if (
    signal.getsignal(signal.SIGINT) is signal.SIG_IGN
):  # started in the background: commands would not end at Ctrl-C
    signal.signal(signal.SIGINT, signal.default_int_handler)
torch.set_num_threads(1)
torch.set_default_dtype(torch.float64)


@pytest.fixture(autouse=True)
def _reproducible_double_precision():
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture(scope="session")
def paper_data() -> Path:
    """The authors' four files, which are theirs and not part of this repository."""
    folder = os.environ.get("GPMPC_PAPER_DATA")
    if not folder:
        pytest.skip("GPMPC_PAPER_DATA names no folder with the authors' data")
    return Path(folder)


@pytest.fixture
def page(tmp_path, monkeypatch):
    """Does what a page of the documentation says in an empty folder, as a user has it.

    See ``tests.pages.follow``.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    torch.set_default_dtype(torch.float32)
    loaded = set(sys.modules)
    yield partial(follow, folder=tmp_path)
    forget_modules_of(tmp_path, loaded)
    torch.set_default_dtype(torch.float64)  # fixtures of the next file rely on it
