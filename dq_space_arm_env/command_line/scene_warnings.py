"""What is valid in a scene and probably not meant: units, masses, limits, targets out of reach, no draws."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np

from dq_space_arm_env.algebra import dual_quaternion, poses
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.interoperability.exporting import joint_limits
from dq_space_arm_env.interoperability.swing_efforts import swing_efforts
from dq_space_arm_env.scene import Link, Pose, Scene, StateLayout
from dq_space_arm_env.scene.bodies import freedoms
from dq_space_arm_env.scene.constraint_rows import path_rows
from dq_space_arm_env.scene.constraints import FRAMES
from dq_space_arm_env.scene.motion import Tumbling, Waypoints
from dq_space_arm_env.scene.parameters import parameters
from dq_space_arm_env.scene.path import shown_target
from dq_space_arm_env.task.constraint_residuals import state_residuals
from dq_space_arm_env.task.equations import SceneEquations

_BASE_DIRECTIONS = 6  # columns of a Jacobian
_SMALL = 1e-3  # rad and m per rad and m, of the least direction of a tip that counts
_FAR = 50.0  # m, between a joint and the next: no arm in space is as long
_ROUNDS = 4.0 * math.pi  # rad, of angles and their limits
_FAST = 50.0  # rad/s
_QUICK = 20.0  # rad/s, of limits
_LIGHT = 0.005  # kg
_GYRATION = 3.0  # radius of gyration of a base relative to the reach of the arm, or 1 m
_DENSE = 1e5  # kg/m^3, of the cube with a body's mass and inertia: five times tungsten
_STEP = 1.0  # s
_FRACTIONS_OF_PI = 6.0, 4.0, 3.0, 2.0, 1.5, 1.0
_ROUNDED_PI = 0.002  # degrees, within which an angle is such a fraction of pi
_SPIN = 1.0  # rad/s, of a target: a turn in six seconds
_EXACT = 1e-9  # of a tolerance, in its unit
_HALF_TURN = 180.0  # degrees, the largest attitude error
_NEAR = 2.0  # times a tolerance, of a way to the target
_ROUNDED = 9  # digits after the point of a distance, m
_SPEEDS = 0.5, 45.0  # m/s and degrees/s, on the mean way to the target
_REFUSED = "constraints that name frames refuse it; rename the link"
_ALIKE = 0.01  # of the radius of gyration and of the inertia, between two descriptions of a body
_VIOLENT = 50.0  # m/s^2 and rad/s^2, by the limits of what drives the base
_COARSE = "actions and noise, which are fractions of the limits, mean little"
_TOO_STRONG, _TOO_WEAK = 100.0, 0.03  # limits of torques, relative to the efforts of a swing


def warnings_of(scene: Scene) -> list[str]:
    """List what is unwise in a valid scene, a sentence each, which names the key and says what would help."""
    return [*maneuver_warnings(scene), *_draws(scene)]


def maneuver_warnings(scene: Scene) -> list[str]:
    """Those of them that may tell why a maneuver misses its target."""
    checks = (_names, _units, _masses, _actuators, limit_warnings, _start, _times, _reach, _caught)
    return [sentence for check in checks for sentence in check(scene)]


def _names(scene: Scene) -> Iterator[str]:
    """Links whose names constraints refuse, as those of frames."""
    yield from _together(
        (f"links[{i}].name", f"{link.name!r} is also a frame of every scene: {_REFUSED}")
        for i, link in enumerate(scene.links)
        if link.name in FRAMES
    )


def _units(scene: Scene) -> Iterator[str]:
    """Lengths that look like millimeters, angles that look like degrees, and degrees like radians."""
    yield from _together(
        (f"links[{i}].joint.position", f"{length:g} m from {link.name!r} to its parent: millimeters?")
        for i, link in enumerate(scene.links)
        if (length := math.hypot(*link.joint.position)) > _FAR
    )
    centers = [(f"links[{i}]", link.center_of_mass) for i, link in enumerate(scene.links)]
    centers += [("payload", scene.payload.center_of_mass)] if scene.payload is not None else []
    yield from _together(
        (f"{place}.center_of_mass", f"{length:g} m from the body's frame: millimeters?")
        for place, center in centers
        if (length := math.hypot(*center)) > _FAR
    )
    if math.hypot(*scene.tip.position) > _FAR:
        yield f"tip.position: {math.hypot(*scene.tip.position):g} m from the last joint: millimeters?"
    start = scene.initial_state
    turning = [scene.links[index].turns for index, _ in freedoms(scene.links)]
    for name, unit, most in (("joint_angles", "rad", _ROUNDS), ("joint_rates", "rad/s", _FAST)):
        for value, turns in zip(getattr(start, name), turning, strict=False):
            if turns and abs(value) > most:
                yield f"initial_state.{name}: {value:g} {unit}: degrees?"
                break
    yield from _together(
        (f"constraints: limits of {link.name!r}", f"{bound:g} m: millimeters?")
        for link, (lower, upper, _) in zip(scene.links, joint_limits(scene), strict=True)
        if link.joint_type == "prismatic"
        for bound in [bound for bound in (lower, upper) if _FAR < abs(bound) < math.inf][:1]
    )
    yield from _together(
        (f"{place}.rotation", f"{angle:.5g} degrees: radians?")
        for place, pose in _poses(scene)
        if any(abs((angle := _angle(pose)) - math.pi / part) < _ROUNDED_PI for part in _FRACTIONS_OF_PI)
    )
    degrees = []
    for link, (lower, upper, rate) in zip(scene.links, joint_limits(scene), strict=True):
        wide = [bound for bound in (lower, upper) if _ROUNDS < abs(bound) < math.inf]
        if link.turns and (wide or _QUICK < rate < math.inf):
            found = f"{wide[0]:g} rad" if wide else f"{rate:g} rad/s"
            degrees.append((repr(link.name), f"{found}: degrees?"))
    yield from (f"constraints: limits of {sentence}" for sentence in _together(degrees))
    if max(scene.spread.joint_angles, scene.spread.base_rotation, scene.spread.wrist_angles) > math.pi:
        yield "spread: draws of angles by more than half a turn, rad: degrees?"


def _poses(scene: Scene) -> Iterator[tuple[str, Pose]]:
    """All poses that a scene gives, with their keys."""
    yield "initial_state.base_pose", scene.initial_state.base_pose
    yield from ((f"links[{i}].joint", link.joint) for i, link in enumerate(scene.links))
    yield from [("wrist.frame", scene.wrist.frame)] if scene.wrist is not None else []
    yield "tip", scene.tip
    yield "target.pose", scene.target.pose
    yield "target.grasp", scene.target.grasp


def _angle(pose: Pose) -> float:
    """Angle of a pose's rotation, degrees."""
    w, *xyz = pose.rotation
    return math.degrees(2.0 * math.atan2(math.hypot(*xyz), abs(w)))


