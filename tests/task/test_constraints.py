"""Constraints: refused mistakes, residuals against independent formulas, and their exact derivatives."""

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from dq_space_arm_env import SceneError, compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses, rotations
from dq_space_arm_env.kernels.library import PENALIZED
from dq_space_arm_env.scene.constraint_rows import n_multipliers, path_rows, terminal_rows
from dq_space_arm_env.scene.constraints import Volume
from dq_space_arm_env.scene.start import episode_scene
from dq_space_arm_env.task.constraint_residuals import _Segment, _segment_distance
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.terminal_residuals import terminal_residuals

FRAME = {"frame": "link 2", "to": [0.75, 0.1, -0.2], "radius": 0.05}
KINDS = {
    "joint_limits": {"lower": [-2.0, -0.6, -1.7], "upper": [1.5, 1.0, math.inf], "rate": 0.2},
    "distance": {
        "bodies": [FRAME, {"frame": "tip", "radius": 0.1}],
        "obstacles": [
            {"frame": "inertial", "position": [0.5, -3.2, 5.4], "radius": 0.1},
            {"frame": "base", "position": [-0.3, -0.3, 0.2], "to": [0.3, 0.3, 0.2], "radius": 0.2},
            {"frame": "target", "position": [0.1, 0.2, 0.3], "to": [0.4, 0.1, -0.2], "radius": 0.2},
        ],
    },
    "keep_out_direction": {
        "axis": {"frame": "link 3", "direction": [1, 0.2, 0]},
        "direction": {"frame": "inertial", "direction": [0, 1, 2]},
        "angle_deg": 20,
    },
    "keep_in_direction": {
        "axis": {"frame": "base", "direction": [1, 0, 0]},
        "direction": {"frame": "grasp", "direction": [0, 1, 1]},
        "angle_deg": 60,
    },
    "line_of_sight": {
        "camera": {"frame": "base", "position": [0.1, 0, 0.3]},
        "boresight": [0, 0.2, 2],
        "angle_deg": 40,
        "point": {"frame": "grasp", "position": [0, 0.1, 0]},
    },
    "approach_corridor": {
        "apex": {"frame": "target", "position": [0, 0, 0.1]},
        "direction": [0.3, 0, -1],
        "angle_deg": 30,
        "width": 0.05,
    },
    "plume": {
        "thruster": [0, 0.1, -0.2],
        "angle_deg": 20,
        "keeps_clear": {"frame": "target", "radius": 0.3},
    },
    "momentum": {"linear": 3.0, "angular": 2.0, "energy": 1.5},
    "control_rate": {"base_force": [1, math.inf, 2], "wrist_rate": 0.3},
    "terminal": {
        "exact": ["pose", "twist", "base_velocity", "linear_momentum", "angular_momentum"],
    },
}


def every_kind():
    """A scene with a target that moves, and constraints of all kinds but one."""
    entries = [{"kind": kind, "name": kind, **fields} for kind, fields in KINDS.items()]
    return load_scene("tumbling-target").replace(constraints=entries)


def with_wheels():
    """A scene without thrusters, whose wheels store momentum."""
    rest = {"base_angular_velocity": 0.0, "base_linear_velocity": 0.0, "joint_rates": 0.0}
    entry = {"kind": "wheel_momentum", "name": "wheels", "capacity": 0.5}
    return load_scene("reaction-wheels").replace(spread=rest, constraints=[entry])


def random_point(kernels, seed):
    """A state some way from the scene's start, an input and parameters."""
    rng = np.random.default_rng(seed)
    x = kernels.retract(kernels.layout.initial_state, 0.3 * rng.standard_normal(kernels.n_t))
    limits = np.minimum(kernels.layout.control_limit, 1e3)
    return x, limits * rng.uniform(-1.0, 1.0, kernels.n_u), kernels.parameters.nominal


