"""Times a control step beside a moment-matched Jacobian and nonlinear GP-MPC.

All see the same instances.

    .venv/bin/python -m benchmarks.controllers [--steps 14] [--horizons 1 10 20 50]
    [--rivals 1 10]

One process, one thread, process CPU time, GPs on 189 transitions. Instances are
recorded on a flight with the plant in the loop, with the plans that the one controller
made, and then put to each controller in turns, warm-started from its own last decision,
shifted. ``nonlinear, sqp`` stops at a relative offset of 1e-6 (``gpmpc.mpc``),
``slsqp`` where a round lowers the cost by less than 1e-12 of it; one program of the
convex ones asks for neither. ``cold`` are the same instances without a plan, from the
last input held. ``plain slsqp`` is what comes to mind first: SciPy's SLSQP on the
inputs as they are, from hover, with the same compiled derivatives. ``jacobian`` is one
call of ``differentiate`` with moment matching. Ratios are paired. Writes
``outputs/benchmarks/controllers.json``.
"""

import argparse
import time
from dataclasses import replace

import numpy as np
import torch
from scipy.optimize import minimize

from benchmarks.quadrotor import HOVER, TRAJECTORIES, Asked, problem, recorded, trained
from benchmarks.timing import write_results
from gpmpc.experiments.slsqp import SLSQP
from gpmpc.gp import GPPosterior
from gpmpc.mpc import (
    GPMPC,
    Decision,
    NonlinearGPMPC,
    PredictionSettings,
    Request,
    Timing,
)
from gpmpc.propagation import Linearization, MomentMatching, differentiate
from gpmpc.status import Status

COLD = ", cold"
# [m, m/s] of the belief: the full covariance is differentiated, as in a loop with an
# estimator
STD = 0.01


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--steps",
        type=int,
        default=14,
        help="of the rivals; ten times as many of the convex ones",
    )
    parser.add_argument("--horizons", type=int, nargs="+", default=[1, 10, 20, 50])
    parser.add_argument(
        "--rivals",
        type=int,
        nargs="*",
        default=[1, 10],
        help="horizons at which they fly as well",
    )
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    for trajectory in TRAJECTORIES:
        gp = trained(trajectory)
        for horizon in arguments.horizons:
            convex, rivals = ways(gp, horizon)
            results.append(
                measured(gp, convex, trajectory, horizon, 10 * arguments.steps)
            )
            if horizon in arguments.rivals:
                results.append(
                    measured(gp, rivals, trajectory, horizon, arguments.steps)
                )
    write_results("controllers", results)


def ways(gp: GPPosterior, horizon: int) -> list[dict]:
    """The controllers that are compared, by name.

    The convex ones, and the rivals that take a hundred times as long.

    Whoever comes after a rival finds the caches full of it; so they take turns apart,
    each with the paper's form.
    """
    exact = MomentMatching(process_noise=False)
    task = (problem(), horizon, HOVER)
    paper = {
        "paper's form": GPMPC(
            gp,
            exact,
            *task,
            prediction=PredictionSettings(form="velocity", covariance="full"),
        )
    }
    convex = {
        "trajectory, linearised": GPMPC(gp, Linearization(), *task),
        "trajectory, mean": GPMPC(
            gp,
            Linearization(),
            *task,
            prediction=PredictionSettings(covariance="none"),
        ),
    }
    rivals = {}
    for start in ("", COLD):
        rivals[f"nonlinear, sqp{start}"] = NonlinearGPMPC(
            gp, exact, *task, iterations=300, tolerance=1e-6
        )
        rivals[f"nonlinear, slsqp{start}"] = SLSQP(gp, exact, *task, tolerance=1e-6)
    rivals[f"nonlinear, plain slsqp{COLD}"] = PlainSLSQP(gp, exact, *task)
    return [paper | convex, paper | rivals]


