"""Solves the nonlinear problem of a control step by acados (Verschueren et al., 2022).

    .venv/bin/python -m benchmarks.peer_acados [--horizons 10 20] [--seconds 20]
    [--starts warm cold]

The question, its instances, the timing and the judge are those of ``benchmarks.peers``.
Both solvers stop by tolerances with which 99 of 100 plans are within 1e-5 of a KKT
point. The acados solver has the settings that were the fastest here: the GPs' mean
expanded to scalar operations and compiled with ``-O3 -march=native``, states
(x_k, u_{k-1}) with the increments as residuals of a linear least-squares cost, SQP with
the Gauss-Newton Hessian, and full condensing with HPIPM. Warm solves start from the
last primal and dual solution, shifted by a stage.

Times include the calls of its Python interface, as a Python user pays them; ``inside``
is what acados reports as its own total. The *real-time iteration* is one quadratic
program a step by acados' ``SQP_RTI``, beside one program a step of ours, in Python and
as exported C (``inside``: the call of C alone).

acados is built from its sources (https://docs.acados.org/installation): this file needs
``acados_template``, ``ACADOS_SOURCE_DIR`` and its libraries on ``LD_LIBRARY_PATH``. It
compiles each horizon for one to five minutes into ``outputs/benchmarks/acados``. Writes
``outputs/benchmarks/peer_acados.json`` and ``peer_acados.md``.
"""

import argparse
import importlib
import importlib.util
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import casadi
import numpy as np
import scipy.linalg

from benchmarks import peers
from benchmarks.kkt import Instance
from benchmarks.peer_casadi import MAX_ITERATIONS, check_problem, mean_function
from benchmarks.quadrotor import HOVER, trained
from benchmarks.timing import (
    RESULTS,
    describe,
    machine,
    use_one_thread,
    write_results,
)
from gpmpc.exceptions import SettingError
from gpmpc.export import CompiledController
from gpmpc.gp import GPPosterior
from gpmpc.mpc import GPMPC, Decision, PredictionSettings, Problem
from gpmpc.propagation import Linearization

MISSING = (
    "acados is not installed here: build it as https://docs.acados.org/installation "
    "says, install its interfaces/acados_template, and set ACADOS_SOURCE_DIR and "
    "LD_LIBRARY_PATH"
)
TOLERANCE = 1e-6  # of acados' own tests
QP_TOLERANCE = 1e-8  # of HPIPM; as loose as its default, 94 % of plans are within
OURS = 1e-4  # of ours
COMPILE_FLAGS = "-O3 -march=native"
RIVAL = "acados, SQP, HPIPM"
IN_C = "gpmpc, exported C"

Array = np.ndarray


def installed() -> bool:
    """Returns whether there is an acados here."""
    has_interface = importlib.util.find_spec("acados_template") is not None
    return has_interface and "ACADOS_SOURCE_DIR" in os.environ


@dataclass(frozen=True)
class AcadosPlan:
    """A plan, and all stages of the solution that the next solve starts from."""

    inputs: Array  #: (H, m)
    #: by the field of acados, one array a stage
    stages: dict[str, list[Array]]
    inside: float  #: what acados took by its own account [s]


