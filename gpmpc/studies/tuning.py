"""Searches settings for the least cost by tree-structured Parzen estimators (Bergstra et al., 2011), with Optuna.

Candidates come in batches, whose costs are all told before the next one. The random numbers of a candidate follow from
the seed and from its number, and its proposal from the costs told before: a search that is repeated, or that goes on
where it was killed with costs from files, proposes the same candidates bit for bit.
"""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from gpmpc.exceptions import GpmpcError
from gpmpc.plotting import png, search_figure
from gpmpc.studies._document import (
    MISSING,
    Document,
    Table,
    figure_label,
    number,
    plain_text,
)
from gpmpc.studies.study import derived_seed

_FEWEST = 8  # candidates of which an importance is told
_SHOWN = 10  # best candidates in the table
_LEGEND = (
    "cost: of states and increments of the inputs along the true flight, per step, mean over the seeds, with the "
    "weights that the settings have which are not searched. Importance: share of the variance of being among the best "
    "tenth (PED-ANOVA; Watanabe, Bansal and Hutter, 2023)."
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
        warnings.simplefilter(
            "ignore", optuna.exceptions.ExperimentalWarning
        )  # of this sampler and the importances
        self._optuna = optuna
        self._seed = seed
        kinds = optuna.distributions
        self._study = optuna.create_study(direction="minimize")
        self._space: dict[str, Any] = {}
        for key, values in space.items():
            if isinstance(values, Interval):
                kind: Any = (
                    kinds.IntDistribution if values.whole else kinds.FloatDistribution
                )
                self._space[key] = kind(values.low, values.high, log=values.logarithmic)
            else:
                self._space[key] = kinds.CategoricalDistribution([*values])
        self._asked: list[Any] = []
        self.candidates: list[dict[str, Any]] = []
        self.costs: list[float] = []

    def ask(self, count: int) -> list[dict[str, Any]]:
        """Returns the next candidates, values by setting."""
        for _ in range(count):
            seed = derived_seed(self._seed, len(self.candidates))
            self._study.sampler = self._optuna.samplers.TPESampler(
                seed=seed, multivariate=True, constant_liar=True
            )
            self._asked.append(self._study.ask(self._space))
            self.candidates.append(dict(self._asked[-1].params))
        return self.candidates[-count:]

    def tell(self, costs: Sequence[float]) -> None:
        """Tells the costs of the candidates asked for last; infinite where a flight was lost or failed."""
        for trial, cost in zip(self._asked, costs, strict=True):
            self._study.tell(trial, cost)
        self.costs += costs
        self._asked = []

    @property
    def best(self) -> int:
        """Number of the best candidate; the first of several."""
        return self.costs.index(min(self.costs))

    def importances(self) -> dict[str, float]:
        """Returns by setting how much it matters, the most first; nothing where too few candidates say so."""
        finite = [cost for cost in self.costs if math.isfinite(cost)]
        if len(finite) < _FEWEST or len(self._space) < 2 or min(finite) == max(finite):
            return {}
        evaluator = self._optuna.importance.PedAnovaImportanceEvaluator()
        return self._optuna.importance.get_param_importances(
            self._study, evaluator=evaluator
        )

    def document(self, base: float | None, command: str) -> Document:
        """Returns the candidates, what mattered, and how the best one is flown.

        Args:
            base: Cost of the settings as they are without the search; None where that flight was lost.
            command: That flies the best candidate.
        """
        keys = [*self._space]
        matter = self.importances()
        data = [
            {"candidate": i, "cost": cost, **self.candidates[i]}
            for i, cost in enumerate(self.costs)
        ]
        best = sorted(data, key=lambda row: row["cost"])[:_SHOWN]
        rows = [
            [
                str(row["candidate"]),
                _shown(row["cost"]),
                *(_text(row[key]) for key in keys),
            ]
            for row in best
        ]
        tables = [Table(["candidate", "cost", *keys], rows, "Best candidates")]
        if matter:
            share = [[key, f"{100 * value:.0f} %"] for key, value in matter.items()]
            tables.append(Table(["setting", "importance"], share, "What mattered"))
        labels = {figure_label(key): value for key, value in matter.items()}
        return Document(
            "Tuning",
            tables,
            pd.DataFrame(data, dtype=object),
            lead=f"{len(self.costs)} candidates; cost of the best {_shown(min(self.costs))}, "
            f"of the settings as they are {MISSING if base is None else number(base)}.",
            notes=[_LEGEND],
            code={"To fly the best one": [command]},
            images={"tuning.png": png(search_figure(self.costs, labels, base))},
        )


def _shown(cost: float) -> str:
    return number(cost) if math.isfinite(cost) else "lost or failed"


def _text(value: Any) -> str:
    return number(value) if isinstance(value, float) else plain_text(str(value))
