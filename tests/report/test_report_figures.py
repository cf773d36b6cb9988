"""The figures show the numbers of the maneuver, in the units that they name."""

import subprocess
import sys
from copy import copy
from pathlib import Path

import numpy as np
import pytest

matplotlib = pytest.importorskip("matplotlib")

from matplotlib.image import imread  # noqa: E402

from dq_space_arm_env import Scene, load_scene  # noqa: E402
from dq_space_arm_env.algebra import dual_quaternion  # noqa: E402
from dq_space_arm_env.algebra.poses import position, to_matrix  # noqa: E402
from dq_space_arm_env.scene import InitialState, StateLayout  # noqa: E402
from dq_space_arm_env.scene.path import shown_target  # noqa: E402
from experts.figures import write_figures, write_readme_picture  # noqa: E402
from experts.figures.maneuver_curves import convergence_figure, figure_3, figure_4, figure_5, figure_6  # noqa: E402
from experts.figures.schematic import Schematic  # noqa: E402
from experts.figures.snapshots import best_view, figure_2, snapshot_stages  # noqa: E402
from experts.figures.space import Grid  # noqa: E402
from experts.figures.style import house_style  # noqa: E402
from experts.report import Maneuver, ManeuverRun  # noqa: E402


def still(scene: Scene) -> Maneuver:
    """A maneuver in which nothing happens."""
    layout = StateLayout.of(scene)
    return Maneuver(scene, np.tile(layout.initial_state, (4, 1)), np.zeros((3, layout.n_u)))


def test_figure_3_shows_the_error_pose(paper_maneuver: Maneuver) -> None:
    upper, lower = figure_3(paper_maneuver).axes
    for axes, values in ((upper, paper_maneuver.error_pose[:, :4]), (lower, paper_maneuver.position_error)):
        assert np.array_equal([line.get_ydata() for line in axes.lines], values.T)
    assert lower.get_ylabel() == "position [m]"
    looks = [(line.get_color(), line._dash_pattern) for line in upper.lines]
    assert len({color for color, _ in looks}) == len({str(pattern) for _, pattern in looks}) == 4


def test_joints_from_the_tenth_on_have_two_digits_below_and_no_limit_is_none(short_scene: Scene) -> None:
    link = short_scene.links[0]
    links = [link.model_copy(update={"name": f"link {i}"}) for i in range(11)]
    actuators = {"joint_torque": {"limit": np.inf}}
    scene = short_scene.replace(links=links, actuators=actuators, initial_state=InitialState())
    (axes,) = figure_6(still(scene)).axes
    named = [text.get_text() for text in axes.get_legend().get_texts()]
    assert named[8:] == [r"$\tau_{9}$", r"$\tau_{10}$", r"$\tau_{11}$"]
    assert axes.get_title(loc="left") == "Joint torques (no limit)"


def test_figure_4_is_in_degrees_and_meters(paper_maneuver: Maneuver) -> None:
    upper, lower = figure_4(paper_maneuver).axes
    assert upper.lines[0].get_ydata()[0] == pytest.approx(74.4, abs=0.05)
    assert lower.lines[0].get_ydata()[0] == pytest.approx(1.330, abs=5e-4)
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("angle [deg]", "distance [m]")
    assert upper.lines[1].get_ydata()[0] == 3.0  # the tolerance


def test_a_number_at_the_end_of_the_time_axis_is_not_cut() -> None:
    scene = load_scene("payload")  # 22.5 s
    layout, steps = StateLayout.of(scene), scene.simulation.steps
    states = np.tile(layout.initial_state, (steps + 1, 1))
    with house_style():
        figure = figure_4(Maneuver(scene, states, np.zeros((steps, layout.n_u))))
        figure.draw_without_rendering()
        last = figure.axes[-1].get_xticklabels()[-1]
        assert last.get_text() == "22.5"
        assert last.get_window_extent().x1 < figure.bbox.x1


def test_figure_5_shows_small_forces_in_millinewtons(paper_maneuver: Maneuver) -> None:
    figure = figure_5(paper_maneuver)
    force, torque = figure.axes
    values, edges, _ = force.patches[1].get_data()
    assert values == pytest.approx(1e3 * paper_maneuver.controls[:, 1])
    assert np.array_equal(edges, paper_maneuver.time)
    assert force.get_ylabel() == "force [mN]"
    assert "±10 N, off the scale" in force.get_title(loc="left")
    assert torque.get_ylabel() == "torque [N m]"
    assert not force.lines


