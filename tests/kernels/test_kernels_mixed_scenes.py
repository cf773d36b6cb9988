"""Scenes that mix features which no shipped scene has together: drawn at random, valid, a few steps long.

Single and vector environments agree to the bit; CasADi, which evaluates the same equations by itself, agrees
with the machine code; derivatives agree with differences.
"""

import random

import numpy as np
import pytest

from dq_space_arm_env import (
    DQSpaceArmEnv,
    DQSpaceArmVectorEnv,
    SceneError,
    casadi_dynamics,
    compile_scene,
    list_scenes,
    load_scene,
)
from dq_space_arm_env.scene import INTEGRATORS

STEPS = 60  # divides among two to six phases
COPIES = 3
AXIAL = ("base_force", "base_torque", "joint_torque", "wrist_rate")
JETS = [
    {"position": [0.5 * sign, 0.1, 0.2], "direction": direction, "force": 10.0}
    for sign in (-1.0, 1.0)
    for direction in ([-sign, 0, 0], [0, sign, 0.2], [0.1, 0, -sign])
]
GRASPED = {"mass": 10.0, "inertia": [0.3, 0.3, 0.4], "center_of_mass": [0.2, 0.0, 0.0]}
TANK = {"propellant": 5.0, "position": [0.0, 0.0, -0.3]}


def _actuator(scene, rng, **change):
    """Change one of the actuators that there are."""
    name = rng.choice([each for each in AXIAL if each in scene["actuators"]])
    scene["actuators"][name] |= change


def _joint(scene, rng, **change):
    """Change one of the links."""
    rng.choice(scene["links"]).update(change)


def _constraint(scene, rng, kind, **fields):
    constraint = {"kind": kind, "name": f"mixed {kind}", "terminates": rng.random() < 0.3, **fields}
    scene.setdefault("constraints", []).append(constraint)


def _instead(scene, old, **new):
    """Replace an actuator."""
    del scene["actuators"][old]
    scene["actuators"] |= new


def _spread(scene, rng):
    kinds = ("base_mass", "link_masses", "link_inertias", "target_position", "grasp_position", "joint_rates")
    changes = dict.fromkeys(rng.sample(kinds, 3), 0.05) | {"observed": rng.random() < 0.5}
    scene["spread"] = scene.get("spread", {}) | changes


def _phases(scene, rng):
    numbers = {"base.mass": 90.0, "cost.pose": 50.0, "target.pose.position": [1.0, 0.1, 1.0]}
    nulls = [f"actuators.{name}" for name in scene["actuators"]] + ["payload"] * ("payload" in scene)
    nulls += ["target.motion"] * ("motion" in scene["target"])
    changes = rng.sample([*numbers.items(), *((name, None) for name in nulls)], 2)
    steps = rng.randint(3, STEPS - 3)
    scene["phases"] = [
        {"name": "first", "steps": steps},
        {"name": "second", "steps": STEPS - steps, "changes": dict(changes)},
    ]


def _catch(scene, rng):
    near, far = {"attitude_error_deg": 180.0, "position_error": 9.0}, {"position_error": 1e-3}
    steps, scene["payload"] = rng.randint(3, STEPS - 3), dict(GRASPED)
    scene["phases"] = [
        {"name": "free", "steps": steps, "changes": {"payload": None}},
        {"name": "held", "steps": STEPS - steps, "catch": rng.choice([near, far])},
    ]


def _tip(scene, rng):
    tip = {"name": "further", "link": "base", "frame": {"position": [0.2, 0.0, 0.3]}}
    tip["relative_to"], tip["goal"] = rng.choice(["target", "inertial"]), {"position": [0.1, 0.1, 0.1]}
    if rng.random() < 0.5:
        tip["payload"] = {"mass": 3.0, "inertia": [0.1, 0.1, 0.1]}
    scene.setdefault("other_tips", []).append(tip)


