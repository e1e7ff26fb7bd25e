"""How the kernels of this package are compiled: serially, mostly without the interpreter's lock, once per machine.

numba keeps the machine code beside the source, or in the user's cache folder when the installation is read-only. When
neither can be written it refuses to cache; the kernels are then compiled anew in each process. Sums may be reordered
(that is what makes them vectorise); infinities and NaN keep their meaning. A kernel's results are the same to the last
bit whether it was compiled in this process or loaded, and whatever else was.

A kernel contains what it calls and the constants that it reads, wherever they are written; numba looks at the kernel's
own file only. So what is kept here is valid for one state of all modules of the package that the kernel's module
imports, directly or not.
"""

import hashlib
import re
import sys
import time
from collections.abc import Callable
from functools import cache, partial
from threading import Lock

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

try:  # not promised
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler
except ImportError:
    JITCodeLibrary = Compiler = None

_compiling = Lock()


REORDERED = frozenset({"reassoc", "contract", "nsz"})


def compiled(
    function: Callable | None = None,
    *,
    fastmath: frozenset[str] = REORDERED,
    allocates: bool = True,
    woven: bool = False,
    locked: bool = False,
) -> Callable:
    """Compiles ``function`` at its first call.

    Args:
        function: The function; this is a decorator.
        fastmath: LLVM's flags for it.
        allocates: False if it, and all that it calls, make no array but views of those they are given. numba then
            counts no references: an atomic operation for each view, which is 40 % of a solve of two microseconds.
        woven: Whether its code is put into each of its callers. A call hands over an array as seven numbers, so that
            one with a dozen arrays takes longer than the work on a few short vectors.
        locked: Whether it keeps the interpreter's lock, as a kernel of microseconds may: two threads are then never in
            it at once and can share its workspace. To let go of the lock takes a fortieth of a microsecond.
    """
    if function is None:
        return partial(compiled, fastmath=fastmath, allocates=allocates, woven=woven, locked=locked)
    options = {"nogil": not locked, "fastmath": set(fastmath), "forceinline": woven}
    if not allocates and _knows("_nrt"):  # not promised; kernels are slower without it
        options["_nrt"] = False
    if _knows("no_cfunc_wrapper"):  # nothing in C calls a kernel; a way in for it is another tenth of compiling
        options["no_cfunc_wrapper"] = True
    if Compiler is not None:
        options["pipeline_class"] = _Compiler
    return _jit(function, options)


def _knows(option: str) -> bool:
    """Whether this numba has an option that it does not document."""
    try:
        from numba.core.cpu import CPUTargetOptions
    except ImportError:
        return False
    return hasattr(CPUTargetOptions, option)


class _Code(JITCodeLibrary or object):
    """A kernel's machine code, with copies of all that it calls.

    numba makes such copies, but lets the linker take any other of the same name for them: that of the function compiled
    by itself, or of another kernel that was loaded earlier. They are optimised, and so rounded, each in its own way,
    and a kernel's last digits then depend on what else has been compiled or loaded. Here they are the kernel's own.
    """

    def _finalize_final_module(self):
        for_callers = self._final_module  # in which copies have to remain mergeable
        self._final_module = for_callers.clone()
        self._final_module.name = for_callers.name
        for function in self._final_module.functions:
            if function.linkage.name == "linkonce_odr":
                function.linkage = "internal"
        super()._finalize_final_module()
        self._final_module = for_callers


