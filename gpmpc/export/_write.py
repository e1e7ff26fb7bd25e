"""Writes a controller as one header and one source in C99."""

import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from gpmpc._calls import explains_arguments
from gpmpc._dynamics import DynamicsModel
from gpmpc._files import write_whole
from gpmpc.estimation import KalmanFilter
from gpmpc.exceptions import SettingError, check_choice
from gpmpc.export._checks import check_exportable
from gpmpc.export._filter import Estimator, FilterWriter, check_estimator
from gpmpc.export._functions import FunctionWriter
from gpmpc.export._models import ModelWriter
from gpmpc.export._points import posterior_of, with_points
from gpmpc.export._problems import (
    Definitions,
    definitions,
    needs_means_alone,
    tables,
    tightens,
)
from gpmpc.export._text import Numbers, Precision, comment, needed_parts
from gpmpc.mpc import GPMPC

_HERE = Path(__file__).parent
_NAME = "gpmpc"
#: In every file that is written, and in no other.
MARK = "Written by gpmpc; the next export overwrites it."
_PREFIX = re.compile(r"(?<![A-Za-z])gpmpc(?=_|\.[ch]\b)")
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
# a header of such a name, or a target of such a name, would hide another one
_TAKEN = frozenset(
    {
        *("assert", "complex", "ctype", "errno", "fenv", "float", "inttypes"),
        *("iso646", "limits", "locale", "math", "setjmp", "signal", "stdalign"),
        *("stdarg", "stdatomic", "stdbool", "stddef", "stdint", "stdio", "stdlib"),
        *("stdnoreturn", "string", "tgmath", "threads", "time", "uchar", "wchar"),
        *("wctype",),
        # that those of C libraries include
        *("alloca", "endian", "features", "ieeefp", "memory", "newlib", "pthread"),
        *("sched", "strings", "unistd", "xlocale"),
        *("all", "arduino", "check", "clean", "help", "install", "m", "replay", "test"),
    }
)

# what stands around the code, by its place in the folder
_AROUND = {
    "Makefile": "Makefile",
    "CMakeLists.txt": "CMakeLists.txt",
    "library.properties": "library.properties",
    "examples/replay/replay.c": "replay.c",
    "examples/step_time/step_time.ino": "step_time.ino",
    "ros2/node.cpp": "ros2_node.cpp",
    "ros2/CMakeLists.txt": "ros2_CMakeLists.txt",
    "ros2/package.xml": "ros2_package.xml",
}


class Export(NamedTuple):
    """The files of an exported controller."""

    header: Path
    source: Path


@explains_arguments
def export_c(
    controller: GPMPC,
    path: str | Path,
    precision: Precision = "double",
    on_failure: str = "previous_plan",
    estimator: Estimator | None = None,
    points: int | None = None,
    name: str = _NAME,
) -> Export:
    """Writes a controller as C into a folder.

    The code, ``src/gpmpc.h`` and ``src/gpmpc.c``, is C99, needs nothing but libm, and
    decides as ``ControlLoop`` does around the controller, to the rounding of
    ``precision``. Around it stand a Makefile, CMakeLists.txt, the layout of an Arduino
    library, an example that replays a flight (``write_replay``), and a ROS 2 node.

    Args:
        controller: A ``GPMPC`` of one program a step.
        path: The folder, which is made where it does not exist.
        precision: Of all numbers, ``"double"`` or ``"float"``; for float, the sums of
            GPs are taken in whole numbers, far from their points in double.
        on_failure: What is applied where a step fails: ``"previous_plan"`` or
            ``"hold"``; see ``ControlLoop``.
        estimator: A filter of which the code decides for the belief: a step is then
            given what sensors show. Without one it is given the state.
        points: How many points its GPs keep, those that explain most; the header says
            so. None keeps all. See ``with_points`` and ``choose_points``.
        name: Of header and source, and what their public names begin with: two
            controllers of one program need two, such as ``"outer"`` for
            ``outer_step``.

    Raises:
        SettingError: Controller or filter have a part that C cannot hold; it is named.
            Or the folder holds a file of somebody else where one is to be written.
    """
    check_name(name)
    folder = Path(path)
    check_unwritten(exported_files(folder, name))
    notes: list[str] = []
    if points is not None:
        check_exportable(controller, on_failure)
        model = controller.prediction.model
        controller, estimator = reduce_points(controller, estimator, points)
        notes.append(_note_of_points(controller.prediction.model, model))
    export = write_code(
        controller, folder / "src", precision, on_failure, estimator, notes, name
    )
    for place, template in _AROUND.items():
        file = folder / place
        text = (_HERE / "around" / template).read_text()
        file.parent.mkdir(parents=True, exist_ok=True)
        write_whole(file, _renamed(text, name).replace("@name@", name))
    return export