def _masses(scene: Scene) -> Iterator[str]:
    """Masses of grams, and inertias that do not fit mass and size."""
    arm = sum(link.mass for link in scene.links)
    if scene.base.mass < arm:
        yield (
            f"base.mass: {scene.base.mass:.3g} kg, lighter than the arm of {arm:.3g} kg: is the spacecraft "
            "missing, or too light? Of an imported robot --spacecraft-mass of `scenes import` sets it"
        )
    reach = max(min(arm_length(scene), _FAR), 1.0)
    light, wide, dense = [], [], []
    bodies = [("base", scene.base)] + [(f"links[{i}]", link) for i, link in enumerate(scene.links)]
    for place, body in bodies:
        if body.mass < _LIGHT:
            whose = f" of {body.name!r}" if isinstance(body, Link) else ""
            sentence = f"{1e3 * body.mass:g} g{whose}: was it meant in other units than kg?"
            light.append((f"{place}.mass", sentence))
        gyration = math.sqrt(np.trace(np.array(body.inertia)) / (2.0 * body.mass))
        size = f"of a body of {body.mass:g} kg that is"
        # A link may be longer than the arm, as a panel: its center of mass is then far from its joint.
        widest = (
            reach + 2.0 * math.hypot(*body.center_of_mass) if isinstance(body, Link) else _GYRATION * reach
        )
        if gyration > widest:
            sentence = (
                f"{size} {gyration:.3g} m wide, where the arm is {reach:.3g} m long: kg mm^2 or kg cm^2"
            )
            wide.append((f"{place}.inertia", f"{sentence}, or a mass in tons?"))
        elif body.mass > _DENSE * (2.0 * gyration) ** 3:
            sentence = f"{size} {1e3 * gyration:.2g} mm wide: a mass in grams, or inertia in other units?"
            dense.append((f"{place}.inertia", sentence))
    for found in (light, wide, dense):
        yield from _together(found)


def _together(found: Iterable[tuple[str, str]]) -> Iterator[str]:
    """The first place and what is wrong there, and the names of the others with the same."""
    places = list(found)
    if places:
        others = ", ".join(place for place, _ in places[1:])
        yield ": ".join(places[0]) + (f" Likewise {others}" if others else "")