MOTORS = (
    {"inertia": 1e-4, "gear": 50.0, "coupling": "exact", "friction": 0.05, "friction_speed": 0.1},
    {"inertia": 1e-4, "gear": -30.0, "coupling": "armature", "stiffness": 200.0, "damping": 1.0},
    {"stall_torque": 3.0, "no_load_speed": 2.0},
)
MOTIONS = (
    {"kind": "screw", "angular_velocity": [0.0, 0.02, 0.05], "linear_velocity": [0.01, 0.0, 0.0]},
    {"kind": "tumbling", "inertia": [20.0, 25.0, 30.0], "angular_velocity": [0.03, 0.05, 0.0]},
)
SPHERE, AXIS = {"frame": "tip", "radius": 0.05}, {"frame": "base", "direction": [0.0, 0.0, 1.0]}
BALL = {"frame": "target", "position": [0.5, 0.5, 1.5], "radius": 0.2}
SET = {"set": "pyramid", "inertia": 0.01, "torque": 0.5, "speed": 20.0, "power": 3.0}
FEATURES = {
    "delay": lambda scene, rng: _actuator(scene, rng, delay=rng.randint(1, 5)),
    "lag": lambda scene, rng: _actuator(scene, rng, time_constant=rng.choice([0.02, 0.2])),
    "slew": lambda scene, rng: _actuator(scene, rng, slew_limit=rng.choice([0.5, 5.0])),
    "rate": lambda scene, rng: _constraint(scene, rng, "control_rate", base_torque=4.0),
    "stops": lambda scene, rng: _constraint(
        scene, rng, "joint_limits", lower=-2.0, upper=2.5, rate=0.5, observed=0.3
    ),
    "ball": lambda scene, rng: _constraint(scene, rng, "distance", bodies=[SPHERE], obstacles=[BALL]),
    "cone": lambda scene, rng: _constraint(
        scene, rng, "keep_out_direction", axis=AXIS, direction=AXIS | {"frame": "target"}, angle_deg=20
    ),
    "momentum": lambda scene, rng: _constraint(scene, rng, "momentum", linear=5.0, angular=5.0, energy=4.0),
    "exact": lambda scene, rng: _constraint(scene, rng, "terminal", exact=["pose", "twist"]),
    "moving": lambda scene, rng: scene["target"].update(
        motion=rng.choice(MOTIONS), grasp={"position": [0.1, 0.0, 0.0]}, base_velocity_relative=True
    ),
    "observed": lambda scene, rng: scene["target"].update(observed=True),
    "spread": _spread,
    "parameters": lambda scene, rng: scene.update(
        parameters=rng.sample(["base.inertia", "target.pose", "links.0.mass", "cost", "actuators"], 2)
    ),
    "wheels": lambda scene, rng: _instead(scene, "base_torque", wheels=SET),
    "jets": lambda scene, rng: _instead(
        scene, "base_force", thrusters=[{**jet, "minimum_impulse": 0.05} for jet in JETS]
    ),
    "tank": lambda scene, rng: _instead(
        scene, "base_force", thrusters=[{**jet, "specific_impulse": 200.0} for jet in JETS], tank=TANK
    ),
    "wrench": lambda scene, rng: scene.update(tip_wrench={"force": [0.1, 0.0, -0.2]}),
    "integrator": lambda scene, rng: scene["simulation"].update(integrator=rng.choice([*INTEGRATORS])),
    "formulation": lambda scene, rng: scene["simulation"].update(formulation="minimal_coordinates"),
    "motor": lambda scene, rng: _joint(scene, rng, motor=rng.choice(MOTORS)),
    "passive": lambda scene, rng: _joint(scene, rng, actuated=False, stiffness=5.0, damping=0.5),
    "slide": lambda scene, rng: _joint(scene, rng, joint_type="prismatic"),
    "screw": lambda scene, rng: _joint(scene, rng, joint_type="screw", pitch=0.05),
    "payload": lambda scene, rng: scene.update(payload=dict(GRASPED)),
    "phases": _phases,
    "catch": _catch,
    "tip": _tip,
    "velocities": lambda scene, rng: scene["success"].update(velocity_error=0.5),
    "twist": lambda scene, rng: scene["cost"].update(tip_twist=0.5),
}


