"""Every entry of the registry can be built, and says of its method what the method says of itself."""

import pytest

from dq_space_arm_env.integrators import integrator_of
from dq_space_arm_env.integrators.method import TwiceDifferentiableIntegrator
from dq_space_arm_env.scene import INTEGRATORS, Simulation
from dq_space_arm_env.scene.simulation import TOLERANCES


@pytest.mark.parametrize("name", INTEGRATORS)
def test_an_entry_says_of_its_method_what_is_so(name):
    entry, method = INTEGRATORS[name], integrator_of(Simulation(), name)
    assert isinstance(method, TwiceDifferentiableIntegrator) == (entry.curvature == name)
    assert entry.curvature is None or INTEGRATORS[entry.curvature].curvature == entry.curvature
    assert hasattr(method, "append_walk") == entry.keeps_momentum
    assert all(hasattr(method, key) for key in entry.tolerances)
    assert entry.is_adaptive == any(hasattr(method, key) for key in TOLERANCES["float64"])
    tableau = getattr(method, "tableau", None)
    assert tableau is None or tableau.order == entry.order