def _actuators(scene: Scene) -> Iterator[str]:
    """Scenes that the environment, and without any actuator also the expert, refuses."""
    layout = StateLayout.of(scene)
    if not layout.n_u:
        yield (
            "actuators: there is none, so there is nothing to solve or to learn: give one, such as "
            "base_torque: {limit: 2.0} (N m)"
        )
    limits = zip(layout.control.names, layout.control_limit, strict=True)
    unlimited = [name for name, limit in limits if math.isinf(limit)]
    if unlimited:
        yield (
            f"actuators: {', '.join(unlimited)} without a finite limit: the environment refuses the scene, "
            "and nothing learns in it"
        )


def limit_warnings(scene: Scene) -> Iterator[str]:
    """Say which forces and torques are out of proportion to what free flight takes."""
    yield from _base_limits(scene)
    motors = scene.actuators.joint_torque
    if motors is None:
        return
    strong, weak = [], []
    for (index, _), effort in zip(freedoms(scene.links), swing_efforts(scene), strict=True):
        link = scene.links[index]
        limit = motors.limit if link.torque_limit is None else link.torque_limit
        if link.actuated and not math.isinf(limit) and not link.stiffness:
            share = limit / effort, f"{limit:g} {link.effort_unit} of {link.name!r}", effort
            strong += [share] if share[0] > _TOO_STRONG else []
            weak += [share] if share[0] < _TOO_WEAK else []
    swing = "what a swing of all joints by 1 rad in seconds takes"
    if strong:
        times, where, effort = max(strong)
        yield (
            f"torque limits: {_several(where, strong)}, {times:,.0f} times {swing}: {_COARSE}; "
            f"{3.0 * effort:.2g} would do there"
        )
    if weak:
        times, where, _ = min(weak)
        yield f"torque limits: {_several(where, weak)}, {times:.2g} of {swing}: the arm will crawl"


def _base_limits(scene: Scene) -> Iterator[str]:
    """Forces and torques that throw the base about."""
    layout, base = StateLayout.of(scene), scene.base
    largest = float(np.linalg.eigvalsh(np.array(base.inertia))[-1])
    for name, key, size, unit in (
        ("base_force", "base_force.limit", base.mass, "m/s^2"),
        ("base_torque", "base_torque.limit", largest, "rad/s^2"),
        ("wheel_torque", "wheels", largest, "rad/s^2"),
        ("thruster_force", "thrusters", base.mass, "m/s^2"),
    ):
        entries = getattr(layout.control, name)
        limits = [limit for limit in layout.control_limit[entries] if math.isfinite(limit)]
        if limits and (rate := max(limits) / size) > _VIOLENT:
            yield (
                f"actuators.{key}: {max(limits):g} {layout.control.unit(entries)} accelerate the base by "
                f"{rate:.3g} {unit}: {_COARSE}"
            )


def _several(where: str, found: list[tuple[float, str, float]]) -> str:
    return where if len(found) == 1 else f"{len(found)} of them are out of proportion, the most {where}"


def _start(scene: Scene) -> Iterator[str]:
    """A start that violates constraints."""
    equations = SceneEquations.of(scene, [number.nominal for number in parameters(scene)])
    x = StateLayout.of(scene).initial_state.tolist()
    residuals = state_residuals(equations, equations.base_pose(x), equations.y(x))
    rows = [row for row in path_rows(scene) if not row.has_input]
    violated = [
        (repr(row.name), f"violated by {float(c):.3g}{'' if row.unit == '1' else f' {row.unit}'}")
        for row, c in zip(rows, residuals, strict=True)
        if float(c) > row.tolerance
    ]
    yield from (f"initial_state: constraint {sentence}" for sentence in _together(violated))


def _times(scene: Scene) -> Iterator[str]:
    """Steps of seconds, episodes that are too short for the way, and tolerances that are as long."""
    simulation = scene.simulation
    if simulation.dt > _STEP:
        yield f"simulation.dt: {simulation.dt:g} s: milliseconds?"
    yield from _path(scene)
    seconds, (degrees, meters) = simulation.steps * simulation.dt, way_to_target(scene)
    drifts = any(scene.initial_state.base_velocity) or any(scene.initial_state.joint_rates)
    if not drifts and (meters / seconds > _SPEEDS[0] or degrees / seconds > _SPEEDS[1]):
        yield (
            f"simulation.steps: an episode of {seconds:.3g} s for {meters:.3g} m and {degrees:.3g} degrees "
            "to the target: is it long enough?"
        )
    if scene.success.attitude_error_deg >= _HALF_TURN:
        yield (
            f"success.attitude_error_deg: {scene.success.attitude_error_deg:g} degrees, half a turn: no "
            "attitude fails"
        )
    for name, value in scene.success.model_dump().items():
        if value is not None and value < _EXACT:
            yield f"success.{name}: {value:g}, as small as what rounding leaves: nothing succeeds"
    tolerance = scene.success.position_error
    if not drifts and scene.target.motion is None and 0.0 < meters < _NEAR * tolerance:
        yield (
            f"success.position_error: {tolerance:g} m, where the way to the target is {meters:.3g} m: hardly "
            "anything fails"
        )


