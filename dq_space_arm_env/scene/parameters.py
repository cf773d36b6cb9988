"""The parameters of a scene: numbers that are inputs of its machine code rather than constants of it.

Those are the numbers that its spread draws for each episode, and those that it names under `parameters`.
Whatever varies is known by its path in the scene: "links.0.mass", "base.inertia.xx", "target.pose.q_r0".
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

from dq_space_arm_env.scene.bodies import Base, Link, Payload, freedoms
from dq_space_arm_env.scene.path import first_velocity
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST, Pose

Scene = Any  # `schema.Scene`, which finds mistakes in its list of parameters by this file

TARGET = "target.pose"
VELOCITY = "target.velocity"
GRASP = "target.grasp"
PHASE = "phase"
CATCH = "catch"
_AXES = ("x", "y", "z")
_EULER_ANGLES = ("psi", "theta", "phi")
_LOWER_TRIANGLE = ((0, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 2))
_POSE = tuple(f"q_{part}{index}" for part in "rd" for index in range(4))
_TWIST = tuple(f"{kind}_{axis}" for kind in ("omega", "v") for axis in _AXES)
CONTROL_UNITS = {
    "base_force": "N",
    "base_torque": "N m",
    "joint_torque": "N m",
    "wrist_rate": "rad/s",
    "wheel_torque": "N m",
    "thruster_force": "N",
}
"""Units of the controls, in their order."""
ACTUATORS = {field: field for field in CONTROL_UNITS} | {
    "wheel_torque": "wheels",
    "thruster_force": "thrusters",
}
"""Names in `actuators` of what the controls drive."""
_STATE_WEIGHTS = {
    "pose": (_POSE, PLANAR_POSE),
    "terminal_pose": (_POSE, PLANAR_POSE),
    "base_velocity": (_TWIST, PLANAR_TWIST),
    "terminal_base_velocity": (_TWIST, PLANAR_TWIST),
    "tip_twist": (_TWIST, PLANAR_TWIST),
    "terminal_tip_twist": (_TWIST, PLANAR_TWIST),
}


class Number(NamedTuple):
    """A number of a scene that may be a parameter."""

    name: str  # its path, with a word for the place in a list
    unit: str  # "1" for dimensionless
    nominal: float
    # Those of the number itself, for `Scene.replace`; a target and a planar inertia change as a whole.
    paths: tuple[str, ...]


class ControlNumbers(NamedTuple):
    """The numbers of a control; joints may share theirs."""

    name: str  # of the control
    limit: Number
    weight: Number


def parameters(scene: Scene) -> tuple[Number, ...]:
    """The parameters of a scene: target, bodies from base to payload, weights, limits."""
    staged = scene.staged.values if scene.phases else {}
    varying = _drawn(scene) | {number.name for number in moving_numbers(scene)} | staged.keys()
    return tuple(
        number._replace(nominal=staged.get(number.name, (number.nominal,))[0])
        for number in numbers(scene)
        if number.name in varying
        or is_part(number.name, CATCH)
        or any(is_part(number.name, path) for path in scene.parameters)
    )


def is_part(name: str, path: str) -> bool:
    """Tell whether a path leads to a number, or to something that it is part of."""
    return name == path or name.startswith(path + ".")


def parents(name: str) -> Iterator[str]:
    """A number's name, and the paths of everything that it is part of."""
    while name:
        yield name
        name = name.rpartition(".")[0]


