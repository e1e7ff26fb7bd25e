"""Compiles the package's kernels with numba: serial, and once per machine.

A kernel is what Python calls: ``compiled``. What only other compiled functions call is
``njit_inner``, ``njit_noalloc`` or ``inline_njit``: it has no machine code of its own
but is optimised inside each kernel that it is a part of, which saves more than half of
the time that compilation takes. Kernels let go of the interpreter's lock, unless they
are ``locked``.

numba keeps the machine code beside the source, or in the user's cache folder when the
installation is read-only. When neither can be written it refuses to cache; the kernels
are then compiled anew in each process. Sums may be reordered (that is what makes them
vectorise); infinities and NaN keep their meaning. A kernel's results are the same to
the last bit whether it was compiled in this process or loaded, and whatever else was.

A kernel contains what it calls and the constants that it reads, wherever they are
written; numba looks at the kernel's own file only. So machine code is loaded only if no
module of the package that the kernel's module imports, directly or not, has changed.
"""

import gc
import hashlib
import inspect
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, partial, update_wrapper
from pathlib import Path
from threading import Lock
from typing import Any, ParamSpec, Protocol, TypeVar, overload

import numba
from numba.extending import register_jitable

P = ParamSpec("P")
R = TypeVar("R")
R_co = TypeVar("R_co", covariant=True)

_compiling = Lock()


class Kernel(Protocol[P, R_co]):
    """A compiled function that Python calls."""

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R_co:
        """Runs the kernel after numba has looked at the arguments' types."""
        ...

    @property
    def unchecked(self) -> Callable[P, R_co]:
        """Runs the kernel without that look, from its second call on.

        For callers that always pass arguments of the same types, and contiguous arrays,
        by place or by name. Where arguments are named tuples, the look takes longer
        than many a kernel.
        """
        ...


@overload
def compiled(function: Callable[P, R]) -> Kernel[P, R]: ...


@overload
def compiled(
    *, allocates: bool = True, locked: bool = False
) -> Callable[[Callable[P, R]], Kernel[P, R]]: ...


def compiled(
    function: Callable | None = None, *, allocates: bool = True, locked: bool = False
) -> Any:
    """Compiles a function that Python calls, at its first call; a decorator.

    Args:
        function: The function.
        allocates: False if it, and all that it calls, make no arrays but views of those
            they are given. numba then counts no references: an atomic operation for
            each view, which is 40 % of a solve of two microseconds.
        locked: Whether it keeps the interpreter's lock, as a kernel of microseconds
            may: two threads are then never in it at once and can share its workspace.
            To let go of the lock takes a fortieth of a microsecond.
    """
    if function is None:
        return partial(compiled, allocates=allocates, locked=locked)
    options = _options(allocates) | _KERNEL_OPTIONS | {"nogil": not locked}
    kernel = _jit_cached(function, options)
    kernel.unchecked = _unchecked_call(function, kernel)
    return kernel


