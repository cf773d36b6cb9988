"""Import and export of scenes, for `scenes import` and `scenes export`."""

from __future__ import annotations

import functools
import math
import re
import shutil
import textwrap
import warnings
from ast import literal_eval
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any, Literal

from dq_space_arm_env import Scene, SceneError, load_scene, scene_from_urdf, scene_to_mjcf, scene_to_urdf
from dq_space_arm_env.algebra import dual_quaternion, poses, rotations
from dq_space_arm_env.command_line.scene_warnings import (
    arm_length,
    tip_directions,
    warnings_of,
    way_to_target,
)
from dq_space_arm_env.common.files import json_value
from dq_space_arm_env.dynamics.kinematic_tree import KinematicTree
from dq_space_arm_env.dynamics.step_stability import joint_motion
from dq_space_arm_env.interoperability.bus_actuators import with_jets, with_wheels
from dq_space_arm_env.interoperability.exporting import joint_limits
from dq_space_arm_env.interoperability.step_choice import (
    ACCURACY,
    StepTrial,
    best_of,
    measured_steps,
    needs_stiff_method,
)
from dq_space_arm_env.interoperability.urdf_arm import HERE, UrdfTree
from dq_space_arm_env.interoperability.urdf_elements import read_robot
from dq_space_arm_env.scene import Link, Simulation, Success

_OPTIONS = {
    r"spacecraft=\{'mass': \.\.\., 'inertia': \.\.\.\}": "--spacecraft-mass and --spacecraft-inertia",
    r"lock_branches=True all": "--lock-branches all",
    r"^lock_branches(?=: )": "--lock",
    r"wrist='fixed'": "--wrist fixed",
    r"give joint_torque, N m,": "give --joint-torque, N m,",
    r"in passive(?=$| )": "with --passive",
    r"^(tip|base|passive)(?=: )": r"--\1",
    r"^joint_torque(?= = )": "--joint-torque",
    r"balance_inertias=True": "--balance-inertias",
    r"as base$": "as --base",
}
"""Options for the Python arguments that messages mention."""


_MOST_ENDS = 12  # of arms that are listed
_TOLERANCE = 0.1  # most of the position at the end, relative to the length of the arm
_WAY = 0.25  # likewise, relative to the way to the target
_ROOMY = 0.9  # share of the spread asked for, below which its user is told


@dataclass(frozen=True)
class Proposals:
    """What the import adds to the robot of a file."""

    wheels: str = "ideal"  # or an arrangement of reaction wheels
    thrusters: str = "ideal"  # or jets
    spread: float = 0.0  # half-width of the starts, rad and m
    scaled_efforts: bool = False  # whether limits of torques are lowered to what free flight takes
    measured: bool = False  # whether integrator and time step are chosen by measuring


@dataclass(frozen=True, eq=False)
class Imported:
    """A scene from a URDF file."""

    scene: Scene
    warnings: tuple[str, ...]
    # Efforts of the file, base to tip, N m; without a motor, or an effort: None.
    efforts: tuple[float | None, ...]
    spacecraft: float = 0.0  # mass that the file does not have, kg
    steps: tuple[StepTrial, ...] = ()  # integrators and time steps that were measured
    joint_torque: float | None = None  # given limit of joints without an effort, N m
    shapes: int = 0  # of the file that are left out


@contextmanager
def in_options() -> Iterator[None]:
    """Name options instead of Python arguments in error messages."""
    try:
        yield
    except SceneError as error:
        message = str(error)
        for argument, option in _OPTIONS.items():
            message = re.sub(argument, option, message)
        message = re.sub(r"lock_branches=(\[.*?\])(?= holds)", _locks, message)
        raise SceneError(message) from error


def _locks(names: re.Match[str]) -> str:
    """The names of a list in Python, as options."""
    return " ".join(f"--lock {quote(name)}" for name in literal_eval(names[1]))


