"""What one step through the GPs costs.

Exact moments, linearised, mean, with Jacobians, beside torch and GPyTorch.

    .venv/bin/python -m benchmarks.gp [--sizes 10 50 100 189 500 1000 2000] [--seconds
    2] [--torch-jacobian-up-to 500]

One process, one thread, processor time. Six outputs, six states and three inputs; at
each size all calls that compute one quantity take turns on one posterior, ours first.
Above ``--torch-jacobian-up-to`` points torch's reverse mode through the closed form is
left out (it keeps all N x N products of the 21 pairs). Beside the times stands the
largest relative difference of a result from ours. Writes
``outputs/benchmarks/gp.json``.
"""

import argparse
import time
from collections.abc import Callable

import gpytorch
import numpy as np
import torch

from benchmarks.timing import (
    describe,
    machine,
    markdown_table,
    time_interleaved,
    write_results,
)
from gpmpc import _kernels as kernels
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior, exact_inference, to_gpytorch
from gpmpc.propagation._moments import moments

STATES = 6
INPUTS = 3
Group = dict[str, Callable[[], list | tuple]]


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[10, 50, 100, 189, 500, 1000, 2000]
    )
    parser.add_argument(
        "--seconds",
        type=float,
        default=2.0,
        help="processor time of a group and size [s]",
    )
    parser.add_argument("--torch-jacobian-up-to", type=int, default=500)
    arguments = parser.parse_args()
    torch.set_default_dtype(torch.float64)
    computer = machine()
    results = []
    began = time.perf_counter()
    gps = posterior(8).packed
    uncertain_state = belief()
    u = np.zeros(INPUTS)
    mu = uncertain_state.mean.numpy()[None]
    S = uncertain_state.covariance.numpy()[None]
    kernels.linearize_gps(gps, mu, u[None], False, np.zeros(STATES), False)
    kernels.expand_gps(gps, mu, u[None])
    kernels.gp_moments(gps, mu, S, u[None], derivatives=True)
    first = time.perf_counter() - began
    print(
        f"{describe(computer)}\n"
        f"first calls of the three kernels: {first:.2f} s (compiled, or read from the "
        "cache)\n"
    )
    for size in arguments.sizes:
        gp = posterior(size)
        control = torch.linspace(-0.3, 0.3, INPUTS)
        rows = []
        for group in linearisation_groups(
            gp, belief(), control, size <= arguments.torch_jacobian_up_to
        ):
            own = next(iter(group))
            times = time_interleaved(group, arguments.seconds)
            values = {name: call() for name, call in group.items()}
            for name, samples in times.items():
                row = (
                    {"N": size, "what": name}
                    | samples.summary()
                    | {"ratio": samples.over(times[own])}
                )
                rows.append(row | {"difference": difference(values[name], values[own])})
        keys = ("what", "median", "p99", "ratio", "difference", "samples")
        header = (
            f"N = {size}",
            "ms, median",
            "99 %",
            "times ours",
            "difference",
            "calls",
        )
        print(
            markdown_table(header, [[row[key] for key in keys] for row in rows]),
            "\n",
            flush=True,
        )
        results += rows
    write_results(
        "gp", results, machine=computer, first_calls=first, states=STATES, inputs=INPUTS
    )


def posterior(size: int) -> GPPosterior:
    """Builds six GPs on smooth functions of nine inputs."""
    generator = torch.Generator().manual_seed(size)
    features = 4 * torch.rand(size, STATES + INPUTS, generator=generator) - 2
    targets = torch.stack(
        [
            torch.sin(features[:, a]) + features[:, -1] * features[:, a - 1]
            for a in range(STATES)
        ],
        1,
    )
    scales = 2 + 2 * torch.rand(STATES, STATES + INPUTS, generator=generator)
    signal = 1 + torch.rand(STATES, generator=generator)
    return GPPosterior.from_hyperparameters(
        features, targets, scales, signal, 1e-3 * signal, INPUTS
    )


