"""Gaussian process model predictive control.

Each package imports only from those above it in this list:

    gp            Gaussian processes: data, training, prediction
    qp            quadratic programs and their solvers
    systems       what is controlled; ``trajectories`` is what it follows
    models        a known part and a learned one
    propagation   beliefs through a model
    estimation    filters, delays, noise, tubes that hold
    mpc           controllers
    simulation    closed loops
    datasets      transitions to learn from
    learning      what has changed since the model was learned
    recording     flights in MCAP files
    logs          models from logs of your own
    plotting      figures and animations
    export        controllers as C
    studies       runs, sweeps and reports
    experiments   the published results
    cli           the command ``gpmpc``
"""

__version__ = "0.3.0"