def differences(function, size):
    """Derivatives of a function of `size` coordinates at zero, extrapolated to order 6."""
    columns = []
    for direction in np.eye(size):
        slopes = []
        for h in (4e-2, 2e-2, 1e-2):
            slopes.append((function(h * direction) - function(-h * direction)) / (2.0 * h))
        first = [(4.0 * b - a) / 3.0 for a, b in itertools.pairwise(slopes)]
        columns.append((16.0 * first[1] - first[0]) / 15.0)
    return np.array(columns).T


def test_any_attitude_is_within_a_tolerance_of_more_than_half_a_turn():
    end = {"name": "end", "kind": "terminal", "exact": ["base_velocity"]}
    scene = load_scene("planar").replace({"constraints": [end], "success.attitude_error_deg": 360.0})
    kernels = compile_scene(scene)
    row = [each.name for each in terminal_rows(scene)].index("success: attitude error")
    states = np.tile(kernels.layout.initial_state, (50, 1))
    states[:, kernels.layout.state.joint_angles] = np.random.default_rng(0).uniform(-9.0, 9.0, (50, 3))
    angles, residuals = kernels.tip_errors(states)[:, 0], kernels.terminal_constraints(states)[:, row]
    assert angles.max() > 170.0
    assert residuals.max() < 0.0


@pytest.mark.parametrize("scene", [every_kind, with_wheels])
def test_derivatives(scene):
    kernels = compile_scene(scene())
    n_t = kernels.n_t
    for seed in range(2):
        x, u, p = random_point(kernels, seed)

        def path(z, x=x, u=u, p=p):
            return kernels.constraints(kernels.retract(x, z[:n_t]), u + z[n_t:], p=p)

        def end(z, x=x, p=p):
            return kernels.terminal_constraints(kernels.retract(x, z), p=p)

        exact = kernels.constraint_jacobian(x, u, p=p)
        assert exact.shape == (len(path_rows(kernels.scene)), n_t + kernels.n_u)
        found = differences(path, n_t + kernels.n_u)
        np.testing.assert_allclose(exact, found, rtol=0, atol=1e-7 * max(1.0, abs(exact).max(initial=0.0)))
        exact = kernels.terminal_constraint_jacobian(x, p=p)
        np.testing.assert_allclose(
            exact, differences(end, n_t), rtol=0, atol=1e-7 * max(1.0, abs(exact).max())
        )


@pytest.mark.slow
@pytest.mark.parametrize("scene", [every_kind, with_wheels])
def test_derivatives_of_the_augmented_lagrangian(scene):
    """Gradients against differences of its cost, exact Hessians against differences of its gradients."""
    kernels = compile_scene(scene())
    n_t, n_u, rng = kernels.n_t, kernels.n_u, np.random.default_rng(3)
    x, u, p = random_point(kernels, 3)
    count = n_multipliers(kernels.scene)
    parameters = np.concatenate([p, rng.uniform(0.1, 1.0, count), rng.uniform(1.0, 5.0, count)])

    def call(name, **inputs):
        """Run a program on one row, with multipliers and penalties."""
        kernel = kernels.kernel(PENALIZED + name, lanes=1)
        inputs |= {"parameters": parameters, "h": [0.015]}
        given = [np.atleast_2d(np.ascontiguousarray(inputs[spec.name])) for spec in kernel.inputs]
        outputs = [np.zeros((1, spec.stride)) for spec in kernel.outputs]
        kernel([*given, *outputs], 1, 1)
        return [output[0] for output in outputs]

    def cost(z):
        return call("step_with_cost", x=kernels.retract(x, z[:n_t]), u=u + z[n_t:])[1]

    def gradient(z):
        slopes = call("cost_derivatives", x=kernels.retract(x, z[:n_t]), u=u + z[n_t:])
        return np.concatenate(slopes[:2])

    zero = np.zeros(n_t + n_u)
    scale = abs(gradient(zero)).max()
    np.testing.assert_allclose(gradient(zero), differences(cost, n_t + n_u)[0], rtol=0, atol=1e-6 * scale)
    # Gradients elsewhere are in coordinates of another tangent space, which matters to the pose alone.
    rest = np.arange(6 if not kernels.layout.planar else 3, n_t + n_u)
    multiplier = np.zeros(n_t)
    found = call("lagrangian_hessian", x=x, u=u, multiplier=multiplier)
    xx, ux, uu = (entries.reshape(rows, -1) for entries, rows in zip(found, (n_t, n_u, n_u), strict=True))
    exact = np.block([[xx, ux.T], [ux, uu]])
    np.testing.assert_array_equal(exact, exact.T)
    numeric = differences(gradient, n_t + n_u)
    np.testing.assert_allclose(
        exact[np.ix_(rest, rest)], numeric[np.ix_(rest, rest)], rtol=0, atol=1e-5 * abs(exact).max()
    )