def check_name(name: str) -> None:
    """Raises ``SettingError`` unless files and names of C may begin with a name."""
    if re.fullmatch(r"[a-z][a-z0-9_]*", str(name)) is None:
        rule = "must be small letters, digits and _, a letter first"
        raise SettingError("name", f"{rule}; got {name!r}")
    if name in _TAKEN:
        raise SettingError("name", f"{name} is the name of another file or target")


def exported_files(folder: Path, name: str) -> list[Path]:
    """Returns the files that ``export_c`` writes into a folder."""
    around = [folder / place for place in _AROUND]
    return [*_sources(folder / "src", name), *around]


def check_unwritten(files: Iterable[Path], key: str = "path") -> None:
    """Raises ``SettingError`` where a file exists that an export did not write."""
    for file in files:
        if file.exists() and not is_exported(file):
            rule = "was not written by an export, or by one of an older version"
            raise SettingError(key, f"{file} {rule}; name another folder")


def is_exported(file: Path) -> bool:
    """Whether a file is one that an export wrote."""
    return file.is_file() and MARK in file.read_text(errors="replace")


def _sources(folder: Path, name: str) -> tuple[Path, Path]:
    """Returns where header and source are."""
    return folder / f"{name}.h", folder / f"{name}.c"


def _renamed(text: str, name: str) -> str:
    """Returns code whose public names, and those of its files, begin with a name."""
    return _PREFIX.sub(name, text).replace("GPMPC_", f"{name.upper()}_")


def _check_own_names(texts: Iterable[str], name: str) -> None:
    """Raises ``SettingError`` where a public name would be that of another thing."""
    code = _COMMENT.sub(" ", "\n".join(texts))
    words = set(re.findall(r"\w+", code))
    renamed = {word: _renamed(word, name) for word in words}
    taken = sorted(own for word, own in renamed.items() if own != word and own in words)
    if taken:
        rule = f"the code has names of its own that begin with {name}_"
        raise SettingError("name", f"{rule}, such as {taken[0]}; take another one")


def reduce_points(
    controller: GPMPC, estimator: Estimator | None, points: int
) -> tuple[GPMPC, Estimator | None]:
    """Returns controller and filter of fewer points.

    A filter with a model of its own keeps that one.
    """
    model = controller.prediction.model
    reduced = with_points(model, points)
    if estimator is not None:
        check_estimator(controller, estimator)
        kalman = estimator.filter
        if kalman.model is model:
            filter = KalmanFilter(
                reduced, kalman.measurement, kalman.propagator, kalman.observer
            )
            estimator = estimator._replace(filter=filter)
    return controller.with_model(reduced), estimator


def _note_of_points(reduced: DynamicsModel, model: DynamicsModel) -> str:
    """Returns the line that says how many points are kept."""
    points = len(posterior_of(reduced))
    size = len(posterior_of(model))
    if points == size:
        return f"points: all {size} of the model"
    return f"points: {points} of the {size} of the model, those that explain most"


def write_code(
    controller: GPMPC,
    folder: Path,
    precision: Precision,
    on_failure: str,
    estimator: Estimator | None = None,
    notes: Sequence[str] = (),
    name: str = _NAME,
) -> Export:
    """Writes header and source alone, notes in their heads; see ``export_c``."""
    check_choice("precision", precision, ("double", "float"))
    check_exportable(controller, on_failure)
    if estimator is not None:
        check_estimator(controller, estimator)
    texts = _texts(controller, Numbers(precision), on_failure, estimator, notes)
    _check_own_names(texts, name)
    folder.mkdir(parents=True, exist_ok=True)
    files = Export(*_sources(folder, name))
    for file, text in zip(files, texts, strict=True):
        write_whole(file, _renamed(text, name))
    return files


