"""Integrators by name: each method has a file of its own and works for every scene."""

from dq_space_arm_env.integrators.field import Integrator, VectorField
from dq_space_arm_env.integrators.rk4 import RungeKuttaMuntheKaas4
from dq_space_arm_env.integrators.symplectic_euler import SymplecticEuler

INTEGRATORS: dict[str, Integrator] = {
    method.name: method for method in (SymplecticEuler(), RungeKuttaMuntheKaas4())
}

__all__ = ["INTEGRATORS", "Integrator", "RungeKuttaMuntheKaas4", "SymplecticEuler", "VectorField"]
