"""Quadratic programs and their solvers (NumPy float64)."""