@pytest.mark.parametrize("seed", range(30))
def test_distances_against_a_search(seed):
    rng = np.random.default_rng(seed)
    (a, b), (c, d) = rng.standard_normal((2, 2, 3))
    if seed % 5 == 0:
        d = c + (b - a) * rng.uniform(0.3, 2.0)  # parallel
    points = [tuple(a), tuple(c)]
    along = [tuple(b - a), tuple(d - c) if seed % 3 else None]

    def apart(shares):
        ends = (a + shares[0] * (b - a), c + shares[1] * (d - c if seed % 3 else 0.0 * c))
        return np.linalg.norm(ends[0] - ends[1])

    search = min(
        minimize(apart, start, bounds=[(0.0, 1.0)] * 2, tol=1e-12).fun
        for start in ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0), (0.5, 0.5))
    )
    found = _segment_distance(_Segment(points[0], along[0]), _Segment(points[1], along[1]), 1e-12)
    assert found == pytest.approx(math.hypot(search, 1e-4), abs=1e-7)
    turned = _segment_distance(_Segment(points[1], along[1]), _Segment(points[0], along[0]), 1e-12)
    assert turned == pytest.approx(found, abs=1e-9)


def test_distances_of_parallel_segments_have_their_derivatives_in_single_precision():
    """About their axis the one turns and stays parallel, but for what rounding changes."""
    axis = np.array([0.8, 0.3, 0.5])
    rod = {"frame": "base", "position": [-0.5, 0.1, 0.3], "to": [0.3, 0.4, 0.8], "radius": 0.1}
    wall = {"frame": "inertial", "position": [-0.7, 0.9, 0.2], "to": [0.42, 1.32, 0.9], "radius": 0.1}
    keep = {"kind": "distance", "name": "apart", "bodies": [rod], "obstacles": [wall]}
    scene, found = load_scene("no-wrist").replace(constraints=[keep]), []
    for precision in ("float64", "float32"):
        kernels = compile_scene(scene.replace(simulation={"precision": precision}))
        x = np.tile(kernels.layout.initial_state, (50, 1))
        for row, angle in zip(x, np.linspace(-1.0, 1.0, len(x)), strict=True):
            turn = rotations.from_axis_angle(tuple(axis / np.linalg.norm(axis)), angle)
            row[:8] = poses.from_rotation_and_position(turn, (0.1, 0.0, -0.1))
        found.append(kernels.constraint_jacobian(x.astype("f4"), np.zeros((len(x), kernels.n_u))))
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-5)


def placed(pose):
    """Rotation and position of a pose."""
    real, position = poses.to_rotation_and_position(pose)
    return Rotation.from_quat(real, scalar_first=True), np.array(position)


