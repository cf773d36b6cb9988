"""What no scene can be made of, or written as URDF, is refused with a sentence that names it."""

import math
from time import process_time
from xml.etree import ElementTree

import numpy as np
import pytest
from foreign_robots import accelerations, drawn, relative_error

from dq_space_arm_env import SceneError, load_scene, scene_from_urdf, scene_to_urdf
from dq_space_arm_env.algebra import rotations
from dq_space_arm_env.scene import StateLayout

INERTIA = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
BODY = f'<inertial><mass value="2"/>{INERTIA}</inertial>'


def link(name, content=BODY):
    return f'<link name="{name}">{content}</link>'


def joint(name, parent, child, kind="revolute", content='<limit effort="1" velocity="1"/>'):
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{content}</joint>'


def robot(*parts):
    return f'<robot name="r">{"".join(parts)}</robot>'


def arm(kind="revolute", content=""):
    return robot(link("base"), joint("j1", "base", "arm", kind, content), link("arm"))


def body(mass="2", **moments):
    """A link's <inertial> with other principal moments."""
    text = BODY.replace('"2"', f'"{mass}"')
    for name, value in moments.items():
        text = text.replace(f'{name}="1"', f'{name}="{value}"')
    return text


BASE, ARM, B = link("base"), link("arm"), link("b")
GOOD = (BASE, joint("j1", "base", "arm"), ARM)
BAD = link("b", body(ixx=-1))
MIMIC = '<mimic joint="j1"/>'
FINGERS = (
    *(joint("j2", "arm", "l"), link("l")),
    *(joint("j3", "arm", "r", content='<mimic joint="j2"/>'), link("r")),
    *(joint("j4", "arm", "p", "planar"), link("p")),
)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("<robot><link></robot>", "not valid XML: mismatched tag: line 1, column 15"),
        ("<sdf/>", "the outermost element is <sdf>, it must be <robot>"),
        ('<!DOCTYPE robot [<!ENTITY a "b">]><robot/>', "remove the document type declaration"),
        (robot("<xacro:macro/>"), "<xacro:macro> belongs to xacro, .* expand the file first"),
        (robot("<link/>"), "a <link>: the attribute 'name' is missing"),
        (robot(link("a"), link("a")), "two links are named 'a'"),
        (robot(link("a", "<inertial/>")), "link 'a', <inertial>: <mass> is missing"),
        (robot(link("a", body("-1"))), "link 'a', <inertial>: mass = -1 kg, it must be 0 or greater"),
        (robot(BASE, joint("j1", "base", "arm"), link("arm", body("0"))), "moved by joint 'j1', has no mass"),
        (robot(link("a", body("heavy"))), "<inertial>, <mass>: value = 'heavy', it must be a finite number"),
        (
            robot(*GOOD, joint("j2", "arm", "b", "hinge"), B),
            "type = 'hinge', it must be one of .*, fixed, or .* no mass",
        ),
        (arm(content='<axis xyz="0 0 0"/>'), "joint 'j1': the axis has zero length"),
        (arm(content='<origin xyz="0 0"/>'), "'j1', <origin>: xyz = '0 0', it must be 3 finite numbers"),
        (
            arm(content='<origin rpy="0 0 0" quat_xyzw="0 0 0 1"/>'),
            "'j1', <origin>: rpy and quat_xyzw both say",
        ),
        (arm(content='<origin quat_xyzw="0 0 0 2"/>'), "quat_xyzw = '0 0 0 2', it must be a unit quaternion"),
        (arm(content='<dynamics damping="-1"/>'), "joint 'j1': damping = -1, it must be 0 or greater"),
        (arm(content='<limit lower="1" upper="0"/>'), "'j1': lower = 1 rad is greater than upper = 0 rad"),
        (robot(*GOOD, joint("j2", "arm", "bb"), B), "its child link 'bb' does not exist; did you"),
        (robot(*GOOD, B, joint("j2", "base", "b"), joint("j3", "arm", "b")), "on two joints, 'j2' and 'j3'"),
        (robot(*GOOD, B), "exactly one link must be no joint's child, the root; there are several: base, b"),
        (robot(*GOOD, B, link("c"), joint("j2", "b", "c"), joint("j3", "c", "b")), "j.' is part of a loop"),
        (
            arm("planar"),
            "joint 'j1' on the way to link 'arm' is planar; a scene has revolute, continuous, pris",
        ),
        (
            robot(BASE, joint("j1", "base", "b"), B, joint("j2", "b", "arm", content=MIMIC), ARM),
            "joint 'j2' on the way to link 'arm' mimics joint 'j1'.*: choose a tip before it, as link 'b'$",
        ),
        (arm("fixed"), "no joint moves link 'arm'"),
        (robot(link("base", ""), *GOOD[1:]), "base link 'base' has no mass, .* give the spacecraft"),
        (robot(*GOOD[:2], link("arm", "")), "link 'arm', moved by joint 'j1', has no mass"),
        (arm(content=""), "no effort limit for joint j1: give joint_torque"),
        (
            robot(*GOOD, joint("j2", "base", "b", "planar"), B),
            r"beside the way .*, joint 'j2' is planar; .* lock_branches=\['j2'\] holds such joints, lock",
        ),
        (
            robot(*GOOD, joint("j2", "base", "b", content=MIMIC), B),
            "joint 'j2' mimics joint 'j1' of the chain",
        ),
        (
            arm(content='<limit effort="50000"/>'),
            r"URDF: effort 50000 of joint j1 is a placeholder \(1e4 and more\): give joint_torque",
        ),
        (arm(content='<limit effort="1.79769e+308"/>'), r"effort 1.79769e\+308 of joint j1 is a placeholder"),
        (
            robot(*GOOD, *FINGERS, joint("j5", "base", "c", content=""), link("c")),
            r"joint 'j3' mimics joint 'j2', joint 'j4' is planar; .* lock_branches=\['j3', 'j4', 'j2'\] "
            ".* no effort limit for joint j5: give joint_torque",
        ),
        (robot(*GOOD[:2], link("arm", body(izz=3))), "moments 1, 1, 3 .* the two smaller must add up"),
        (robot(*GOOD[:2], link("arm", body(izz=0))), "principal moments .*, all must be greater than 0"),
        (
            robot(*GOOD[:2], link("arm", body(izz=9)), joint("f", "arm", "b", "fixed"), BAD),
            "with b fixed to it, <inertia>: .*; link 'arm', <inertia>: .*; link 'b', <inertia>: .* -1, 1, 1",
        ),
        (robot(), "there is no <link> in <robot>"),
        (robot(joint("j1", "a", "arm"), B), "its parent link 'a' does not exist; the links are b"),
        (robot(link("arm"), joint("j1", "arm", "arm")), "joint 'j1' connects link 'arm' with itself"),
        (robot(joint("a", "arm", "b"), joint("b", "b", "arm"), link("arm"), B), "joints form a loop: a, b"),
        (
            robot(BASE, joint("j1", "base", "b", "floating"), B, joint("j2", "b", "arm"), ARM),
            "joint 'j1' on the way to link 'arm' is floating; .*: choose link 'b' as base$",
        ),
        (arm("floating"), "joint 'j1' on the way to link 'arm' is floating; .* fixed joints only$"),
        (robot(*GOOD[:2], link("arm", BODY + BODY)), "link 'arm': there are 2 <inertial>"),
        ("", "the text '' must begin with '<', or be the path of a file"),
        (b"<robot/>", "neither the path nor the text of a URDF file"),
        ("nul\0", "cannot be read: embedded null byte"),
    ],
)
def test_what_no_scene_can_be_made_of_is_refused(text, sentence):
    with pytest.raises(SceneError, match=sentence):
        scene_from_urdf(text, "arm")


