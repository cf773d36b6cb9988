"""Integrators that the reports compare with those of other engines and solvers."""

COMPARED_INTEGRATORS = ("symplectic_euler", "rk4")
"""Those that the others have as well."""