def test_cones_and_plume_against_vectors():
    """Formulas in inertial axes, by another library's rotations."""
    scene = load_scene("paper").replace(
        constraints=[
            {"kind": kind, "name": kind, **KINDS[kind]}
            for kind in (
                "keep_out_direction",
                "keep_in_direction",
                "line_of_sight",
                "approach_corridor",
                "plume",
            )
        ]
    )
    kernels = compile_scene(scene)
    for seed in range(5):
        x, u, _ = random_point(kernels, seed)
        frames = kernels.frame_poses(x)
        (base, at), (link, _), (_, tip) = placed(frames[0]), placed(frames[3]), placed(frames[-1])
        target, there = placed(scene.target.pose.dual_quaternion)

        def unit(vector):
            return np.array(vector) / np.linalg.norm(vector)

        cosine = link.apply(unit([1, 0.2, 0])) @ unit([0, 1, 2])
        expected = [cosine - math.cos(math.radians(20))]
        cosine = base.apply([1, 0, 0]) @ target.apply(unit([0, 1, 1]))
        expected.append(math.cos(math.radians(60)) - cosine)
        sight = there + target.apply([0, 0.1, 0]) - at - base.apply([0.1, 0, 0.3])
        boresight = base.apply(unit([0, 0.2, 2]))
        expected.append(math.cos(math.radians(40)) * np.linalg.norm(sight) - boresight @ sight)
        r = tip - there - target.apply([0, 0, 0.1])
        axis = target.apply(unit([0.3, 0, -1]))
        height = axis @ r
        aside = np.linalg.norm(r - height * axis)
        expected.append(aside - 0.05 - height * math.tan(math.radians(30)))
        force = base.apply(u[:3])
        d = there - at - base.apply([0, 0.1, -0.2])
        opening = math.radians(20) + math.asin(0.3 / np.linalg.norm(d))
        between = math.acos(-unit(force) @ unit(d))
        expected.append(np.linalg.norm(force) * math.sin(opening - between))
        np.testing.assert_allclose(kernels.constraints(x, u), expected, rtol=0, atol=2e-3)


def test_wheels_store_the_negative_of_what_bodies_have():
    kernels = compile_scene(with_wheels())
    x, u, p = random_point(kernels, 1)
    turned, _ = placed(kernels.frame_poses(x)[0])
    stored = -turned.inv().apply(kernels.momentum(x)[3:])
    expected = [sign * each - 0.5 for each in stored for sign in (1.0, -1.0)]
    np.testing.assert_allclose(kernels.constraints(x, u, p=p), expected, rtol=0, atol=1e-12)


def test_pairs_that_cannot_touch_have_no_row():
    near = {"frame": "base", "position": [0, 0, 0.6], "radius": 0.1}
    far = {"frame": "base", "position": [0, 0, 9.0], "radius": 0.1}
    own = {"frame": "link 2", "position": [0, 0, 1.0], "radius": 0.1}
    entry = {"kind": "distance", "name": "it", "bodies": [FRAME], "obstacles": [near, far, own]}
    scene = load_scene("paper").replace(constraints=[entry])
    assert [row.name for row in path_rows(scene)] == ["it: link 2 0 to base 0"]
    # Within the bound nothing is missed: no joint angles bring the far volume near.
    kernels = compile_scene(scene.replace({"constraints": [{**entry, "obstacles": [near]}]}))
    angles = kernels.layout.state.joint_angles
    nearest = math.inf
    for seed in range(200):
        x = kernels.layout.initial_state.copy()
        x[angles] = np.random.default_rng(seed).uniform(-math.pi, math.pi, 3)
        base, link = (placed(kernels.frame_poses(x)[i]) for i in (0, 2))
        ends = [link[1] + link[0].apply(end) for end in Volume.model_validate(FRAME).ends]
        center = base[1] + base[0].apply(far["position"])
        nearest = min(nearest, *(np.linalg.norm(end - center) for end in ends))
    assert nearest > 0.15


