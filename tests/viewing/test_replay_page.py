"""The page as a file: self-contained, small, escaped, and with scripts that a JavaScript engine accepts."""

import json
import re
import subprocess
from base64 import b64decode
from dataclasses import replace
from importlib.resources import files
from shutil import which

import numpy as np
import pytest

from dq_space_arm_env import list_scenes, load_scene
from dq_space_arm_env.algebra import dual_quaternion, poses, screw
from dq_space_arm_env.viewing.replay import replay_page, write_replay
from dq_space_arm_env.viewing.replay.flights import prepare
from dq_space_arm_env.viewing.replay.geometry import view_of
from dq_space_arm_env.viewing.replay.page import SCRIPTS, bundle

BROWSER = files("dq_space_arm_env.viewing.replay").joinpath("browser")
DATA = re.compile(r'<script type="application/json" class="replay-data"[^>]*>(.*?)</script>', re.DOTALL)


def data_of(page):
    return json.loads(DATA.search(page)[1])


@pytest.mark.sampled
@pytest.mark.parametrize("name", list_scenes())
def test_every_scene_has_a_page_without_a_reference_to_anything(name, make_flight):
    scene = load_scene(name)
    page = replay_page([make_flight(scene)], scene)
    outside_the_data = DATA.sub("", page)
    assert not re.search(r"(src|href)=(?!\"data:,\")", outside_the_data)
    asks = r"url\(|@import|fetch\(|XMLHttpRequest|WebSocket|\bimport\b.*\bfrom\b"
    assert not re.search(asks, outside_the_data)
    assert set(re.findall(r"https?://[^\"']+", outside_the_data)) == {"http://www.w3.org/2000/svg"}
    assert "default-src 'none'" in page
    assert "{{" not in outside_the_data


def test_two_flights_of_a_thousand_steps_stay_below_two_megabytes(make_flight):
    scene = load_scene("six-joint")  # the most frames
    flights = [make_flight(scene, "expert", 1000), make_flight(scene, "agent", 1000, 0.6)]
    assert len(replay_page(flights, scene).encode()) < 2e6


def test_labels_cannot_end_the_script(make_flight, paper, tmp_path):
    label = "</script><img src=x onerror=alert(1)><!--{{script}}"
    scene = paper.replace(name=label, description=label)
    page = write_replay(tmp_path / "page.html", [make_flight(scene, label)], scene).read_text("utf-8")
    assert "<img" not in page
    assert page.count("</script>") == 2
    data = data_of(page)
    assert data["flights"][0]["label"] == label == data["scene"]["name"]


def test_scenes_of_a_page_are_listed_by_name(make_flight, paper):
    """Each with its own data, and names that cannot end an attribute."""
    planar = load_scene("planar").replace(name='a "b" <c>')
    page = replay_page([make_flight(paper)], paper, ([make_flight(planar), make_flight(planar, "b")], planar))
    names = re.findall(r'class="replay-data" data-scene="([^"]*)">', page)
    assert names == ["paper", "a &quot;b&quot; &lt;c&gt;"]
    first, second = (json.loads(text) for text in DATA.findall(page))
    assert [len(first["flights"]), len(second["flights"])] == [1, 2]
    assert second["scene"]["name"] == planar.name
    assert first == data_of(replay_page([make_flight(paper)], paper))
    with pytest.raises(ValueError, match="two scenes are called 'paper': show their flights together"):
        replay_page([make_flight(paper)], paper, ([make_flight(paper)], paper))


@pytest.mark.parametrize("label", ["fl\udce9g", "سلام\u2028", "🚀"])
def test_any_name_of_a_file_can_be_a_label(make_flight, paper, tmp_path, label):
    """Names of files need not be valid Unicode: what is not comes as a lone surrogate."""
    page = write_replay(tmp_path / "page.html", [make_flight(paper, label, 2)], paper).read_text("utf-8")
    assert data_of(page)["flights"][0]["label"] == label


def test_numbers_of_the_page_are_those_of_the_flight(make_flight, paper):
    flight = replace(make_flight(paper), noise=np.ones((60, 12)))
    data = data_of(replay_page([flight], paper))
    blob = b64decode(data["blob"])

    def array(place):
        return np.frombuffer(blob, place["type"], place["length"], place["start"])

    shown = prepare([flight], paper)[0]
    frames = array(data["flights"][0]["frames"]).reshape(61, 6, 8)
    np.testing.assert_array_equal(frames, shown.frames.astype(np.float32))
    rates = data["panels"][5]
    expected = flight.controls[:, 9:].T.ravel()
    np.testing.assert_array_equal(array(rates["curves"][0]), expected.astype(np.float32))
    np.testing.assert_allclose(array(rates["disturbed"][0]), expected + 1.0, rtol=1e-6)


