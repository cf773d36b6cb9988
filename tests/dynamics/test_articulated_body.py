"""Articulated bodies against the mass matrix, and refinement of the Schur complement (21)."""

from dataclasses import replace

import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.dynamics import minimal, newton_euler
from dq_space_arm_env.dynamics.articulated_body import ArticulatedBodies
from dq_space_arm_env.dynamics.forward import inertia_of
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.mass_matrix import MassMatrix

ZERO = (0.0, 0.0, 0.0)


def flat(solved):
    return np.array([*solved.angular, *solved.linear, *solved.joints], dtype=float)


def random_wrenches(rng, tree):
    """Wrenches on the bodies, within the plane for a planar base, and joint torques."""
    wrenches = []
    for _ in range(len(tree.links) + 1):
        force, torque = rng.normal(size=3), rng.normal(size=3)
        if tree.planar:
            force[2], torque[:2] = 0.0, 0.0
        wrenches.append((tuple(force.tolist()), tuple(torque.tolist())))
    return wrenches, rng.normal(size=len(tree.links)).tolist()


@pytest.mark.parametrize("scene", ["paper", "planar", "payload", "six-joint"])
def test_both_formulations_respond_alike_to_wrenches_on_every_body(scene):
    tree, rng = KinematicTree.from_scene(load_scene(scene)), np.random.default_rng(0)
    for _ in range(5):
        angles = rng.uniform(-3.0, 3.0, len(tree.links)).tolist()
        rotations = minimal.link_frames(tree, angles)
        wrenches, joints = random_wrenches(rng, tree)
        expected = flat(MassMatrix(tree, rotations).accelerations(wrenches, joints))
        for root in range(len(tree.links) + 1):
            found = flat(ArticulatedBodies(tree, rotations, root).accelerations(wrenches, joints))
            assert np.linalg.norm(found - expected) < 1e-12 * np.linalg.norm(expected)


@pytest.mark.parametrize("scene", ["paper", "planar", "six-joint"])
@pytest.mark.parametrize("formulation", ["articulated_body", "minimal_coordinates"])
@pytest.mark.parametrize("many", [False, True])
def test_inverse_dynamics_at_rest_undoes_the_response_to_generalized_forces(scene, formulation, many):
    tree, rng = KinematicTree.from_scene(load_scene(scene)), np.random.default_rng(1)
    n = len(tree.links)
    rotations = minimal.link_frames(tree, rng.uniform(-3.0, 3.0, n).tolist())
    (force, torque), joints = random_wrenches(rng, replace(tree, links=()))[0][0], rng.normal(size=n)
    solved = inertia_of(formulation, tree, rotations, many=many).solve(force, torque, joints.tolist())
    needed = minimal.inverse_dynamics(tree, rotations, ZERO, [0.0] * n, solved)
    found = np.array([*needed.force, *needed.torque, *needed.joints])
    given = np.array([*force, *torque, *joints])
    if tree.planar:  # what holds the base in its plane is nobody's input
        found[2:5] = given[2:5] = 0.0
    np.testing.assert_allclose(found, given, rtol=0, atol=1e-13 * np.abs(given).max())


def test_a_light_base_keeps_its_digits_where_the_mass_matrix_loses_them():
    """A torque about the first joint turns a light base by torque over its own inertia, the arm hardly."""
    paper = load_scene("paper")
    inertia = (1e-7 * np.array(paper.base.inertia)).tolist()
    base = {**paper.base.model_dump(), "mass": 1e-7 * paper.base.mass, "inertia": inertia}
    tree = KinematicTree.from_scene(paper.replace(base=base))
    rotations = minimal.link_frames(tree, [0.3, -0.7, 1.1])
    errors = {}
    for formulation in ("articulated_body", "minimal_coordinates"):
        solved = inertia_of(formulation, tree, rotations).solve(ZERO, ZERO, [1.0, 0.0, 0.0])
        turning = solved.angular[2] * inertia[2][2]
        errors[formulation] = abs(turning + 1.0)
    assert errors["articulated_body"] < 1e-15
    assert 1e-12 < errors["minimal_coordinates"] < 1e-6


def test_one_refinement_brings_back_what_needles_cost_the_schur_complement_21():
    paper, rng = load_scene("paper"), np.random.default_rng(2)
    needles = [{**link.model_dump(), "inertia": [5e-9, 0.5, 0.5]} for link in paper.links]
    tree = KinematicTree.from_scene(paper.replace(links=needles))
    frames = newton_euler.joint_frames(tree, [0.3, -0.7, 1.1], [0.0] * 3)
    resting = [(0.0,) * 8] * 4
    wrench = (0.0, *rng.normal(size=3).tolist(), 0.0, *rng.normal(size=3).tolist())
    system = newton_euler.assemble(tree, frames, resting, wrench, rng.normal(size=3).tolist())
    corner = np.zeros((len(system.b2),) * 2)
    full = np.block([[np.array(system.s11), np.array(system.s12)], [np.array(system.s21), corner]])
    expected = np.linalg.solve(full, [*system.b1, *system.b2])[: len(system.b1)]

    def error(refinements):
        found = np.array(newton_euler.solve_schur(tree, system, refinements)[0])
        return np.abs(found - expected).max() / np.abs(expected).max()

    assert error(0) > 1e-12
    assert error(1) < 1e-14


def test_a_light_first_link_beside_an_arm_costs_no_digits():
    """The base is no worse a root for the arm, whose mass does not count against it."""
    links = [
        {
            "name": "flap",
            "mass": 1e-9,
            "inertia": [1e-10, 1.5e-10, 1.2e-10],
            "center_of_mass": [0.3, 0.2, 0.1],
        },
        {"name": "arm", "mass": 20.0, "inertia": [1.0, 1.2, 0.8], "center_of_mass": [0.4, 0.1, 0.0]},
    ]
    for link, angle in zip(links, (50, 70), strict=True):
        place = {"position": [0.5, 0.3, 0.2], "rotation": {"axis": [0.2, 1.0, 0.3], "angle": angle}}
        link |= {"parent": "base", "joint": place}
    base = {"mass": 200.0, "inertia": [20.0, 22.0, 18.0]}
    found = []
    for order in (links, links[::-1]):
        scene = {"name": "flap", "base": base, "links": order, "tip_link": "arm", "target": {"pose": {}}}
        tree = KinematicTree.from_scene(load_scene(scene))
        step = 1 if order is links else -1
        frames = minimal.link_frames(tree, [0.4, 0.3][::step])
        solved = inertia_of("articulated_body", tree, frames).solve(
            (100.0, 50.0, -80.0), (4.0, -3.0, 2.0), [1e-10, 1.0][::step]
        )
        found.append(np.array([*solved.angular, *solved.linear, *solved.joints[::step]]))
    np.testing.assert_allclose(*found, rtol=1e-12)
