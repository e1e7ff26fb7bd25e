"""Times a control step over training points, horizon and state dimension.

    .venv/bin/python -m benchmarks.steps [--states 6] [--sizes 10 189] [--horizons 1 10
    50] [--caches hot flushed]

A cell is one n, N and H. A flight of coupled pendulums records the beliefs and
references of its steps; the convex controllers then solve these problems in turns, each
warm-started from its own last decision, as in a loop. Beside them stand single
predictions with their derivatives. Processor time of one thread in one process. Writes
``outputs/benchmarks/steps.json``, ``steps.md`` and ``steps.png``.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle, product

import matplotlib.pyplot as plt
import torch
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator

from benchmarks.pendulums import pendulum_gp, pendulum_plant, pendulum_references
from benchmarks.timing import (
    RESULTS,
    describe,
    machine,
    markdown_table,
    time_interleaved,
    write_results,
)
from gpmpc.gaussian import Gaussian
from gpmpc.gp import GPPosterior
from gpmpc.mpc import (
    GPMPC,
    Box,
    Controller,
    Decision,
    PredictionSettings,
    Problem,
    Reference,
    Tracking,
)
from gpmpc.plotting import png
from gpmpc.propagation import Linearization, MomentMatching, differentiate
from gpmpc.simulation import closed_loop

RECORDED_STEPS = 40
# [rad, rad/s] of the beliefs: a full covariance is propagated, as with an estimator in
# the loop
STD = 0.01
# N and H that the panels hold, or the nearest ones measured
FIGURE_SIZE = 189
FIGURE_HORIZON = 10
LOOKS = {
    "paper's form": ("C1", "o"),
    "zero order": ("C0", "s"),
    "mean only": ("C2", "^"),
}


def main() -> None:
    """Measures, prints and draws."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--states", type=int, nargs="+", default=[2, 6, 12], help="n, even"
    )
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[10, 50, 189, 500, 2000], help="N"
    )
    parser.add_argument(
        "--horizons", type=int, nargs="+", default=[1, 10, 50], help="H"
    )
    parser.add_argument(
        "--caches", nargs="+", choices=["hot", "flushed"], default=["hot"]
    )
    parser.add_argument(
        "--seconds", type=float, default=0.5, help="processor time a cell [s]"
    )
    arguments = parser.parse_args()
    computer = machine()
    rows = []
    sections = []
    print(f"{describe(computer)}\n")
    for n, cache in product(arguments.states, arguments.caches):
        found = [
            row
            for size in arguments.sizes
            for row in measure_size(
                pendulum_gp(n, size),
                arguments.horizons,
                arguments.seconds,
                cache == "flushed",
            )
        ]
        rows += [row | {"cache": cache} for row in found]
        sections.append(
            f"n = {n}, m = {n // 2}, {cache} caches: median (99 %) in "
            f"ms\n\n{table(found)}\n"
        )
        print(sections[-1], flush=True)
    write_results("steps", rows, machine=computer)
    (RESULTS / "steps.md").write_text("\n".join([f"{describe(computer)}\n", *sections]))
    (RESULTS / "steps.png").write_bytes(png(speed_figure(rows)))


def controllers(gp: GPPosterior, horizon: int) -> dict[str, Controller]:
    """Builds the convex controllers that are compared."""
    m = gp.state_dim // 2
    problem = Problem(
        Tracking([10.0, 1.0] * m, [0.1] * m, penalized="inputs"),
        inputs=Box([-6.0] * m, [6.0] * m),
    )
    common = (problem, horizon, [0.0] * m)
    return {
        "paper's form": GPMPC(
            gp,
            MomentMatching(process_noise=False),
            *common,
            prediction=PredictionSettings(form="velocity", covariance="full"),
        ),
        "zero order": GPMPC(gp, Linearization(), *common),
        "mean only": GPMPC(
            gp,
            Linearization(),
            *common,
            prediction=PredictionSettings(covariance="none"),
        ),
    }


@dataclass
class WarmStarted:
    """Solves recorded steps endlessly, each from the decision before.

    Attributes:
        controller: What is measured.
        steps: Beliefs and references.
        unsolved: Number of decisions without a solution.
    """

    controller: Controller
    steps: Sequence[tuple[Gaussian, Reference]]
    unsolved: int = 0

    def __post_init__(self) -> None:
        self._cycle = cycle(self.steps)
        self._previous = None

    def __call__(self) -> Decision:
        """Decides the next step."""
        self._previous = self.controller.control(*next(self._cycle), self._previous)
        self.unsolved += not self._previous.status.solved
        return self._previous


def record_steps(
    gp: GPPosterior, controller: Controller, steps: int
) -> list[tuple[Gaussian, Reference]]:
    """Flies the pendulums and returns the beliefs and references of the steps."""
    n = gp.state_dim
    recorded_steps = []

    class Recorder:
        horizon = controller.horizon
        problem = controller.problem

        def control(self, belief, reference, previous=None):
            belief = Gaussian(belief.mean, STD**2 * torch.eye(n, dtype=torch.float64))
            recorded_steps.append((belief, reference))
            return controller.control(belief, reference, previous)

    references = pendulum_references(n, steps + controller.horizon + 1)
    closed_loop(
        pendulum_plant(n),
        Recorder(),
        references,
        references[0],
        steps,
        on_failure="previous_plan",
    )
    return recorded_steps


