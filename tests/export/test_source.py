"""What the exported source needs from elsewhere."""

import shutil
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.export_checks import foreign_symbols, undefined_symbols
from gpmpc.export import export_c
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from tests.mpc.small_models import pendulum_posterior

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or None in (shutil.which("cc"), shutil.which("nm")),
    reason="needs a C compiler, nm and glibc",
)


def test_it_links_to_libm_alone_and_allocates_nothing(tmp_path):
    problem = Problem(
        Tracking([1.0, 0.1], [0.05]),
        Box([-2.0], [2.0]),
        constraints=[Box(upper=[0.5, np.inf], probability=0.9)],
    )
    controller = GPMPC(
        pendulum_posterior(), Linearization(), problem, 6, [0.0], iterations=1
    )
    for precision in ("double", "float"):
        export = export_c(controller, tmp_path / precision, precision)
        compiled = tmp_path / f"{precision}.o"
        command = ["cc", "-std=c99", "-O0", "-c", str(export.source)]
        subprocess.run([*command, "-o", str(compiled)], check=True)
        needed = undefined_symbols(compiled)
        assert not foreign_symbols(needed)
        assert any(name.startswith("sqrt") for name in needed)


def test_what_allocates_is_foreign():
    assert foreign_symbols(["sqrt", "fma", "memcpy", "malloc"]) == ["malloc"]