def test_masses_of_lumped_bodies_have_no_residue_of_rounding():
    joints = [joint(name, "arm", name, "fixed") + link(name, body("0.7")) for name in ("b", "c")]
    text = robot(*GOOD[:2], link("arm", body("0.7")), *joints)
    assert 0.7 + 0.7 + 0.7 != 2.1
    assert scene_from_urdf(text, "arm").links[0].mass == 2.1


def test_fixed_joints_are_none_to_lock():
    text = robot(*GOOD, joint("f", "arm", "b", "fixed"), B, joint("g", "b", "c"), link("c"))
    for name in ("f", "j1"):
        with pytest.raises(SceneError, match=f"'{name}' is not a movable joint beside the .*; these are g$"):
            scene_from_urdf(text, "b", lock_branches=[name])
    assert len(scene_from_urdf(text, "b", lock_branches=["g"]).links) == 1
    follower = joint("g", "b", "c", content='<limit effort="1"/><mimic joint="f"/>')
    text = robot(*GOOD, joint("f", "arm", "b", "fixed"), B, follower, link("c"))
    with pytest.raises(SceneError, match=r"'g' mimics joint 'f'; .* lock_branches=\['g'\] holds such"):
        scene_from_urdf(text, "b")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"tip": "amr"}, "tip: 'amr' is not a link of 'r'; did you mean 'arm'\\? its links are base, arm"),
        ({"tip": "arm", "base": "bus"}, "base: 'bus' is not a link of 'r'"),
        ({"tip": ["arm"]}, r"tip: \['arm'\] is not a link of 'r'; did you mean 'arm'"),
        ({"tip": "base", "base": "arm"}, "joint 'j1' carries the base and not the tip; choose link 'base'"),
        ({"tip": "j1"}, "'j1' is not a link of 'r'; it is a joint, which carries link 'arm'; its links are"),
        ({"tip": "base"}, "tip: link 'base' is the base: choose a link that the joints move"),
        ({"tip": "arm", "passive": ["j2"]}, "'j2' is not a joint that moves a mass; these are j1"),
        (
            {"tip": "arm", "lock_branches": ["j1"]},
            "lock_branches: 'j1' is not a movable joint beside the way from base to tip; there is none$",
        ),
        ({"tip": "arm", "lock_branches": [1]}, "lock_branches: 1 is not a movable joint beside the way"),
        ({"tip": "arm", "lock_branches": 1}, "lock_branches = 1: must be a list of names of joints, or True"),
        ({"tip": "arm", "passive": None}, "passive = None: must be a list of names of joints"),
        ({"tip": "arm", "joint_torque": True}, "joint_torque = True: must be a number greater than 0, N m"),
        ({"tip": "arm", "lock_branches": "j1"}, "lock_branches = 'j1': must be a list of names of joints"),
        ({"tip": "arm", "joint_torque": -1}, "joint_torque = -1: must be a number greater than 0, N m"),
        ({"tip": "arm", "spacecraft": 80}, "spacecraft = 80: must be a mapping"),
        (
            {"tip": "arm", "spacecraft": {"mass": -1, "inertia": [1, 1, 1]}},
            "spacecraft:\n  - mass = -1: .* \\(mass of the spacecraft, kg\\)",
        ),
        ({"tip": "arm", "base_force": -1}, "actuators.base_force.limit = -1: must be"),
    ],
)
def test_wrong_arguments_are_refused(arguments, sentence):
    with pytest.raises(SceneError, match=sentence):
        scene_from_urdf(robot(*GOOD), **arguments)