def _path(scene: Scene) -> Iterator[str]:
    """Waypoints that begin elsewhere or come after the end of the episode, and targets that spin."""
    motion, seconds = scene.target.motion, scene.simulation.steps * scene.simulation.dt
    if isinstance(motion, Waypoints):
        if motion.points[0].pose != scene.target.pose:
            yield (
                "target.motion.points[0].pose: is not target.pose, from where the body moves as the points "
                "do from the first: to pass through them, give target.pose the first one's"
            )
        late = [index for index, point in enumerate(motion.points) if point.time > seconds]
        if late:
            yield (
                f"target.motion.points[{late[0]}].time: {motion.points[late[0]].time:g} s, after the end of "
                f"the episode at {seconds:g} s: the target does not come there"
            )
    elif motion is not None and (rate := math.hypot(*motion.angular_velocity)) > _SPIN:
        yield f"target.motion.angular_velocity: {rate:.3g} rad/s: degrees per second?"


def way_to_target(scene: Scene) -> tuple[float, float]:
    """Attitude [deg] and distance [m] from the tip at the start to the target."""
    start = scene.initial_state
    base = start.base_pose.dual_quaternion
    layout, tree = StateLayout.of(scene), KinematicTree.from_scene(scene)
    angles = tree.coordinates(layout.initial_state[layout.state.joint_angles].tolist())
    tip = kinematics.tip_pose(tree, base, angles, start.wrist_angles or (0.0, 0.0, 0.0))
    target = np.atleast_2d(shown_target(scene)[0])[0]
    way = dual_quaternion.multiply(dual_quaternion.conjugate(tip), tuple(target.tolist()))
    rotation, position = poses.to_rotation_and_position(way)
    return _angle(Pose(rotation=rotation)), round(math.hypot(*position), _ROUNDED)


def _reach(scene: Scene) -> Iterator[str]:
    """Goals of tips too far from the center of mass, which only thrusters move."""
    start, simulation = scene.initial_state, scene.simulation
    if any(start.base_velocity) or any(start.joint_rates):
        return  # it drifts
    masses, centers = _mass_points(scene)
    center, total = np.average(centers, axis=0, weights=masses), sum(masses)
    seconds = simulation.steps * simulation.dt
    pushed = 0.25 * _force(scene) / total * seconds**2  # there and to rest, by the largest force
    # From the center of mass the base is at most the arm's share of the mass times its length.
    share, by = 2.0 - scene.base.mass / total, ""
    if pushed:
        by = f", thrusters move it by {pushed:.3g} m in {seconds:g} s"
    for where, goal, length in _goals(scene):
        reach, distance = length * share + scene.success.position_error, math.dist(goal, center)
        if distance > reach + pushed:
            yield (
                f"{where}: {distance:.3g} m from the center of mass, from which the arm reaches {reach:.3g} m"
                f"{by}: it is out of reach"
            )


def _goals(scene: Scene) -> Iterator[tuple[str, tuple[float, ...], float]]:
    """Where the scene says them, places of the tips at the end, m, and lengths of their arms, m."""
    aims, bodies = shown_target(scene)
    aim, body = (np.atleast_2d(path)[-1] for path in (aims, aims if bodies is None else bodies))
    yield "target", poses.to_rotation_and_position(tuple(aim.tolist()))[1], arm_length(scene)
    for index, tip in enumerate(scene.other_tips):
        frame = tuple(body.tolist()) if tip.relative_to == "target" else dual_quaternion.IDENTITY
        goal = dual_quaternion.multiply(frame, tip.goal.dual_quaternion)
        length = math.hypot(*tip.frame.position) + _length(scene, scene.body_named(tip.link))
        yield f"other_tips[{index}].goal", poses.to_rotation_and_position(goal)[1], length


