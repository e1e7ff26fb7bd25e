"""The quadratic programs of exported C, solved without a controller around them."""

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from gpmpc.export import export_c
from gpmpc.models import Affine, KnownModel
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.qp import DualActiveSet, QuadraticProgram
from gpmpc.status import Status

_WRAPPER = """
    #include "gpmpc.c"

    int solve_program(const real *P, const real *q, const real *G, const real *lower,
                      const real *upper, const real *prices, real *x,
                      real *multipliers)
    {
        static gpmpc_problem problem;
        static gpmpc_program work;
        static gpmpc_solution guess;
        static gpmpc_solution solution;
        memset(&guess, 0, sizeof guess);
        guess.rows = -1;
        work.rows = r;
        copy(P, &work.P[0][0], N * N);
        copy(q, work.q, N);
        copy(G, &work.G[0][0], r * N);
        copy(lower, work.lower, N + r);
        copy(upper, work.upper, N + r);
        copy(prices, problem.prices, r);
        solve(&problem, &work, &guess, &solution);
        copy(solution.x, x, N);
        copy(solution.multiplier, multipliers, N + r);
        return solution.status;
    }

    void solve_riccati(const real *A, const real *B, const real *R, real *P, real *K)
    {
        real D[GPMPC_INPUTS * GPMPC_INPUTS];
        riccati(A, B, 0, R, n, P, K, D);
    }
"""


class Answer(NamedTuple):
    """What C says of a program."""

    status: Status
    x: np.ndarray
    multipliers: np.ndarray


class CompiledPrograms:
    """Programs of as many variables and rows, all rows at a price, in double.

    The C is that of a controller of one stage, of as many inputs and state rows.
    """

    def __init__(self, variables: int, rows: int, tolerance: float = 1e-9):
        self.variables = variables
        self.rows = rows
        problem = Problem(
            Tracking(np.ones(rows), np.ones(variables)),
            constraints=[Box(upper=np.ones(rows), penalty=1.0)],
        )
        still = Affine(
            torch.eye(rows, dtype=torch.float64),
            torch.zeros(rows, variables, dtype=torch.float64),
            torch.zeros(rows, dtype=torch.float64),
        )
        controller = GPMPC(
            KnownModel(still, rows, variables),
            Linearization(),
            problem,
            1,
            np.zeros(variables),
            solver=DualActiveSet(tolerance),
            iterations=1,
        )
        with tempfile.TemporaryDirectory() as folder:
            export_c(controller, folder)
            wrapper = Path(folder) / "src" / "wrapper.c"
            wrapper.write_text(_WRAPPER)
            library = Path(folder) / "programs.so"
            command = ["cc", "-std=c99", "-O1", "-shared", "-fPIC", str(wrapper)]
            subprocess.run([*command, "-lm", "-o", str(library)], check=True)
            self._code = ctypes.CDLL(str(library))

    def solve(self, problem: QuadraticProgram, prices=None) -> Answer:
        """Solves a program of this size; rows without a price are hard."""
        if prices is None:
            prices = np.full(self.rows, np.inf)
        x = np.zeros(self.variables)
        multipliers = np.zeros(self.variables + self.rows)
        arrays = [*problem, np.array(prices, dtype=float), x, multipliers]
        numbers = [np.ascontiguousarray(array, dtype=float) for array in arrays[:6]]
        pointers = [
            array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
            for array in [*numbers, x, multipliers]
        ]
        status = self._code.solve_program(*pointers)
        return Answer(list(Status)[status], x, multipliers)

    def gains(self, A: np.ndarray, B: np.ndarray, R: np.ndarray) -> np.ndarray:
        """Returns K (variables, rows) of the last stage, whose states weigh 1."""
        gains = np.full((self.variables, self.rows), np.nan)
        arrays = [A, B, R, np.eye(self.rows), gains]
        numbers = [np.ascontiguousarray(array, dtype=float) for array in arrays[:4]]
        pointers = [
            array.ctypes.data_as(ctypes.POINTER(ctypes.c_double))
            for array in [*numbers, gains]
        ]
        self._code.solve_riccati(*pointers)
        return gains
