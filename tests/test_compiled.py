"""Compiled code is reused until a source that it was compiled from has changed."""

import gc
import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

import gpmpc._compiled

ROOT = Path(__file__).resolve().parents[1]
KERNEL = """
from gpmpc._compiled import compiled
from tiny.callee import double
@compiled
def kernel(x):
    return double(x)
print(kernel(1.0), sum(kernel.stats.cache_hits.values()))
"""
CALLEE = """
from gpmpc._compiled import inline_njit
from tiny import (
    constants,  # a module
)
FACTOR = constants.FACTOR
@inline_njit
def double(x):
    return FACTOR * x
"""


@pytest.fixture
def package(tmp_path):
    """Makes a package: a kernel, its callee, the constant of that, and another file."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    texts = {
        "__init__": "",
        "kernel": KERNEL,
        "callee": CALLEE,
        "constants": "FACTOR = 2.0\n",
        "other": "A = 1\n",
    }
    for name, text in texts.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def run(package, **environment):
    """Returns the kernel's answer to 1 in a new process, and if its code was cached."""
    result = subprocess.run(
        [sys.executable, "-B", "-c", "import tiny.other, tiny.kernel"],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ
        | {"PYTHONPATH": f"{package.parent}{os.pathsep}{ROOT}"}
        | environment,
    )
    answer, hits = result.stdout.split()
    return float(answer), int(hits) == 1


def test_machine_code_is_reused_until_one_of_its_files_changes(package):
    assert run(package) == (2.0, False)
    (package / "other.py").write_text("A = 3\n")
    assert run(package) == (2.0, True)
    (package / "constants.py").write_text("FACTOR = 5.0\n")
    assert run(package) == (5.0, False)
    callee = package / "callee.py"
    callee.write_text(callee.read_text().replace("FACTOR * x", "FACTOR * x + 1.0"))
    assert run(package) == (6.0, False)
    assert run(package) == (6.0, True)


MOVED = """
from typing import NamedTuple
from gpmpc._compiled import compiled
from {module} import Pair
@compiled
def kernel(pair):
    return pair.x + pair.y
print(kernel(Pair(1.0, 2.0)), sum(kernel.stats.cache_hits.values()))
"""


def test_code_for_a_class_that_has_moved_is_compiled_anew(package):
    pair = (
        "from typing import NamedTuple\nclass Pair(NamedTuple):\n    x: float\n"
        "    y: float\n"
    )
    for module in ("here", "there"):
        (package / f"{module}.py").write_text(pair)
        (package / "kernel.py").write_text(MOVED.format(module=f"tiny.{module}"))
        assert run(package) == (3.0, False)
        (package / f"{module}.py").unlink()


OWN = """
import math
import os
from gpmpc._compiled import compiled
FACTOR = float(os.environ["FACTOR"])
@compiled
def callee(x):  # too long to be put into its caller
    y = 0.0
{lines}
    return FACTOR * x + 0.0 * y
@compiled
def first(x):
    return callee(x)
@compiled
def second(x):
    return callee(x) + callee(2.0 * x)
""".format(
    lines="\n".join(f"    y += math.cos(x + {i}.0) * math.sin(y)" for i in range(40))
)


def test_a_kernel_runs_its_own_copy_of_its_callees(tmp_path):
    """Whatever was loaded or compiled before.

    Copies of one function differ by rounding; here by a factor, so that it is seen on
    any machine.
    """
    (tmp_path / "own.py").write_text(OWN)

    def run(factor, code):
        script = f"from own import *\nprint({code})"
        result = subprocess.run(
            [sys.executable, "-B", "-c", script],
            capture_output=True,
            text=True,
            check=True,
            env=os.environ
            | {
                "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}",
                "FACTOR": factor,
                "NUMBA_CACHE_DIR": "",
            },
        )
        return [float(number) for number in result.stdout.split()]

    assert run("2", "first(1.0)") == [2.0]
    for cached in tmp_path.rglob("own.callee*"):
        cached.unlink()
    assert run("5", "second(1.0)") == [15.0]
    assert run("7", "first(1.0), second(1.0), first(1.0)") == [2.0, 15.0, 2.0]
    assert run("7", "second(1.0), first(1.0)") == [15.0, 2.0]


def test_kernels_compile_where_no_cache_can_be_written(package):
    (package / "__pycache__").write_text("in the way of the cache beside the source")
    nowhere = str(package / "other.py")  # a file: no folder can be made below it
    for _ in range(2):
        assert run(
            package, HOME=nowhere, XDG_CACHE_HOME=nowhere, NUMBA_CACHE_DIR=""
        ) == (2.0, False)


