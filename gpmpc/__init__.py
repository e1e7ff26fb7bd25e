"""gpmpc: Gaussian process model predictive control.

The packages, from the ground up: ``gp`` (Gaussian processes), ``qp`` (quadratic
programs), ``systems`` and ``trajectories`` (what is controlled and what it follows),
``models``, ``propagation`` (beliefs through a model), ``estimation``, ``mpc``
(controllers), ``simulation``, ``datasets``, ``learning``, ``recording`` (runs in MCAP
files), ``logs``, ``plotting``, ``studies``, ``experiments`` (the published results),
``cli``.
"""

__version__ = "0.3.0"
