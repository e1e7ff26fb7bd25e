"""A recorded run as arrays, with what is wrong with its file."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from gpmpc._calls import explains_arguments
from gpmpc.exceptions import GpmpcError, RecordingError, check_kind
from gpmpc.recording._encoding import deviations
from gpmpc.recording._flaws import LOST_CHUNKS, LOST_STEPS, NO_CHECKSUMS, Flaw
from gpmpc.recording._problems import RecordedProblem, residuals, solve_again
from gpmpc.status import Status

if TYPE_CHECKING:
    import pandas

    from gpmpc.qp import QPSolution

Array = np.ndarray
TIMINGS = ("model", "build", "solve", "total")  # columns of ``Run.timings``
RESIDUALS = ("primal", "dual", "gap")  # columns of ``Run.residuals``


@dataclass(frozen=True, eq=False)
class Run:
    """K recorded steps with n states and m inputs.

    Plans have the longest horizon H. They are NaN beyond a shorter one, and at steps
    that have none: where nothing was decided, or the plan is lost.
    """

    path: Path
    # The file has its end, nothing is missing, and checksums vouch for all of it;
    # otherwise this is what could be read of it, and ``flaws`` say what is wrong. Its
    # flight may have ended early all the same: see ``ended_by``.
    finished: bool
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    steps: Array  # (K,) their numbers k
    times: Array  # (K,) [s]
    references: Array  # (K, n)
    states: Array  # (K, n) true states
    measured: Array  # (K, n)
    inputs: Array  # (K, m) applied inputs
    input_bounds: Array  # (2, m) lower and upper; infinite where none were given
    # (K, n) measured minus predicted one step ago; NaN where nothing was predicted, at
    # the first step or after one that failed, and where nothing was measured
    innovations: Array
    belief_covariances: Array  # (K, n, n) of a model loop; zero with a plant
    plan_inputs: Array  # (K, H, m)
    plan_means: Array  # (K, H + 1, n)
    plan_covariances: Array  # (K, H + 1, n, n)
    statuses: tuple[Status, ...]
    iterations: Array  # (K,)
    active_set_sizes: Array  # (K,)
    timings: Array  # (K, 4) model, build, solve, total [s]
    gp_sizes: Array  # (K,)
    gp_versions: Array  # (K,)
    failed: Array  # (K,) whether the decision was not applied
    # (K,) ``novelty`` of the decisions; 0 in files that do not have it
    novelties: Array
    # (K,) of texts, healthy, suspicious or lost; empty ones in files that have none
    judgements: Array
    reasons: Array  # (K,) of texts, why a step is not healthy
    channels: dict[str, tuple[int, str]]  # number of messages and schema by topic
    metadata: dict[str, dict[str, str]]
    config: str  # text of the resolved configuration
    problems: dict[int, RecordedProblem]  # by k; see ``replay``
    flaws: tuple[Flaw, ...] = ()  # what is wrong with the recording

    @property
    def whole(self) -> bool:
        """Whether nothing of it is known to be missing.

        Where it is not finished all the same, it has no checksums to tell.
        """
        return all(flaw.kind == NO_CHECKSUMS for flaw in self.flaws)

    @property
    def ended_by(self) -> str:
        """What ended the flight early, such as an interrupt; empty where nothing did.

        It is empty as well where the file does not tell.
        """
        outcome = self.metadata.get("end", {}).get("outcome", "complete")
        is_complete = outcome.partition(":")[0] == "complete"
        return "" if is_complete else outcome.strip(": ")

    @property
    def lost_steps(self) -> int:
        """Number of the steps that are known to be lost."""
        return sum(flaw.count for flaw in self.flaws if flaw.kind == LOST_STEPS)

    @property
    def lost_chunks(self) -> int:
        """Number of the pieces of the file that could not be read."""
        return sum(flaw.count for flaw in self.flaws if flaw.kind == LOST_CHUNKS)

    @cached_property
    def pose(self) -> dict[str, int]:
        """Indices of the states that are x, y, z, roll, pitch and yaw in space.

        An axis that no state is, is left out.
        """
        axes = self.metadata.get("pose", {}).items()
        return {
            axis: self.state_names.index(name)
            for axis, name in axes
            if name in self.state_names
        }

    @cached_property
    def plan_stds(self) -> Array:
        """Standard deviations of the plans (K, H + 1, n)."""
        return deviations(self.plan_covariances)

    @cached_property
    def residuals(self) -> Array:
        """Primal and dual residual and duality gap of recorded solutions (K, 3).

        They are NaN where there is no solution.
        """
        by_step = [residuals(self.problems.get(k)) for k in self.steps.tolist()]
        return np.reshape(by_step, (-1, len(RESIDUALS)))

    @cached_property
    def columns(self) -> dict[str, Array]:
        """The run as a table: a column (K,) per scalar field of ``gpmpc.Step``."""
        statuses = [status.name for status in self.statuses]
        belief_stds = deviations(self.belief_covariances)
        return {
            "time": self.times,
            "k": self.steps,
            **_columns("reference", self.state_names, self.references),
            **_columns("state", self.state_names, self.states),
            **_columns("measured", self.state_names, self.measured),
            **_columns("input", self.input_names, self.inputs),
            **_columns("innovation", self.state_names, self.innovations),
            **_columns("belief_std", self.state_names, belief_stds),
            "status": np.array(statuses, dtype=object),
            "iterations": self.iterations,
            "active_set_size": self.active_set_sizes,
            **_columns("timing", TIMINGS, self.timings),
            **_columns("residuals", RESIDUALS, self.residuals),
            "gp_size": self.gp_sizes,
            "gp_version": self.gp_versions,
            "failed": self.failed,
            "novelty": self.novelties,
            "judgement": self.judgements,
            "reason": self.reasons,
        }

    def to_pandas(self) -> "pandas.DataFrame":
        """Returns ``columns`` as a data frame, units in its ``attrs``."""
        import pandas

        frame = pandas.DataFrame(self.columns)
        frame.attrs["units"] = self.metadata.get("units", {})
        return frame


def _columns(field: str, names: Sequence[str], values: Array) -> dict[str, Array]:
    """Returns the columns of values (K, len(names)) by the path of their field."""
    return {
        f"{field}.{name}": column for name, column in zip(names, values.T, strict=True)
    }


@explains_arguments
def replay(run: Run, k: int) -> "QPSolution":
    """Solves the recorded quadratic program of step k again.

    Raises:
        RecordingError: The step or its problem is not in the recording, or it is no
            convex program.

    See Also:
        ``read_run``, which reads a recording.
    """
    check_kind("run", run, Run, "a Run of read_run")
    recorded = run.problems.get(k)
    if recorded is None:
        raise RecordingError(
            f"{run.path}: holds no quadratic program of step {k}; it holds "
            f"{len(run.problems)} others"
        )
    try:
        return solve_again(recorded)
    except GpmpcError as error:
        raise RecordingError(f"{run.path}: step {k}: {error}") from error