def _texts(
    controller: GPMPC,
    numbers: Numbers,
    on_failure: str,
    estimator: Estimator | None,
    notes: Sequence[str],
) -> tuple[str, str]:
    """Returns header and source."""
    functions = FunctionWriter(controller, numbers)
    prediction = controller.prediction
    means_alone = needs_means_alone(controller)
    shares_model = estimator is not None and estimator.filter.model is prediction.model
    variances = tightens(controller) or shares_model
    model = ModelWriter(numbers, variances, means_alone)
    model.write(prediction.model, "model")
    filter_tables = ""
    if estimator is not None:
        filter_tables = FilterWriter(controller, estimator, numbers, model).text
    settings = definitions(
        controller, numbers, functions, model.sizes, on_failure, estimator
    )
    generated = [
        _gp_code(model, numbers),
        model.text,
        filter_tables,
        tables(controller, numbers),
        functions.text,
    ]
    texts = {
        "generated": "\n".join(generated),
        "pairs": _part("pairs.c"),
        "exact": _part("exact.c"),
        "qp": _part("qp.c").replace("/*{rescue}*/", _part("rescue.c")),
        "filter": _part("filter.c") if estimator is not None else "",
    }
    names = [*_names(controller, estimator), *notes]
    header = _header(settings, numbers, names)
    source = needed_parts(_source(texts, names), settings.flags)
    # of both: header and source of two exports do not go together
    export = f"0x{zlib.crc32((header + source).encode()):08x}ul"
    return header.replace("{export}", export), source.replace("{export}", export)


def _gp_code(model: ModelWriter, numbers: Numbers) -> str:
    """Returns the code that evaluates GPs; a known model has none."""
    if not model.sizes["POINTS"]:
        return ""
    fixed = _part("fixed.c") if numbers.precision == "float" else ""
    return _part("gp.c").replace("/*{fixed}*/", fixed)


def _header(settings: Definitions, numbers: Numbers, names: list[str]) -> str:
    """Returns the header."""
    lines = [
        _banner("A controller in C: its memory and its calls.", names),
        "#ifndef GPMPC_H",
        "#define GPMPC_H",
        "",
        "#include <stdint.h>",
        "",
        "#define GPMPC_EXPORT {export} /* that header and source are of */",
        "",
        f"typedef {numbers.precision} gpmpc_real;",
        "",
        settings.text(),
        "",
        needed_parts(_part("core.h"), settings.flags),
        "#endif",
        "",
    ]
    return "\n".join(lines)


def _source(parts: Mapping[str, str], names: list[str]) -> str:
    """Returns the source, with parts in their places in ``core.c``."""
    core = _part("core.c")
    for name, text in parts.items():
        core = core.replace(f"/*{{{name}}}*/", text)
    lines = [
        _banner("A controller in C: tables, model, program and policy.", names),
        '#include "gpmpc.h"',
        "",
        "#include <float.h>",
        "#include <math.h>",
        "#include <stdint.h>",
        "#include <stdlib.h>",
        "#include <string.h>",
        "",
        "#if GPMPC_EXPORT != {export}",
        '#error "gpmpc.h and gpmpc.c are of two exports: take both of one"',
        "#endif",
        "",
        _part("numbers.h"),
        core,
    ]
    return "\n".join(lines)


def _part(name: str) -> str:
    """Returns a part of the code that is the same for every controller."""
    return (_HERE / name).read_text()


def _names(controller: GPMPC, estimator: Estimator | None) -> list[str]:
    """Returns the lines that name states, inputs and measurements."""
    prediction = controller.prediction
    signals = prediction.signals
    states = signals.state_names or [f"x{i}" for i in range(prediction.state_dim)]
    inputs = signals.input_names or [f"u{i}" for i in range(prediction.input_dim)]
    lines = [f"state {i}: {name}" for i, name in enumerate(states)]
    lines += [f"input {i}: {name}" for i, name in enumerate(inputs)]
    if estimator is not None:
        measurement = estimator.filter.measurement
        measured = measurement.measured_states or range(measurement.output_dim)
        for i, state in enumerate(measured):
            name = f"y{i}"
            if measurement.measured_states is not None:
                name = states[state]
            lines.append(f"measured {i}: {name}")
    if signals.time_step:
        lines.append(f"time step: {signals.time_step:g} s")
    return lines


def _banner(title: str, names: list[str]) -> str:
    """Returns the comment that a file begins with."""
    lines = [title, MARK, "", *names]
    body = "\n   ".join(comment(line) for line in lines)
    return f"/* {body} */\n".replace("\n   \n", "\n\n")
