"""How time and memory of training grow with the number of points.

Exact GPs to 5000, sparse ones to 20000.

    .venv/bin/python -m benchmarks.training_scale                      # about ten
    minutes .venv/bin/python -m benchmarks.training_scale --quick              # to 1000
    points; a minute .venv/bin/python -m benchmarks.training_scale --threads 2

One output of nine features; every case in a process of its own, whose peak resident set
less that after the imports is the memory. Times are processor time (of all threads
together, as many as ``--threads``): of one evaluation of the likelihood with its
gradient, and of whole trainings with the error they end with. Beside it GPyTorch's own
route, exact (automatic differentiation through Cholesky) and sparse
(``InducingPointKernel``), to the sizes that are bearable; the ratio, its time over
ours, is from taking turns in one process. Written to ``--out``: training_scale.json and
training_scale.png.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

EXACT = "exact"
GPYTORCH = "GPyTorch"
SPARSE = "sparse"
GPYTORCH_SPARSE = "GPyTorch sparse"
D = 9
NOISE = 0.05
TEST_ROWS = 2000
COLOURS = {EXACT: "C0", GPYTORCH: "C1", SPARSE: "C2", GPYTORCH_SPARSE: "C4"}


def main() -> None:
    """Measures every case in a process of its own; prints, writes and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="to 1000 points")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--minutes", type=float, default=15, help="after them no other case is begun"
    )
    parser.add_argument("--out", type=Path, default=Path("outputs/benchmarks"))
    parser.add_argument("--case", help=argparse.SUPPRESS)
    settings = parser.parse_args()
    if settings.case:
        print(json.dumps(measure(**json.loads(settings.case))))
        return
    environment = dict(os.environ)
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        environment[variable] = str(settings.threads)
    results = []
    left_out = []
    began = time.monotonic()
    print(
        f"{'case':38}{'median [s]':>12}{'p99 [s]':>12}{'ratio':>8}"
        f"{'memory [MB]':>13}{'test RMSE':>11}"
    )
    for case in cases(settings.quick):
        if time.monotonic() - began > 60 * settings.minutes:
            left_out.append(case)
            continue
        command = [
            sys.executable,
            "-m",
            "benchmarks.training_scale",
            "--case",
            json.dumps(case),
        ]
        finished = subprocess.run(
            command, env=environment, check=True, stdout=subprocess.PIPE, text=True
        )
        results.append(case | json.loads(finished.stdout.splitlines()[-1]))
        print(described(results[-1]), flush=True)
    from gpmpc._provenance import provenance

    settings.out.mkdir(parents=True, exist_ok=True)
    meta = provenance() | {
        "threads": settings.threads,
        "load": os.getloadavg()[0],
        "left out": left_out,
    }
    (settings.out / "training_scale.json").write_text(
        json.dumps({"meta": meta, "results": results}, indent=1)
    )
    draw(results, settings.out / "training_scale.png", settings.threads)
    if left_out:
        print(
            f"{len(left_out)} cases left out after {settings.minutes:g} minutes, the "
            "largest"
        )
    print(f"written to {settings.out}")


def cases(quick: bool) -> list[dict]:
    """What is measured: evaluations, trainings, a posterior; the smallest first."""
    sizes = (100, 200, 500, 1000)
    many = (1000,)
    if not quick:
        sizes = (*sizes, 2000, 5000)
        many = (*many, 5000, 20000)
    cases = [{"what": "evaluation", "route": EXACT, "size": size} for size in sizes]
    cases += [
        {"what": "evaluation", "route": GPYTORCH, "size": size}
        for size in sizes
        if size <= 2000
    ]
    cases += [
        {"what": "evaluation", "route": SPARSE, "size": size, "inducing": M}
        for M in (200, 500)
        for size in many
    ]
    cases += [
        {"what": "evaluation", "route": GPYTORCH_SPARSE, "size": size, "inducing": 200}
        for size in many
    ]
    cases += [{"what": "training", "route": EXACT, "size": size} for size in sizes]
    cases += [
        {"what": "training", "route": SPARSE, "size": size, "inducing": 200}
        for size in many
    ]
    return [
        *sorted(cases, key=lambda case: case["size"]),
        {"what": "posterior", "route": EXACT, "size": sizes[-1]},
    ]