def test_figure_6_shows_limits_that_are_near(paper_maneuver: Maneuver) -> None:
    figure = figure_6(paper_maneuver)
    joints, wrist = figure.axes
    assert sorted(line.get_ydata()[0] for line in joints.lines) == [-2.0, 2.0]
    assert sorted(line.get_ydata()[0] for line in wrist.lines) == [-0.5, 0.5]
    assert len(joints.patches) == len(wrist.patches) == 3
    low, high = joints.get_ylim()
    assert low < -2.0 < 2.0 < high


def test_eight_thrusters_look_different_and_leave_the_title_free() -> None:
    scene = load_scene("thrusters")
    maneuver = still(scene)
    maneuver.controls[:, StateLayout.of(scene).control.thruster_force] = 3.0
    with house_style():
        figure = figure_5(maneuver)
    (axes,) = figure.axes
    assert "limit 0 to 5 N" in axes.get_title(loc="left")
    looks = {(patch.get_edgecolor(), str(patch.get_linestyle())) for patch in axes.patches}
    assert len(looks) == len(axes.patches) == 8
    box, title = axes.get_legend().get_window_extent(), axes._left_title.get_window_extent()
    assert not box.overlaps(title)
    assert axes.transData.inverted().transform(box.min)[1] > 5.0


def test_panels_of_absent_actuators_are_left_out() -> None:
    assert figure_5(still(load_scene("free-floating"))) is None
    figure = figure_5(still(load_scene("reaction-wheels")))
    (axes,) = figure.axes
    assert axes.get_title(loc="left").startswith("Torque on the base")


def test_motors_that_turn_and_motors_that_slide_have_both_units() -> None:
    maneuver = still(load_scene("sliding"))
    for largest, label in ((0.01, "torque [mN m or mN]"), (1.0, "torque [N m or N]")):
        maneuver.controls[:, StateLayout.of(maneuver.scene).control.joint_torque] = largest
        figure = figure_6(maneuver)
        assert figure.axes[0].get_ylabel() == label
    assert maneuver.actuator("joint_torque").unit == "N m or N"


def test_different_limits_are_all_drawn() -> None:
    maneuver = still(load_scene("six-joint"))
    maneuver.controls[1, 6:12] = 2.0, 2.0, 2.0, 2.0, 2.0, 0.5
    figure = figure_6(maneuver)
    (axes,) = figure.axes
    assert sorted(line.get_ydata()[0] for line in axes.lines) == [-2.0, -0.5, 0.5, 2.0]


def test_planar_error_has_no_identically_zero_components(short_run: ManeuverRun) -> None:
    upper, lower = figure_3(short_run.maneuver).axes
    assert [line.get_label() for line in upper.lines] == ["$q_0$", "$q_3$"]
    assert [line.get_label() for line in lower.lines] == ["$r_x$", "$r_y$"]


def test_convergence_begins_with_doing_nothing(short_run: ManeuverRun) -> None:
    figure = convergence_figure(short_run.solution, short_run.zero_control_cost, short_run.tolerance, 1.0)
    cost, decrease, _ = figure.axes
    shown = cost.lines[0].get_ydata()
    assert shown[0] == short_run.zero_control_cost
    assert shown[-1] == pytest.approx(short_run.solution.cost)
    assert len(shown) == len(decrease.lines[0].get_ydata()) == short_run.solution.iterations + 1


@pytest.mark.parametrize("factor", [1.0, 1e2, 1e4, 1e6, 1e9])
def test_costs_of_any_range_are_numbered(short_run: ManeuverRun, factor: float) -> None:
    figure = convergence_figure(short_run.solution, factor * short_run.zero_control_cost, 1e-7, 1.0)
    cost = figure.axes[0]
    low, high = cost.get_ylim()
    assert sum(low <= tick <= high for tick in cost.get_yticks()) >= 2


def test_convergence_under_constraints_has_penalties(short_run: ManeuverRun) -> None:
    solution = copy(short_run.solution)
    for constraints, label in ((None, "$J$ [$-$]"), (object(), "$J$ + penalties [$-$]")):
        solution.constraints = constraints
        cost = convergence_figure(solution, short_run.zero_control_cost, 1e-7, 1.0).axes[0]
        assert cost.get_ylabel() == label
        assert np.isnan(cost.lines[0].get_ydata()[0]) == (constraints is not None)


def test_snapshots_are_spread_over_the_motion(short_run: ManeuverRun) -> None:
    stages = snapshot_stages(short_run.maneuver, 6)
    assert (stages[0], stages[-1], len(stages)) == (0, 60, 6)
    assert sorted(stages) == stages