def test_a_moving_link_called_as_the_spacecraft_is_refused():
    parts = link("bus"), joint("j1", "bus", "base"), BASE, joint("j2", "base", "arm"), ARM
    for tip in ("base", "arm"):
        with pytest.raises(SceneError, match=r"link 'base', which a joint moves, .* rename it"):
            scene_from_urdf(robot(*parts), tip)


@pytest.mark.parametrize(
    ("lower", "upper", "follows", "held"),
    [
        (-1.0, 1.0, "", (0.0, 0.0)),
        (0.3, 1.0, "", (0.3, 0.0)),
        (-1.0, -0.2, 'joint="s" multiplier="-2" offset="0.5"', (-0.2, 0.9)),
    ],
)
def test_locked_joints_are_held_where_they_can_be(lower, upper, follows, held):
    """At zero or the nearest limit, and followers where those put them; as arms whose links are there."""
    aside = BODY.replace("<mass", '<origin xyz="1 0 0"/><mass')

    def hand(kinds, slide, turn):
        joints = joint("s", "arm", "l", kinds[0], slide), joint("t", "arm", "r", kinds[1], turn)
        return robot(*GOOD, *joints, link("l"), link("r", aside))

    slide = f'<axis xyz="0 1 0"/><limit lower="{lower}" upper="{upper}"/>'
    turn = f'<axis xyz="0 0 -1"/>{follows and f"<mimic {follows}/>"}'
    moving = hand(("prismatic", "continuous"), slide, turn)
    there = f'<origin xyz="0 {held[0]} 0"/>', f'<origin rpy="0 0 {-held[1]}"/>'
    standing = hand(("fixed", "fixed"), *there)
    found, expected = (
        scene_from_urdf(text, "arm", lock_branches=True).links[0] for text in (moving, standing)
    )
    assert found.center_of_mass == pytest.approx(expected.center_of_mass, abs=1e-14)
    np.testing.assert_allclose(found.inertia, expected.inertia, atol=1e-13)