def measure(what: str, route: str, size: int, inducing: int = 0) -> dict:
    """One case, in this process."""
    import gpytorch  # noqa: F401  # before the memory is read
    import torch

    import gpmpc.gp  # noqa: F401

    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    x, y = data(size)
    imported = peak_megabytes()
    if what == "posterior":
        return posterior(x, y, imported)
    if what == "training":
        return training(route, x, y, inducing, imported)
    evaluate = evaluation(route, x, y, inducing)
    imported = peak_megabytes()  # what is loaded at first use is no matrix
    evaluate()
    count = repeats(evaluate)
    summary = {"megabytes": peak_megabytes() - imported}
    if route in (EXACT, SPARSE):
        return quantiles([seconds_of(evaluate) for _ in range(count)]) | summary
    ours = evaluation(EXACT if route == GPYTORCH else SPARSE, x, y, inducing)
    ours()
    turns = [(seconds_of(evaluate), seconds_of(ours)) for _ in range(count)]
    ratio = quantiles([theirs / own for theirs, own in turns])
    return (
        quantiles([theirs for theirs, _ in turns])
        | {"ratio": ratio["median"], "ratio p99": ratio["p99"]}
        | summary
    )


def data(size: int, seed: int = 0):
    """x~ (N, 9) and one target (N, 1) with noise."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(size, D, generator=generator, dtype=torch.float64)
    return x, function(x) + NOISE * torch.randn(
        size, 1, generator=generator, dtype=torch.float64
    )


def function(x):
    """What is learned (N, 1)."""
    return (x[:, 0].sin() + 0.5 * x[:, 0] * x[:, 1] + 0.3 * (x[:, 2] + x[:, 3]).cos())[
        :, None
    ]


def evaluation(route: str, x, y, inducing: int):
    """A function of nothing.

    The likelihood or bound and its gradient, at one point of the search.
    """
    import numpy as np
    import torch

    from benchmarks.gpytorch_likelihood import GPyTorchLikelihood
    from gpmpc.gp import Hyperparameters
    from gpmpc.gp._likelihood import NegativeLogMarginalLikelihood
    from gpmpc.gp._sparse import collapsed_bound

    theta = np.append(np.linspace(0.5, 1.5, D), [0.5, np.log(30.0)])
    if route == EXACT:
        likelihood = NegativeLogMarginalLikelihood(x.numpy(), y[:, 0].numpy())
        return lambda: likelihood(theta)
    if route == GPYTORCH:
        likelihood = GPyTorchLikelihood(x.numpy(), y[:, 0].numpy())
        return lambda: likelihood(theta)
    scales = torch.from_numpy(np.exp(theta[None, :D]))
    sf2 = torch.tensor([np.exp(1.0)], dtype=torch.float64)
    if route == SPARSE:
        leaves = [
            part.requires_grad_()
            for part in (x[:inducing].clone(), scales, sf2.clone(), sf2 / 900)
        ]

        def bound():
            value = collapsed_bound(leaves[0], x, y, Hyperparameters(*leaves[1:]))
            value.sum().backward()
            return value

        return bound
    return gpytorch_sparse(x, y, inducing, scales, sf2)


def gpytorch_sparse(x, y, inducing: int, scales, sf2):
    """Builds GPyTorch's collapsed bound (SGPR) and its gradient, as documented."""
    import gpytorch
    import torch

    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    likelihood.noise = float(sf2 / 900)

    class Sparse(gpytorch.models.ExactGP):
        def __init__(self):
            super().__init__(x, y[:, 0], likelihood)
            self.mean_module = gpytorch.means.ZeroMean()
            base = gpytorch.kernels.ScaleKernel(
                gpytorch.kernels.RBFKernel(ard_num_dims=D)
            ).double()
            base.base_kernel.lengthscale = scales
            base.outputscale = sf2[0]
            self.covar_module = gpytorch.kernels.InducingPointKernel(
                base, x[:inducing].clone(), likelihood
            )

        def forward(self, z):
            return gpytorch.distributions.MultivariateNormal(
                self.mean_module(z), self.covar_module(z)
            )

    model = Sparse().train()
    bound = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)

    def evaluate():
        model.zero_grad()
        with torch.enable_grad():
            (-bound(model(x), y[:, 0])).backward()

    return evaluate


def training(route: str, x, y, inducing: int, imported: float) -> dict:
    """A whole training of one output, and its error on fresh rows without noise."""
    import torch

    from gpmpc.gp import SparseTrainer, Trainer

    trainer = Trainer() if route == EXACT else SparseTrainer(inducing=inducing)
    begin = time.process_time()
    trained = trainer.fit(x, y, 0, "value")
    seconds = time.process_time() - begin
    megabytes = peak_megabytes() - imported
    queries = data(TEST_ROWS, seed=1)[0].split(100)
    error = torch.cat(
        [trained.posterior.predict(query).mean - function(query) for query in queries]
    )
    return {
        "median": seconds,
        "megabytes": megabytes,
        "evaluations": trained.evaluations,
        "test RMSE": float(error.square().mean().sqrt()),
        "minus log evidence": float(trained.objective[0]),
    }