class Acados:
    """Solves tracking problems on the mean of GPs by acados.

    Args:
        gp: The GPs.
        problem: Weights of states and increments, and bounds of the inputs.
        horizon: H.
        method: SQP until ``TOLERANCE``, or one program a call.

    Raises:
        SettingError: acados is not installed, or the problem has what this file does
            not hand on.
    """

    def __init__(
        self,
        gp: GPPosterior,
        problem: Problem,
        horizon: int,
        method: Literal["SQP", "SQP_RTI"] = "SQP",
    ):
        if not installed():
            raise SettingError("peers", MISSING)
        check_problem(problem)
        self._horizon = horizon
        self._state_dim = problem.state_dim
        self._input_dim = problem.input_dim
        self._method = method
        self._solver = _generate(gp, problem, horizon, method)
        self.inside: list[float] = []

    def __call__(self, instance: Instance, last: AcadosPlan | None) -> AcadosPlan:
        """Plans along a reference, started from the last solution, shifted."""
        self._set_instance(instance)
        if last is None:
            self._start_cold(instance)
        else:
            self._start_warm(last)
        self._solver.solve()
        plan = self._solution()
        self.inside.append(plan.inside)
        return plan

    def _set_instance(self, instance: Instance) -> None:
        """Hands over the first state and the references."""
        solver = self._solver
        first = np.concatenate([instance.state, instance.last])
        solver.set(0, "lbx", first)
        solver.set(0, "ubx", first)
        no_increment = np.zeros(self._input_dim)
        solver.set(0, "yref", no_increment)
        for k in range(1, self._horizon):
            target = np.concatenate([instance.targets[k - 1], no_increment])
            solver.set(k, "yref", target)
        solver.set(self._horizon, "yref", instance.targets[-1])

    def _start_cold(self, instance: Instance) -> None:
        """Starts from the last input and the reference, without multipliers."""
        solver = self._solver
        solver.reset()
        states = np.vstack([instance.state, instance.targets])
        for k, state in enumerate(states):
            solver.set(k, "x", np.concatenate([state, instance.last]))
        for k in range(self._horizon):
            solver.set(k, "u", instance.last)

    def _start_warm(self, last: AcadosPlan) -> None:
        """Starts from the last solution, a stage on; its last stage stands twice."""
        for field, stages in last.stages.items():
            for k, values in enumerate([*stages[1:], stages[-1]]):
                if values.size == stages[k].size:
                    self._solver.set(k, field, values)

    def _solution(self) -> AcadosPlan:
        """Reads the plan and everything that a warm start needs."""
        solver = self._solver
        H = self._horizon
        counts = {"x": H + 1, "u": H, "pi": H, "lam": H + 1}
        stages = {
            field: [solver.get(k, field) for k in range(count)]
            for field, count in counts.items()
        }
        return AcadosPlan(
            inputs=np.array(stages["u"]),
            stages=stages,
            inside=float(solver.get_stats("time_tot")),
        )


def _generate(gp: GPPosterior, problem: Problem, horizon: int, method: str) -> Any:
    """Generates, compiles and loads acados' solver of a problem."""
    acados: Any = importlib.import_module("acados_template")
    n = problem.state_dim
    m = problem.input_dim
    name = f"gp_{method.lower()}_{horizon}"
    ocp = acados.AcadosOcp()
    ocp.model = _model(acados, gp, name)
    ocp.solver_options.N_horizon = horizon
    ocp.solver_options.tf = float(horizon)  # steps of one: costs are not scaled
    _set_cost(ocp.cost, problem, n, m)
    ocp.constraints.x0 = np.zeros(n + m)
    ocp.constraints.idxbu = np.arange(m)
    ocp.constraints.lbu = np.asarray(problem.inputs.lower, dtype=float)
    ocp.constraints.ubu = np.asarray(problem.inputs.upper, dtype=float)

    options = ocp.solver_options
    options.integrator_type = "DISCRETE"
    options.nlp_solver_type = method
    options.hessian_approx = "GAUSS_NEWTON"
    options.qp_solver = "FULL_CONDENSING_HPIPM"
    options.qp_solver_warm_start = 1
    options.qp_solver_iter_max = 100
    options.nlp_solver_max_iter = MAX_ITERATIONS
    options.print_level = 0
    for tolerance in ("stat", "eq", "ineq", "comp"):
        setattr(options, f"nlp_solver_tol_{tolerance}", TOLERANCE)
        setattr(options, f"qp_solver_tol_{tolerance}", QP_TOLERANCE)
    ocp.code_gen_options.ext_fun_compile_flags = COMPILE_FLAGS
    folder = RESULTS / "acados" / name
    folder.mkdir(parents=True, exist_ok=True)
    ocp.code_gen_options.code_export_directory = str(folder)
    return acados.AcadosOcpSolver(ocp, verbose=False)


def _model(acados: Any, gp: GPPosterior, name: str) -> Any:
    """Returns the model (x, u_last), u -> (mean(x, u), u), in scalar operations."""
    n = gp.state_dim
    m = gp.input_dim
    state = casadi.SX.sym("state", n + m)
    input = casadi.SX.sym("input", m)
    model = acados.AcadosModel()
    model.name = name
    model.x = state
    model.u = input
    model.disc_dyn_expr = casadi.vertcat(mean_function(gp)(state[:n], input), input)
    return model


