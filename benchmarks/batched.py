"""How many trials a second fly together, and one at a time.

    .venv/bin/python -m benchmarks.batched [--device cuda] [--sizes 10 50 189] [--trials
    1 10 50 200] [--steps 3]

The quadrotor's translational subsystem with the plant in the loop, H = 10. *alone*:
``closed_loop``, a trial after the other, the model in host memory (compiled loops).
*together*: ``closed_loops`` with the model on ``--device``; on the CPU that is the same
compiled loops, asked for all trials at once. *torch*: the same by the torch expressions
that answer on a GPU, here on the CPU. *mean* and *linearised* are the ``trajectory``
form with H stages a step; *moment-matched* is the paper's form with one exact Jacobian
a step.

One process, one thread on the host, in turns; process time, on a GPU wall time. Trials
alone are independent: no more than ``--alone`` of them are flown and their time is
scaled. Ratios are paired; above 1 the crowd is faster. Writes
``outputs/benchmarks/batched-DEVICE.json``.
"""

import argparse
import time
from contextlib import nullcontext

import numpy as np
import torch

from benchmarks.quadrotor import HOVER, NOISE, OUTER, TRAJECTORIES, problem, trained
from benchmarks.timing import write_results
from gpmpc.gp import GPPosterior, backend
from gpmpc.mpc import GPMPC, PredictionSettings
from gpmpc.propagation import Linearization, MomentMatching
from gpmpc.simulation import closed_loop, closed_loops
from gpmpc.trajectories import states_along

HORIZON = 10
# T N^2 of exact moments above which torch on the CPU is left out: minutes a flight
TORCH_LIMIT = 2_000_000
MODES = {
    "mean": {
        "propagator": Linearization(),
        "prediction": PredictionSettings(covariance="none"),
    },
    "linearised": {"propagator": Linearization(), "prediction": PredictionSettings()},
    "moment-matched": {
        "propagator": MomentMatching(),
        "prediction": PredictionSettings("velocity", "full"),
    },
}


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--modes", choices=MODES, nargs="+", default=list(MODES))
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 50, 189])
    parser.add_argument("--trials", type=int, nargs="+", default=[1, 10, 50, 200])
    parser.add_argument("--steps", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--alone", type=int, default=10)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    results = []
    print(
        "trials a second (median); over alone: median of paired ratios, and its least"
    )
    print(
        f"{'':16}{'N':>5}{'T':>5}{'alone':>10}{'together':>10}{'torch':>10}"
        f"{'over alone: together':>24}{'torch':>16}"
    )
    for name in arguments.modes:
        for size in arguments.sizes:
            gp = trained("elliptical", size=size)
            for trials in arguments.trials:
                results.append(
                    {"mode": name, "size": size, "trials": trials}
                    | measured(gp, MODES[name], trials, arguments)
                )
                show(results[-1])
    meta = {"device": arguments.device, "horizon": HORIZON, "steps": arguments.steps}
    if arguments.device != "cpu":
        meta["device_name"] = torch.cuda.get_device_name(arguments.device)
    write_results(f"batched-{arguments.device.replace(':', '')}", results, **meta)


def measured(
    gp: GPPosterior, mode: dict, trials: int, arguments: argparse.Namespace
) -> dict:
    """Trials a second and ratios to those alone at one number of trials."""
    states = states_along(
        TRAJECTORIES["elliptical"], np.arange(arguments.steps + HORIZON + 1.0)
    )
    flight = {
        "references": states,
        "initial": states[0],
        "steps": arguments.steps,
        "noise": NOISE,
    }
    host_controller = GPMPC(
        gp, problem=problem(), horizon=HORIZON, initial_input=HOVER, **mode
    )
    device_controller = host_controller
    if arguments.device != "cpu":
        gp_on_device = gp.to(arguments.device)
        device_controller = GPMPC(
            gp_on_device,
            problem=problem(),
            horizon=HORIZON,
            initial_input=HOVER,
            **mode,
        )

    def alone() -> float:
        flown = range(min(trials, arguments.alone))
        for seed in flown:
            closed_loop(OUTER, host_controller, **flight, seed=seed)
        return trials / len(flown)

    def together(choice: str = "auto") -> float:
        with nullcontext() if choice == "auto" else backend(choice):
            flown = closed_loops(OUTER, device_controller, **flight, seeds=trials)
        errors = {trial.error for trial in flown if trial.error}
        if errors:
            raise SystemExit(f"a flight failed: {errors}")
        return 1.0

    ways = {"alone": alone, "together": together}
    exact = isinstance(mode["propagator"], MomentMatching)
    if arguments.device == "cpu" and not (
        exact and trials * len(gp) ** 2 > TORCH_LIMIT
    ):
        ways["torch"] = lambda: together("torch")
    clock = time.process_time if arguments.device == "cpu" else time.perf_counter
    seconds = {name: [] for name in ways}
    for repeat in range(arguments.repeats + 1):
        for name, way in ways.items():
            began = clock()
            share = way()
            if repeat:  # the first compiles, or loads
                seconds[name].append((clock() - began) * share)
    samples = {name: np.array(values) for name, values in seconds.items()}
    ratios = {
        name: samples["alone"] / values
        for name, values in samples.items()
        if name != "alone"
    }
    return {
        "trials_per_second": {
            name: trials / float(np.median(values)) for name, values in samples.items()
        },
        "over_alone": {
            name: float(np.median(values)) for name, values in ratios.items()
        },
        "over_alone_least": {
            name: float(values.min()) for name, values in ratios.items()
        },
    }


def show(result: dict) -> None:
    """One row of the table."""
    row = f"{result['mode']:16}{result['size']:5}{result['trials']:5}"
    for name in ("alone", "together", "torch"):
        row += f"{result['trials_per_second'].get(name, np.nan):10.1f}"
    for name, width in (("together", 14), ("torch", 6)):
        middle, least = (
            result[key].get(name, np.nan) for key in ("over_alone", "over_alone_least")
        )
        row += f"{middle:{width + 4}.2f} ({least:4.2f})"[: width + 12]
    print(row, flush=True)


if __name__ == "__main__":
    main()