def drifting(paper, steps):
    """Poses of a target that turns and moves, shape (steps + 1, 8)."""
    start, axis = paper.target.pose.dual_quaternion, (0.0, 0.0, 1.0)
    moves = [poses.from_axis_angle(axis, 0.01 * step, (0.02 * step, 0.0, 0.0)) for step in range(steps + 1)]
    return np.array([dual_quaternion.multiply(start, move) for move in moves])


def test_a_moving_target_and_its_body_are_in_the_data(make_flight, paper):
    scene = paper.replace({"target.geometry": [{"box": [1, 1, 1]}]})
    target = drifting(paper, 60)
    moving = replace(make_flight(scene), target=target, target_body=target[5])
    data = data_of(replay_page([moving, make_flight(scene, "still")], scene))
    blob, (first, second) = b64decode(data["blob"]), data["flights"]
    place = first["target"]
    found = np.frombuffer(blob, place["type"], place["length"], place["start"]).reshape(61, 8)
    np.testing.assert_array_equal(found, target.astype(np.float32))
    assert first["targetBody"] == target[5].tolist()
    assert (second["target"], second["targetBody"]) == (list(paper.target.pose.dual_quaternion), None)
    assert data["solids"]["counts"][-3:] == [12, 0, 0]  # triangles of a box


def test_a_target_at_rest_and_no_shapes_cost_nothing(make_flight, paper):
    flight = make_flight(paper)
    pose = np.array(paper.target.pose.dual_quaternion)
    page = replay_page([flight], paper)
    assert replay_page([replace(flight, target=np.tile(pose, (61, 1)))], paper) == page
    data = data_of(page)
    flight = data["flights"][0]
    assert (data["solids"]["counts"][-2:], flight["targetBody"], flight["payload"]) == ([0, 0], None, None)


def test_a_target_that_moves_away_stays_in_the_picture(make_flight, paper):
    flight = make_flight(paper)
    target = drifting(paper, 60)
    near, far = (view_of(prepare([replace(flight, target=q)], paper), paper) for q in (target[0], target))
    position = np.array(poses.position(tuple(target[-1])))
    assert any((near.points @ axis).max() < position @ axis for axis in (*np.eye(3), *-np.eye(3)))
    assert all(position @ axis <= (far.points @ axis).max() for axis in (*np.eye(3), *-np.eye(3)))