def test_what_a_fixed_joint_would_mimic_moves_nothing():
    aside = BODY.replace("<mass", '<origin xyz="1 0 0"/><mass')
    follows = '<mimic joint="j1" multiplier="-1" offset="1.57"/>'
    plain, told = (
        scene_from_urdf(robot(*GOOD, joint("s", "arm", "l", "fixed", each), link("l", aside)), "arm").links[0]
        for each in ("", follows)
    )
    assert told == plain


@pytest.mark.parametrize("number", ["1_5", "٣", "0x1", "1,5"])
def test_numbers_are_those_of_xml(number):
    with pytest.raises(
        SceneError, match=r"link 'arm', <inertial>, <mass>: value = .*, it must be a finite number"
    ):
        scene_from_urdf(robot(*GOOD[:2], link("arm", body(number))), "arm")


def test_either_joint_of_a_gripper_that_is_locked_alone_brings_up_both():
    text = robot(*GOOD, *FINGERS[:4])
    for name in ("j2", "j3"):
        with pytest.raises(SceneError, match=r"'j3' mimics joint 'j2'; .* lock_branches=\['j3', 'j2'\] "):
            scene_from_urdf(text, "arm", lock_branches=[name])
    assert len(scene_from_urdf(text, "arm", lock_branches=["j3", "j2"]).links) == 1


def test_a_locked_joint_must_not_follow_the_chain():
    follower = joint("j2", "base", "panel", content=MIMIC)
    with pytest.raises(SceneError, match="joint 'j2' mimics joint 'j1' of the chain"):
        scene_from_urdf(robot(*GOOD, follower, link("panel")), "arm", lock_branches=True)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [(b"", "is empty"), (b" \n", "is empty"), (bytes(90), "is not XML"), (b"\x89<\xff", "not valid XML")],
)
def test_files_that_are_no_text_are_refused(content, sentence, tmp_path):
    file = tmp_path / "robot.urdf"
    file.write_bytes(content)
    with pytest.raises(SceneError, match=sentence):
        scene_from_urdf(file, "arm")
    with pytest.raises(SceneError, match=r"nowhere\.urdf: there is no such file"):
        scene_from_urdf("nowhere.urdf", "arm")
    with pytest.raises(SceneError, match="is a folder"):
        scene_from_urdf(tmp_path, "arm")


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
def test_a_file_in_the_encoding_that_it_declares(encoding, tmp_path):
    declared = encoding.removesuffix("-sig")
    text = f'<?xml version="1.0" encoding="{declared}"?>' + robot(*GOOD).replace('"arm"', '"ärm"')
    file = tmp_path / "robot.urdf"
    file.write_bytes(text.encode(encoding))
    assert scene_from_urdf(file, "ärm").links[0].name == "ärm"
    assert scene_from_urdf("\ufeff" + text, "ärm").links[0].name == "ärm"


