"""Measures control steps, predictions, programs and trainings.

They stand beside other packages and each other.

Every module is a command: ``python -m benchmarks.NAME``, with ``--help``; ``make
bench`` runs those whose figures docs/performance.md quotes. Importing this package
limits all numerical libraries to one thread.
"""

import os

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
