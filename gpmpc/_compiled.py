"""Compilation of the package's kernels by numba: serial, mostly without the interpreter's lock, once per machine.

A kernel is what Python calls: ``compiled``. What only other compiled functions call is ``njit_inner``, ``njit_noalloc``
or ``inline_njit``: it has no machine code of its own but is optimised inside each kernel that it is a part of, which
saves more than half of the time that compilation takes.

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
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from threading import Lock
from typing import Any, ParamSpec, Protocol, TypeVar, overload

import numba
from numba.extending import register_jitable

_compiling = Lock()


P = ParamSpec("P")
R = TypeVar("R", covariant=True)


class Kernel(Protocol[P, R]):
    """A compiled function that Python calls."""

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Runs the kernel after numba's look at the arguments' types."""
        ...

    @property
    def unchecked(self) -> Callable[P, R]:
        """Runs the kernel without a look at the arguments, from the second call on.

        For callers that always pass arguments of the same types, by position, and
        contiguous arrays. Where arguments are named tuples, that look takes longer than
        many a kernel.
        """
        ...


@overload
def compiled(function: Callable[P, R]) -> Kernel[P, R]: ...


@overload
def compiled(
    *,
    allocates: bool = True,
    kernel: bool = True,
    inline: bool = False,
    locked: bool = False,
) -> Callable[[Callable[P, R]], Kernel[P, R]]: ...


def compiled(
    function: Callable | None = None,
    *,
    allocates: bool = True,
    kernel: bool = True,
    inline: bool = False,
    locked: bool = False,
) -> Any:
    """Compiles ``function`` at its first call.

    Args:
        function: The function; this is a decorator.
        allocates: False if it, and all that it calls, make no array but views of those they are given. numba then
            counts no references: an atomic operation for each view, which is 40 % of a solve of two microseconds.
        kernel: Whether Python calls its machine code. Otherwise only other compiled functions do, which is cheaper to
            compile; in Python it stays the function that it is.
        inline: Whether its code is put into each of its callers. A call hands over an array as seven numbers, so that
            one with a dozen arrays takes longer than the work on a few short vectors.
        locked: Whether it keeps the interpreter's lock, as a kernel of microseconds may: two threads are then never in
            it at once and can share its workspace. To let go of the lock takes a fortieth of a microsecond.
    """
    if function is None:
        return partial(
            compiled, allocates=allocates, kernel=kernel, inline=inline, locked=locked
        )
    options = {
        "nogil": not locked,
        "fastmath": {"reassoc", "contract", "nsz"},
        "forceinline": inline,
    }
    options |= _PRIVATE_OPTIONS[kernel] | ({} if allocates else {"_nrt": False})
    if not kernel:
        return register_jitable(**options)(function)
    dispatcher = _jit_cached(function, options)
    _offer_unchecked_calls(dispatcher)
    return dispatcher


njit_inner: Any = partial(compiled, kernel=False)
"""Compiles a part of other compiled functions."""

njit_noalloc: Any = partial(njit_inner, allocates=False)
"""Compiles a part of other compiled functions that makes no arrays but views."""

inline_njit: Any = partial(njit_noalloc, inline=True)
"""Compiles such a function into each of its callers."""