def import_urdf(
    file: str, tip: str | None, arguments: Mapping[str, Any], proposals: Proposals = Proposals()
) -> Imported:
    """Make a scene of a URDF file; `arguments` are those of `scene_from_urdf`.

    Where these do not say whether to keep dampers, those that only a method for stiff joints follows are
    refused: who was not asked would wait for hours.
    """
    path = Path(file)
    if tip is None:
        with in_options():
            tips = _tips(path, arguments.get("base"))
        raise SceneError(f"--tip LINK is missing, the link that is to reach the target:\n{tips}")
    with warnings.catch_warnings(record=True) as caught, in_options():
        warnings.simplefilter("always")
        scene = scene_from_urdf(path, tip, **arguments, scaled_efforts=proposals.scaled_efforts)
    if "dampers" not in arguments and needs_stiff_method(scene):
        raise SceneError(
            f"dampers of {path} stop joints within {_stopping(scene)}, too fast for rk4: solving would take "
            "minutes and training hours. They are guesses in many files: --no-dampers leaves them out, "
            "--dampers keeps them"
        )
    if proposals.wheels != "ideal":
        scene = with_wheels(scene, proposals.wheels)
    if proposals.thrusters != "ideal":
        assert scene.actuators.base_force is not None
        scene = with_jets(scene, 0.5 * max(scene.actuators.base_force.limit))
    scene = scene.replace(spread=_spread(scene, proposals.spread), success=_success(scene))
    steps = tuple(measured_steps(scene)) if proposals.measured else ()
    messages = [str(each.message).removeprefix("URDF: ") for each in caught]
    if scene.spread.joint_angles < _ROOMY * proposals.spread:
        room, narrow = min((room, link.name) for link, room in _rooms(scene))
        messages.append(
            f"spread: starts of all joints are within {scene.spread.joint_angles:g} rad (m), where "
            f"{proposals.spread:g} was asked: {narrow} is {room:.2g} from a stop"
        )
    if steps:
        best = best_of(steps)
        scene = best.of(scene)
        if best.error > ACCURACY:
            messages.append(
                f"simulation: the best steps that were tried end {best.error:.0e} m or rad off, where "
                f"{ACCURACY:.0e} was asked: --lock JOINT and --lock-branches hold joints that are not needed"
            )
    robot = read_robot(path)
    written = {joint.child: joint.effort for joint in robot.joints.values()}
    efforts = tuple(written[link.name] if link.actuated else None for link in scene.links)
    added = (arguments.get("spacecraft") or {}).get("mass", 0.0)
    torque: float | None = arguments.get("joint_torque")
    return Imported(scene, (*messages, *warnings_of(scene)), efforts, added, steps, torque, robot.shapes)


def _spread(scene: Scene, width: float) -> dict[str, float]:
    """Draws of the start: the joints within their limits, the base where anything makes up for it."""
    room = min(room for _, room in _rooms(scene))
    actuators = scene.actuators
    pushed = actuators.base_force or actuators.thrusters
    turned = pushed or actuators.base_torque or actuators.wheels or tip_directions(scene) == 6
    return {
        "joint_angles": min(width, float(f"{0.95 * room:.2g}")),  # two digits add less than 5 %
        "base_rotation": width if turned else 0.0,
        "base_position": width if pushed else 0.0,
    }


def _rooms(scene: Scene) -> Iterator[tuple[Link, float]]:
    """Links, each with the distance of its joint from the nearest stop at the start, rad (m)."""
    start = zip(scene.links, scene.initial_state.joint_angles, joint_limits(scene), strict=True)
    for link, angle, (lower, upper, _) in start:
        yield link, min(angle - lower, upper - angle)


def _success(scene: Scene) -> dict[str, float]:
    """A tolerance in proportion to the arm from its first joint on and to its way, at most the usual one."""
    length = arm_length(scene) - math.hypot(*scene.links[0].joint.position)
    usual, (_, meters) = Success().position_error, way_to_target(scene)
    most = min(_TOLERANCE * length, _WAY * meters or math.inf)
    return {"position_error": min(usual, float(f"{most:.1g}") or usual)}


def mounted(position: tuple[float, ...] | None, degrees: tuple[float, ...] | None) -> dict[str, Any]:
    """Pose of the base link on the spacecraft; `degrees` are roll, pitch and yaw."""
    roll, pitch, yaw = (math.radians(angle) for angle in degrees or (0.0, 0.0, 0.0))
    if not math.isfinite(roll + pitch + yaw):
        raise ValueError(f"--mount-rotation is {degrees}, should be 3 finite numbers, degrees")
    return {"position": position or (0.0, 0.0, 0.0), "rotation": rotations.from_euler_321(yaw, pitch, roll)}


def _tips(path: Path, base: str | None) -> str:
    """Ends of arms, with what is between them and the base, and the other links."""
    robot = read_robot(path)
    tree, ways = UrdfTree(robot), {}
    mimicked = tree.mimicked()
    for name, joints in tree.ways(base).items():
        pose = functools.reduce(dual_quaternion.multiply, (joint.origin for joint in joints), HERE)
        # No tip hangs on joints that mimic others, or are mimicked by those of a mass.
        bound = any(joint.mimics or joint.name in mimicked for joint in joints)
        moving = 0 if bound else sum(joint.type != "fixed" for joint in joints)
        ways[name] = moving, math.hypot(*poses.to_rotation_and_position(pose)[1])
    onward = {joint.parent for joint in robot.joints.values() if ways.get(joint.child, (0,))[0]}
    ends = [name for name, (moving, _) in ways.items() if name not in onward and moving]
    ends = sorted(ends, key=ways.__getitem__, reverse=True)[:_MOST_ENDS]
    width = max((len(name) for name in ends), default=0)
    rows = [
        f"  {name:{width}}  {moving} joint{'s' * (moving > 1)}, {meters:.2f} m from the base"
        for name in ends
        for moving, meters in [ways[name]]
    ]
    others = [name for name in robot.links if name not in ends]
    return "\n".join([*rows, *wrapped(f"  others  {', '.join(others)}")])


