"""How one run is shown in a terminal."""

from collections.abc import Mapping
from typing import Any

from rich import box
from rich.markup import escape
from rich.table import Table


def summary(result: Mapping[str, Any]) -> Table:
    """A run's metrics in words."""
    table = Table(show_header=False, box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    options, training, times = result["settings"]["options"], result["training"], result["times"]
    flown = options["trajectory"] if options["subsystem"] == "translational" else f"{options['trajectory']} attitude"
    table.add_row("flight", f"{result['steps']} steps of {flown} with {options['controller']}")
    if training:
        table.add_row("training", f"{training['size']} rows, {times['training']:.2f} s")
    if lost := result.get("lost"):
        table.add_row("[red]lost", f"[red]from step {lost['step']} ({lost['time']:g} s) on: {escape(lost['reason'])}")
    rmse = dict(result["rmse"])
    total = rmse.pop("total")
    axes = ", ".join(f"{name} {value:.3g}" for name, value in rmse.items() if value is not None)
    table.add_row(rf"RMSE \[{result['unit']}]", "none: it diverged" if total is None else f"{total:.3g}  ({axes})")
    for name, rate in result["violations"].items():
        low, high = 100 * rate["low"], 100 * rate["high"]
        text = f"{rate['violations']} of {rate['steps']} steps outside (95 %: {low:.2g} to {high:.2g} %)"
        table.add_row(f"bounds of {name}", text)
    failures = ", ".join(f"{status} {count}" for status, count in result["failures"].items())
    table.add_row("failed solves", failures or "none")
    if result.get("suboptimal"):
        stopped = ", ".join(f"{status} {count}" for status, count in result["suboptimal"].items())
        table.add_row("stopped early", f"{stopped}: plans that were not optimal yet, applied")
    total = times["total"]
    stages = ", ".join(f"{stage} {1e3 * times[stage]['median']:.3g}" for stage in ("model", "build", "solve"))
    decision = f"median {1e3 * total['median']:.3g}  ({stages}), 99 % below {1e3 * total['p99']:.3g}"
    table.add_row(r"decision \[ms]", decision)
    return table
