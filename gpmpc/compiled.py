"""How the kernels of this package are compiled: serially, mostly without the interpreter's lock, once per machine.

numba keeps the machine code beside the source, or in the user's cache folder when the installation is read-only. When
neither can be written it refuses to cache; the kernels are then compiled anew in each process. Sums may be reordered
(that is what makes them vectorise); infinities and NaN keep their meaning.
"""

from collections.abc import Callable
from functools import partial
from threading import Lock

import numba

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
    if not allocates and _counting_is_optional():
        options["_nrt"] = False
    return _jit(function, options)


def _counting_is_optional() -> bool:
    """Whether this numba knows its own option ``_nrt``, which it does not promise; without it kernels are slower."""
    try:
        from numba.core.cpu import CPUTargetOptions
    except ImportError:
        return False
    return hasattr(CPUTargetOptions, "_nrt")


def _jit(function: Callable, options: dict) -> Callable:
    try:
        return numba.njit(cache=True, **options)(function)
    except RuntimeError:  # "cannot cache function ...: no locator available"
        return numba.njit(**options)(function)


borrowing = partial(compiled, allocates=False)
"""Compiles a function whose arrays are all borrowed from its caller."""

woven = partial(borrowing, woven=True)
"""Compiles such a function as a part of its callers."""


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
