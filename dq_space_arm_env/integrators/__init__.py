"""Integrators by name: each method has a file of its own and works for every scene."""

from dq_space_arm_env.integrators.dormand_prince import DormandPrince
from dq_space_arm_env.integrators.explicit_runge_kutta import ExplicitRungeKutta
from dq_space_arm_env.integrators.field import Integrator, TwiceDifferentiableIntegrator, VectorField
from dq_space_arm_env.integrators.momentum import MomentumPreserving
from dq_space_arm_env.integrators.rk4 import RungeKuttaMuntheKaas4
from dq_space_arm_env.integrators.rosenbrock import RODAS_METHODS, Rosenbrock
from dq_space_arm_env.integrators.rosenbrock_w import RosenbrockW
from dq_space_arm_env.integrators.symplectic_euler import SymplecticEuler
from dq_space_arm_env.integrators.tableaus import CALVO_6, DORMAND_PRINCE_8
from dq_space_arm_env.scene.schema import Simulation

INTEGRATORS: dict[str, Integrator] = {
    method.name: method
    for method in (
        SymplecticEuler(),
        RungeKuttaMuntheKaas4(),
        ExplicitRungeKutta("rk6", CALVO_6),
        ExplicitRungeKutta("rk8", DORMAND_PRINCE_8),
        DormandPrince(),
        *RODAS_METHODS,
        MomentumPreserving(RungeKuttaMuntheKaas4()),
        MomentumPreserving(RosenbrockW()),
    )
}

__all__ = [
    "INTEGRATORS",
    "DormandPrince",
    "ExplicitRungeKutta",
    "Integrator",
    "MomentumPreserving",
    "Rosenbrock",
    "RosenbrockW",
    "RungeKuttaMuntheKaas4",
    "SymplecticEuler",
    "TwiceDifferentiableIntegrator",
    "VectorField",
    "integrator_of",
]


def integrator_of(simulation: Simulation, name: str = "") -> Integrator:
    """The integrator of a scene, with the scene's settings.

    Args:
        simulation: How the scene discretizes time.
        name: Name of another integrator than the scene's.

    Returns:
        The integrator.

    Raises:
        KeyError: If there is no integrator of that name.
    """
    method = INTEGRATORS[name or simulation.integrator]
    return DormandPrince(*simulation.tolerances) if isinstance(method, DormandPrince) else method