class PlainSLSQP(SLSQP):
    """Minimises the same objective as SciPy's manual shows it."""

    def control(self, belief, reference, previous=None) -> Decision:
        """Minimises from hover, to a millionth of the cost of hovering."""
        began = time.perf_counter()
        request = Request.read(
            self.problem, self.horizon, self.initial_input, belief, reference, previous
        )
        memory = [self.evaluate(np.tile(HOVER, self.horizon), request)]
        start = memory[0].plan
        cost = memory[0].cost

        def at(plan):
            if not np.array_equal(plan, memory[0].plan):
                memory[0] = self.evaluate(plan, request)
            return memory[0]

        box = (
            list(zip(self.problem.inputs.lower, self.problem.inputs.upper, strict=True))
            * self.horizon
        )
        options = {"ftol": 1e-6 * cost, "maxiter": 300}
        gradient = {"jac": lambda U: at(U).gradient, "bounds": box, "options": options}
        result = minimize(lambda U: at(U).cost, start, method="SLSQP", **gradient)
        solution = at(result.x)
        status = Status.SOLVED if result.success else Status.ITERATION_LIMIT
        inputs = result.x.reshape(self.horizon, -1)
        spent = Timing(0.0, 0.0, time.perf_counter() - began)
        return Decision(
            inputs[0],
            inputs,
            solution.means,
            solution.covariances,
            status,
            result.nit,
            spent,
        )


def measured(
    gp: GPPosterior, controllers: dict, trajectory: str, horizon: int, steps: int
) -> dict:
    """Median times [ms] and ratios of some controllers at one horizon."""
    flown: list[Asked] = recorded(
        GPMPC(gp, Linearization(), problem(), horizon, HOVER), trajectory, steps, STD
    )
    exact = MomentMatching()
    milliseconds = {name: [] for name in ["jacobian", *controllers]}
    unsolved = dict.fromkeys(controllers, 0)
    last = dict.fromkeys(controllers)
    for count, step in enumerate(flown):
        input = torch.tensor(step.decision.input)
        spent = {
            "jacobian": _time(
                lambda s=step, u=input: differentiate(exact, gp, s.belief, u)
            )[0]
        }
        for name, controller in controllers.items():
            before = last[name]
            if before is not None and name.endswith(COLD):
                before = replace(
                    before, status=Status.ITERATION_LIMIT
                )  # its input is known, its plan is not to be used
            spent[name], decision = _time(
                lambda c=controller, s=step, p=before: c.control(
                    s.belief, s.reference, p
                )
            )
            unsolved[name] += not decision.status.solved
            last[name] = decision
        if count >= 2:  # what is compiled or loaded at a first call is left out
            for name, seconds in spent.items():
                milliseconds[name].append(seconds)
    times = {name: np.array(seconds) for name, seconds in milliseconds.items()}
    ours = times["paper's form"]
    result = {
        "trajectory": trajectory,
        "horizon": horizon,
        "steps": len(ours),
        "ms_median": {name: 1e3 * float(np.median(t)) for name, t in times.items()},
        "ms_p95": {
            name: 1e3 * float(np.quantile(t, 0.95)) for name, t in times.items()
        },
        "over_jacobian": {
            name: float(np.median(t / times["jacobian"])) for name, t in times.items()
        },
        "over_papers_form": {
            name: float(np.median(t / ours)) for name, t in times.items()
        },
        "unsolved": unsolved,
    }
    print(f"{trajectory}, H = {horizon} ({len(ours)} steps)")
    for name in times:
        row = [
            result[key][name]
            for key in ("ms_median", "ms_p95", "over_jacobian", "over_papers_form")
        ]
        print(
            f"  {name:24}" + "".join(f"{value:10.3f}" for value in row),
            unsolved.get(name, ""),
            flush=True,
        )
    return result


def _time(call) -> tuple[float, object]:
    began = time.process_time()
    answer = call()
    return time.process_time() - began, answer


if __name__ == "__main__":
    main()
