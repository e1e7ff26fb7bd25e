"""Solves the nonlinear problem of a control step to one common accuracy.

CasADi, do-mpc and GPyTorch stand beside it.

    .venv/bin/python -m benchmarks.peers [--horizons 10 20] [--alone 50] [--seconds 20]
    [--starts warm cold]

The quadrotor follows the Lorenz path with the plant in the loop; GPs of 189 transitions
of a dithered flight (n = 6, m = 3), weights of one on positions, velocities and
increments of the inputs, bounds of the inputs that are active in half of the steps. The
instances of that flight (state, reference, last input) are solved by every solver in
turns, one instance per call, in one process on one thread; times are processor time.

* ``converged``: a KKT point of the nonlinear problem on the GPs' mean. Every plan is
  judged by one function (``benchmarks.kkt``); solvers stop by tests of their own, whose
  tolerances are the loosest powers of ten that brought nine plans of ten within
  ``ACCURACY``; the share that is within is printed. *Warm* solvers start from their own
  last solution, shifted where the library allows it, *cold* ones from the last input
  and the reference.
* ``one program``: one quadratic program per step from the last plan (real-time
iteration), with our QP solver and DAQP.

Every solver solves ten instances in a row, then the next one the same ten. ``times
ours`` is the median ratio of paired calls after the first of each ten, as in a loop of
its own; ``times ours, evicted`` that of the first ones, which find the caches as
another solver left them. Writes ``outputs/benchmarks/peers.json`` and ``peers.md``.
"""

import argparse
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks import peer_daqp, peer_do_mpc
from benchmarks.kkt import Instance, kkt_residual
from benchmarks.peer_casadi import Casadi
from benchmarks.peer_gpytorch import GPyTorchSlsqp
from benchmarks.quadrotor import HOVER, problem, recorded, trained
from benchmarks.timing import (
    RESULTS,
    WARM_UP_CALLS,
    describe,
    machine,
    markdown_table,
    time_interleaved,
    use_one_thread,
    write_results,
)
from gpmpc.gp import GPPosterior
from gpmpc.mpc import GPMPC, Controller, Decision, PredictionSettings, Problem, Timing
from gpmpc.propagation import Linearization
from gpmpc.status import Status

TRAJECTORY = "lorenz"
STEPS = 150
ACCURACY = 1e-5  # of the common KKT residual
# tolerances of the solvers' own tests
IPOPT = 1e-7
SQP = 1e-4
FATROP = 1e-7
SLSQP = 1e-12
OURS = 1e-3
IN_A_ROW = 10
MIN_ROUNDS = 2  # where a solver takes seconds
SLOW_ABOVE = 10  # horizon above which SLSQP is left out: minutes
OWN = "gpmpc, iterated"

Solve = Callable[[Instance, Any], Any]
"""From an instance and the last solution (None at first) to a solution.

A solution has ``inputs`` (H, m).
"""
Cases = dict[str, Callable[[], Solve] | None]
"""Solvers by name; None where the package is not installed."""


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--horizons", type=int, nargs="*", default=[1, 10, 20])
    parser.add_argument(
        "--alone", type=int, nargs="*", default=[50], help="horizons for gpmpc only"
    )
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="processor time of each table [s]"
    )
    parser.add_argument(
        "--starts", nargs="+", choices=["warm", "cold"], default=["warm", "cold"]
    )
    arguments = parser.parse_args()
    use_one_thread()
    computer = machine()
    rows = []
    sections = []
    gp = trained(TRAJECTORY)
    task = peers_problem()
    print(f"{describe(computer)}\n")
    for horizon in (*arguments.horizons, *arguments.alone):
        instances = record_instances(gp, task, horizon, STEPS)
        tables = {
            ("converged", start): converged(gp, task, horizon)
            for start in arguments.starts
        }
        if horizon in arguments.alone:
            tables = {key: {OWN: cases[OWN]} for key, cases in tables.items()}
        elif horizon <= SLOW_ABOVE:
            tables["converged by torch", "warm"] = slow(gp, task, horizon)
        tables["one program", "warm"] = one_program(gp, task, horizon)
        for (kind, start), cases in tables.items():
            measured_rows = measure(
                cases, gp, task, instances, arguments.seconds, cold=start == "cold"
            )
            sections.append(
                f"H = {horizon}, {kind}, started {start}\n\n{table(measured_rows)}\n"
            )
            print(sections[-1], flush=True)
            rows += [
                {"kind": kind, "start": start, "H": horizon} | row
                for row in measured_rows
            ]
    write_results("peers", rows, machine=computer)
    (RESULTS / "peers.md").write_text("\n".join([f"{describe(computer)}\n", *sections]))