def numbers(scene: Scene) -> Iterator[Number]:
    """All numbers of a scene that may be parameters; a planar scene has those of its plane only."""
    yield from target_numbers(scene)
    yield from velocity_numbers(scene)
    yield from grasp_numbers(scene)
    yield from body_numbers(scene, "base")
    for index, link in enumerate(scene.links):
        place = f"links.{index}"
        yield from body_numbers(scene, place)
        if link.is_fixed:
            continue
        yield _number(f"{place}.stiffness", f"{link.effort_unit}/{link.unit}", link.stiffness)
        yield _number(f"{place}.damping", f"{link.effort_unit} s/{link.unit}", link.damping)
        yield from _motor_numbers(f"{place}.motor", link)
    if scene.payload is not None:
        yield from body_numbers(scene, "payload")
    for field, (entries, planar) in _STATE_WEIGHTS.items():
        weights = getattr(scene.cost, field)
        if field.endswith("tip_twist") and not any(weights):
            continue  # the term is not in the machine code
        for index in planar if _is_planar(scene) else range(len(entries)):
            yield _number(weight_name(field, index), "1", weights[index], f"cost.{field}.{index}")
    if scene.phases:
        yield _number(PHASE, "1", 0.0)
        yield from catch_numbers(scene)
    controls = [each for numbers in control_numbers(scene).values() for each in numbers]
    yield from _shared(control.weight for control in controls)
    yield from _shared(control.limit for control in controls)


def _shared(found: Iterable[Number]) -> Iterable[Number]:
    """Each number once by its name: motors of which some turn and others slide share theirs, in two units."""
    each: dict[str, Number] = {}
    for number in found:
        known = each.setdefault(number.name, number)
        if number.unit not in known.unit.split(" or "):
            each[number.name] = known._replace(unit=f"{known.unit} or {number.unit}")
    return each.values()


def _motor_numbers(place: str, link: Link) -> Iterator[Number]:
    """The numbers of a joint's motor that may vary."""
    units = {
        "inertia": "kg m^2",
        "friction": link.effort_unit,
        "stiffness": f"{link.effort_unit}/{link.unit}",
        "damping": f"{link.effort_unit} s/{link.unit}",
    }
    for name in link.motor.varying if link.motor is not None else ():
        yield _number(f"{place}.{name}", units[name], getattr(link.motor, name))


def catch_numbers(scene: Scene) -> Iterator[Number]:
    """Whether the payload is caught at the end of a stage, 1 or 0, and its twist then, tip axes."""
    if any(phase.catch is not None for phase in scene.phases):
        yield _number(f"{CATCH}.now", "1", 0.0)
        for index in velocity_entries(scene):
            yield _number(f"{CATCH}.{_TWIST[index]}", "rad/s" if index < 3 else "m/s", 0.0)


def _number(name: str, unit: str, nominal: float, *paths: str) -> Number:
    return Number(name, unit, nominal, paths or (name,))


def weight_name(field: str, index: int) -> str:
    """Name of a weight of the state in the cost, for example of ("pose", 0)."""
    return f"cost.{field}.{_STATE_WEIGHTS[field][0][index]}"


def target_numbers(scene: Scene) -> Iterator[Number]:
    """The numbers of the target's dual quaternion; in a planar scene four of them are zero."""
    yield from _pose_numbers(scene, TARGET, scene.target.pose.dual_quaternion)


def grasp_numbers(scene: Scene) -> Iterator[Number]:
    """Likewise of the grasp frame, where there is one."""
    if has_grasp(scene):
        yield from _pose_numbers(scene, GRASP, scene.target.grasp.dual_quaternion)


def _pose_numbers(scene: Scene, path: str, pose: Sequence[float]) -> Iterator[Number]:
    for index in target_entries(scene):
        yield Number(f"{path}.{_POSE[index]}", "1" if index < 4 else "m", pose[index], ())


def velocity_numbers(scene: Scene) -> Iterator[Number]:
    """The numbers of the velocity of a target that moves, body axes, at the start."""
    if scene.target.motion is not None:
        velocity = first_velocity(scene)
        for index in velocity_entries(scene):
            yield Number(f"{VELOCITY}.{_TWIST[index]}", "rad/s" if index < 3 else "m/s", velocity[index], ())


def moving_numbers(scene: Scene) -> list[Number]:
    """What changes from stage to stage: pose and velocity of a target that moves."""
    if scene.target.motion is None:
        return []
    return [*target_numbers(scene), *velocity_numbers(scene)]