def test_view_has_the_tip_before_the_base(paper_maneuver: Maneuver) -> None:
    view = best_view(paper_maneuver)
    base, tip = (np.mean(position(paper_maneuver.frames[:, frame].T), axis=1) for frame in (0, -1))
    assert view.toward @ (tip - base) > 0.0
    basis = np.array(view)
    assert basis @ basis.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.cross(view.right, view.up) == pytest.approx(view.toward)


def test_planar_scene_is_seen_from_above(short_run: ManeuverRun) -> None:
    view = best_view(short_run.maneuver)
    assert view.project(np.array([[2.0, 3.0, 7.0]])) == pytest.approx(np.array([[2.0, 3.0]]))
    assert len(figure_2(still(short_run.scene)).axes) >= 2  # though nothing moves


def test_shapes_of_bodies_are_placed_and_replace_what_is_derived(paper_maneuver: Maneuver) -> None:
    scene, frames = paper_maneuver.scene, paper_maneuver.frames[0]
    cube = {"box": [0.1, 0.1, 0.1], "pose": {"position": [0, 0, 3]}, "color": "#ff00ff"}
    shaped = scene.replace({f"{body}.geometry": [cube] for body in ("base", "links.0", "target")})
    light = np.array([0.0, 0.0, 1.0])
    plain, found = Schematic(scene, light), Schematic(shaped, light)
    for faces, pose in (
        (found.spacecraft(frames), frames[0]),
        (found.spacecraft(frames), frames[1]),
        (found.target(0), np.array(scene.target.pose.dual_quaternion)),
    ):
        rotation, origin = to_matrix(tuple(pose.tolist()))
        expected = np.array(origin) + np.array(rotation) @ [0.0, 0.0, 3.0]
        magenta = (faces.colors[:, 1] == 0.0) & (faces.colors[:, 0] > 0.0)
        centers = faces.corners[magenta].mean(axis=1)
        near = np.linalg.norm(centers - expected, axis=1) < 0.1
        assert centers[near].mean(axis=0) == pytest.approx(expected, abs=1e-9)
    assert len(found.target(0).corners) > len(plain.target(0).corners)
    assert len(found.spacecraft(frames).corners) < len(plain.spacecraft(frames).corners)


def test_a_payload_that_was_let_go_stays_behind_in_snapshots(paper_maneuver: Maneuver) -> None:
    scene = load_scene("release")
    layout, start = StateLayout.of(scene), scene.staged.starts[-1]
    states = np.tile(layout.initial_state, (scene.simulation.steps + 1, 1))
    states[start + 1 :, layout.state.joint_angles] += 0.5
    maneuver = Maneuver(scene, states, np.zeros((len(states) - 1, layout.n_u)))
    assert maneuver.payload == pytest.approx(np.tile(maneuver.frames[0, -1], (len(states), 1)), abs=1e-12)
    assert paper_maneuver.payload is None
    schematic, frames = Schematic(scene, np.array([0.0, 0.0, 1.0])), maneuver.frames[-1]
    carried, left = schematic.spacecraft(frames), schematic.spacecraft(frames, maneuver.payload[-1])
    moved = np.abs(carried.corners - left.corners).max(axis=(1, 2)) > 1e-6
    center = np.array(position(tuple(maneuver.payload[-1]))) + to_matrix(tuple(maneuver.payload[-1]))[
        0
    ] @ np.array([0.35, 0.0, 0.0])
    assert left.corners[moved].reshape(-1, 3).mean(axis=0) == pytest.approx(center, abs=1e-9)
    assert 0 < moved.sum() < len(moved)


def test_a_target_is_seen_where_it_is_at_the_time_of_a_snapshot() -> None:
    scene = load_scene("tumbling-target")
    path, body = shown_target(scene)
    schematic = Schematic(scene, np.array([0.0, 0.0, 1.0]))
    for stage in (0, 300, scene.simulation.steps):
        assert schematic.target_points(stage)[0] == pytest.approx(position(tuple(path[stage])), abs=1e-12)
    first, last = schematic.target(0), schematic.target(scene.simulation.steps)
    (turn, origin), (turned, moved) = (to_matrix(tuple(body[stage])) for stage in (0, -1))
    from_body = (first.corners - origin) @ np.array(turn)
    shapes = np.abs(from_body @ np.array(turned).T + moved - last.corners).max(axis=(1, 2)) < 1e-9
    assert shapes.sum() > 100


