"""What memory a control step takes.

Peak resident set of a fresh process, and what its steps allocate once it runs.

    .venv/bin/python -m benchmarks.memory [--size 2000] [--horizon 20]

A posterior of six GPs over ``size`` points is written to a file; a process of its own
then loads it and steers with the ``trajectory`` form, mean only and zero-order.
``peak`` is the operating system's count over the whole life of that process, libraries
included (Linux). Of the steady state, after the first steps: the largest peak of what
Python and NumPy allocate during a step (tracemalloc), and how far the resident set rose
above where it was before (which sees compiled code and torch too). The model is as
large as its Cholesky factors. Writes ``outputs/benchmarks/memory.json``.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import tracemalloc
from pathlib import Path

import numpy as np

# steps before the steady state, and in it
WARM = 5
STEADY = 20
MIB = 2.0**20


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=2000)
    parser.add_argument("--horizon", type=int, default=20)
    parser.add_argument(
        "--child", nargs=2, metavar=("FILE", "COVARIANCE"), help=argparse.SUPPRESS
    )
    arguments = parser.parse_args()
    if arguments.child:
        print(json.dumps(flown(*arguments.child, arguments.horizon)))
        return
    results = []
    with tempfile.TemporaryDirectory() as folder:
        model = Path(folder) / "model.safetensors"
        from benchmarks.floor import posterior  # loads torch
        from gpmpc.gp import save_posterior

        save_posterior(posterior(arguments.size), model)
        for covariance in ("none", "zero_order"):
            command = [
                sys.executable,
                "-m",
                "benchmarks.memory",
                "--horizon",
                str(arguments.horizon),
                "--child",
                str(model),
                covariance,
            ]
            for _ in range(
                2
            ):  # the first may have to compile, which is not a step's memory
                answer = subprocess.run(
                    command, check=True, capture_output=True, text=True
                ).stdout
            result = {"N": arguments.size, "horizon": arguments.horizon} | json.loads(
                answer
            )
            results.append(result)
            print(
                f"N = {arguments.size}, H = {arguments.horizon}, {covariance}: peak "
                f"{result['peak_mib']:.0f} MiB "
                f"(libraries {result['libraries_mib']:.0f}, model "
                f"{result['model_mib']:.0f}); steady state: largest "
                f"allocations {result['steady_mib']:.2f} MiB, resident set "
                f"+{result['risen_mib']:.2f} MiB"
            )
    from benchmarks.timing import write_results

    write_results("memory", results)


def flown(file: str, covariance: str, horizon: int) -> dict:
    """Loads the model and makes steps, in this process."""
    import torch

    from gpmpc.gaussian import Gaussian
    from gpmpc.gp import load_posterior
    from gpmpc.mpc import GPMPC, Box, PredictionSettings, Problem, Reference, Tracking
    from gpmpc.propagation import Linearization

    torch.set_num_threads(1)
    libraries = resident()
    gp = load_posterior(file)
    n = gp.state_dim
    m = gp.input_dim
    box = {"inputs": Box([-1] * m, [1] * m)}
    problem = Problem(Tracking([1] * n, [1] * m), **box)
    settings = PredictionSettings(covariance=covariance)
    controller = GPMPC(
        gp, Linearization(), problem, horizon, [0.0] * m, prediction=settings
    )
    reference = Reference(np.zeros((horizon + 1, n)))
    eye = torch.eye(n, dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    decision = None
    steady = 0
    risen = 0.0
    peak = 0.0
    for step in range(WARM + 2 * STEADY):
        belief = Gaussian(
            0.1 * torch.randn(n, generator=generator, dtype=torch.float64), 1e-4 * eye
        )
        traced = (
            WARM <= step < WARM + STEADY
        )  # tracing itself takes memory: the resident set is looked at without
        if traced:
            tracemalloc.start()
        elif step >= WARM:
            peak = max(peak, resident("VmHWM"))
            forget_peak()
        before = resident()
        decision = controller.control(belief, reference, decision)
        if traced:
            steady = max(steady, tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        elif step >= WARM:
            risen = max(risen, resident("VmHWM") - before)
    return {
        "covariance": covariance,
        "status": decision.status.name,
        "peak_mib": max(peak, resident("VmHWM")),
        "libraries_mib": libraries,
        "model_mib": gp.cholesky.nbytes / MIB,
        "steady_mib": steady / MIB,
        "risen_mib": risen,
    }


def resident(entry: str = "VmRSS") -> float:
    """The resident set, or its peak (``VmHWM``) [MiB]."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next(
        float(line.split()[1]) / 1024 for line in lines if line.startswith(entry)
    )


def forget_peak() -> None:
    """Starts the resident set's peak anew."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


if __name__ == "__main__":
    main()