def target_entries(scene: Scene) -> tuple[int, ...]:
    """Indices of the target's eight numbers that are not zero whatever the target."""
    return PLANAR_POSE if _is_planar(scene) else tuple(range(8))


def velocity_entries(scene: Scene) -> tuple[int, ...]:
    """Likewise of the six numbers of its velocity."""
    return PLANAR_TWIST if _is_planar(scene) else tuple(range(6))


def has_grasp(scene: Scene) -> bool:
    """Tell whether the target has a grasp frame apart from its body's."""
    return scene.target.grasp != Pose() or has_grasp_spread(scene)


def body_numbers(scene: Scene, place: str) -> Iterator[Number]:
    """Mass, center of mass and inertia of the body at a place: "base", "links.0", "payload"."""
    planar, body = _is_planar(scene), _body(scene, place)
    yield _number(f"{place}.mass", "kg", body.mass)
    center = () if isinstance(body, Base) else body.center_of_mass
    for index, value in enumerate(center[:2] if planar else center):
        yield _number(center_name(place, index), "m", value, f"{place}.center_of_mass.{index}")
    for i, j in ((2, 2),) if planar else _LOWER_TRIANGLE:
        paths = tuple(dict.fromkeys((f"{place}.inertia.{i}.{j}", f"{place}.inertia.{j}.{i}")))
        yield Number(inertia_name(place, i, j), "kg m^2", body.inertia[i][j], () if planar else paths)


def center_name(place: str, index: int) -> str:
    """Name of a coordinate of a body's center of mass."""
    return f"{place}.center_of_mass.{_AXES[index]}"


def inertia_name(place: str, row: int, column: int) -> str:
    """Name of an entry of a body's inertia, a symmetric matrix."""
    return f"{place}.inertia.{_AXES[min(row, column)]}{_AXES[max(row, column)]}"


def inertia_paths(scene: Scene, place: str) -> Iterator[tuple[str, float]]:
    """Paths and values of all entries of a body's inertia."""
    for i, row in enumerate(_body(scene, place).inertia):
        yield from ((f"{place}.inertia.{i}.{j}", entry) for j, entry in enumerate(row))


def _body(scene: Scene, place: str) -> Base | Link | Payload:
    kind, _, index = place.partition(".")
    body: Base | Link | Payload = scene.links[int(index)] if index else getattr(scene, kind)
    return body


def drawn_factors(scene: Scene) -> Iterator[tuple[float, list[Number]]]:
    """Half-widths of the factors that the spread draws for bodies, in order, each with what it scales."""
    spread = scene.spread
    links = [f"links.{index}" for index in range(len(scene.links))]
    for width, quantity, places in (
        (spread.base_mass, "mass", ["base"]),
        (spread.base_inertia, "inertia", ["base"]),
        (spread.link_masses, "mass", links),
        (spread.link_inertias, "inertia", links),
        (spread.payload_mass, "mass", ["payload"]),
        (spread.payload_inertia, "inertia", ["payload"]),
    ):
        for place in places if width else ():
            found = (each for each in body_numbers(scene, place) if is_part(each.name, f"{place}.{quantity}"))
            yield width, [number for number in found if number.nominal]


def observed_masses(scene: Scene) -> list[Number]:
    """Masses and inertias whose relative changes are observed; inertias by their first entries."""
    return [group[0] for _, group in drawn_factors(scene) if group] if scene.spread.observed else []


def has_target_spread(scene: Scene) -> bool:
    """Tell whether the target is drawn for each episode."""
    return bool(scene.spread.target_rotation or scene.spread.target_position)


def has_velocity_spread(scene: Scene) -> bool:
    """Tell whether the velocity of the target is drawn for each episode."""
    return bool(scene.spread.target_angular_velocity or scene.spread.target_linear_velocity)


def has_grasp_spread(scene: Scene) -> bool:
    """Tell whether the grasp frame is drawn for each episode."""
    return bool(scene.spread.grasp_rotation or scene.spread.grasp_position)