def mixed_scene(seed):
    """A shipped scene with features at random, those left out that make it invalid; names of the others."""
    rng = random.Random(seed)
    scene = load_scene(rng.choice(list_scenes()))
    lengths = {f"phases.{i}.steps": STEPS // len(scene.phases) for i in range(len(scene.phases))}
    scene, kept = scene.replace({**lengths, "simulation.steps": STEPS}), []
    for name in rng.sample([*FEATURES], 6):
        data = scene.model_dump(mode="json", exclude_none=True)
        try:
            FEATURES[name](data, rng)
            scene = load_scene(data)
        except (SceneError, LookupError):  # LookupError: nothing there that it changes
            continue
        kept.append(name)
    return scene, kept


MIXED = [mixed_scene(seed) for seed in range(11, 25)]


def test_every_feature_is_in_some_scene():
    found = {name for _, names in MIXED for name in names}
    assert found == {*FEATURES}


def for_scenes(count):
    """Call a test with each of the first scenes; the later ones are endurance tests."""
    cases = [
        pytest.param(scene, id="-".join(names), marks=() if index < 7 else pytest.mark.endurance)
        for index, (scene, names) in enumerate(MIXED[:count])
    ]
    return pytest.mark.parametrize("scene", cases)


def under_way(scene):
    """Kernels, states, inputs within the limits and parameters of a stage, of an episode under way."""
    kernels, rng = compile_scene(scene), np.random.default_rng(3)
    environment = DQSpaceArmVectorEnv(COPIES, scene)
    environment.reset(seed=1)
    rows = np.array([kernels.stage_parameters(p)[1] for p in environment.parameters])
    p = rows if kernels.n_p else None
    limit = kernels.layout.control_limit
    u = rng.uniform(0.1, 0.8, (COPIES, kernels.n_u)) * np.where(np.isfinite(limit), limit, 1.0)
    return kernels, kernels.step(environment.states, u, p=p), u, p


@pytest.mark.slow
@for_scenes(len(MIXED))
def test_single_and_vector_environments_agree_to_the_bit(scene):
    vector, singles = DQSpaceArmVectorEnv(COPIES, scene), [DQSpaceArmEnv(scene) for _ in range(COPIES)]
    seen, _ = vector.reset(seed=[*range(COPIES)])
    for seed, single in enumerate(singles):
        np.testing.assert_array_equal(single.reset(seed=seed)[0], seen[seed])
    space, rng, flying = vector.single_action_space, np.random.default_rng(0), set(range(COPIES))
    for _ in range(STEPS):
        actions = np.clip(rng.uniform(-1.3, 1.3, vector.action_space.shape), space.low, space.high)
        seen, rewards, terminated, truncated, _ = vector.step(actions)
        for row in sorted(flying):
            observation, reward, *ended, _ = singles[row].step(actions[row])
            assert reward == rewards[row]
            assert ended == [terminated[row], truncated[row]]
            assert np.isfinite(reward)
            if any(ended):
                flying.remove(row)
            else:
                np.testing.assert_array_equal(observation, seen[row])


@pytest.mark.slow
@for_scenes(len(MIXED))
def test_casadi_agrees(scene):
    kernels, x, u, p = under_way(scene)
    try:
        functions = casadi_dynamics(scene)
    except ValueError:  # adaptive or implicit
        scene = scene.replace({"simulation.integrator": "rk4"})
        kernels, functions = compile_scene(scene), casadi_dynamics(scene)
    h = scene.simulation.dt
    for row in range(COPIES):
        state = [x[row]] if p is None else [x[row], p[row]]
        own = None if p is None else p[row]
        for found, expected in (
            (functions.step(*state, u[row], h), kernels.step(x[row], u[row], p=own)),
            (functions.cost(*state, u[row]), kernels.cost(x[row], u[row], p=own)),
            (functions.terminal_cost(*state), kernels.terminal_cost(x[row], p=own)),
            (functions.tip_pose(*state), kernels.tip_pose(x[row], p=own)),
            (functions.constraints(*state, u[row]), kernels.constraints(x[row], u[row], p=own)),
        ):
            expected = np.ravel(expected)
            scale = np.abs(expected).max(initial=1.0)
            np.testing.assert_allclose(found.full()[:, 0], expected, rtol=0.0, atol=1e-11 * scale)


@pytest.mark.slow
@for_scenes(5)
def test_derivatives_agree_with_differences(scene):
    kernels, x, u, p = under_way(scene)
    size, n_t = 1e-6, kernels.n_t
    units = np.append(np.ones(n_t), np.maximum(np.abs(u).max(axis=0), 1e-3))

    def slopes(function):
        """Central differences of rows (B, m) by tangent states and inputs, (B, m, n_t + n_u)."""
        columns = []
        for column, unit in enumerate(units):
            step = np.zeros((COPIES, n_t + kernels.n_u))
            step[:, column] = size * unit
            ends = [
                np.reshape(
                    function(kernels.retract(x, s * step[:, :n_t]), u + s * step[:, n_t:]), (COPIES, -1)
                )
                for s in (1.0, -1.0)
            ]
            columns.append((ends[0] - ends[1]) / (2.0 * size * unit))
        return np.stack(columns, axis=-1)

    after = kernels.step(x, u, p=p)
    found = np.concatenate(kernels.linearize(x, u, p=p), axis=-1)
    expected = slopes(lambda x, u: kernels.difference(after, kernels.step(x, u, p=p)))
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())
    v = np.random.default_rng(4).normal(size=(COPIES, n_t))
    reverse = np.concatenate(kernels.vjp(x, u, v, p=p), axis=-1)
    np.testing.assert_allclose(reverse, np.einsum("bi,bij->bj", v, found), rtol=1e-9, atol=1e-9)
    gradient = np.concatenate(kernels.cost_gradient(x, u, p=p), axis=-1)
    expected = slopes(lambda x, u: kernels.cost(x, u, p=p))[:, 0]
    np.testing.assert_allclose(gradient, expected, rtol=0.0, atol=1e-6 * np.abs(expected).max())