@pytest.mark.skipif(which("node") is None, reason="node is not installed")
def test_the_page_moves_target_body_and_payload_with_time(make_flight, paper, tmp_path):
    """Poses at an instant between two, by the page's own script, against the screw motion between them."""
    target = drifting(paper, 60)
    body = np.array([dual_quaternion.multiply(tuple(pose), tuple(target[30])) for pose in target])
    payload = body[::-1]
    flight = replace(make_flight(paper), target=target, target_body=body, payload=payload)
    text = DATA.search(replay_page([flight, make_flight(paper, "still")], paper))[1]
    (tmp_path / "data.json").write_text(text, encoding="utf-8")
    script = tmp_path / "read.mjs"
    script.write_text(
        'import { readFileSync } from "node:fs";\n'
        f'import {{ readRecording }} from "{BROWSER / "recording.mjs"}";\n'
        f'const {{ flights }} = readRecording(readFileSync("{tmp_path / "data.json"}", "utf-8"));\n'
        "for (const flight of flights) flight.moveTo(20.25 * 0.015);\n"
        "const shown = flights.map((flight) => [[...flight.poses.slice(-40, -8)], flight.aim]);\n"
        "console.log(JSON.stringify(shown));"
    )
    printed = subprocess.run(["node", str(script)], check=True, capture_output=True, text=True).stdout
    (moved, aim), (rest, _) = json.loads(printed)
    expected = [screw.interpolate(tuple(each[20]), tuple(each[21]), 0.25) for each in (target, body, payload)]
    np.testing.assert_allclose(np.reshape(moved, (4, 8))[1:], expected, rtol=0, atol=1e-5)
    np.testing.assert_allclose(aim, poses.position(expected[0]), rtol=0, atol=1e-5)
    nominal = paper.target.pose.dual_quaternion
    tip, *others, held = np.reshape(rest, (4, 8))
    np.testing.assert_allclose(others, [nominal, nominal], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(held, tip)


def test_unlimited_inputs_have_a_page(make_flight, paper):
    actuators = paper.actuators.model_dump() | {"joint_torque": {"limit": float("inf")}}
    scene = paper.replace(actuators=actuators)
    data = data_of(replay_page([make_flight(scene)], scene))
    assert (data["panels"][4]["note"], data["panels"][4]["bounds"]) == ("no limit", [])


@pytest.mark.skipif(which("node") is None, reason="node is not installed")
def test_node_accepts_the_scripts_one_by_one_and_joined(tmp_path):
    joined = tmp_path / "joined.mjs"
    joined.write_text(bundle(), encoding="utf-8")
    assert {part.name for part in BROWSER.iterdir() if part.name.endswith(".mjs")} == set(SCRIPTS)
    for path in (*(BROWSER.joinpath(name) for name in SCRIPTS), joined):
        subprocess.run(["node", "--check", str(path)], check=True, capture_output=True)


@pytest.mark.skipif(which("node") is None, reason="node is not installed")
def test_rare_inputs_of_a_diverged_flight_stay_in_their_plot(tmp_path):
    """Most inputs are zero, and the last ones, within the limits, or before these have none, are not."""
    script = tmp_path / "range.mjs"
    script.write_text(
        f'import {{ rangeOf }} from "{BROWSER / "plots.mjs"}";\n'
        "const flights = [{ note: 'diverges after 1 s' }];\n"
        "const curve = new Float32Array(100), steady = new Float32Array(100).fill(1);\n"
        "curve[98] = -3, curve[99] = 4, steady[99] = 1000;\n"
        "const range = (curve, bounds) => rangeOf({ curves: [curve], disturbed: [null], bounds }, flights);\n"
        "console.log(JSON.stringify([range(curve, [-5, 5]), range(curve, []), range(steady, [])]));"
    )
    printed = subprocess.run(["node", str(script)], check=True, capture_output=True, text=True).stdout
    bounded, free, cut = json.loads(printed)
    np.testing.assert_allclose([bounded, free, cut], [(-5.6, 5.6), (-3.42, 4.42), (0.0, 3.18)])


@pytest.mark.skipif(which("node") is None, reason="node is not installed")
def test_shift_and_an_arrow_move_by_a_second_or_by_a_longer_step(tmp_path):
    script = tmp_path / "keys.mjs"
    script.write_text(
        f'import {{ listenToKeys }} from "{BROWSER / "gestures.mjs"}";\n'
        "const moves = [], commands = { changed() {} };\n"
        "const document = { addEventListener(name, call) { this.press = call; }, querySelector() {} };\n"
        "globalThis.document = document;\n"
        "const event = { shiftKey: true, getModifierState() {}, preventDefault() {} };\n"
        "event.target = { closest() {} };\n"
        "for (const dt of [0.1, 0.4, 2.5]) {\n"
        "  listenToKeys({ player: { dt, step: (count) => moves.push(count) }, camera: null, commands });\n"
        '  for (const key of ["ArrowLeft", "ArrowRight"]) document.press({ ...event, key });\n'
        "}\n"
        "console.log(JSON.stringify(moves));"
    )
    printed = subprocess.run(["node", str(script)], check=True, capture_output=True, text=True).stdout
    assert json.loads(printed) == [-10, 10, -3, 3, -1, 1]


@pytest.mark.skipif(which("node") is None, reason="node is not installed")
def test_blended_poses_are_screw_motions(tmp_path):
    """The page's blend of two instants against the screw motion between them; a step turns by 0.6 degrees."""
    start = poses.from_axis_angle((1.0, 0.0, 0.0), 0.3, (0.2, -1.0, 4.0))
    step = poses.from_axis_angle((0.0, 0.6, 0.8), 0.01, (0.003, 0.01, -0.005))
    end = dual_quaternion.multiply(start, step)
    script = tmp_path / "blend.mjs"
    script.write_text(
        f'import {{ blendPoses, poseMatrix, positionOf }} from "{BROWSER / "algebra.mjs"}";\n'
        f"const poses = {json.dumps([*start, *end])}, blend = [];\n"
        "blendPoses(poses, 0, 8, 0.25, 1, blend);\n"
        "const result = { blend, position: positionOf(blend), matrix: [...poseMatrix(blend, 0)] };\n"
        "console.log(JSON.stringify(result));"
    )
    printed = subprocess.run(["node", str(script)], check=True, capture_output=True, text=True).stdout
    result = json.loads(printed)
    expected = screw.interpolate(start, end, 0.25)
    np.testing.assert_allclose(result["blend"], expected, rtol=0, atol=1e-6)
    rotation, position = poses.to_matrix(expected)
    np.testing.assert_allclose(result["position"], position, rtol=0, atol=1e-6)
    matrix = np.array(result["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, :3], rotation, rtol=0, atol=1e-6)
    np.testing.assert_allclose(matrix[:3, 3], position, rtol=0, atol=1e-6)