MISTAKES = [
    ({"kind": "wall"}, "must be a mapping whose kind is one of joint_limits, distance"),
    ({"kind": "joint_limit"}, r"did you mean 'joint_limits'\? Must be a mapping whose kind is one of"),
    ({"kind": "joint_limits", "lower": [0.0, 0.0]}, "one per link: the scene has 3 links"),
    ({"kind": "joint_limits", "lower": 1.0, "upper": 0.5}, "must be above the lower limit of link 0"),
    ({"kind": "joint_limits"}, "must bound something"),
    ({"kind": "joint_limits", "upper": math.nan}, "each finite, or infinite for no bound"),
    ({"kind": "joint_limits", "upper": 10**400}, "each finite, or infinite for no bound"),
    ({"kind": "distance", "bodies": [], "obstacles": [FRAME]}, "must list at least one volume"),
    ({"kind": "distance", "bodies": [{**FRAME, "frame": "hand"}]}, "must be one of inertial, base, link 1"),
    ({"kind": "keep_out_direction", "angle_deg": 180}, "must be below 180 degrees"),
    ({"kind": "line_of_sight", "boresight": [0, 0, 0]}, "must not have zero length"),
    ({"kind": "momentum"}, "must bound at least one of linear, angular, energy"),
    ({"kind": "wheel_momentum", "capacity": 1.0}, "thrusters change the total momentum"),
    ({"kind": "terminal", "exact": []}, "must list at least one quantity"),
    ({"kind": "plume", "observed": 1.0}, "is not observed"),
    ({"kind": "control_rate"}, "must limit at least one of base_force"),
    ({"kind": "control_rate", "wrist_rate": 0.0}, "each greater than 0"),
    ({"kind": "control_rate", "joint_torque": 1.0, "observed": 1.0}, "is not observed"),
    ({"kind": "approach_corridor", "tolerance": 0.0}, "must be a finite number greater than 0"),
    ({"kind": "approach_corridor", "marign": 0.1}, "unknown key; did you mean"),
]
WITHOUT_DEFAULTS = ("joint_limits", "momentum", "control_rate")


@pytest.mark.parametrize(("changes", "message"), MISTAKES)
def test_mistakes_are_named(changes, message):
    rest = {} if changes["kind"] in WITHOUT_DEFAULTS else KINDS.get(changes["kind"], {})
    with pytest.raises(SceneError, match=message):
        load_scene("paper").replace(constraints=[{"name": "it", **rest, **changes}])


def test_a_bound_that_no_joint_has_is_refused():
    links = [{**load_scene("no-wrist").links[0].model_dump(mode="json"), "joint_type": "spherical"}]
    ball = load_scene("no-wrist").replace({"links": links, "initial_state.joint_angles": []})
    with pytest.raises(SceneError, match="no joint has one coordinate"):
        ball.replace(constraints=[{"kind": "joint_limits", "name": "it", "rate": 0.1}])


def test_limits_of_slides_are_lengths():
    crossed = {"kind": "joint_limits", "name": "it", "lower": [0, 0, 1.0, 0], "upper": [1, 1, 0.5, 1]}
    with pytest.raises(SceneError, match=r"must be above the lower limit of link 2, 1 m$"):
        load_scene("sliding").replace(constraints=[crossed])


def test_limits_of_all_joints_that_cross_are_one_mistake():
    crossed = {"kind": "joint_limits", "name": "it", "lower": 2.0, "upper": -2.0}
    with pytest.raises(SceneError) as caught:
        load_scene("paper").replace(constraints=[crossed])
    assert str(caught.value).count("must be above") == 1


def test_wheels_of_changing_masses_store_what_nobody_knows():
    scene = with_wheels()
    phases = [
        {"name": "a", "steps": 10},
        {"name": "b", "steps": scene.simulation.steps - 10, "changes": {"base.mass": 50.0}},
    ]
    with pytest.raises(SceneError, match="what the wheels store is not known: phases change masses"):
        scene.replace(phases=phases)