def njit_inner(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a part of other compiled functions; in Python it stays as it is.

    Those are of ``compiled``, or parts themselves: what numba alone compiles would not
    find what the part calls.
    """
    options = _options(allocates=True) | _INNER_OPTIONS
    return register_jitable(**options)(function)


def njit_noalloc(function: Callable[P, R]) -> Callable[P, R]:
    """Compiles a part of other compiled functions that makes no arrays but views."""
    options = _options(allocates=False) | _INNER_OPTIONS
    return register_jitable(**options)(function)


def inline_njit(function: Callable[P, R]) -> Callable[P, R]:
    """Puts the code of a function that makes no arrays into each of its callers.

    A call hands over an array as seven numbers, so that one with a dozen arrays takes
    longer than the work on a few short vectors.
    """
    options = _options(allocates=False) | _INNER_OPTIONS | {"forceinline": True}
    return register_jitable(**options)(function)


def _options(allocates: bool) -> dict[str, Any]:
    """Returns numba's options that all compiled functions share."""
    options: dict[str, Any] = {
        "nogil": True,
        "fastmath": {"reassoc", "contract", "nsz"},
        # what a function calls would inherit it, and be compiled once more for each
        "forceinline": False,
    }
    if not allocates:
        options["_nrt"] = False
    return options


@contextmanager
def _without_collections() -> Iterator[None]:
    """Keeps Python from collecting garbage for as long as a kernel is compiled.

    Each collection walks through all objects of PyTorch and SciPy, and the many of
    numba cause one after another: a tenth of the time of compilation.
    """
    if not gc.isenabled():
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


# numba optimises every function that a kernel calls, and makes machine code of it,
# before it does so for the kernel, which contains it all. No public interface prevents
# that, nor does one prevent a kernel from running another kernel's copy of what both
# call. Where a numba without these private parts is installed, kernels are compiled as
# it does by itself: slower to start, and their last digits depend on what was loaded
# before. ``tests/test_compiled.py`` notices.
_KERNEL_OPTIONS: dict[str, Any] = {}
_INNER_OPTIONS: dict[str, Any] = {}
with suppress(ImportError):
    from numba.core.codegen import CodeLibrary, JITCodeLibrary
    from numba.core.compiler import Compiler, Flags

    class _Library(JITCodeLibrary):
        """LLVM's intermediate code of a kernel, or of a part of one."""

        _final_module: Any
        _linking_libraries: list[CodeLibrary]

        def _optimize_functions(self, ll_module):
            """Leaves the functions as they are: the kernel is optimised as a whole."""
            ll_module.data_layout = self._codegen._data_layout

    class _KernelLibrary(_Library):
        """A kernel's machine code, with its own copies of all that it calls.

        numba lets the linker take any other copy of the same name: that of another
        kernel that was loaded earlier. They are optimised, and so rounded, each in its
        own way.
        """

        def finalize(self):
            """Links what the kernel's parts call too, once each, and optimises all."""
            libraries = dict.fromkeys(self._linking_libraries)
            pending = list(libraries)
            while pending:
                library = pending.pop()
                if isinstance(library, _InnerLibrary):
                    called = [
                        part
                        for part in library._linking_libraries
                        if part not in libraries
                    ]
                    libraries.update(dict.fromkeys(called))
                    pending += called
            self._linking_libraries = list(libraries)
            super().finalize()

        def _optimize_final_module(self):
            """Runs LLVM's passes once; numba runs the cheaper half of them before."""
            passes, builder = self._codegen._module_pass_manager()
            passes.run(self._final_module, builder)

        def _finalize_final_module(self):
            for function in self._final_module.functions:
                if function.linkage.name == "linkonce_odr":
                    function.linkage = "internal"
            super()._finalize_final_module()

    class _InnerLibrary(_Library):
        """LLVM's intermediate code of a part of kernels, without that of what it calls.

        It is linked into them, and neither optimised nor assembled before.
        """

        class _NoEngine:
            def set_env(self, name, environment):
                """Does nothing: there is no machine code to tell its environment."""

        codegen: Any = _NoEngine()

        def finalize(self):
            """Leaves the rest to the kernel."""
            self._finalize_dynamic_globals()
            self._finalized = True

        def _get_module_for_linking(self):
            for function in self._final_module.functions:
                if function.linkage.name == "external" and not function.is_declaration:
                    function.linkage = "linkonce_odr"
            return self._final_module

        def get_pointer_to_function(self, name):
            """Returns nothing: Python calls the function itself."""
            return 0

    class _Flags(Flags):
        """Options of a compilation, equal where callees would inherit the same.

        numba compiles a callee anew for a caller with other options, and looks for it
        by comparing all of them tens of thousands of times. A callee inherits four.
        """

        def _inherited(self) -> tuple:
            return self.nrt, self.forceinline, self.error_model, self.fastmath

        def __eq__(self, other: object) -> bool:
            return isinstance(other, _Flags) and (
                self._values == other._values or self._inherited() == other._inherited()
            )

        def __hash__(self) -> int:
            return hash(_Flags)

    class _KernelCompiler(Compiler):
        library: Any = _KernelLibrary

        def __init__(self, typing, target, library, types, result, flags, names):
            super().__init__(
                typing, target, library, types, result, _Flags(flags), names
            )

        def compile_extra(self, func):
            with _without_collections():
                return super().compile_extra(func)

        def define_pipelines(self):
            if self.state.library is None:
                self.state.library = self.library(
                    self.state.targetctx.codegen(), self.state.func_id.func_qualname
                )
                # as numba does where it makes a library of its own
                self.state.library.enable_object_caching()
            return super().define_pipelines()

    class _InnerCompiler(_KernelCompiler):
        library = _InnerLibrary

    # nothing in C calls a kernel, and Python no inner function: to make these ways in
    # would take a tenth of the time of compilation
    _KERNEL_OPTIONS.update(pipeline_class=_KernelCompiler, no_cfunc_wrapper=True)
    _INNER_OPTIONS.update(
        pipeline_class=_InnerCompiler, no_cfunc_wrapper=True, no_cpython_wrapper=True
    )


def _jit_cached(function: Callable, options: dict[str, Any]) -> Any:
    try:
        kernel: Any = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # "cannot cache function ...: no locator available"
        return numba.njit(**options)(function)
    with suppress(AttributeError):  # another numba: edits of other files go unseen
        index = kernel._cache._cache_file
        # the version is compared before anything else in the index is read, which may
        # name modules that are gone
        index._version = f"{index._version} {sources_stamp(function.__module__).hex()}"
    return kernel


def _unchecked_call(function: Callable, kernel: Any) -> Callable:
    """Makes a function's ``Kernel.unchecked``.

    Machine code takes its arguments by place alone. A function that has the kernel's
    parameters puts them in place, and costs no dictionary of names as ``**kwargs``
    would.
    """

    def run_first(*arguments: Any) -> Any:
        value = kernel(*arguments)
        namespace["run"] = unchecked_entry_point(kernel)
        return value

    names = ", ".join(inspect.signature(function).parameters)
    namespace: dict[str, Any] = {"run": run_first}
    exec(f"def unchecked({names}): return run({names})", namespace)
    return update_wrapper(namespace["unchecked"], function)


def sources_stamp(module: str) -> bytes:
    """Returns a hash of the sources of a module and of all that it imports.

    Modules that it imports indirectly count too; those of other packages than its own
    and this one do not. The modules must have been imported: of others no kernel can
    contain anything. Imports are to be absolute.
    """
    packages = {name.partition(".")[0] for name in (module, __name__)}
    pending = [module]
    digests: dict[str, bytes] = {}
    while pending:
        name = pending.pop()
        package = name.partition(".")[0]
        if name in digests or package not in packages or name not in sys.modules:
            continue
        file = getattr(sys.modules[name], "__file__", None)
        digests[name], imported = _read_source(file)
        pending += imported
    return hashlib.sha256(b"".join(digests[name] for name in sorted(digests))).digest()


_IMPORT = re.compile(
    r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+)?import[ \t]+(\([^)]*\)|.*)", re.MULTILINE
)


@cache
def _read_source(path: str | None) -> tuple[bytes, list[str]]:
    """Returns a file's hash, and the names in its imports that can be modules."""
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
    """Compiles a kernel for one signature and no other.

    It then refuses other types with ``TypeError``. Without this numba would quietly
    build a second kernel for Fortran-ordered or integer arrays.
    """
    with _compiling:
        if not kernel.signatures:
            kernel.compile(signature)
            kernel.disable_compile()


def unchecked_entry_point(kernel: Any) -> Callable:
    """Returns the machine code of a compiled kernel, which checks no argument's type.

    The caller has to see to it that each argument is a NumPy array of the right dtype;
    other objects and other numbers of axes raise ``TypeError``, strides are the
    kernel's business.
    """
    try:
        return next(iter(kernel.overloads.values())).entry_point
    except (AttributeError, StopIteration):  # another numba
        return kernel