def test_an_inertia_that_a_neighbor_hides_comes_with_a_warning():
    hand = (joint("f", "arm", "hand", "fixed"), link("hand", body(izz=3)))
    text = robot(*GOOD, *hand, joint("g", "arm", "big", "fixed"), link("big"))
    with pytest.warns(UserWarning, match="link 'hand', <inertia>: .* moments 1, 1, 3 .* used as it is"):
        assert scene_from_urdf(text, "hand").links[0].mass == 6.0


@pytest.mark.parametrize("length", [1e-300, 1e200])
def test_the_length_of_an_axis_does_not_matter(length):
    text = robot(*GOOD).replace("<limit", f'<axis xyz="{length} {length} 0"/><limit')
    unit = robot(*GOOD).replace("<limit", '<axis xyz="1 1 0"/><limit')
    assert scene_from_urdf(text, "arm") == scene_from_urdf(unit, "arm")


def test_origins_may_be_turned_by_quaternions():
    """As URDF 1.1 has it, scalar last; few digits are enough."""
    angles = '<origin xyz="1 2 3" rpy="0.3 -0.4 0.5"/>'
    w, *vector = rotations.from_euler_321(0.5, -0.4, 0.3)
    turned = angles.replace('rpy="0.3 -0.4 0.5"', f'quat_xyzw="{" ".join(f"{n:.6f}" for n in (*vector, w))}"')
    poses = [
        np.array(scene_from_urdf(arm(content=f'{origin}<limit effort="1"/>'), "arm").links[0].joint.rotation)
        for origin in (angles, turned)
    ]
    np.testing.assert_allclose(*poses, rtol=0, atol=1e-5)


def test_a_long_file_is_read_in_a_moment():
    """Links and joints are looked at once, not once for each other."""
    parts = [link("link 0"), link("arm")]
    for i in range(3000):
        parts += [joint(f"j{i}", f"link {i}", f"link {i + 1}", "fixed"), link(f"link {i + 1}", "")]
    began = process_time()
    scene_from_urdf(robot(*parts, joint("last", "link 3000", "arm")), "arm")
    assert process_time() - began < 10.0


def test_an_inertia_that_violates_the_triangle_inequality_is_mended_if_asked():
    text = robot(BASE, joint("j1", "base", "arm"), link("arm", body(ixx=0.2, izz=1.4)))
    with pytest.raises(SceneError, match=r"balance_inertias=True raises the smallest to 0.4 kg m"):
        scene_from_urdf(text, "arm")
    with pytest.warns(UserWarning, match="link 'arm', <inertia>: .* the smallest was raised to 0.4 kg m"):
        (part,) = scene_from_urdf(text, "arm", balance_inertias=True).links
    np.testing.assert_allclose(np.linalg.eigvalsh(part.inertia), [0.4, 1.0, 1.4], rtol=1e-12)
    with pytest.raises(SceneError, match=r"all must be greater than 0$"):
        scene_from_urdf(text.replace('ixx="0.2"', 'ixx="-0.2"'), "arm", balance_inertias=True)


def test_a_base_link_without_mass_is_a_frame_whatever_its_inertia():
    """Simulators that hold the base write it so."""
    text = robot(link("base", body("0")), *GOOD[1:])
    with pytest.warns(UserWarning, match="link 'base': its mass is 0: its inertia is left out"):
        scene = scene_from_urdf(text, "arm", spacecraft={"mass": 50, "inertia": [5, 6, 7]})
    assert scene.base.mass == 50.0
    assert np.diag(scene.base.inertia).tolist() == [5.0, 6.0, 7.0]