def test_a_kernels_stamp_covers_only_its_constants_and_callees():
    import gpmpc.qp._dual_active_set
    import gpmpc.qp._primal_active_set

    def covered(module):
        before = gpmpc._compiled.sources_stamp(module)
        read = gpmpc._compiled._read_source
        changed = set()
        for name in [name for name in sys.modules if name.startswith("gpmpc.")]:
            file = getattr(sys.modules[name], "__file__", None)

            def edited(path, file=file):
                digest, imported = read(path)
                return (digest[::-1] if path == file else digest), imported

            gpmpc._compiled._read_source = edited
            try:
                if gpmpc._compiled.sources_stamp(module) != before:
                    changed.add(name)
            finally:
                gpmpc._compiled._read_source = read
        return changed

    kernels = covered("gpmpc.qp._dual_kernels")
    assert {
        f"gpmpc.qp._{name}"
        for name in ("dual_iteration", "triangular", "workspace", "record")
    } <= kernels
    assert {"gpmpc._compiled", "gpmpc._kernels._simd"} <= kernels
    assert (
        not {"gpmpc.qp", "gpmpc.qp._dual_active_set", "gpmpc.qp._primal_active_set"}
        & kernels
    )


def test_numba_still_has_the_private_parts_that_are_used_here():
    """If one has moved, see ``gpmpc._compiled``.

    Then kernels compile for longer, and edits of other files go unseen.
    """
    from numba.core.codegen import CPUCodegen, JITCodeLibrary
    from numba.core.compiler import Compiler, Flags
    from numba.core.cpu import CPUTargetOptions

    hooks = (
        "_optimize_functions",
        "_get_module_for_linking",
        "finalize",
        "_optimize_final_module",
        "_finalize_final_module",
        "_finalize_dynamic_globals",
        "get_pointer_to_function",
    )
    assert all(callable(getattr(JITCodeLibrary, hook)) for hook in hooks)
    assert isinstance(JITCodeLibrary.codegen, property)
    assert callable(Compiler.define_pipelines)
    assert callable(Compiler.compile_extra)
    assert callable(CPUCodegen._module_pass_manager)
    inherited = {"nrt", "forceinline", "error_model", "fastmath"}
    assert inherited <= set(Flags.options)
    assert all(
        hasattr(CPUTargetOptions, option)
        for option in ("_nrt", "no_cfunc_wrapper", "no_cpython_wrapper")
    )

    @gpmpc._compiled.njit_noalloc
    def inner(x):
        return 2.0 * x

    @gpmpc._compiled.compiled
    def kernel(x):
        return inner(x) + 1.0

    assert kernel._cache._cache_file._version.startswith(f"{numba.__version__} ")
    assert (kernel(1.0), inner(1.0)) == (
        3.0,
        2.0,
    )  # as a part of the kernel, and in Python
    anew = numba.njit(**gpmpc._compiled._KERNEL_OPTIONS)(
        kernel.py_func
    )  # ``kernel`` may have been loaded
    anew(1.0)
    library = anew.overloads[anew.signatures[0]].library
    assert type(library) is gpmpc._compiled._KernelLibrary
    assert gpmpc._compiled._InnerLibrary in {
        type(part) for part in library._linking_libraries
    }
    assert (
        gpmpc._compiled.unchecked_entry_point(kernel)
        is kernel.overloads[kernel.signatures[0]].entry_point
    )


def test_a_callee_is_compiled_once_without_collecting_garbage():
    """Once for kernels that keep the interpreter's lock and for those that do not."""
    from numba.core import event

    @gpmpc._compiled.njit_noalloc
    def callee(x):
        return 2.0 * x

    def caller(x):
        return callee(x) + 1.0

    class Passes(event.Listener):
        """What was lowered, and whether garbage was collected then."""

        def __init__(self):
            self.lowered = []
            self.collects = set()

        def on_start(self, event):
            name = event.data["name"].removesuffix("]")
            if name.startswith("native_lowering"):
                self.lowered.append(name.rpartition(".")[2])
            self.collects.add(gc.isenabled())

        def on_end(self, event):
            pass

    options = gpmpc._compiled._KERNEL_OPTIONS
    with event.install_listener("numba:run_pass", Passes()) as passes:
        for locked in (True, False):
            assert numba.njit(nogil=not locked, **options)(caller)(1.0) == 3.0
    assert passes.lowered == ["callee", "caller", "caller"]
    assert passes.collects == {False}
    assert gc.isenabled()


def test_kernels_compile_without_numbas_private_parts(monkeypatch):
    monkeypatch.setattr(gpmpc._compiled, "_KERNEL_OPTIONS", {})
    monkeypatch.setattr(gpmpc._compiled, "_INNER_OPTIONS", {})

    @gpmpc._compiled.njit_noalloc
    def inner(x):
        return 2.0 * x

    @gpmpc._compiled.compiled(allocates=False)
    def kernel(x):
        return inner(x) + 1.0

    assert kernel(1.0) == 3.0
    assert gpmpc._compiled.unchecked_entry_point(print) is print


def test_another_numba_caches_in_its_own_way(monkeypatch):
    class Kernel:
        """Without the private parts."""

    monkeypatch.setattr(numba, "njit", lambda **options: lambda function: Kernel())
    assert isinstance(gpmpc._compiled.compiled(len), Kernel)


def test_unchecked_calls_take_arguments_by_place_and_by_name():
    @gpmpc._compiled.compiled
    def divide(x, y):
        return x / y

    for _ in range(2):  # compiled, and then straight to the machine code
        assert divide.unchecked(1.0, 2.0) == divide.unchecked(y=2.0, x=1.0) == 0.5
    with pytest.raises(TypeError, match="y"):
        divide.unchecked(1.0)
