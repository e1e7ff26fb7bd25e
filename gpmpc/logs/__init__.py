"""Logs of real systems: reading, checking, learning from them, and judging the models.

How ``read_log`` makes rows of files, and where each step is:

1. file          ``_formats`` finds the reader by the file's ending; one file a format.
                 To add a format, see there. It returns tables by topic (``_file``),
                 which ``_runs`` splits into runs.
2. channels      ``_signals`` reads the columns that the mapping names (``_mapping``),
                 in SI units (``_units``), without what nobody measured (``_dropouts``).
3. clock         ``_clocks`` orders the stamps; ``_resampling`` makes one grid for all
                 topics; ``_run_tables`` puts the signals of a run on it.
4. rows          ``_usable_rows`` leaves out rows at rest or without a value, and marks
                 where pieces begin.
5. frames        ``_frames`` brings rigid bodies to ENU and FLU axes, after
6. conventions   ``_conventions`` has checked that their columns fit each other; if not,
                 it searches what they mean instead (``_interpretations``).
7. log           ``_log``: the runs, with what was noticed on the way (``_findings``).

``_read_log`` holds these steps in their order; ``_inspection`` looks at a file before.

How ``learn`` makes a model of a log:

1. structures    ``_structures`` has the simplest models, and what they may grow by. To
                 add a structure, see there. ``_input_delay`` says by how many rows
                 inputs may act late. The models themselves are those of
                 ``gpmpc.models``.
2. folds         ``_folds`` deals runs, or blocks of rows, to two or four folds.
3. rows          ``_smoothing`` takes the noise from the rows that models are fitted to.
4. parameters    ``_fitting`` fits nominal models on rollouts.
5. residuals     ``_output_gps`` trains GPs on what a nominal model leaves.
6. choice        ``_search`` compares structures: ``_structure_fits`` fits them on each
                 fold, ``_held_out_errors`` holds their errors beside those of the
                 baselines of ``_baselines``; ``_comparison`` says by how much one wins.
7. corrections   ``_rollout_corrections`` corrects rollouts by the past, fitted to those
                 of ``_validation``.
8. noise         ``_noise`` finds the noise behind the errors of held-out rollouts.

``_learning`` holds these steps in their order. ``_judging`` judges what was learned
beside baselines, ``_control_fitness`` whether a controller can plan with it;
``_storage`` stores it.
"""

from gpmpc.logs._baselines import PLANNABLE_BASELINES
from gpmpc.logs._control_fitness import ControlFitness
from gpmpc.logs._fitting import fit_nominal
from gpmpc.logs._inspection import Inspection, inspect_log
from gpmpc.logs._judging import Judgement, judge
from gpmpc.logs._learning import IdentifiedModel, learn
from gpmpc.logs._log import Log
from gpmpc.logs._mapping import LogMapping
from gpmpc.logs._read_log import read_log
from gpmpc.logs._storage import (
    SavedModel,
    load_flyable,
    load_learned,
    save_learned,
)

__all__ = [
    "PLANNABLE_BASELINES",
    "ControlFitness",
    "IdentifiedModel",
    "Inspection",
    "Judgement",
    "Log",
    "LogMapping",
    "SavedModel",
    "fit_nominal",
    "inspect_log",
    "judge",
    "learn",
    "load_flyable",
    "load_learned",
    "read_log",
    "save_learned",
]
