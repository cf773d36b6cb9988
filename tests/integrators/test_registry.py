"""Every entry of the registry can be built, and says of its method what the method says of itself."""

import pytest

from dq_space_arm_env.integrators import integrator_of
from dq_space_arm_env.integrators.method import TwiceDifferentiableIntegrator
from dq_space_arm_env.scene import INTEGRATORS, SceneError, Simulation, load_scene
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


@pytest.mark.parametrize("name", ["paper", "heavy-wrist", "burning"])
def test_an_entry_takes_the_scenes_that_may_name_it(name):
    if name == "burning":
        jet = {"position": [0, 0, -0.4], "direction": [0, 0, 1], "force": 5, "specific_impulse": 220}
        actuators = {"base_force": None, "thrusters": [jet], "tank": {"propellant": 5.0}}
        scene = load_scene("paper").replace(actuators=actuators)
    else:
        scene = load_scene(name)
    allowed = []
    for integrator in INTEGRATORS:
        try:
            allowed.append(scene.replace(simulation={"integrator": integrator}).simulation.integrator)
        except SceneError:
            continue
    assert [integrator for integrator, entry in INTEGRATORS.items() if entry.takes(scene)] == allowed
    assert len(allowed) < len(INTEGRATORS) or name == "paper"
