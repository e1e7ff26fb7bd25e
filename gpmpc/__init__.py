"""gpmpc: Gaussian process model predictive control.

The rooms of the house, from the ground up: ``gp`` (exact Gaussian processes), ``qp`` (quadratic programs), ``plants``
and ``trajectories`` (the systems and what they follow), ``propagation`` (beliefs through a model), ``control``,
``simulation``, ``datasets``, ``metrics``, ``recording`` (runs in MCAP files), ``plotting``, ``experiments`` (the
paper's results), ``cli``.
"""

__version__ = "0.1.0"