def test_an_exact_base_velocity_is_that_of_the_cost():
    """A base that moves along with a target, as if fixed to it."""
    entry = {"kind": "terminal", "name": "it", "exact": ["base_velocity"]}
    scene = load_scene("tumbling-target").replace(
        {"constraints": [entry], "target.base_velocity_relative": True, "target.base_velocity": [0.0] * 6}
    )
    kernels = compile_scene(scene)
    row, x = kernels.stage_parameters()[-1], kernels.layout.initial_state.copy()
    relative = dq.multiply(dq.conjugate(tuple(kernels.layout.target_with(row))), tuple(x[:8]))
    twist = dual_vectors.inverse_transform(
        *poses.to_matrix(relative), tuple(kernels.layout.target_velocity_with(row))
    )
    x[kernels.layout.state.base_velocity] = twist
    equations = SceneEquations.of(scene, row.tolist())
    assert float(equations.terminal_cost_terms(list(x))[1]) < 1e-25
    residuals = terminal_residuals(equations, list(x[:8]), list(x[8:]))
    np.testing.assert_allclose(np.array(residuals[-6:], dtype=float), 0.0, rtol=0, atol=1e-13)


def test_two_constraints_of_a_name_are_refused():
    entry = {"kind": "momentum", "name": "it", "linear": 1.0}
    with pytest.raises(SceneError, match="another constraint has this name"):
        load_scene("paper").replace(constraints=[entry, entry])


def test_joint_limits_of_no_joints_are_refused() -> None:
    limits = {"kind": "joint_limits", "name": "limits", "upper": 1.0}
    scene = {"name": "body", "target": {"pose": {}}, "constraints": [limits]}
    with pytest.raises(SceneError, match=r"constraints\[0\].*must bound something"):
        load_scene({**scene, "base": {"mass": 10.0, "inertia": [1.0, 1.0, 1.0]}})


def test_gas_from_within_a_sphere_is_charged_in_single_precision() -> None:
    """The radius over its own root of a square is rounded to more than 1 there."""
    sphere = {"frame": "inertial", "position": [0.1, 0.0, 0.0], "radius": 0.27}
    plume = {"kind": "plume", "name": "gas", "thruster": [0, 0, 0], "angle_deg": 30.0, "keeps_clear": sphere}
    scene = load_scene("planar").replace(constraints=[plume], simulation={"precision": "float32"})
    kernels = compile_scene(scene)
    u = np.array([-1.0, *[0.0] * (kernels.n_u - 1)], np.float32)
    x, double = kernels.layout.initial_state, scene.replace(simulation={"precision": "float64"})
    assert kernels.constraints(x, u) == pytest.approx(compile_scene(double).constraints(x, u), rel=1e-3)


JET = {"position": [0, 0, 0], "direction": [1, 0, 0], "force": 2.0, "minimum_on_time": 0.005}


@pytest.mark.parametrize(
    ("actuators", "constraints", "p", "u"),
    [
        (
            {"wheels": [{"axis": [0, 0, 1], "inertia": 0.01, "torque": 0.5, "power": 10.0}]},
            [{"kind": "wheel_limits", "name": "wheel"}],
            5.0,
            [5.0],
        ),
        ({"thrusters": [JET]}, [], 20.0, [2.0]),
    ],
)
def test_largest_torques_and_forces_that_vary_are_those_of_the_episode(actuators, constraints, p, u) -> None:
    scene = load_scene(
        {
            "name": "body",
            "base": {"motion": "planar", "mass": 20.0, "inertia": [1.0, 1.0, 1.0]},
            "target": {"pose": {}},
            "actuators": actuators,
            "parameters": ["actuators"],
            "constraints": constraints,
            "simulation": {"dt": 0.02, "steps": 10},
        }
    )
    varying, own = compile_scene(scene), compile_scene(episode_scene(scene, [p]))
    x = own.layout.initial_state
    np.testing.assert_allclose(varying.applied_inputs(x, u, p=[p]), own.applied_inputs(x, u))
    np.testing.assert_allclose(varying.constraints(x, u, p=[p]), own.constraints(x, u))