def _drawn(scene: Scene) -> set[str]:
    """Names of what the spread draws; of the target all of it, even if only its position is drawn."""
    target = target_numbers(scene) if has_target_spread(scene) else ()
    grasp = grasp_numbers(scene) if has_grasp_spread(scene) else ()
    scaled = (number for _, group in drawn_factors(scene) for number in group)
    return {number.name for number in (*target, *grasp, *scaled)}


def control_numbers(scene: Scene) -> dict[str, list[ControlNumbers]]:
    """The controls by actuator, in order; an absent one, or one without joints, has none."""
    planar = _is_planar(scene)
    found = {
        "base_force": _axis_controls(scene, "base_force", (0, 1) if planar else range(3)),
        "base_torque": _axis_controls(scene, "base_torque", (2,) if planar else range(3)),
        "joint_torque": _joint_controls(scene),
        "wrist_rate": _axis_controls(scene, "wrist_rate", range(3)),
        "wheel_torque": _one_by_one(scene, "wheel_torque", "wheels", "torque", wheel_names(scene)),
        "thruster_force": _one_by_one(scene, "thruster_force", "thrusters", "force", thruster_names(scene)),
    }
    return {field: [*controls] for field, controls in found.items()}


def _axis_controls(scene: Scene, field: str, axes: Sequence[int]) -> Iterator[ControlNumbers]:
    actuator, weights = getattr(scene.actuators, field), getattr(scene.cost, field)
    limit, weight = f"actuators.{field}.limit", f"cost.{field}"
    of_wrist = field == "wrist_rate"
    for axis in axes if actuator is not None else ():
        entry = (_EULER_ANGLES if of_wrist else _AXES)[axis]
        yield ControlNumbers(
            f"wrist {entry} rate" if of_wrist else f"{field.replace('_', ' ')} {entry}",
            _number(f"{limit}.{entry}", CONTROL_UNITS[field], actuator.limit[axis], f"{limit}.{axis}"),
            _number(f"{weight}.{entry}", _per_square(field), weights[axis], f"{weight}.{axis}"),
        )


def _joint_controls(scene: Scene) -> Iterator[ControlNumbers]:
    motors = scene.actuators.joint_torque
    for index, axis in freedoms(scene.links):
        link = scene.links[index]
        if motors is None or not link.actuated:
            continue
        weight = _number("cost.joint_torque", f"({link.effort_unit})^-2", scene.cost.joint_torque)
        limit = _number("actuators.joint_torque.limit", link.effort_unit, motors.limit)
        if link.torque_limit is not None:
            limit = _number(f"links.{index}.torque_limit", link.effort_unit, link.torque_limit)
        if link.torque_weight is not None:
            weight = _number(f"links.{index}.torque_weight", f"({link.effort_unit})^-2", link.torque_weight)
        yield ControlNumbers(f"{link.name} {'torque' if link.turns else 'force'}{axis}", limit, weight)


def _one_by_one(
    scene: Scene, field: str, part: str, limit: str, names: Sequence[str]
) -> Iterator[ControlNumbers]:
    """Controls of wheels or of thrusters, each with a limit of its own."""
    weight = _number(f"cost.{field}", _per_square(field), getattr(scene.cost, field))
    for index, name in enumerate(names):
        largest = getattr(getattr(scene.actuators, part)[index], limit)
        number = _number(f"actuators.{part}.{index}.{limit}", CONTROL_UNITS[field], largest)
        yield ControlNumbers(f"{name} {limit}", number, weight)


def thruster_names(scene: Scene) -> list[str]:
    """Names of the thrusters, in their order."""
    thrusters = scene.actuators.thrusters or ()
    return [each.name or f"thruster {index + 1}" for index, each in enumerate(thrusters)]


def wheel_names(scene: Scene) -> list[str]:
    """Names of the wheels, in their order."""
    return [f"wheel {index + 1}" for index in range(len(scene.actuators.wheels or ()))]


def _per_square(field: str) -> str:
    return f"({CONTROL_UNITS[field]})^-2"


def _is_planar(scene: Scene) -> bool:
    return bool(scene.base.motion == "planar")
