"""Searches settings for the least cost, with Optuna.

The search uses tree-structured Parzen estimators (Bergstra et al., 2011). Candidates
come in batches; the costs of one batch are all known before the next one is proposed.
The random numbers of a candidate follow from the seed and from its number, and its
proposal from the costs of earlier batches. So a search that is repeated, or that goes
on where it was killed, proposes the same candidates bit for bit.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from gpmpc.exceptions import GpmpcError
from gpmpc.plotting import png, search_figure
from gpmpc.plotting._style import figure_label
from gpmpc.studies._document import (
    MISSING,
    Document,
    Table,
    number,
    plain_text,
)
from gpmpc.studies.study import derived_seed

_FEWEST_FOR_IMPORTANCE = 8  # candidates
_BEST_IN_TABLE = 10  # candidates
_LEGEND = (
    "cost: of states and increments of the inputs along the true flight, per step, "
    "mean over the seeds, with the weights that the settings have which are not "
    "searched. "
    "Importance: share of the variance of being among the best tenth (PED-ANOVA; "
    "Watanabe, Bansal and Hutter, 2023)."
)


@dataclass(frozen=True)
class Interval:
    """Numbers from ``low`` to ``high``, both included."""

    low: float
    high: float
    logarithmic: bool = False
    whole: bool = False


class Search:
    """A search for the candidate of least cost.

    Args:
        space: By setting, an ``Interval`` or a list of values as text.
        seed: Of all random numbers.

    Raises:
        GpmpcError: Optuna is not installed.
    """

    def __init__(self, space: Mapping[str, Interval | Sequence[str]], seed: int):
        try:
            import optuna
        except ImportError as error:
            raise GpmpcError("tune: needs Optuna: pip install 'gpmpc[tune]'") from error
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        # of this sampler and of the importances
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        self._optuna = optuna
        self._seed = seed
        self._study = optuna.create_study(direction="minimize")
        self._space = {
            key: _distribution(optuna.distributions, values)
            for key, values in space.items()
        }
        self._untold_trials: list[Any] = []
        self.candidates: list[dict[str, Any]] = []
        self.costs: list[float] = []

    def ask(self, count: int) -> list[dict[str, Any]]:
        """Returns the next candidates, values by setting."""
        for _ in range(count):
            self._study.sampler = self._optuna.samplers.TPESampler(
                seed=derived_seed(self._seed, len(self.candidates)),
                multivariate=True,
                constant_liar=True,
            )
            trial = self._study.ask(self._space)
            self._untold_trials.append(trial)
            self.candidates.append(dict(trial.params))
        return self.candidates[-count:]

    def tell(self, costs: Sequence[float]) -> None:
        """Tells the costs of the candidates that were asked for last.

        A cost is infinite where a flight was lost or failed.
        """
        for trial, cost in zip(self._untold_trials, costs, strict=True):
            self._study.tell(trial, cost)
        self.costs += costs
        self._untold_trials = []

    @property
    def best(self) -> int:
        """Number of the best candidate; the first of several."""
        return self.costs.index(min(self.costs))

    def importances(self) -> dict[str, float]:
        """Returns by setting how much it matters, the most first.

        Empty where too few candidates say so.
        """
        finite = [cost for cost in self.costs if math.isfinite(cost)]
        if len(finite) < _FEWEST_FOR_IMPORTANCE or len(self._space) < 2:
            return {}
        if min(finite) == max(finite):
            return {}
        evaluator = self._optuna.importance.PedAnovaImportanceEvaluator()
        return self._optuna.importance.get_param_importances(
            self._study, evaluator=evaluator
        )

    def document(self, base: float | None, command: str) -> Document:
        """Returns the candidates, what mattered, and how the best one is flown.

        Args:
            base: Cost of the settings as they are without the search; None where that
                flight was lost.
            command: That flies the best candidate.
        """
        importances = self.importances()
        candidates = [
            {"candidate": i, "cost": cost, **self.candidates[i]}
            for i, cost in enumerate(self.costs)
        ]
        tables = [self._table_of_best(candidates)]
        if importances:
            tables.append(_table_of_importances(importances))
        labels = {figure_label(key): value for key, value in importances.items()}
        base_cost = MISSING if base is None else number(base)
        return Document(
            title="Tuning",
            tables=tables,
            data=pd.DataFrame(candidates, dtype=object),
            lead=(
                f"{len(self.costs)} candidates; "
                f"cost of the best {_cost_text(min(self.costs))}, "
                f"of the settings as they are {base_cost}."
            ),
            notes=[_LEGEND],
            code={"To fly the best one": [command]},
            images={"tuning.png": png(search_figure(self.costs, labels, base))},
        )

    def _table_of_best(self, candidates: Sequence[Mapping[str, Any]]) -> Table:
        keys = [*self._space]
        best = sorted(candidates, key=lambda candidate: candidate["cost"])
        rows = []
        for candidate in best[:_BEST_IN_TABLE]:
            values = [_value_text(candidate[key]) for key in keys]
            cost = _cost_text(candidate["cost"])
            rows.append([str(candidate["candidate"]), cost, *values])
        return Table(["candidate", "cost", *keys], rows, "Best candidates")


def _distribution(kinds: Any, values: Interval | Sequence[str]) -> Any:
    """Returns Optuna's distribution over an interval or a list of values."""
    if not isinstance(values, Interval):
        return kinds.CategoricalDistribution([*values])
    kind = kinds.IntDistribution if values.whole else kinds.FloatDistribution
    return kind(values.low, values.high, log=values.logarithmic)


def _table_of_importances(importances: Mapping[str, float]) -> Table:
    rows = [[key, f"{100 * value:.0f} %"] for key, value in importances.items()]
    return Table(["setting", "importance"], rows, "What mattered")


def _cost_text(cost: float) -> str:
    return number(cost) if math.isfinite(cost) else "lost or failed"


def _value_text(value: Any) -> str:
    return number(value) if isinstance(value, float) else plain_text(str(value))