def test_the_arm_is_mounted_on_the_spacecraft():
    """As if the file had the spacecraft as its base link, with the mount as a fixed joint."""
    inertia = '<inertia ixx="5" ixy="0.1" ixz="0.2" iyy="6" iyz="0.3" izz="7"/>'
    bus = link("bus", f'<inertial><mass value="50"/>{inertia}</inertial>')
    origin = '<origin xyz="0.1 0.2 0.5" rpy="0 0 0.3"/>'
    expected = scene_from_urdf(robot(bus, joint("m", "bus", "base", "fixed", origin), *GOOD), "arm", "bus")
    half = 0.15  # of the yaw
    mount = {"position": [0.1, 0.2, 0.5], "rotation": [math.cos(half), 0, 0, math.sin(half)]}
    tensor = [[5, 0.1, 0.2], [0.1, 6, 0.3], [0.2, 0.3, 7]]
    found = scene_from_urdf(robot(*GOOD), "arm", spacecraft={"mass": 50, "inertia": tensor, "mount": mount})
    x, u = drawn(expected, np.random.default_rng(0))
    assert relative_error(accelerations(found, x, u), accelerations(expected, x, u)) < 1e-14
    np.testing.assert_allclose(
        found.links[0].joint.position, expected.links[0].joint.position, rtol=0, atol=1e-15
    )
    np.testing.assert_allclose(found.target.pose.position, expected.target.pose.position, rtol=0, atol=1e-15)


def test_limits_are_scaled_for_free_flight_and_never_raised():
    """Three times omega^2 I: 1.47 N m of an inertia of 1 kg m^2."""
    strong = robot(*GOOD).replace('effort="1"', 'effort="87"')
    assert scene_from_urdf(strong, "arm").links[0].torque_limit == 87.0
    scene = scene_from_urdf(strong, "arm", scaled_efforts=True)
    assert scene.links[0].torque_limit == scene.actuators.joint_torque.limit == 1.5
    assert scene_from_urdf(robot(*GOOD), "arm", scaled_efforts=True).links[0].torque_limit == 1.0
    unknown = robot(*GOOD).replace('effort="1"', 'effort="0"')
    assert scene_from_urdf(unknown, "arm", scaled_efforts=True).links == scene.links
    asked = scene_from_urdf(unknown, "arm", joint_torque=40, scaled_efforts=True)
    assert asked.links[0].torque_limit == 40.0
    damped = strong.replace("<limit", '<dynamics damping="30"/><limit')
    assert scene_from_urdf(damped, "arm", scaled_efforts=True).links[0].torque_limit == 63.0
    undamped = scene_from_urdf(damped, "arm", dampers=False, scaled_efforts=True)
    assert undamped.links == scene.links


def test_every_joint_has_a_weight_in_its_own_unit():
    """A slide's is per N^2, of the mass that it moves: a / (omega^2 m)^2 with a = w / 4."""
    slide = joint("j2", "arm", "hand", "prismatic", '<axis xyz="1 0 0"/><limit effort="1"/>')
    scene = scene_from_urdf(robot(*GOOD, slide, link("hand")), "hand")
    layout = StateLayout.of(scene)
    assert layout.control.units[layout.control.joint_torque] == ("N m", "N")
    turning, sliding = layout.control_weight[layout.control.joint_torque]
    assert sliding == pytest.approx(15 / 4 / (0.7**2 * 2.0) ** 2, rel=0.03)
    assert turning == pytest.approx(15 / 4 / (0.7**2 * 2.0) ** 2, rel=0.03)  # of two bodies of 1 kg m^2


def test_the_weight_of_the_torques_makes_arms_of_any_size_move_alike():
    """a / b = omega^2 (I^2 omega^2 + c^2) of an inertia I with the damping c, a = w (1 + d^2) / 4."""
    fixed = joint("f", "arm", "hand", "fixed", '<origin xyz="0 2 0"/>')
    text = robot(*GOOD, link("hand", ""), fixed)
    heavy = text.replace('ixx="1"', 'ixx="100"').replace('iyy="1"', 'iyy="100"')
    damped = text.replace("<limit", '<dynamics damping="3"/><limit')
    for urdf, inertia, damping in ((text, 1.0, 0.0), (heavy, 100.0, 0.0), (damped, 1.0, 3.0)):
        weight = scene_from_urdf(urdf, "hand").links[0].torque_weight
        ratio = 0.7**2 * (inertia**2 * 0.7**2 + damping**2)
        assert 15 * (1 + 2**2) / (4 * weight) == pytest.approx(ratio, rel=0.03)


