"""Loads what numba would load with the first kernel of every process.

That is a third of the time of a short flight whose kernels are compiled already.
"""

from numba.core.registry import cpu_target

cpu_target.typing_context.refresh()
cpu_target.target_context.refresh()
