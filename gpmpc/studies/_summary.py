"""Says the metrics of a run in words, a line each."""

from collections.abc import Mapping, Sequence
from typing import Any

from gpmpc._calls import explains_arguments
from gpmpc.studies._document import Table

Result = Mapping[str, Any]  # content of metrics.json


@explains_arguments
def summary(result: Result) -> Table:
    """Returns a run's metrics in words; what there is nothing to say of has no line."""
    unit = result["unit"]
    lines = [
        ("flight", _flight(result)),
        ("flown with", _changed_plant(result)),
        ("model", _model_file(result)),
        ("learned from", _training(result)),
        ("known before", _nominal(result)),
        ("before the flight", "; ".join(result.get("outlook", {}).get("warnings", ()))),
        ("lost", _loss(result)),
        ("judgement", _judgement(result)),
        (f"RMSE [{unit}]", _rmse(result)),
        (f"at the end [{unit}]", _error_at_end(result)),
        *_further_units(result),
        ("episodes before", _episodes(result)),
    ]
    for name, rate in result["violations"].items():
        label = f"bounds of {name}" if name in ("inputs", "states") else name
        lines.append((label, _violations(rate)))
    lines += [
        ("failed solves", _counts(result["failures"]) or "none"),
        ("stopped early", _suboptimal(result)),
        ("far from the data", _far_from_data(result)),
        ("decision [ms]", _decision_times(result)),
    ]
    return Table(
        header=("", ""),
        rows=[(label, text) for label, text in lines if text],
    )


def _flight(result: Result) -> str:
    options = result["settings"]["options"]
    along = ""
    if options["trajectory"] != "goal":
        along = f" along {options['trajectory']}"
    steps = _steps(result["steps"])
    return f"{steps} of {options['system']}{along} with {options['controller']}"


def _changed_plant(result: Result) -> str:
    """Returns the parameters of the plant that differ from those of the system."""
    learned = result["settings"].get("system") or {}
    plant = result["settings"].get("plant") or {}
    return ", ".join(
        f"{key} {value} (learned: {learned.get(key)})"
        for key, value in plant.items()
        if value != learned.get(key)
    )


def _model_file(result: Result) -> str:
    model = result["settings"].get("model") or {}
    return model.get("path") or ""


def _training(result: Result) -> str:
    training = result["training"]
    if not training:
        return ""
    data = result["settings"]["options"]["data"]
    seconds = result["times"]["training"]
    return f"{training['size']} rows of {data} data, in {seconds:.2f} s"


def _nominal(result: Result) -> str:
    nominal = result["settings"].get("nominal") or {}
    return ", ".join(f"{key} {value}" for key, value in nominal.items())


def _loss(result: Result) -> str:
    loss = result.get("lost")
    if not loss:
        return ""
    return f"from step {loss['step']} ({loss['time']:g} s) on: {loss['reason']}"


def _judgement(result: Result) -> str:
    """Returns what the steps said of their flight; nothing where its loss says more."""
    judgement = result.get("judgement")
    if judgement is None or result.get("lost"):
        return ""
    if judgement["level"] == "suspicious":
        return f"suspicious from step {judgement['step']} on: {judgement['reason']}"
    if judgement["suspicious"]:
        were = "was" if judgement["suspicious"] == 1 else "were"
        return (
            f"healthy at the end; {_steps(judgement['suspicious'])} {were} suspicious"
        )
    return "healthy"


def _rmse(result: Result) -> str:
    """Returns the RMSE of the tracked states in the first unit, and of each."""
    rmse = result["rmse"]
    if rmse["total"] is None:
        return "none: it diverged"
    further: set[str] = set()
    for unit in result.get("further_units", {}).values():
        further.update(unit["states"])
    axes = [axis for axis in rmse if axis != "total" and axis not in further]
    return f"{rmse['total']:.3g}  ({_by_axis(rmse, axes)})"


def _further_units(result: Result) -> list[tuple[str, str]]:
    """Returns the lines of tracked states in further units."""
    lines = []
    for name, unit in result.get("further_units", {}).items():
        if unit["rmse"] is None:
            continue
        axes = _by_axis(result["rmse"], unit["states"])
        lines.append((f"RMSE [{name}]", f"{unit['rmse']:.3g}  ({axes})"))
        lines.append((f"at the end [{name}]", f"{unit['error_at_end']:.3g}"))
    return lines


def _by_axis(rmse: Mapping[str, float | None], axes: Sequence[str]) -> str:
    return ", ".join(
        f"{axis} {rmse[axis]:.3g}" for axis in axes if rmse[axis] is not None
    )


def _error_at_end(result: Result) -> str:
    error = result.get("error_at_end")
    return "" if error is None else f"{error:.3g}"


def _episodes(result: Result) -> str:
    return ", ".join(
        "diverged" if error is None else f"{error:.3g}"
        for error in result.get("episodes", ())
    )


def _violations(rate: Mapping[str, Any]) -> str:
    """Returns how often one constraint was broken, with the interval of that rate."""
    count = f"{rate['violations']} of {rate['steps']} steps outside"
    interval = f"(95 %: {100 * rate['low']:.2g} to {100 * rate['high']:.2g} %)"
    text = f"{count} {interval}"
    if not rate["violations"]:
        return text
    worst_by_entry = rate.get("worst_by_entry")
    if not worst_by_entry:  # of constraints without units, and of older results
        return f"{text}, by up to {rate['worst']:.3g}"
    distances = [f"{worst:.3g} in {name}" for name, worst in worst_by_entry.items()]
    return f"{text}, by up to {', '.join(distances)}"


def _suboptimal(result: Result) -> str:
    counts = _counts(result.get("suboptimal", {}))
    if not counts:
        return ""
    return f"{counts}: plans that were not optimal yet, applied"


def _far_from_data(result: Result) -> str:
    count = result.get("far_from_data")
    if not count:
        return ""
    plans = "the plan" if count == 1 else "the plans"
    return (
        f"{plans} of {_steps(count)}: there the model knows little more than its prior"
    )


def _decision_times(result: Result) -> str:
    times = result["times"]
    total = times["total"]
    stages = ", ".join(
        f"{stage} {1e3 * times[stage]['median']:.3g}"
        for stage in ("model", "build", "solve")
    )
    median = f"median {1e3 * total['median']:.3g}"
    return f"{median}  ({stages}), 99 % below {1e3 * total['p99']:.3g}"


def _steps(count: int) -> str:
    return "1 step" if count == 1 else f"{count} steps"


def _counts(statuses: Mapping[str, int]) -> str:
    return ", ".join(f"{status} {count}" for status, count in statuses.items())