def _set_cost(cost: Any, problem: Problem, n: int, m: int) -> None:
    """Weighs the states after the first one, and the increments of the inputs."""
    state = np.eye(n, n + m)
    increment_by_state = np.hstack([np.zeros((m, n)), -np.eye(m)])
    cost.cost_type_0 = cost.cost_type = cost.cost_type_e = "LINEAR_LS"
    cost.Vx_0 = increment_by_state
    cost.Vu_0 = np.eye(m)
    cost.W_0 = 2 * np.asarray(problem.cost.R)
    cost.yref_0 = np.zeros(m)
    cost.Vx = np.vstack([state, increment_by_state])
    cost.Vu = np.vstack([np.zeros((n, m)), np.eye(m)])
    cost.W = 2 * scipy.linalg.block_diag(problem.cost.Q, problem.cost.R)
    cost.yref = np.zeros(n + m)
    cost.Vx_e = state
    cost.W_e = 2 * np.asarray(problem.cost.terminal)
    cost.yref_e = np.zeros(n)


class Exported:
    """Our controller as compiled C.

    Attributes:
        inside: What each call of C took [s].
    """

    def __init__(self, controller: GPMPC):
        self._compiled = CompiledController(controller)
        self._start = peers.by_controller(self._compiled)
        self.inside: list[float] = []

    def __call__(self, instance: Instance, last: Decision | None) -> Decision:
        """Decides for an instance, from the memory of the last decision."""
        if last is None:
            return self._start(instance, None)
        previous = replace(last, input=instance.last)
        decision = self._compiled.control(instance.belief, instance.reference, previous)
        self.inside.append(decision.timing.solve)
        return decision


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--horizons", type=int, nargs="+", default=[10, 20])
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="processor time of each table [s]"
    )
    parser.add_argument(
        "--starts", nargs="+", choices=["warm", "cold"], default=["warm", "cold"]
    )
    arguments = parser.parse_args()
    if not installed():
        raise SystemExit(MISSING)
    use_one_thread()
    computer = machine()
    rows: list[dict[str, Any]] = []
    sections = [f"{describe(computer)}\n"]
    print(sections[0])
    for horizon in arguments.horizons:
        for section in measure(horizon, arguments.starts, arguments.seconds):
            rows += section
            title = f"H = {horizon}, {section[0]['kind']}, {section[0]['start']}"
            sections.append(f"{title}\n\n{peers.table(section)}\n")
            print(sections[-1], flush=True)
    write_results("peer_acados", rows, machine=computer)
    (RESULTS / "peer_acados.md").write_text("\n".join(sections))


def measure(
    horizon: int, starts: Sequence[str], seconds: float
) -> list[list[dict[str, Any]]]:
    """Measures both at one horizon; a list of rows for each table."""
    gp = trained(peers.TRAJECTORY)
    problem = peers.peers_problem()
    instances = peers.record_instances(gp, problem, horizon, peers.STEPS)
    rival = Acados(gp, problem, horizon)
    real_time = Acados(gp, problem, horizon, method="SQP_RTI")
    ours = peers.by_controller(_controller(gp, problem, horizon, iterations=50))
    controller = _controller(gp, problem, horizon, iterations=1)
    one_program = peers.by_controller(controller)
    in_c = Exported(controller)
    converged: peers.Cases = {peers.OWN: lambda: ours, RIVAL: lambda: rival}
    programs: peers.Cases = {
        peers.OWN: lambda: one_program,
        IN_C: lambda: in_c,
        "acados, real-time iteration": lambda: real_time,
    }
    tables = [("converged", start, converged, rival) for start in starts]
    tables.append(("one program a step", "warm", programs, real_time))
    sections = []
    for kind, start, cases, solver in tables:
        solver.inside.clear()
        rows = peers.measure(
            cases, gp, problem, instances, seconds, cold=start == "cold"
        )
        rows[-1]["inside"] = 1e3 * float(np.median(solver.inside))
        for row in rows:
            if row["what"] == IN_C:
                row["inside"] = 1e3 * float(np.median(in_c.inside))
        label = {"kind": kind, "start": start, "H": horizon}
        sections.append([label | row for row in rows])
    return sections


def _controller(
    gp: GPPosterior, problem: Problem, horizon: int, iterations: int
) -> GPMPC:
    """Returns our controller on the mean."""
    return GPMPC(
        gp,
        Linearization(),
        problem,
        horizon,
        HOVER,
        prediction=PredictionSettings(covariance="none"),
        iterations=iterations,
        tolerance=OURS,
    )


if __name__ == "__main__":
    main()