def _caught(scene: Scene) -> Iterator[str]:
    """A payload that is not the body that tumbles until it is caught: its momentum changes freely."""
    motion, payload, grasp = scene.target.motion, scene.payload, scene.target.grasp
    catches = any(phase.catch is not None for phase in scene.phases)
    if not catches or payload is None or not isinstance(motion, Tumbling):
        return
    turn, inertia = np.array(grasp.rotation_matrix), np.array(payload.inertia)
    center = turn @ payload.center_of_mass + grasp.position
    gyration = math.sqrt(np.trace(inertia) / (2.0 * payload.mass))
    if (apart := float(np.linalg.norm(center))) > _ALIKE * gyration:
        yield (
            f"payload.center_of_mass: {apart:.3g} m from the target's origin, about which the body tumbles "
            "until it is caught: its momentum changes without a force; "
            f"{_shown(-turn.T @ grasp.position)} is there"
        )
    held, free = turn @ inertia @ turn.T, np.array(motion.inertia)
    if np.abs(held / np.trace(held) - free / np.trace(free)).max() > _ALIKE:
        rows = f"[{', '.join(_shown(row) for row in held)}]"
        found = rows if np.any(held - np.diag(np.diag(held))) else _shown(np.diag(held))
        yield (
            "target.motion.inertia: not in the ratios of payload.inertia, turned by target.grasp: the body "
            "tumbles as another than is caught, and the momentum of that one changes without a torque; "
            f"{found} is the payload's"
        )


def _draws(scene: Scene) -> Iterator[str]:
    """Episodes that are all the same."""
    if not any(scene.spread.model_dump().values()):
        width = "joint_angles: 0.2" if freedoms(scene.links) else "base_rotation: 0.2"
        yield (
            "spread: there is none, so all episodes begin alike, and agents see one start: give widths, such "
            f"as {width} (rad)"
        )


def _shown(numbers: Iterable[float]) -> str:
    return f"[{', '.join(f'{number + 0.0:.6g}' for number in numbers)}]"


def _mass_points(scene: Scene) -> tuple[list[float], list[tuple[float, ...]]]:
    """Masses of all bodies, kg, and where their centers are at the start, m."""
    tree, layout, start = KinematicTree.from_scene(scene), StateLayout.of(scene), scene.initial_state
    angles = tree.coordinates(layout.initial_state[layout.state.joint_angles].tolist())
    wrist = start.wrist_angles or (0.0, 0.0, 0.0)
    frames = kinematics.frame_poses(tree, start.base_pose.dual_quaternion, angles, wrist)
    bodies = [(scene.base.mass, (0.0, 0.0, 0.0), frames[0])]
    others = [tip.payload for tip in scene.other_tips]  # whose frames follow those of the links
    held = [*zip([*scene.links, *others], frames[1:], strict=False), (scene.payload, frames[-1])]
    bodies += [(each.mass, each.center_of_mass, frame) for each, frame in held if each is not None]
    centers = []
    for _, center, frame in bodies:
        rotation, position = poses.to_matrix(tuple(frame))
        centers.append(tuple((np.array(position) + np.array(rotation) @ np.array(center)).tolist()))
    return [mass for mass, *_ in bodies], centers


def _force(scene: Scene) -> float:
    """Largest force on the base, N."""
    force, jets = scene.actuators.base_force, scene.actuators.thrusters or ()
    return (math.hypot(*force.limit) if force is not None else 0.0) + sum(jet.force for jet in jets)


def arm_length(scene: Scene) -> float:
    """Length of the stretched arm from the base's center of mass to the tip, m; infinite for free slides."""
    length = math.hypot(*scene.tip.position)
    if scene.wrist is not None:
        length += math.hypot(*scene.wrist.frame.position)
    return length + _length(scene, scene.tip_body)


def _length(scene: Scene, body: int) -> float:
    """Length of the stretched arm from the base's center of mass to a body's joint, m."""
    length, limits = 0.0, joint_limits(scene)
    while body:
        link = scene.links[body - 1]
        length += math.hypot(*link.joint.position)
        if link.joint_type in ("prismatic", "screw"):
            slide = 1.0 if link.joint_type == "prismatic" else abs(link.pitch)
            length += slide * max(abs(bound) for bound in limits[body - 1][:2])  # infinite for no limit
        body = scene.parent_bodies[body - 1]
    return length


def tip_directions(scene: Scene) -> int:
    """In how many directions joints and wrist can move the tip at the start, turns included: 6 at most."""
    tree, layout, start = KinematicTree.from_scene(scene), StateLayout.of(scene), scene.initial_state
    angles = tree.coordinates(layout.initial_state[layout.state.joint_angles].tolist())
    columns = kinematics.tip_jacobian(tree, angles, start.wrist_angles or (0.0, 0.0, 0.0))[_BASE_DIRECTIONS:]
    return int(np.linalg.matrix_rank(np.array(columns), tol=_SMALL)) if columns else 0