def posterior(x, y, imported: float) -> dict:
    """Six outputs frozen, linearised and moment-matched: seconds of a second call."""
    import torch

    from gpmpc.gaussian import Gaussian
    from gpmpc.gp import GPPosterior
    from gpmpc.propagation import Linearization, MomentMatching, linearize

    k = 6
    begin = time.process_time()
    size = len(x)
    scales = torch.linspace(2, 4, D, dtype=torch.float64).expand(k, D)
    one = torch.ones(k, dtype=torch.float64)
    gp = GPPosterior.from_hyperparameters(
        x, y.expand(size, k), scales, one, 1e-3 * one, input_dim=3
    )
    summary = {
        "median": time.process_time() - begin,
        "built megabytes": peak_megabytes() - imported,
    }
    belief = Gaussian(x[0, :6], 0.01 * torch.eye(6, dtype=torch.float64))
    for propagator in (Linearization(), MomentMatching()):
        name = type(propagator).__name__
        linearize(propagator, gp, belief, x[0, 6:])
        summary[name] = seconds_of(
            lambda propagator=propagator: linearize(propagator, gp, belief, x[0, 6:])
        )
        summary[f"{name} megabytes"] = peak_megabytes() - imported
    return summary | {"megabytes": peak_megabytes() - imported}


def seconds_of(call) -> float:
    """Processor time of one call."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def repeats(call) -> int:
    """As many calls as take some three seconds, from 3 to 50."""
    return int(min(max(3.0 / max(seconds_of(call), 1e-4), 3), 50))


def quantiles(seconds: list[float]) -> dict[str, float]:
    """Median and 99th percentile."""
    import numpy as np

    return {
        "median": float(np.median(seconds)),
        "p99": float(np.quantile(seconds, 0.99)),
    }


def peak_megabytes() -> float:
    """Of this process so far; Linux counts in KiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def described(result: dict) -> str:
    """One line of the table."""
    name = f"{result['route']} {result['what']}, N = {result['size']}"
    name += f", M = {result['inducing']}" if "inducing" in result else ""
    cells = [
        (result.get("median"), 12, ".4g"),
        (result.get("p99"), 12, ".4g"),
        (result.get("ratio"), 8, ".3g"),
    ]
    cells += [
        (result.get("megabytes"), 13, ".0f"),
        (result.get("test RMSE"), 11, ".3g"),
    ]
    return f"{name:38}" + "".join(
        " " * width if v is None else f"{v:{width}{form}}" for v, width, form in cells
    )


def draw(results: list[dict], path: Path, threads: int) -> None:
    """Time and memory over N."""
    import matplotlib.pyplot as plt

    plt.style.use("gpmpc.plotting.gpmpc")
    figure, (times, memory) = plt.subplots(1, 2, figsize=(9, 5.2))
    lines: dict[tuple, list[dict]] = {}
    for result in results:
        if result["what"] in ("evaluation", "training"):
            lines.setdefault(
                (result["what"], result["route"], result.get("inducing")), []
            ).append(result)
    for (what, route, inducing), line in lines.items():
        label = f"{route}, {what}" + (f", M = {inducing}" if inducing else "")
        marker = {"evaluation": "o", "training": "s"}[what]
        style = ":" if what == "training" else "--" if inducing == 500 else "-"
        look = {
            "color": COLOURS[route],
            "marker": marker,
            "linestyle": style,
            "markersize": 4,
            "label": label,
        }
        x = [one["size"] for one in line]
        times.loglog(x, [one["median"] for one in line], **look)
        if what == "evaluation":
            memory.loglog(x, [max(one["megabytes"], 0.1) for one in line], **look)
    sizes = sorted({one["size"] for one in results if one["route"] == EXACT})
    memory.loglog(
        sizes,
        [8 * size**2 / 2**20 for size in sizes],
        color="C7",
        zorder=0,
        label="one N x N matrix",
    )
    times.set(ylabel=f"processor time [s], {threads} thread(s)", title="time")
    memory.set(ylabel="peak beyond the imports [MB]", title="memory of one evaluation")
    for axis in (times, memory):
        axis.set_xlabel("training points N")
    figure.suptitle(
        "One output of nine features: the likelihood with its gradient, and whole "
        "trainings"
    )
    handles, labels = (
        a + b[-1:]
        for a, b in zip(
            *(x.get_legend_handles_labels() for x in (times, memory)), strict=True
        )
    )
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.savefig(path)


if __name__ == "__main__":
    main()
