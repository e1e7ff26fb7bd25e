"""The stability of a loop, known before it runs: against the loop itself."""

from collections import deque
from dataclasses import replace

import casadi
import numpy as np
import pytest
import torch

from gpmpc._dynamics import linearize
from gpmpc.gaussian import Gaussian
from gpmpc.models import CasadiFunction, DelayedModel, DisturbedModel, KnownModel
from gpmpc.models._nominal import Affine
from gpmpc.mpc import (
    GPMPC,
    Box,
    LeastSquares,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.mpc._stability import _linear_plant, _Loop, _points, stability
from gpmpc.propagation import Linearization

TANK_STEP = 10.0  # [s]
VOLTAGES = [3.15, 3.15]  # [V]


def quadruple_tank():
    """Two pumps and four tanks in their non-minimum phase setting (Johansson, 2000), levels in cm."""
    areas, outlets = [28.0, 32.0, 28.0, 32.0], [0.071, 0.057, 0.071, 0.057]
    pumps, shares, gravity, substeps = [3.14, 3.29], [0.43, 0.34], 981.0, 4
    x, u = casadi.SX.sym("x", 4), casadi.SX.sym("u", 2)

    def derivative(levels):
        flows = [
            outlet * casadi.sqrt(2 * gravity * casadi.fmax(level, 1e-3))
            for outlet, level in zip(outlets, levels, strict=True)
        ]
        inflows = [
            flows[2] + shares[0] * pumps[0] * u[0],
            flows[3] + shares[1] * pumps[1] * u[1],
            (1 - shares[1]) * pumps[1] * u[1],
            (1 - shares[0]) * pumps[0] * u[0],
        ]
        return [
            (inflow - flow) / area
            for inflow, flow, area in zip(inflows, flows, areas, strict=True)
        ]

    levels, h = [x[i] for i in range(4)], TANK_STEP / substeps
    for _ in range(substeps):
        k1 = derivative(levels)
        middle = [level + h / 2 * k for level, k in zip(levels, k1, strict=True)]
        k2 = derivative(middle)
        levels = [level + h * k for level, k in zip(levels, k2, strict=True)]
    function = casadi.Function("tank", [x, u], [casadi.vertcat(*levels)])
    return KnownModel(CasadiFunction(function), 4, 2)


def linear(A, B):
    """A known linear model."""
    A, B = (torch.tensor(part, dtype=torch.float64) for part in (A, B))
    return KnownModel(Affine(A, B, torch.zeros(len(A), dtype=torch.float64)), *B.shape)


def controller(model, cost, horizon, initial_input, outputs=(), **settings):
    problem = Problem(cost, outputs=outputs)
    settings = {"covariance": "none"} | settings
    prediction = PredictionSettings(**settings)
    return GPMPC(model, Linearization(), problem, horizon, initial_input, prediction)


TANK = quadruple_tank()
LEVELS = [12.4, 13.2, 0.0, 0.0]  # of the upper tanks nothing is asked


def tank_controller(horizon, **settings):
    cost = Tracking(Q=[1.0, 1.0, 0.0, 0.0], R=[0.1, 0.1])
    return controller(TANK, cost, horizon, VOLTAGES, **settings)