def peers_problem() -> Problem:
    """Builds weights and bounds of the comparison."""
    return problem(thrust=(6.0, 8.0), tilt=0.05)


def record_instances(
    gp: GPPosterior, task: Problem, horizon: int, steps: int
) -> list[Instance]:
    """Returns the optimal control problems of a flight with one program a step."""
    flown = recorded(
        GPMPC(
            gp,
            Linearization(),
            task,
            horizon,
            HOVER,
            prediction=PredictionSettings(covariance="none"),
        ),
        TRAJECTORY,
        steps,
    )
    before = [
        np.array(HOVER) if step.previous is None else step.previous.input
        for step in flown
    ]
    return [
        Instance(step.belief, step.reference, last)
        for step, last in zip(flown, before, strict=True)
    ]


def converged(gp: GPPosterior, task: Problem, horizon: int) -> Cases:
    """Builds the solvers of the nonlinear problem."""

    def ours() -> Solve:
        settings = PredictionSettings(covariance="none")
        problem = task, horizon, HOVER
        return by_controller(
            GPMPC(
                gp, Linearization(), *problem, settings, iterations=50, tolerance=OURS
            )
        )

    def do_mpc() -> Solve:
        return peer_do_mpc.DoMpc(gp, task, horizon, IPOPT)

    cases: Cases = {
        OWN: ours,
        "CasADi, IPOPT, exact Hessian": lambda: Casadi(
            gp, task, horizon, "ipopt", IPOPT
        ),
        "CasADi, IPOPT, Gauss-Newton": lambda: Casadi(
            gp, task, horizon, "ipopt, gauss-newton", IPOPT
        ),
        "CasADi, sqpmethod + HPIPM": lambda: Casadi(
            gp, task, horizon, "sqpmethod", SQP
        ),
        "CasADi, FATROP": lambda: Casadi(gp, task, horizon, "fatrop", FATROP),
        "do-mpc, IPOPT": do_mpc if peer_do_mpc.installed() else None,
    }
    return cases


def slow(gp: GPPosterior, task: Problem, horizon: int) -> Cases:
    """Builds what takes seconds, with ours beside it."""
    ours = converged(gp, task, horizon)
    return {
        OWN: ours[OWN],
        "GPyTorch autograd, SLSQP": lambda: GPyTorchSlsqp(gp, task, horizon, SLSQP),
    }


def one_program(gp: GPPosterior, task: Problem, horizon: int) -> Cases:
    """Builds the real-time iterations, with our QP solver and with DAQP."""
    cases: Cases = {}
    for name, covariance in (("mean only", "none"), ("zero order", "zero_order")):
        settings: dict[str, Any] = {
            "prediction": PredictionSettings(covariance=covariance)
        }
        common = (gp, Linearization(), task, horizon, HOVER)
        cases[f"gpmpc, {name}"] = lambda a=common, s=settings: by_controller(
            GPMPC(*a, **s)
        )
        daqp = (
            settings | {"solver": peer_daqp.Daqp()} if peer_daqp.installed() else None
        )
        cases[f"gpmpc, {name}, DAQP inside"] = daqp and (
            lambda a=common, s=daqp: by_controller(GPMPC(*a, **s))
        )
    return cases