def belief() -> Gaussian:
    """Builds a belief near the middle of the data with standard deviations near 0.3."""
    root = (
        0.3
        * torch.randn(STATES, STATES, generator=torch.Generator().manual_seed(1))
        / STATES**0.5
    )
    return Gaussian(
        torch.linspace(-0.5, 0.5, STATES), root @ root.T + 0.01 * torch.eye(STATES)
    )


def linearisation_groups(
    gp: GPPosterior, belief: Gaussian, control: torch.Tensor, reverse_mode: bool
) -> list[Group]:
    """Builds the calls that predict one step, grouped by what they compute.

    Args: gp: The GPs. belief: Where; points take its mean. control: The input (m,).
        reverse_mode: Includes torch's reverse mode through the closed form of the
        moments, which keeps all N x N products of all pairs of outputs.
    """
    n = gp.state_dim
    packed = gp.packed
    moments_input = (
        belief.mean.numpy()[None],
        belief.covariance.numpy()[None],
        control.numpy()[None],
    )
    mu, _, u = moments_input
    query = torch.cat([belief.mean, control])

    def by_torch(mean, covariance, control):
        return moments(gp, Gaussian(mean, covariance), control)[:2]

    def jacobian_by_torch():
        dM, dV = torch.func.jacrev(by_torch, argnums=(0, 1, 2))(
            belief.mean, belief.covariance, control
        )
        return [
            dM[0],
            (dM[1] + dM[1].mT) / 2,
            dM[2],
            dV[0],
            (dV[1] + dV[1].mT) / 2,
            dV[2],
        ]

    def jacobian():
        d = kernels.gp_moments(packed, *moments_input, derivatives=True)
        return [part[0] for part in (d.J, d.dM_dS, d.dM_du, d.dV_dmu, d.dV_dS, d.dV_du)]

    frozen = to_gpytorch(gp).requires_grad_(False)
    trained = to_gpytorch(gp)  # as it comes from training

    def by_gpytorch():
        with (
            exact_inference(),
            gpytorch.settings.skip_posterior_variances(),
        ):  # the mean alone, from its cache
            return torch.autograd.functional.jacobian(
                lambda x: frozen(x[None]).mean[:, 0], query
            ).split(n, dim=1)

    def by_gpytorch_as_usual():
        return torch.autograd.functional.jacobian(
            lambda x: trained(x[None]).mean[:, 0], query
        ).split(n, dim=1)

    def by_jacrev():
        adds = torch.eye(n, len(query), dtype=query.dtype) * (
            gp.predicts == "difference"
        )
        whole = torch.func.jacrev(lambda x: gp.predict(x[:n], x[n:]).mean)(query)
        return (whole - adds).split(n, dim=1)

    zeros = np.zeros(gp.output_dim)
    groups: list[Group] = [
        {
            "moments": lambda: [
                part[0] for part in kernels.gp_moments(packed, *moments_input)[:2]
            ],
            "moments, torch": lambda: by_torch(belief.mean, belief.covariance, control),
        },
        {"moments with Jacobians": jacobian},
        {
            "moments, diagonal": lambda: kernels.gp_moments(
                packed, *moments_input, diagonal=True
            )[:2]
        },
        {
            "diagonal with Jacobians": lambda: kernels.gp_moments(
                packed, *moments_input, diagonal=True, derivatives=True
            )
        },
        {"linearised": lambda: kernels.expand_gps(packed, mu, u)},
        {
            "mean with Jacobian": lambda: [
                part[0]
                for part in kernels.linearize_gps(packed, mu, u, False, zeros, False)[
                    1:3
                ]
            ],
            "mean with Jacobian, torch jacrev": by_jacrev,
            "mean with Jacobian, GPyTorch, frozen": by_gpytorch,
            "mean with Jacobian, GPyTorch": by_gpytorch_as_usual,
        },
    ]
    if reverse_mode:
        groups[1]["moments with Jacobians, torch jacrev"] = jacobian_by_torch
    return groups


def difference(result, reference) -> float:
    """Returns the largest difference of arrays, relative to their largest entries."""
    pairs = [
        (np.asarray(a), np.asarray(b)) for a, b in zip(result, reference, strict=True)
    ]
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in pairs)


if __name__ == "__main__":
    main()
