"""Every module of the package imports, with whatever versions are installed."""

import importlib
import pkgutil

import pytest

import gpmpc.experiments

MODULES = sorted(
    module.name for module in pkgutil.walk_packages(gpmpc.__path__, "gpmpc.")
)


def test_the_modules_are_all_found():
    assert {"gpmpc.recording._recorder", "gpmpc.experiments.tables"} <= {*MODULES}
    assert len(MODULES) > 150


@pytest.mark.parametrize("name", MODULES)
def test_a_module_can_be_imported(name):
    importlib.import_module(name)
