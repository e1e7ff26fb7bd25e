"""What the exported source needs from elsewhere."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.export_checks import foreign_symbols, undefined_symbols
from gpmpc.export import export_c
from gpmpc.mpc import GPMPC, Box, Problem, Tracking
from gpmpc.propagation import Linearization
from gpmpc.signals import Signals
from tests.mpc.small_models import pendulum_posterior

pytestmark = pytest.mark.skipif(
    sys.platform != "linux" or None in (shutil.which("cc"), shutil.which("nm")),
    reason="needs a C compiler, nm and glibc",
)


def controller_of(*constraints, points=40):
    problem = Problem(
        Tracking([1.0, 0.1], [0.05]), Box([-2.0], [2.0]), constraints=constraints
    )
    model = pendulum_posterior(points)
    return GPMPC(model, Linearization(), problem, 6, [0.0], iterations=1)


def test_it_links_to_libm_alone_and_allocates_nothing(tmp_path):
    controller = controller_of(Box(upper=[0.5, np.inf], probability=0.9))
    for precision in ("double", "float"):
        export = export_c(controller, tmp_path / precision, precision)
        compiled = tmp_path / f"{precision}.o"
        command = ["cc", "-std=c99", "-O0", "-c", str(export.source)]
        subprocess.run([*command, "-o", str(compiled)], check=True)
        needed = undefined_symbols(compiled)
        assert not foreign_symbols(needed)
        assert any(name.startswith("sqrt") for name in needed)


def complaints(source, *options, folder="."):
    """Returns what the compiler says to options without compiling."""
    command = ["cc", "-std=c99", "-fsyntax-only", *options, str(source)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    return done.stderr if done.returncode else ""


def test_options_that_reorder_sums_are_refused(tmp_path):
    source = export_c(controller_of(), tmp_path).source
    assert not complaints(source)
    assert "-ffast-math" in complaints(source, "-ffast-math")
    assert "-ffinite-math-only" in complaints(source, "-ffinite-math-only")


def test_header_and_source_of_two_exports_do_not_compile(tmp_path):
    source = export_c(controller_of(), tmp_path / "one").source
    header = export_c(controller_of(Box(upper=[0.5, np.inf])), tmp_path / "two").header
    header.replace(source.with_suffix(".h"))
    assert "are of two exports" in complaints(source)


def test_it_holds_no_part_of_what_the_controller_lacks(tmp_path):
    plain = export_c(controller_of(), tmp_path / "plain")
    bounded = Box(upper=[0.5, np.inf], probability=0.9)
    tube = export_c(controller_of(bounded), tmp_path / "tube")
    for export in (plain, tube):
        assert "#if GPMPC" not in export.header.read_text()
        text = export.source.read_text()
        conditions = re.findall("#if.* (GPMPC_[A-Z_]+)", text)
        assert conditions == ["GPMPC_EXPORT"]
    assert "predict_covariances" not in plain.source.read_text()
    assert "predict_covariances" in tube.source.read_text()


def test_a_controller_of_a_later_model_keeps_its_ranges(tmp_path):
    """Where the first model's data were is what its plans are told to be near."""
    first = controller_of()
    other = controller_of(points=5)
    later = first.with_model(other.prediction.model)
    tables = []
    for name, exported in (("first", first), ("later", later), ("other", other)):
        text = export_c(exported, tmp_path / name).source.read_text()
        table = re.search(r"data_ranges\[.*?\};", text, re.DOTALL)
        assert table is not None
        tables.append(table.group())
    assert tables[1] == tables[0]
    assert tables[2] != tables[0]


def test_two_controllers_of_one_program_have_names(tmp_path):
    program = """
        #include "inner.h"
        #include "outer.h"
        int main(void)
        {
            static outer_controller outer;
            static inner_controller inner;
            outer_reset(&outer);
            inner_reset(&inner);
            return outer_memory() == inner_memory() || OUTER_ROWS == INNER_ROWS;
        }
    """
    bounded = controller_of(Box(upper=[0.5, np.inf]))
    export_c(controller_of(), tmp_path / "outer", name="outer")
    export_c(bounded, tmp_path / "inner", name="inner")
    (tmp_path / "main.c").write_text(program)
    sources = ["main.c", "outer/src/outer.c", "inner/src/inner.c"]
    folders = ["-Iouter/src", "-Iinner/src"]
    command = ["cc", "-std=c99", "-O0", *folders, *sources, "-lm", "-o", "both"]
    subprocess.run(command, cwd=tmp_path, check=True)
    subprocess.run(["./both"], cwd=tmp_path, check=True)


BOARD = """
    #pragma once
    struct Port { void begin(long); void println(unsigned long); };
    extern Port Serial;
    unsigned long micros();
    void delay(unsigned long);
"""


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
def test_the_sketch_of_a_board_is_cpp_and_the_source_may_be(tmp_path):
    """Builds for boards, and those of a careless user, take C for C++."""
    export_c(controller_of(), tmp_path, name="arm")
    (tmp_path / "board.h").write_text(BOARD)
    command = ["c++", "-std=c++11", "-fsyntax-only", "-Wall", "-Wextra", "-Werror"]
    sketch = ["-include", "board.h", "-x", "c++", "examples/step_time/step_time.ino"]
    subprocess.run([*command, "-Isrc", *sketch, "src/arm.c"], cwd=tmp_path, check=True)


def test_names_of_signals_end_no_comment(tmp_path):
    names = ["*/ int x;", "*\\ /\\* int y; \u202e\n #error ???/"]
    gp = replace(pendulum_posterior(), signals=Signals(names, ["float"], 0.2))
    problem = Problem(Tracking([1.0, 0.1], [0.05]))
    controller = GPMPC(gp, Linearization(), problem, 6, [0.0], iterations=1)
    export = export_c(controller, tmp_path)
    assert "* / int x;" in export.header.read_text()
    assert "* / // * int y;" in export.header.read_text()
    assert not complaints(export.source, "-Wall", "-Wextra", "-Werror", "-pedantic")


def test_what_allocates_is_foreign():
    assert foreign_symbols(["sqrt", "fma", "memcpy", "malloc"]) == ["malloc"]
