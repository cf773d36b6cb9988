"""A scene's Pinocchio model: accelerations, tip, momentum; states there and back."""

import sys

import numpy as np
import pytest
from foreign_robots import accelerations, drawn, relative_error, tip_pose

from dq_space_arm_env import from_pinocchio, generalized_forces, load_scene, pinocchio_model, to_pinocchio
from dq_space_arm_env.scene import SceneError, StateLayout
from dq_space_arm_env.scene.start import unit_quaternions

pin = pytest.importorskip("pinocchio")

# With wrist, without; planar; a payload; a wrench at the tip; six joints; no thrusters; a slide and a screw.
SCENES = ("paper", "no-wrist", "planar", "payload", "tip-load", "six-joint", "free-floating", "sliding")


def sprung(scene):
    """The scene with springs and dampers in its joints, and its second joint passive."""
    parts = {"stiffness": 3.0, "rest_angle": 0.4, "damping": 0.7}
    links = [{**link.model_dump(), **parts, "actuated": i != 1} for i, link in enumerate(scene.links)]
    return scene.replace(links=links)


@pytest.mark.parametrize("change", [lambda scene: scene, sprung], ids=["as it is", "sprung"])
@pytest.mark.parametrize("name", SCENES)
def test_accelerations_and_tip_are_the_same(name, change):
    scene = change(load_scene(name))
    model, rng = pinocchio_model(scene), np.random.default_rng(0)
    data = model.createData()
    for _ in range(5):
        x, u = drawn(scene, rng)
        x[StateLayout.of(scene).state.wrist_angles] = scene.initial_state.wrist_angles
        q, v = to_pinocchio(scene, x)
        a = pin.aba(model, data, q, v, generalized_forces(scene, x, u))
        expected = accelerations(scene, x, u)
        planar = StateLayout.of(scene).planar
        found = [a[2], *a[:2], *a[3:]] if planar else [*a[3:6], *a[:3], *a[6:]]
        assert relative_error(found, expected) < 1e-12
        pin.framesForwardKinematics(model, data, q)
        placement, (rotation, position) = data.oMf[model.getFrameId("tip")], tip_pose(scene, x)
        np.testing.assert_allclose(placement.rotation, rotation, rtol=0, atol=1e-13)
        np.testing.assert_allclose(placement.translation, position, rtol=0, atol=1e-13)


def branched():
    """A scene whose first link carries a ball, after the arm, and its second a slide."""
    scene = load_scene("no-wrist")
    links = [link.model_dump() for link in scene.links]
    more = {"mass": 2.0, "inertia": [0.1, 0.2, 0.25], "center_of_mass": [0.1, 0.2, 0.3]}
    slide = {"name": "slide", "parent": links[1]["name"], "joint_type": "prismatic", "damping": 0.3}
    ball = {"name": "ball", "parent": links[0]["name"], "joint_type": "spherical", "actuated": False}
    place = {"joint": {"position": [0.3, -0.2, 0.1], "rotation": {"axis": [1, 2, 3], "angle": 50}}}
    links += [{**ball, **more, **place}, {**slide, **more, **place}]
    start = {"joint_angles": [0.0] * 7, "joint_rates": [0.0] * 7}
    simulation = {"integrator": "rk4"}
    return scene.replace(links=links, tip_link=links[2]["name"], initial_state=start, simulation=simulation)


def test_where_arms_branch_every_algorithm_has_its_order():
    """Composite inertias are sums over joints in a row, which those that a joint carries must be."""
    scene, rng = branched(), np.random.default_rng(1)
    model = pinocchio_model(scene)
    data = model.createData()
    x, u = drawn(scene, rng)
    for where in unit_quaternions(scene):
        x[where] /= np.linalg.norm(x[where])
    q, v = to_pinocchio(scene, x)
    np.testing.assert_allclose(from_pinocchio(scene, q, v), x, rtol=0, atol=1e-14)
    mass = np.triu(pin.crba(model, data, q))
    mass += np.triu(mass, 1).T
    at_rest = np.zeros(model.nv)
    columns = [pin.rnea(model, data, q, at_rest, unit) for unit in np.eye(model.nv)]
    np.testing.assert_allclose(mass, np.array(columns).T, rtol=0, atol=1e-10)
    a = pin.aba(model, data, q, v, generalized_forces(scene, x, u))
    first, second, third, *ball, slide = accelerations(scene, x, u)[6:]
    np.testing.assert_allclose(a[6:], [first, second, third, slide, *ball], rtol=1e-11, atol=0)


@pytest.mark.parametrize("name", SCENES)
def test_states_come_back(name):
    scene = load_scene(name)
    layout, rng = StateLayout.of(scene), np.random.default_rng(3)
    x, _ = drawn(scene, rng)
    back = from_pinocchio(scene, *to_pinocchio(scene, x), x[layout.state.wrist_angles])
    np.testing.assert_allclose(back, x, rtol=0, atol=1e-14)


def test_wrong_shapes_are_refused():
    scene = load_scene("no-wrist")
    with pytest.raises(ValueError, match=r"x: shape \(3,\), it must be \(20,\)"):
        to_pinocchio(scene, np.zeros(3))
    with pytest.raises(ValueError, match=r"u: shape \(2,\), it must be \(9,\)"):
        generalized_forces(scene, np.zeros(20), np.zeros(2))
    with pytest.raises(ValueError, match=r"wrist_angles: shape \(3,\), it must be \(0,\)"):
        from_pinocchio(scene, np.zeros(10), np.zeros(9), np.zeros(3))


@pytest.mark.parametrize(
    ("name", "q"),
    [("no-wrist", [0, 0, 0, 0, 0, 0, 2, 0, 0, 0]), ("planar", [0, 0, 0, 0, 0, 0, 0])],
)
def test_configurations_that_turn_nowhere_are_refused(name, q):
    scene = load_scene(name)
    with pytest.raises(ValueError, match=r"q: .* has norm [02], it must be 1 within 1e-6"):
        from_pinocchio(scene, q, np.zeros(len(q) - 1))
    state = StateLayout.of(scene).initial_state
    with pytest.raises(ValueError, match=r"x: .* has norm 2, it must be 1 within 1e-6"):
        to_pinocchio(scene, 2.0 * state)


def test_what_is_no_real_number_is_refused():
    """NumPy drops imaginary parts and masks."""
    zeros = np.zeros(13)
    for wrong in (zeros + 1j, np.ma.masked_array(zeros, mask=True), ["a"] * 13):
        with pytest.raises(TypeError, match=r"x: .*should be real numbers"):
            to_pinocchio("planar", wrong)


def test_phases_that_change_the_robot_are_refused():
    scene = load_scene("capture-and-detumble")
    with pytest.raises(SceneError, match=r"its robot stays as it is, and phases change payload\.mass"):
        pinocchio_model(scene)
    assert pinocchio_model(scene.replace(phases=())).nv > 0


def test_without_pinocchio_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(ImportError, match="pip install pin"):
        pinocchio_model(load_scene("no-wrist"))
