"""Structures of models of logs, from the simplest ones on.

A structure is a nominal model with its history and lag, grown by one addition after the
other, and GPs on groups of outputs. ``bases`` lists those that a search begins with.

Of past rows three numbers speak. ``rows_back`` are those that a memory, or an addition,
looks back on. ``most_rows_back`` is their limit in a search, by the lengths of the
log's pieces (``affordable_rows_back``). ``past_rows_needed`` are those that windows are
cut with, so that any structure of the search has them: delays come upon that limit.

What excludes what:

=====================  ================================================================
addition               none where there is
=====================  ================================================================
a memory               a memory, or a fitted affine part, which its linear term has
products of rows       no memory of as many rows; lags, as products see past inputs
a delay of inputs      a delay, a memory (it knows the past inputs), or a still state
first-order lags       lags, products, no input, or a still state without a memory
a disturbance          a memory, whose means of outputs take its place in either order
fitted on rollouts     no memory; a rigid body, whose weights are too many
a group by past rows   no memory
=====================  ================================================================

A mapping may name any system (``nominal``), and vehicles stand in
``_system_structures``. To add a structure for another kind of system that is none:

1. Write its nominal model beside ``MultirotorNominal`` (``gpmpc.models._parametric``),
   and its kinematics beside ``RigidBodyKinematics`` (``gpmpc.models._kinematics``)
   unless it is a rigid body.
2. Return it from ``bases`` for the logs that it fits, beside other alternatives: all
   are tried, and the best one grows. What it may grow by stands in ``additions``.
3. Is it only for logs whose mapping says so, enter a name of it among the choices of
   ``LogMapping.model`` (``_mapping``).
4. Write and read its name and its settings in ``gpmpc.models._stored_log_model``
   (``_nominal_header`` and ``_nominal``).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpmpc._dynamics import Array
from gpmpc.logs._fitting import PAST
from gpmpc.logs._input_delay import MOST_ROWS, likely_delay
from gpmpc.logs._log import Log
from gpmpc.logs._system_structures import system_nominal
from gpmpc.models._kinematics import Increments, Kinematics, RigidBodyKinematics
from gpmpc.models._log_model import LAG_FILL_ROWS, LogModel
from gpmpc.models._memory import Memory, Products
from gpmpc.models._parametric import AffineNominal, MultirotorNominal, is_still
from gpmpc.models._system_nominal import SystemNominal

MOTOR_DELAY_ROWS = 3  # by which motors may act late
# Rows over which the residuals before a start are averaged to a disturbance: all of the
# past that windows are cut with.
DISTURBANCE_ROWS = PAST
#: what models may remember, by its key and with its label
_MEMORIES = {
    "rows_and_means": (
        "3 past rows and means",
        Memory(3, (0.75, 0.9, 0.95), (0.0, 0.5, 0.8, 0.95)),
    ),
    "rows2": ("2 past rows", Memory(2)),
    "rows4": ("4 past rows", Memory(4)),
    "rows7": ("7 past rows", Memory(7)),
    "rows14": ("14 past rows", Memory(14)),
    "rows8": ("8 past rows and means of outputs", Memory(8, (), (0.0, 0.5, 0.8, 0.95))),
}
# Rows whose features are multiplied, and most factors: the first that are few enough.
_PRODUCTS = ((2, 3), (2, 2), (1, 3), (1, 2))
_MOST_PRODUCTS = 36
_COUNTS = {2: "two", 3: "three"}
_PIECE_SHARE = 10  # of a piece: a structure looks back on no more rows of it


@dataclass(frozen=True)
class Candidate:
    """A structure that was tried: its name, and the errors on held-out runs."""

    name: str  #: of the structure
    errors: Array  #: mean Euclidean or geodesic error (judged steps, groups)
    chosen: bool = False  #: whether it is the best one


@dataclass(frozen=True)
class Addition:
    """Something that a structure may have besides."""

    key: str  #: in the memory of a search
    label: str  #: in the names of candidates
    #: adds it to a model; returns None where it makes no sense
    extend: Callable[[LogModel], LogModel | None]
    for_control: bool = True  #: whether a controller can plan with it
    rows_back: int = 0  #: that it looks back on
    is_disturbance: bool = False  #: whether a memory takes its place


class GroupGP(NamedTuple):
    """A GP on a group of outputs."""

    group: str
    rows: int  # over which its targets are averaged
    sees_past: bool = False  # whether it is a function of the past rows as well

    @property
    def label(self) -> str:
        """The GP in the names of candidates."""
        if self.sees_past:
            return f"{self.group} (of past rows)"
        return f"{self.group} (averaged over {self.rows})"

    @property
    def key(self) -> str:
        """The GP in the memory of a search."""
        suffix = ":past" if self.sees_past else ""
        return f"gp:{self.group}:{self.rows}{suffix}"


@dataclass(frozen=True, eq=False)
class Structure:
    """A form of a model, without the values of its parameters."""

    base: str  #: that it grew from, such as "rigid body"
    model: LogModel  #: its form: what the values of the parameters are does not matter
    inputs: int  #: number of inputs
    most_rows_back: int  #: that its additions may look back on
    #: smallest and largest features in the log (2, d); empty where no term needs them
    ranges: tuple[tuple[float, ...], ...] = ()
    delay_rows: int = 0  #: by which the inputs are likely to act late
    additions: tuple[Addition, ...] = ()
    gps: tuple[GroupGP, ...] = ()
    #: structures without GPs, each with the groups of outputs that are its own; none of
    #: a structure that is not put together
    parts: tuple[tuple["Structure", tuple[str, ...]], ...] = ()
    #: of the corrections by the past whose average it has (priors, judged steps, groups
    #: of states); empty of a structure without a correction
    correction_shares: tuple[tuple[tuple[float, ...], ...], ...] = ()

    @property
    def name(self) -> str:
        """The structure in words."""
        labels = [self.base, *(addition.label for addition in self.additions)]
        if self.parts:
            labels = [
                f"{part.name} for {_enumeration(groups)}" for part, groups in self.parts
            ]
        if self.gps:
            labels.append(f"GP on {_enumeration([gp.label for gp in self.gps])}")
        if self.correction_shares:
            labels.append("corrected by the past")
        return ", ".join(labels)

    @property
    def key(self) -> str:
        """The structure in the memory of a search."""
        keys = [self.base, *sorted(addition.key for addition in self.additions)]
        for part, groups in self.parts:
            keys.append(f"({part.key}:{'+'.join(groups)})")
        keys += sorted(gp.key for gp in self.gps)
        if self.correction_shares:
            keys.append("corrected")
        return "/".join(keys)

    @property
    def size(self) -> int:
        """Number of the pieces that it is made of, to prefer what is simpler.

        A correction is none: it hedges against runs that are unlike those of the log.
        """
        pieces_of_parts = sum(part.size for part, _ in self.parts)
        return len(self.additions) + len(self.gps) + pieces_of_parts

    @property
    def nominal(self) -> "Structure":
        """The structure without GPs and correction."""
        return replace(self, gps=(), correction_shares=())

    @property
    def uncorrected(self) -> "Structure":
        """The structure without its correction."""
        return replace(self, correction_shares=())

    def extended(self, addition: Addition) -> "Structure | None":
        """Returns the structure with an addition; None where that makes no sense."""
        if self.parts or addition.key in {one.key for one in self.additions}:
            return None
        model = addition.extend(self.model)
        if model is None:
            return None
        extended = (*self.additions, addition)
        if not model.memory.empty:
            extended = tuple(one for one in extended if not one.is_disturbance)
        return replace(self, model=model, additions=extended)

    def with_gps(self, gps: Iterable[GroupGP]) -> "Structure":
        """Returns the structure with other GPs, in the order of their groups."""
        return replace(self, gps=tuple(sorted(gps)))


def _enumeration(names: Sequence[str]) -> str:
    """Returns names as an enumeration: "a, b and c"."""
    *before, final = names
    return f"{', '.join(before)} and {final}" if before else final


def affordable_rows_back(log: Log, for_control: bool) -> int:
    """Returns how many rows a structure of a log may look back on.

    It is a tenth of a piece as most rows are in. Beyond that, short runs leave few
    windows, and what looks best on these is chance. A controller's model has lags or
    nothing: there it is as many as they need.
    """
    if for_control:
        return _ROWS_BACK[-1]
    lengths = sorted(end - begin for run in log for begin, end in run.pieces)
    rows = np.cumsum(lengths)
    typical = lengths[int(np.searchsorted(rows, rows[-1] / 2))]
    affordable = typical // _PIECE_SHARE
    return max([rows for rows in _ROWS_BACK if rows <= affordable], default=0)


def likely_delay_rows(log: Log, most_rows_back: int) -> int:
    """Returns by how many rows the inputs of a log are likely to act late.

    That of a multirotor's motors is known.

    Args:
        log: All runs.
        most_rows_back: That a structure may look back on.
    """
    if log.mapping.model == "rigid_body":
        return 0
    return likely_delay(log, Increments(log.space), min(most_rows_back, MOST_ROWS))


def past_rows_needed(most_rows_back: int, delay_rows: int = 0) -> int:
    """Returns the rows before a start that structures need at most.

    Args:
        most_rows_back: That they may look back on.
        delay_rows: By which inputs are likely to act late.
    """
    # A likely delay is tried with one row more as well. The last row is to spare.
    longest_delay = max(MOTOR_DELAY_ROWS, delay_rows + 1)
    return max(PAST, most_rows_back) + longest_delay + 1


def bases(log: Log, most_rows_back: int, delay_rows: int = 0) -> list[Structure]:
    """Returns the structures that a search begins with, all of which are tried.

    Args:
        log: All runs.
        most_rows_back: That they may look back on.
        delay_rows: By which inputs are likely to act late.
    """
    structures = _bases(log, most_rows_back)
    return [replace(structure, delay_rows=delay_rows) for structure in structures]


def _bases(log: Log, most_rows_back: int) -> list[Structure]:
    """Returns the bases, whose inputs act at once."""
    if log.mapping.model == "rigid_body":
        body = RigidBodyKinematics(log.space)
        affine_bases = _affine_bases(body, len(log.input_names), most_rows_back)
        return [_multirotor_base(log, most_rows_back), *affine_bases]
    kinematics = Increments(log.space)
    ranges = _ranges_of_features(kinematics, log)
    affine_bases = _affine_bases(
        kinematics, len(log.input_names), most_rows_back, ranges
    )
    nominal = system_nominal(log)
    if nominal is None:
        return affine_bases
    return [_system_base(nominal, kinematics, log, most_rows_back), *affine_bases]


def _system_base(
    nominal: SystemNominal, kinematics: Increments, log: Log, most_rows_back: int
) -> Structure:
    model = LogModel(
        kinematics=kinematics,
        nominal=nominal,
        theta=np.empty(0),
        history=(0,) * len(kinematics.output_names),
    )
    name = nominal.code.rpartition(":")[2]
    return Structure(name, model, len(log.input_names), most_rows_back)


def _multirotor_base(log: Log, most_rows_back: int) -> Structure:
    nominal = MultirotorNominal(
        motors=len(log.input_names),
        voltage=_median_voltage(log),
        thrusts=all(signal.group.unit == "N" for signal in log.mapping.of("inputs")),
    )
    model = LogModel(
        kinematics=RigidBodyKinematics(log.space),
        nominal=nominal,
        theta=np.empty(0),
        history=(0,) * 6,
    )
    return Structure("rigid body", model, len(log.input_names), most_rows_back)


def _ranges_of_features(
    kinematics: Kinematics, log: Log
) -> tuple[tuple[float, ...], ...]:
    """Returns the smallest and the largest features of all rows (2, d).

    Beside a context there is none: no product has it as a factor.
    """
    if log.mapping.of("context"):
        return ()
    features = np.concatenate(
        [kinematics.features(run.states, run.inputs, run.context) for run in log]
    )
    return tuple(features.min(axis=0).tolist()), tuple(features.max(axis=0).tolist())


def _affine_bases(
    kinematics: Kinematics,
    inputs: int,
    most_rows_back: int,
    ranges: tuple[tuple[float, ...], ...] = (),
) -> list[Structure]:
    """Returns outputs of zero, and outputs that are affine in the features."""
    names = {False: "constant state", True: "least squares"}
    if isinstance(kinematics, RigidBodyKinematics):
        names[False] = "free fall"
    return [
        Structure(
            name,
            LogModel(
                kinematics=kinematics,
                nominal=AffineNominal(kinematics, fitted=fitted),
                theta=np.empty(0),
                history=(0,) * len(kinematics.output_names),
            ),
            inputs,
            most_rows_back,
            ranges,
        )
        for fitted, name in names.items()
    ]


def additions(structure: Structure) -> tuple[Addition, ...]:
    """Returns what a structure may grow by; each is tried on what did best so far."""
    if structure.parts:
        return ()
    lags = Addition(
        key="first_order_lags",
        label="first-order lags",
        extend=_with_lags(structure.inputs),
        rows_back=LAG_FILL_ROWS,
    )
    if isinstance(structure.model.nominal, MultirotorNominal):
        memories = _body_memories(structure.most_rows_back)
        by_past_rows = _additions_by_past_rows(structure.model)
        possible = (*_MULTIROTOR_ADDITIONS, *memories, lags, *by_past_rows)
    else:
        possible = (
            *_AFFINE_ADDITIONS,
            *_delay_additions(structure.delay_rows),
            *_MEMORY_ADDITIONS,
            *_product_additions(structure),
            lags,
            _REFINED,
        )
    return tuple(one for one in possible if one.rows_back <= structure.most_rows_back)


def _median_voltage(log: Log) -> float:
    """Returns the median of a voltage in the context [V]; zero where there is none."""
    signals = log.mapping.of("context")
    if not signals or signals[0].unit not in ("V", "mV"):
        return 0.0
    return float(np.median(np.concatenate([run.context[:, 0] for run in log])))


def _with_memory(memory: Memory) -> Callable[[LogModel], LogModel | None]:
    def extend(model: LogModel) -> LogModel | None:
        nominal = model.nominal
        has_affine_part = isinstance(nominal, AffineNominal) and nominal.fitted
        # The linear term has all of an affine part: the same comes of a constant state.
        if has_affine_part or not model.memory.empty:
            return None
        no_history = (0,) * len(model.history)
        return replace(model, memory=memory, history=no_history)

    return extend


_MEMORY_ADDITIONS = tuple(
    Addition(
        key=key,
        label=label,
        extend=_with_memory(memory),
        for_control=False,
        rows_back=memory.rows_back,
    )
    for key, (label, memory) in _MEMORIES.items()
)


_SHARES_OF_DELAY = (0.2, 0.4, 0.6, 0.8)  # of a likely delay, which are tried as well
_ROWS_BACK = sorted({LAG_FILL_ROWS, *(one.rows_back for one in _MEMORY_ADDITIONS)})


def _body_memories(most_rows_back: int) -> tuple[Addition, ...]:
    """Returns the memories of a rigid body: rows with means, where these are filled.

    Rows alone are enough of few signals, whose outputs have no physics.
    """
    keys = ("rows_and_means", "rows8")
    memories = tuple(one for one in _MEMORY_ADDITIONS if one.key in keys)
    if all(one.rows_back <= most_rows_back for one in memories):
        return memories
    return _MEMORY_ADDITIONS


def _product_additions(structure: Structure) -> list[Addition]:
    """Returns products of the last features, the most that are not too many."""
    if not structure.ranges:
        return []
    low, high = structure.ranges
    for rows, degree in _PRODUCTS:
        products = Products(rows, degree, low, high)
        if len(products.factors) <= _MOST_PRODUCTS:
            addition = Addition(
                key="products",
                label=f"products of {_COUNTS[degree]}",
                extend=_with_products(products),
                for_control=False,
            )
            return [addition]
    return []


def _with_products(products: Products) -> Callable[[LogModel], LogModel | None]:
    def extend(model: LogModel) -> LogModel | None:
        memory = model.memory
        if memory.products is not None or not 0 < memory.rows >= products.rows - 1:
            return None
        if len(model.time_constants):
            return None
        return replace(model, memory=replace(memory, products=products))

    return extend


def _delay_additions(delay_rows: int) -> list[Addition]:
    """Returns delays of the inputs up to a likely one; none of none.

    What looks like one may be a shorter one and a first-order lag.
    """
    if not delay_rows:
        return []
    shorter = {max(round(share * delay_rows), 1) for share in _SHARES_OF_DELAY}
    delays = sorted({delay_rows, delay_rows + 1} | shorter)
    return [
        Addition(
            key=f"late:{number}",
            label=_delay_label(number),
            extend=_with_delay(number),
            rows_back=number,
        )
        for number in delays
    ]


def _delay_label(rows: int) -> str:
    return f"inputs {rows} {'row' if rows == 1 else 'rows'} late"


def _with_delay(rows: int) -> Callable[[LogModel], LogModel | None]:
    def extend(model: LogModel) -> LogModel | None:
        nominal = model.nominal
        # A memory knows the past inputs.
        if model.lag or is_still(nominal) or not model.memory.empty:
            return None
        return replace(model, lag=rows)

    return extend


def _with_refined_term(model: LogModel) -> LogModel | None:
    is_small = isinstance(model.kinematics, Increments)
    if model.memory.empty or model.refined or not is_small:
        return None
    return replace(model, refined=True)


_REFINED = Addition(
    key="refined",
    label="fitted on rollouts",
    extend=_with_refined_term,
    for_control=False,
)


def _additions_by_past_rows(model: LogModel) -> tuple[Addition, ...]:
    """Returns one addition a group: past rows alone predict it, without the physics."""
    return tuple(
        Addition(
            key=f"alone:{name}",
            label=f"{name} by past rows alone",
            extend=_without_physics_of(outputs),
            for_control=False,
        )
        for name, outputs in model.kinematics.output_groups.items()
    )


def _without_physics_of(
    outputs: tuple[int, ...],
) -> Callable[[LogModel], LogModel | None]:
    def extend(model: LogModel) -> LogModel | None:
        if model.memory.empty or set(outputs) <= set(model.without_nominal):
            return None
        without = tuple(sorted({*model.without_nominal, *outputs}))
        return replace(model, without_nominal=without)

    return extend


def _with_lags(inputs: int) -> Callable[[LogModel], LogModel | None]:
    def extend(model: LogModel) -> LogModel | None:
        nominal = model.nominal
        if len(model.time_constants) or (is_still(nominal) and model.memory.empty):
            return None
        if not inputs or model.memory.products is not None:  # which see their past
            return None
        return replace(model, time_constants=np.zeros(inputs))

    return extend


def _with_disturbance(model: LogModel) -> LogModel | None:
    if not model.memory.empty:
        return None
    return replace(model, history=(DISTURBANCE_ROWS,) * len(model.history))


_AFFINE_ADDITIONS = (
    Addition("disturbance", "disturbance", _with_disturbance, is_disturbance=True),
)


def _with_force_disturbance(model: LogModel) -> LogModel | None:
    if not model.memory.empty:
        return None
    return replace(model, history=(DISTURBANCE_ROWS,) * 3 + (0,) * 3)


def _with_motor_torque(model: LogModel) -> LogModel:
    return replace(model, nominal=replace(_multirotor(model), torque=True))


def _with_feedback(model: LogModel) -> LogModel:
    return replace(model, nominal=replace(_multirotor(model), feedback=True))


def _with_motor_delay(model: LogModel) -> LogModel | None:
    if not _multirotor(model).torque:
        return None
    return replace(model, lag=MOTOR_DELAY_ROWS)


def _with_torque_disturbance(model: LogModel) -> LogModel | None:
    if not _multirotor(model).torque or not model.memory.empty:
        return None
    return replace(model, history=model.history[:3] + (DISTURBANCE_ROWS,) * 3)


def _multirotor(model: LogModel) -> MultirotorNominal:
    assert isinstance(model.nominal, MultirotorNominal)
    return model.nominal


_MULTIROTOR_ADDITIONS = (
    Addition(
        "force_disturbance",
        "force disturbance",
        _with_force_disturbance,
        is_disturbance=True,
    ),
    Addition("motor_torque", "motor torque", _with_motor_torque),
    Addition("feedback", "feedback", _with_feedback, for_control=False),
    Addition("lag", f"inputs {MOTOR_DELAY_ROWS} rows late", _with_motor_delay),
    Addition(
        "torque_disturbance",
        "torque disturbance",
        _with_torque_disturbance,
        is_disturbance=True,
    ),
)