def by_controller(controller: Controller) -> Solve:
    """Wraps a controller of this package as a solver."""

    def solve(instance: Instance, last: Decision | None) -> Decision:
        return controller.control(
            instance.belief, instance.reference, _previous(instance, last)
        )

    return solve


def _previous(instance: Instance, last: Decision | None) -> Decision:
    """The last decision with the input that was applied.

    Without one, no plan but an input.
    """
    if last is not None:  # ``dataclasses.replace`` takes as long as a program
        return Decision(
            input=instance.last,
            inputs=last.inputs,
            means=last.means,
            covariances=last.covariances,
            status=last.status,
            iterations=0,
            timing=Timing(0.0, 0.0, 0.0),
            solution=last.solution,
        )
    H, n = instance.targets.shape
    inputs = np.tile(instance.last, (H, 1))
    nothing = np.full((H + 1, n, n), np.nan)
    return Decision(
        input=inputs[0],
        inputs=inputs,
        means=nothing[:, 0],
        covariances=nothing,
        status=Status.ITERATION_LIMIT,
        iterations=0,
        timing=Timing(0.0, 0.0, 0.0),
    )


class Run:
    """Solves the next instance with every call, warm or cold.

    Attributes:
        plans: Number of the instance and the plan (H, m), in the order of the calls.
    """

    def __init__(self, solve: Solve, instances: Sequence[Instance], cold: bool = False):
        self._solve = solve
        self._instances = instances
        self._cold = cold
        self._last = None
        self.plans: list[tuple[int, np.ndarray]] = []

    def __call__(self) -> None:
        """Solves one instance.

        After the last one comes the first again, without a last solution.
        """
        number = len(self.plans) % len(self._instances)
        last = self._last if number and not self._cold else None
        self._last = self._solve(self._instances[number], last)
        self.plans.append((number, self._last.inputs))


def measure(
    cases: Cases,
    gp: GPPosterior,
    task: Problem,
    instances: Sequence[Instance],
    seconds: float,
    cold: bool,
) -> list[dict]:
    """Times the solvers in turns and judges their plans."""
    runs = {
        name: Run(make(), instances, cold)
        for name, make in cases.items()
        if make is not None
    }
    samples = time_interleaved(runs, seconds, min_rounds=MIN_ROUNDS, in_a_row=IN_A_ROW)
    first, later = (
        {name: times.split(IN_A_ROW)[part] for name, times in samples.items()}
        for part in (0, 1)
    )
    rows = []
    for name, make in cases.items():
        if make is None:
            rows.append({"what": name, "note": peer_do_mpc.MISSING})
            continue
        residuals = [
            kkt_residual(gp, task, instances[k], plan)
            for k, plan in runs[name].plans[WARM_UP_CALLS:]
        ]
        ours = (
            OWN if OWN in cases else name.removesuffix(", DAQP inside")
        )  # or its own controller
        row = (
            {"what": name}
            | later[name].summary()
            | {"evicted": 1e3 * first[name].median}
        )
        row |= {
            "times_ours": later[name].over(later[ours]),
            "times_ours_evicted": first[name].over(first[ours]),
        }
        row |= {"kkt": float(np.median(residuals)), "kkt_worst": float(max(residuals))}
        row["within"] = float((np.array(residuals) <= ACCURACY).mean())
        rows.append(row)
    return rows


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Formats the rows of one comparison."""
    columns = {
        "what": "",
        "median": "ms, median",
        "p99": "99 %",
        "inside": "ms, inside",
        "evicted": "evicted",
        "times_ours": "times ours",
        "times_ours_evicted": "times ours, evicted",
        "kkt": "KKT, median",
        "kkt_worst": "worst",
        "within": f"within {ACCURACY:g}",
        "samples": "calls",
        "note": "note",
    }
    shown = [key for key in columns if any(key in row for row in rows)]
    cells = [
        [
            f"{row[key]:.0%}" if key == "within" and key in row else row.get(key)
            for key in shown
        ]
        for row in rows
    ]
    return markdown_table([columns[key] for key in shown], cells)


if __name__ == "__main__":
    main()