def measure_size(
    gp: GPPosterior, horizons: Sequence[int], seconds: float, flushed: bool
) -> Iterator[dict]:
    """Yields the rows of one model.

    Its predictions, and the controllers at every horizon.
    """
    times = time_interleaved(predictions(gp), seconds, min_rounds=10, flushed=flushed)
    size = {"n": gp.state_dim, "N": len(gp)}
    for name, samples in times.items():
        yield size | {"H": None, "what": name} | samples.summary()
    for horizon in horizons:
        compared = controllers(gp, horizon)
        steps = record_steps(gp, compared["mean only"], RECORDED_STEPS)
        cases = {
            name: WarmStarted(controller, steps)
            for name, controller in compared.items()
        }
        for name, samples in time_interleaved(
            cases, seconds, min_rounds=10, flushed=flushed
        ).items():
            yield (
                size
                | {"H": horizon, "what": name}
                | samples.summary()
                | {"unsolved": cases[name].unsolved}
            )


def predictions(gp: GPPosterior) -> dict[str, Callable[[], object]]:
    """Builds the calls that predict one step of the GPs.

    Mean, exact moments, exact moments with all derivatives.
    """
    n = gp.state_dim
    exact = MomentMatching()
    references = torch.from_numpy(pendulum_references(n, RECORDED_STEPS))
    covariance = STD**2 * torch.eye(n, dtype=torch.float64)
    input = torch.zeros(n // 2, dtype=torch.float64)

    def along(predict: Callable[[Gaussian], object]) -> Callable[[], object]:
        beliefs = cycle([Gaussian(mean, covariance) for mean in references])
        return lambda: predict(next(beliefs))

    return {
        "mean": along(
            lambda belief: gp.linearize(
                belief.mean[None].numpy(), input[None].numpy(), covariance=False
            )
        ),
        "exact moments": along(lambda belief: exact(gp, belief, input)),
        "exact moments, all Jacobians": along(
            lambda belief: differentiate(exact, gp, belief, input)
        ),
    }


def table(rows: Sequence[Mapping]) -> str:
    """Formats the rows of one n: cases down, sizes across."""
    sizes = list(dict.fromkeys(row["N"] for row in rows))
    cases = sorted(
        dict.fromkeys((row["what"], row["H"]) for row in rows),
        key=lambda case: case[1] is not None,
    )
    cases.sort(key=lambda case: case[0] if case[1] else "")
    cells = {
        (row["what"], row["H"], row["N"]): f"{row['median']:.3g} ({row['p99']:.3g})"
        for row in rows
    }
    lines = [
        [
            what if H is None else f"{what}, H = {H}",
            *(cells.get((what, H, size), "") for size in sizes),
        ]
        for what, H in cases
    ]
    return markdown_table(["", *(f"N = {size}" for size in sizes)], lines)


def speed_figure(rows: Sequence[Mapping]) -> Figure:
    """Draws milliseconds per step.

    Above over N at one horizon, below over H at one size; one column for every n.

    A line is the median, the area above it reaches to the 99th percentile; hot caches
    where both were measured.
    """
    cache = "hot" if any(row["cache"] == "hot" for row in rows) else "flushed"
    rows = [row for row in rows if row["H"] is not None and row["cache"] == cache]
    size = min({row["N"] for row in rows}, key=lambda N: abs(N - FIGURE_SIZE))
    horizon = min({row["H"] for row in rows}, key=lambda H: abs(H - FIGURE_HORIZON))
    dims = sorted({row["n"] for row in rows})
    plt.style.use("gpmpc.plotting.gpmpc")
    figure, axes = plt.subplots(
        2, len(dims), sharey=True, squeeze=False, figsize=(2.6 * len(dims) + 0.8, 5.6)
    )
    for column, n in enumerate(dims):
        rows_of_size = [row for row in rows if row["n"] == n]
        upper = (
            [row for row in rows_of_size if row["H"] == horizon],
            "N",
            f"training points N (H = {horizon})",
        )
        lower = (
            [row for row in rows_of_size if row["N"] == size],
            "H",
            f"horizon H (N = {size})",
        )
        for axis, (panel, key, label) in zip(
            axes[:, column], (upper, lower), strict=True
        ):
            for what in dict.fromkeys(row["what"] for row in panel):
                line = sorted(
                    (row for row in panel if row["what"] == what),
                    key=lambda row: row[key],
                )
                values = [row[key] for row in line]
                median = [row["median"] for row in line]
                colour, marker = LOOKS[what]
                axis.plot(
                    values,
                    median,
                    color=colour,
                    marker=marker,
                    markersize=3.5,
                    label=what,
                )
                axis.fill_between(
                    values,
                    median,
                    [row["p99"] for row in line],
                    color=colour,
                    alpha=0.15,
                    lw=0,
                )
            axis.set(xscale="log", yscale="log", xlabel=label)
            ticks = sorted({row[key] for row in panel})
            axis.set_xticks(ticks, [str(tick) for tick in ticks], rotation=45)
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.yaxis.set_major_locator(LogLocator(10, (1, 2, 5)))
            axis.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.yaxis.set_minor_locator(NullLocator())
        axes[0, column].set_title(f"{n} states, {n // 2} inputs")
    for axis in axes[:, 0]:
        axis.set_ylabel("time per control step [ms]")
    figure.suptitle(
        "Decisions of the convex controllers: median, shaded to the 99th percentile"
    )
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3
    )
    return figure


if __name__ == "__main__":
    main()