def test_a_straight_arm_begins_bent_within_its_limits():
    ahead = '<origin xyz="0 1 0"/><limit effort="1" lower="-3" upper="{}"/>'
    names = ["base", "one", "two", "three", "hand"]
    kinds = [("continuous", "0"), ("revolute", "0.2"), ("revolute", "3"), ("fixed", "0")]
    joints = [
        joint(f"j{i}", names[i], names[i + 1], kind, ahead.format(upper))
        for i, (kind, upper) in enumerate(kinds)
    ]
    scene = scene_from_urdf(robot(*map(link, names), *joints), "hand")
    assert scene.initial_state.joint_angles == (0.5, -0.5, 0.5)
    narrow = robot(*map(link, names), *joints).replace('lower="-3" upper="3"', 'lower="-0.6" upper="0.5"')
    assert scene_from_urdf(narrow, "hand").initial_state.joint_angles == (0.5, -0.5, -0.4)  # off its stops
    two = scene_from_urdf(robot(*map(link, names[:3]), *joints[:2]), "two")
    assert two.initial_state.joint_angles == (0.0, 0.0)  # each moves the tip in its own way


def test_digits_stay_as_they_were_given():
    text = robot(*GOOD).replace("<limit", '<origin xyz="0.1 0 0.7"/><axis xyz="0 1 0"/><limit')
    (part,) = scene_from_urdf(text.replace('iyy="1"', 'iyy="1.1"'), "arm").links
    assert part.joint.position == (0.1, 0.0, 0.7)
    assert part.inertia == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.1))


@pytest.mark.parametrize("tiny", ["1e-292", "-1e-300", "5e-324"])
def test_numbers_next_to_zero_are_numbers(tiny):
    text = robot(*GOOD).replace("<limit", f'<origin xyz="0 0 {tiny}"/><limit')
    (part,) = scene_from_urdf(text, "arm").links
    assert part.joint.position == pytest.approx((0.0, 0.0, 0.0), abs=1e-290)


def test_friction_is_left_out_with_a_warning():
    text = robot(*GOOD).replace("<limit", '<dynamics friction="0.1"/><limit')
    with pytest.warns(UserWarning, match="Coulomb friction of j1 is left out"):
        assert scene_from_urdf(text, "arm").links[0].damping == 0.0


def test_what_drives_the_arm_is_an_option():
    text = robot(*GOOD, joint("j2", "arm", "hand", content=""), link("hand"))
    scene = scene_from_urdf(text, "hand", base_force=None, base_torque=[1, 2, 3], joint_torque=np.int64(4))
    layout = StateLayout.of(scene)
    assert layout.control.names[:3] == ("base torque x", "base torque y", "base torque z")
    assert layout.control_limit.tolist() == [1.0, 2.0, 3.0, 1.0, 4.0]
    scene = scene_from_urdf(text, "hand", passive=["j2"], name="mine", target={"position": [1, 2, 3]})
    assert StateLayout.of(scene).actuated_joints == (0,)
    assert scene.name == "mine"
    assert scene.target.pose.position == (1.0, 2.0, 3.0)


