"""One formula is for floats, arrays, CasADi and torch; what is none says the rule."""

import casadi
import numpy as np
import pytest
import torch

from gpmpc import systems
from gpmpc.exceptions import SettingError
from gpmpc.gp.casadi_ import successor_function
from gpmpc.models import CasadiFunction
from gpmpc.systems import System, step_many, where

POINTS = np.array([[0.3, 0.7], [0.9, -0.4], [0.2, 0.25]])
UNARY = [
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "exp",
    "log",
    "sqrt",
    "sinh",
    "cosh",
    "tanh",
    "abs",
]
FUNCTIONS = {name: lambda x, y, name=name: getattr(systems, name)(x) for name in UNARY}
FUNCTIONS |= {
    "atan2": lambda x, y: systems.atan2(y, x),
    "min": lambda x, y: systems.min(x, y) + systems.min(0.5, x),
    "max": lambda x, y: systems.max(x, y) + systems.max(x, 0.5),
    "where": lambda x, y: where(x > y, x * y, 1.0),
    "sign": lambda x, y: systems.sign(y, width=0.3),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_is_the_same_for_all_kinds(name):
    function = FUNCTIONS[name]
    expected = [float(function(x, y)) for x, y in POINTS.tolist()]
    assert np.allclose(function(*POINTS.T), expected, rtol=1e-14)
    tensors = function(*torch.from_numpy(POINTS).T)
    assert np.allclose(tensors.numpy(), expected, rtol=1e-12)
    x = casadi.SX.sym("x", 2)
    compiled = CasadiFunction(casadi.Function("f", [x], [function(x[0], x[1])]))
    assert compiled.tape is not None
    values, slopes = compiled.linearize(POINTS)
    assert np.allclose(values[:, 0], expected, rtol=1e-12)
    moved = compiled.linearize(POINTS + np.array([1e-6, 0.0]))[0] - values
    assert np.allclose(moved[:, 0], 1e-6 * slopes[:, 0, 0], atol=1e-9)


class Deciding:
    state_names = ("x",)
    input_names = ("u",)

    def successor(self, x, u):
        return [u[0] if x[0] > 0 else -u[0]]


class Solving(Deciding):
    def successor(self, x, u):
        return [np.linalg.solve(np.array([[1 + x[0]]]), np.array([u[0]]))[0]]


@pytest.mark.parametrize(
    ("dynamics", "words"), [(Deciding, "systems.where"), (Solving, "written out")]
)
def test_what_needs_numbers_is_told_what_to_write(dynamics, words):
    plant = System(dynamics(), time_step=0.1)
    with pytest.raises(SettingError, match=f"dynamics: must be written .*{words}"):
        successor_function(plant)
    if dynamics is Deciding:
        with pytest.raises(SettingError, match=f"dynamics: must be written .*{words}"):
            step_many(plant, np.zeros((3, 1)), np.zeros((3, 1)))