def test_every_tip_has_axes_a_payload_and_a_goal() -> None:
    """The ends of the arrows of the other tip and of its goal, with the target or in space."""
    scene, light = load_scene("dual-arm"), np.array([0.0, 0.0, 1.0])
    frames, (tip,), (grasp, body) = still(scene).frames[0], scene.other_tips, shown_target(scene)
    held = {"mass": 1.0, "inertia": [0.1, 0.1, 0.1], "center_of_mass": [0.0, 0.0, 0.2]}
    loaded = scene.replace({"other_tips.0.payload": held})
    faces = [len(Schematic(each, light).spacecraft(frames).corners) for each in (scene, loaded)]
    assert faces[0] < faces[1]
    inertial = scene.replace({"other_tips.0.relative_to": "inertial"})
    goal = tip.goal.dual_quaternion
    shown = [
        (Schematic(scene, light).spacecraft(frames), frames[1 + len(scene.links)], 0.15),
        (Schematic(scene, light).spacecraft(frames), frames[-1], 0.15),
        (Schematic(scene, light).target(0), grasp, 0.27),
        (Schematic(scene, light).target(0), dual_quaternion.multiply(tuple(body), goal), 0.27),
        (Schematic(inertial, light).target(0), goal, 0.27),
    ]
    for found, pose, length in shown:
        rotation, origin = to_matrix(tuple(pose))
        ends = np.array(origin) + length * Schematic(scene, light).reach * np.array(rotation).T
        corners = found.corners.reshape(-1, 3)
        assert np.linalg.norm(corners[:, None] - ends, axis=2).min(axis=0) == pytest.approx(0.0, abs=1e-12)


def test_names_of_the_axes_of_a_target_leave_the_time_free() -> None:
    """The target of this scene is above all else, in the middle."""
    scene = load_scene("solar-panels")
    layout = StateLayout.of(scene)
    states = np.tile(layout.initial_state, (13, 1))
    states[:, layout.state.joint_angles.stop - 2] += np.linspace(0.0, 1.0, 13)
    with house_style():
        figure = figure_2(Maneuver(scene, states, np.zeros((12, layout.n_u))))
    assert len(figure.axes) == 6
    for axes in figure.axes:
        axes.apply_aspect()
        names = [text for text in axes.texts if "_D" in text.get_text()]
        (time,) = (text for text in axes.texts if text.get_text().startswith("$t$"))
        assert len(names) == 3
        assert not any(time.get_window_extent().overlaps(name.get_window_extent()) for name in names)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e5])
def test_grid_lies_below_everything_at_round_numbers(size: float) -> None:
    points = size * np.random.default_rng(1).normal(size=(50, 3))
    grid = Grid.below(points)
    assert grid.height < points[:, 2].min()
    for axis in (0, 1):
        lines = grid.lines(axis)
        assert lines[0] <= points[:, axis].min()
        assert lines[-1] >= points[:, axis].max()
        assert lines / grid.cell == pytest.approx(np.round(lines / grid.cell))
        assert 3 <= len(lines) <= 9


@pytest.mark.slow
def test_files_are_pictures_and_stale_ones_go(short_run: ManeuverRun, tmp_path: Path) -> None:
    settings = dict(matplotlib.rcParams)
    files = write_figures(short_run.maneuver, tmp_path)
    assert [file.name[:8] for file in files] == [f"figure-{number}" for number in range(2, 7)]
    for file in files:
        picture = imread(file)
        assert picture.shape[1] == 1432
        assert 0.005 < np.mean(picture[..., :3].min(axis=2) < 0.9) < 0.5, file.name
    assert dict(matplotlib.rcParams) == settings
    bare = Maneuver(short_run.scene, short_run.solution.states, short_run.solution.controls)
    bare.__dict__["actuators"] = ()
    files = write_figures(bare, tmp_path, ("png", "pdf"))
    assert [file.suffix for file in files] == 3 * [".png", ".pdf"]
    assert files[1].read_bytes().startswith(b"%PDF")
    assert not (tmp_path / "figure-5-base-inputs.png").exists()


def test_readme_picture_has_its_size(short_run: ManeuverRun, tmp_path: Path) -> None:
    file = tmp_path / "picture.png"
    write_readme_picture(short_run.maneuver, file)
    assert imread(file).shape[:2] == (700, 1600)
    assert file.stat().st_size < 250_000


@pytest.mark.slow
def test_only_the_figures_import_matplotlib_and_never_pyplot() -> None:
    code = (
        "import sys, experts.report; assert 'matplotlib' not in sys.modules;"
        "import experts.figures; assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[2])


def test_without_matplotlib_there_is_one_clear_sentence() -> None:
    code = "import sys; sys.modules['matplotlib'] = None; import experts.figures"
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert result.returncode == 1
    assert result.stderr.rstrip().endswith('figures need matplotlib: pip install "dq-space-arm[plots]"')