class _Compiler(Compiler or object):
    """numba's compiler, for ``_Code``."""

    def define_pipelines(self):
        if self.state.library is None:
            self.state.library = _Code(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
            self.state.library.enable_object_caching()  # as numba does where it makes a library of its own
        return super().define_pipelines()


def _jit(function: Callable, options: dict) -> Callable:
    try:
        kernel = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # "cannot cache function ...: no locator available"
        return numba.njit(**options)(function)
    try:
        index = kernel._cache._cache_file
        index._source_stamp = index._source_stamp, sources_stamp(function.__module__)
    except AttributeError:  # another numba: edits of other files go unseen
        pass
    return kernel


IMPORT = re.compile(
    rb"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import[ \t]+(\([^)]*\)|.*)|import[ \t]+([\w., \t]+))", re.MULTILINE
)


def sources_stamp(module: str) -> bytes:
    """A hash of the sources of a module and of all those it imports, directly or not, from its own package or this one.

    The modules must have been imported: of others no kernel can contain anything. Imports are to be absolute.
    """
    packages = {name.partition(".")[0] for name in (module, __name__)}
    pending, seen = [module], {}
    while pending:
        name = pending.pop()
        if name not in seen and name.partition(".")[0] in packages and name in sys.modules:
            seen[name], imported = _read_source(getattr(sys.modules[name], "__file__", None))
            pending += imported
    return hashlib.sha256(b"".join(seen[name] for name in sorted(seen))).digest()


@cache
def _read_source(path: str | None) -> tuple[bytes, list[str]]:
    """The hash of a file, and the names in its import statements that can be modules."""
    try:
        with open(path or "", "rb") as file:
            source = file.read()
    except OSError:  # in an archive, or no file at all
        return b"", []
    imported = []
    for parent, names, plain in IMPORT.findall(source):
        imported += re.findall(r"[\w.]+", plain.decode())
        if parent:
            parts = [f"{parent.decode()}.{name}" for name in re.findall(r"\w+", names.decode())]
            modules = [part for part in parts if part in sys.modules]
            imported += modules if len(modules) == len(parts) else [parent.decode(), *modules]
    return hashlib.sha256(source).digest(), imported


borrowing = partial(compiled, allocates=False)
"""Compiles a function whose arrays are all borrowed from its caller."""

woven = partial(borrowing, woven=True)
"""Compiles such a function as a part of its callers."""


@borrowing
def copy(x, y):
    """Writes a vector to one of its length. For ``y[:] = x`` numba compiles an error's words: a second a kernel."""
    for i in range(len(y)):
        y[i] = x[i]


@borrowing
def copy_matrix(X, Y):
    """Writes a matrix to one of its shape."""
    for r in range(len(Y)):
        copy(X[r], Y[r])


def compile_for(kernel: Callable, signature: str) -> None:
    """Compiles ``kernel`` for one signature and no other: it then refuses other types with ``TypeError``.

    Without this numba would quietly build a second kernel for Fortran-ordered or integer arrays.
    """
    with _compiling:
        if not kernel.signatures:
            kernel.compile(signature)
            kernel.disable_compile()


def direct(kernel: Callable) -> Callable:
    """The machine code of a kernel that ``compile_for`` has compiled, called without numba's look at the arguments.

    That look takes a quarter of a microsecond. The caller has to see to it that each argument is a NumPy array of the
    right dtype; other objects and other numbers of axes raise ``TypeError``, strides are the kernel's business.
    """
    try:
        return next(iter(kernel.overloads.values())).entry_point
    except (AttributeError, StopIteration):  # another numba
        return kernel


@intrinsic
def clock(typing_context):
    """Seconds since some moment, inside compiled code; zero where the system has no monotonic POSIX clock."""

    def generate(context, builder, signature, arguments):
        if not hasattr(time, "CLOCK_MONOTONIC"):
            return context.get_constant(types.float64, 0.0)
        whole, narrow = ir.IntType(64), ir.IntType(32)
        moment = cgutils.alloca_once(builder, ir.ArrayType(whole, 2))  # struct timespec
        kind = ir.FunctionType(narrow, [narrow, moment.type])
        read = cgutils.get_or_insert_function(builder.module, kind, "clock_gettime")
        builder.call(read, [narrow(time.CLOCK_MONOTONIC), moment])
        parts = [builder.extract_value(builder.load(moment), i) for i in range(2)]
        seconds, nanoseconds = (builder.sitofp(part, ir.DoubleType()) for part in parts)
        return builder.fadd(seconds, builder.fmul(nanoseconds, ir.DoubleType()(1e-9)))

    return types.float64(), generate
