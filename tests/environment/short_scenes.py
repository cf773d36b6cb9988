"""Scenes with few steps, and one that diverges."""

from dq_space_arm_env import load_scene


def short(scene="paper", steps=12, precision="float64"):
    scene = load_scene(scene)
    changes = {"steps": steps, "precision": precision}
    # A part of the steps for each phase, and the rest for the first.
    count = len(scene.phases)
    lengths = [steps - (count - 1) * (steps // count), *[steps // count] * (count - 1)] if count else []
    phases = {f"phases.{index}.steps": length for index, length in enumerate(lengths)}
    return scene.replace(phases, simulation=changes)


def diverging(scene="paper", stiffness=1e6, steps=60):
    """Links so stiff that symplectic Euler blows up after a few long steps."""
    scene = load_scene(scene)
    links = [link.model_dump() | {"stiffness": stiffness} for link in scene.links]
    simulation = {"dt": 0.1, "steps": steps, "integrator": "symplectic_euler"}
    return scene.replace(links=links, simulation=simulation)