def test_a_scene_comes_back_from_its_urdf():
    """Everything that URDF can hold: bodies, joints, tip, dampers, limits, motors and their absence."""
    scene = load_scene("payload")
    links = [{**part.model_dump(), "damping": 0.5, "actuated": i != 1} for i, part in enumerate(scene.links)]
    scene = scene.replace(links=links)
    again = scene_from_urdf(scene_to_urdf(scene), "tip", passive=["link 2 joint"])
    rng = np.random.default_rng(0)
    x, u = drawn(scene, rng)
    assert relative_error(accelerations(again, x, u), accelerations(scene, x, u)) < 1e-13
    expected, found = StateLayout.of(scene), StateLayout.of(again)
    np.testing.assert_array_equal(found.control_limit, expected.control_limit)
    assert found.state.names == expected.state.names
    assert again.tip.position == pytest.approx(scene.tip.position, abs=1e-15)


def test_a_slide_comes_back_from_its_urdf():
    scene = load_scene("sliding")
    with pytest.raises(SceneError, match="it has no screw joints, and link 'drive' has one"):
        scene_to_urdf(scene)
    upper = [math.inf, math.inf, 0.9, 0.5]
    limits = {"name": "joint limits", "kind": "joint_limits", "upper": upper}
    turned = {"links.3.joint_type": "revolute", "links.3.pitch": 0.0, "links.2.damping": 0.5}
    scene = scene.replace(turned, constraints=[limits])
    again = scene_from_urdf(scene_to_urdf(scene), "tip", base_force=10, base_torque=5)
    x, u = drawn(scene, np.random.default_rng(0))
    assert relative_error(accelerations(again, x, u), accelerations(scene, x, u)) < 1e-13
    expected, found = StateLayout.of(scene), StateLayout.of(again)
    np.testing.assert_array_equal(found.control_limit, expected.control_limit)
    assert (found.state.units, found.control.units) == (expected.state.units, expected.control.units)
    assert again.constraints == scene.constraints


def test_a_fixed_wrist_changes_no_acceleration():
    scene = load_scene("paper")
    again = scene_from_urdf(scene_to_urdf(scene, wrist="fixed"), "tip")
    rng, layout = np.random.default_rng(0), StateLayout.of(scene)
    x, u = drawn(scene, rng)
    without = np.delete(x, range(layout.n_x)[layout.state.wrist_angles])
    found = accelerations(again, without, u[:9])
    assert relative_error(found, accelerations(scene, x, u)) < 1e-13


def test_other_tips_keep_their_payloads():
    held = {"mass": 30.0, "inertia": [1.0, 2.0, 2.5], "center_of_mass": [0.1, 0.0, 0.2]}
    scene = load_scene("dual-arm").replace({"other_tips.0.payload": held})
    robot = ElementTree.fromstring(scene_to_urdf(scene))
    name, link = scene.other_tips[0].name, scene.other_tips[0].link
    (joint,) = (each for each in robot.findall("joint") if each.find("child").get("link") == name)
    assert joint.find("parent").get("link") == link
    (body,) = (each for each in robot.findall("link") if each.get("name") == name)
    assert float(body.find("inertial/mass").get("value")) == 30.0


def test_names_of_our_own_make_way():
    scene = load_scene("no-wrist")
    names = ("bus", "tip", "tip_")
    scene = scene.replace(
        links=[{**part.model_dump(), "name": name} for part, name in zip(scene.links, names, strict=True)]
    )
    again = scene_from_urdf(scene_to_urdf(scene), "tip__")
    assert [part.name for part in again.links] == list(names)


@pytest.mark.parametrize(
    ("name", "change", "sentence"),
    [
        ("paper", {}, "the wrist has joints without mass"),
        ("tip-load", {}, "no constant wrench at the tip"),
        ("planar", {}, "no base that moves in a plane"),
        ("release", {}, "its robot stays as it is, and phases change payload.mass"),
        ("no-wrist", {"stiffness": 1.0}, "no joint springs, and link 'link 1' has one"),
    ],
)
def test_what_urdf_cannot_hold_is_refused(name, change, sentence):
    scene = load_scene(name)
    scene = scene.replace(links=[{**part.model_dump(), **change} for part in scene.links])
    with pytest.raises(SceneError, match=f"cannot be written as URDF:(?s:.*){sentence}"):
        scene_to_urdf(scene)