def record(imported: Imported, file: str, source: str) -> dict[str, Any]:
    """Describe an imported scene for programs."""
    scene = imported.scene
    degrees, meters = way_to_target(scene)
    return {
        "file": file,
        "name": scene.name,
        "from": source,
        "base_mass_kg": scene.base.mass,
        "links": [link.name for link in scene.links],
        "start_attitude_error_deg": degrees,
        "start_position_error_m": meters,
        "efforts": list(imported.efforts),
        "torque_limits": [link.torque_limit for link in scene.links],
        "steps": [json_value(each._asdict()) for each in imported.steps],
        "shapes_left_out": imported.shapes,
        "warnings": list(imported.warnings),
    }


def summary(imported: Imported, file: str) -> Iterator[str]:
    """Summarize an imported scene, and what its user will want to change, in lines for the terminal."""
    for line in _lines(imported, file):
        yield from wrapped(line)


def wrapped(line: str) -> list[str]:
    """Break a line where the terminal ends, but neither commands nor numbers and their units."""
    whole = re.sub(r"`[^`]*`|\d N m|\d \w", lambda found: found[0].replace(" ", "\u00a0"), line)
    indent = " " * (10 if line.startswith(" ") else 2)
    width = shutil.get_terminal_size().columns
    broken = textwrap.wrap(
        whole, width, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
    return [part.replace("\u00a0", " ") for part in broken]


def _lines(imported: Imported, file: str) -> Iterator[str]:
    scene = imported.scene
    degrees, meters = way_to_target(scene)
    links = ", ".join(f"{link.name} {_number(link.mass, 4)} kg" for link in scene.links)
    joints = "1 joint" if len(scene.links) == 1 else f"{len(scene.links)} joints"
    yield f"{file}: {scene.name}, {joints}"
    whole, part = (_number(mass, 4) for mass in (scene.base.mass, imported.spacecraft))
    share = f", {part} kg of it the spacecraft's" if imported.spacecraft and part != whole else ""
    yield f"  base    {whole} kg{share}"
    yield f"  links   {links}"
    tree = KinematicTree.from_scene(scene)
    beside = [link.name for i, link in enumerate(scene.links) if i not in tree.path_to(tree.tip_body)]
    if beside:
        yield (
            f"  beside  the way to the tip {len(beside)} more move: {', '.join(beside)}; --lock-branches "
            "holds all, --lock JOINT one"
        )
    yield f"  limits  {'; '.join(_limits(scene)) or 'no motors'}; edit actuators and links"
    yield from _scaled(imported)
    limits_of_joints = joint_limits(scene)
    ranges = sum(math.isfinite(lower) or math.isfinite(upper) for lower, upper, _ in limits_of_joints)
    rates = sum(math.isfinite(rate) for *_, rate in limits_of_joints)
    if ranges or rates:
        yield f"  joints  {ranges} with limits of the angle, {rates} of the rate; edit constraints"
    else:
        yield "  joints  without limits of the angle or the rate; constraints of kind joint_limits add them"
    start = zip(scene.links, scene.initial_state.joint_angles, strict=True)
    yield f"  start   at rest, {', '.join(_by_kind(start, 'unit', ' at'))}; edit initial_state"
    within = scene.success
    yield (
        f"  target  {degrees:.3g} degrees and {meters:.3g} m from the start, to be reached within "
        f"{within.attitude_error_deg:g} degrees and {within.position_error:g} m; edit target and success"
    )
    yield from _steps(imported)
    spread = scene.spread
    if any(each for each in spread.model_dump().values()):
        yield (
            f"  spread  starts within {spread.joint_angles:.3g} rad of the joints, "
            f"{spread.base_rotation:.3g} rad and {spread.base_position:.3g} m of the base; edit spread"
        )
    else:
        yield "  spread  every episode is the same; edit spread before an agent is trained"
    if imported.shapes:
        yield f"  shapes  left out: {imported.shapes}; edit geometry for pictures"
    word = quote(file)
    yield f"Next: `dq-space-arm solve {word}`; after edits first `dq-space-arm scenes validate {word}`"


def _scaled(imported: Imported) -> Iterator[str]:
    """Say which limits of torques were lowered, and why."""
    own = imported.efforts
    lowered = [
        (link, before, link.torque_limit)
        for before, link in zip(own, imported.scene.links, strict=True)
        if before is not None and link.torque_limit is not None and before > link.torque_limit
    ]
    if lowered:
        most = max(before / after for _, before, after in lowered)
        efforts = ", ".join(_by_kind(((link, before) for link, before, _ in lowered), "effort_unit"))
        yield (
            "          scaled for free flight to three times what a swing by 1 rad in seconds takes: the "
            f"file's efforts, {efforts}, work against gravity and are up to {most:,.0f} times as large; "
            "--full-efforts keeps them"
        )
    pairs = zip(own, imported.scene.links, strict=True)
    free = [link.name for before, link in pairs if before is None and link.actuated]
    if free and imported.joint_torque is None:
        yield (
            f"          the file has no effort, or 1e4 and more, for {', '.join(free)}: --joint-torque gives "
            "another limit"
        )


def _steps(imported: Imported) -> Iterator[str]:
    """Say what was measured of integrators and time steps, and what stiff dampers mean."""
    scene, simulation = imported.scene, imported.scene.simulation
    if imported.steps:
        dt = simulation.dt * best_of(imported.steps).division
        words = [
            f"{each.integrator} of {1e3 * dt / each.division:.3g} ms "
            + (f"ends {each.error:.0e} m or rad off" if math.isfinite(each.error) else "diverges")
            for each in imported.steps
        ]
        taken = "this" if len(words) == 1 else f"{simulation.integrator} of {1e3 * simulation.dt:.3g} ms"
        yield f"  steps   a swing by {'; by '.join(words)}: {taken} is taken"
    elif simulation.integrator != Simulation().integrator:
        yield f"  steps   by {simulation.integrator}: the joints' dampers are too stiff for others"
    slower = simulation.integrator != Simulation().integrator or simulation.dt < Simulation().dt
    if slower and joint_motion(scene).decay * Simulation().dt > 1.0:
        yield (
            f"          dampers stop joints within {_stopping(scene)}: solving and training take many "
            "times as long; many files' dampers are guesses: --no-dampers leaves them out"
        )


def _stopping(scene: Scene) -> str:
    """Time in which dampers stop joints."""
    return f"{1e3 / joint_motion(scene).decay:.2g} ms"


def _number(value: float, digits: int = 3) -> str:
    """A number with some digits, or whole where it has more."""
    return f"{value:.0f}" if abs(value) >= 10**digits - 0.5 else f"{value:.{digits}g}"


def _numbers(values: Sequence[float]) -> str:
    """The numbers, or the one that they all are."""
    return ", ".join(_number(value) for value in (values if len(set(values)) > 1 else values[:1]))


def _by_kind(values: Iterable[tuple[Link, float]], unit: str, verb: str = "") -> Iterator[str]:
    """The numbers of joints and those of slides, each with their unit, an attribute of links."""
    pairs = list(values)
    for kind, turns in (("joints", True), ("slides", False)):
        found = [(value, getattr(link, unit)) for link, value in pairs if link.turns is turns]
        if found:
            yield f"{kind}{verb} {_numbers([value for value, _ in found])} {found[0][1]}"


def _limits(scene: Scene) -> Iterator[str]:
    actuators = scene.actuators
    if actuators.base_force is not None:
        yield f"thrusters {_numbers(actuators.base_force.limit)} N"
    if actuators.thrusters is not None:
        yield f"{len(actuators.thrusters)} jets of {actuators.thrusters[0].force:.3g} N"
    if actuators.wheels is not None:
        wheel = actuators.wheels[0]
        stored = f"{wheel.inertia * wheel.speed:.3g} N m s"
        yield f"{len(actuators.wheels)} wheels of {wheel.torque:.3g} N m and {stored}"
    if actuators.base_torque is not None:
        yield f"wheels {_numbers(actuators.base_torque.limit)} N m"
    if actuators.joint_torque is not None:
        limits = [(link, link.torque_limit) for link in scene.links if link.torque_limit]
        yield from _by_kind(((link, limit) for link, limit in limits if limit is not None), "effort_unit")
        passive = [link.name for link in scene.links if not link.torque_limit]
        if passive:
            yield f"passive: {', '.join(passive)}"


def export(scene: str, language: str, wrist: Literal["refuse", "fixed"]) -> str:
    """Write a scene's robot in another language."""
    loaded = load_scene(scene)
    with in_options():
        return (scene_to_urdf if language == "urdf" else scene_to_mjcf)(loaded, wrist=wrist)