# numba optimises every function that a kernel calls, and makes machine code of it, before it does so for the kernel,
# which contains it all. No public interface prevents that, nor does one prevent a kernel from running another kernel's
# copy of what both call. Where a numba without these private parts is installed, kernels are compiled as it does by
# itself: slower to start, and their last digits depend on what was loaded before. ``tests/test_compiled.py`` notices.
_PRIVATE_OPTIONS: dict[bool, dict[str, Any]] = {True: {}, False: {}}
with suppress(ImportError):
    from numba.core.codegen import JITCodeLibrary
    from numba.core.compiler import Compiler

    class _KernelLibrary(JITCodeLibrary):
        """A kernel's machine code, with its own copies of all that it calls.

        numba lets the linker take any other copy of the same name: that of another kernel that was loaded earlier. They
        are optimised, and so rounded, each in its own way.
        """

        def _finalize_final_module(self):
            for function in self._final_module.functions:
                if function.linkage.name == "linkonce_odr":
                    function.linkage = "internal"
            super()._finalize_final_module()

    class _InnerLibrary(JITCodeLibrary):
        """LLVM's intermediate code of a part of kernels: linked into them, neither optimised nor assembled before."""

        class _NoEngine:
            def set_env(self, name, environment):
                """Does nothing: there is no machine code to tell its environment."""

        codegen = _NoEngine()  # pyright: ignore[reportIncompatibleMethodOverride, reportAssignmentType]

        def _optimize_final_module(self):
            pass

        def _finalize_final_module(self):
            self._finalize_dynamic_globals()
            self._finalized = True

        def get_pointer_to_function(self, name):
            """Nothing: Python calls the function itself."""
            return 0

    class _KernelCompiler(Compiler):
        library: Any = _KernelLibrary

        def define_pipelines(self):
            if self.state.library is None:
                self.state.library = self.library(
                    self.state.targetctx.codegen(), self.state.func_id.func_qualname
                )
                self.state.library.enable_object_caching()  # as numba does where it makes a library of its own
            return super().define_pipelines()

    class _InnerCompiler(_KernelCompiler):
        library = _InnerLibrary

    # nothing in C calls a kernel, and Python no inner function: ways in take a tenth of the time
    _PRIVATE_OPTIONS[True] = {
        "pipeline_class": _KernelCompiler,
        "no_cfunc_wrapper": True,
    }
    _PRIVATE_OPTIONS[False] = {
        "pipeline_class": _InnerCompiler,
        "no_cfunc_wrapper": True,
        "no_cpython_wrapper": True,
    }


def _jit_cached(function: Callable, options: dict) -> Callable:
    try:
        kernel: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # "cannot cache function ...: no locator available"
        return numba.njit(**options)(function)
    with suppress(AttributeError):  # another numba: edits of other files go unseen
        index = kernel._cache._cache_file
        # compared before anything else in the index is read, which may name modules that are gone
        index._version = f"{index._version} {sources_stamp(function.__module__).hex()}"
    return kernel


def _offer_unchecked_calls(kernel: Any) -> None:
    """Gives a kernel its attribute ``unchecked``; see ``Kernel``."""

    def call_and_remember(*arguments: Any) -> Any:
        result = kernel(*arguments)
        kernel.unchecked = unchecked_entry_point(kernel)
        return result

    kernel.unchecked = call_and_remember


def sources_stamp(module: str) -> bytes:
    """A hash of the sources of a module and of all those it imports, directly or not, from its own package or this one.

    The modules must have been imported: of others no kernel can contain anything. Imports are to be absolute.
    """
    packages = {name.partition(".")[0] for name in (module, __name__)}
    pending = [module]
    seen = {}
    while pending:
        name = pending.pop()
        if (
            name not in seen
            and name.partition(".")[0] in packages
            and name in sys.modules
        ):
            seen[name], imported = _read_source(
                getattr(sys.modules[name], "__file__", None)
            )
            pending += imported
    return hashlib.sha256(b"".join(seen[name] for name in sorted(seen))).digest()


_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+)?import[ \t]+(\([^)]*\)|.*)", re.MULTILINE
)


@cache
def _read_source(path: str | None) -> tuple[bytes, list[str]]:
    """The hash of a file, and the names in its import statements that can be modules."""
    try:
        source = Path(path or "").read_text(encoding="utf-8")
    except OSError:  # in an archive, or no file at all
        return b"", []
    imported = []
    for parent, names in _IMPORT.findall(source):
        parts = [
            f"{parent}.{name}" if parent else name
            for name in re.findall(r"[\w.]+", names)
        ]
        imported += [part if part in sys.modules else parent for part in parts]
    return hashlib.sha256(source.encode()).digest(), imported


def compile_for(kernel: Any, signature: str) -> None:
    """Compiles ``kernel`` for one signature and no other: it then refuses other types with ``TypeError``.

    Without this numba would quietly build a second kernel for Fortran-ordered or integer arrays.
    """
    with _compiling:
        if not kernel.signatures:
            kernel.compile(signature)
            kernel.disable_compile()


def unchecked_entry_point(kernel: Any) -> Callable:
    """The machine code of a compiled kernel, called without numba's look at the arguments, a quarter of a microsecond.

    The caller has to see to it that each argument is a NumPy array of the right dtype; other objects and other numbers
    of axes raise ``TypeError``, strides are the kernel's business.
    """
    try:
        return next(iter(kernel.overloads.values())).entry_point
    except (AttributeError, StopIteration):  # another numba
        return kernel
