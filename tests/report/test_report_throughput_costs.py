"""What scenes and their parts cost, and the start of processes; never how long they take."""

import math
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from dq_space_arm_env import Scene, compile_scene, list_scenes, load_scene
from dq_space_arm_env.scene import StateLayout
from experts.report.peak import Peak
from experts.report.start_up import EMPTY, IMPORT, LINEARIZE, MAKE, WARM, measure_start_up
from experts.report.throughput.cost_tables import print_feature_costs, print_scene_costs
from experts.report.throughput.features import feature_variants, in_the_plane, with_links, without_wrist
from experts.report.throughput.scene_costs import BATCH, measure_costs
from experts.report.throughput.timing import FLOAT64, Effort, Timing

SHORT = Effort(batch_sizes=(1,), repeats=2, sample_seconds=1e-4)


def test_cost_of_a_scene_is_that_of_its_kernels(short_scene: Scene) -> None:
    (cost,) = measure_costs({"short": short_scene}, SHORT, environments=True)
    kernels = compile_scene(short_scene)
    assert (cost.title, cost.states, cost.inputs) == ("short", kernels.n_x, kernels.n_u)
    for timing, program in (
        (cost.dynamics, "forward_dynamics"),
        (cost.step, "step"),
        (cost.environment_step, "environment_step"),
    ):
        assert timing.operations == kernels.operation_count(program)
        assert timing.batch == BATCH
        assert 0.0 < timing.best_ns <= timing.median_ns < math.inf
    assert cost.environment is not None
    assert cost.environment.batch == BATCH


def test_environments_are_timed_only_where_asked_for(short_scene: Scene) -> None:
    scenes = {"one": short_scene, "other": short_scene}
    costs = measure_costs(scenes, SHORT, environments=False)
    assert [cost.title for cost in costs] == ["one", "other"]
    assert all(cost.environment is None for cost in costs)


def test_tables_of_costs_fit_a_terminal_of_110_columns(short_scene: Scene) -> None:
    (cost,) = measure_costs({"short": short_scene}, SHORT, environments=True)
    rate = {"operations": 9999, "best_ns": 123.4, "median_ns": 123.4}
    wide = replace(
        cost,
        states=26,
        inputs=12,
        **{name: replace(value, **rate) for name, value in vars(cost).items() if isinstance(value, Timing)},
    )
    peaks = {FLOAT64: Peak(FLOAT64, 8, 12, 100.0)}
    pages = []
    for width in (110, 200):
        console = Console(width=width, file=StringIO(), highlight=False)
        print_scene_costs(console, [replace(wide, title=name) for name in list_scenes()], peaks)
        titles = feature_variants(load_scene("paper"))
        print_feature_costs(console, [replace(wide, title=title) for title in titles])
        assert isinstance(console.file, StringIO)
        pages.append([line.rstrip() for line in console.file.getvalue().splitlines()])
    assert pages[0] == pages[1]


def test_parts_left_out_take_their_states_and_inputs_along() -> None:
    sizes = {
        title: (StateLayout.of(scene).n_x, StateLayout.of(scene).n_u)
        for title, scene in feature_variants(load_scene("paper")).items()
    }
    assert sizes == {
        "paper, as it is": (23, 12),
        "without wrist": (20, 9),
        "without base force": (23, 9),
        "without base torque": (23, 9),
        "without joint torques": (23, 9),
        "without wrist inputs": (23, 9),
        "without base force and torque": (23, 6),
        "with a tip wrench": (23, 12),
        "with springs and dampers": (23, 12),
        "without random starts": (23, 12),
        "with random target": (23, 12),
        "with random masses": (23, 12),
        "with 2 links": (21, 11),
        "with 1 link": (19, 10),
        "with 0 links": (17, 9),
        "in the plane, without wrist": (13, 6),
    }


@pytest.mark.parametrize(
    ("name", "title"),
    [("payload", "without payload"), ("tip-load", "without tip wrench")],
)
def test_parts_that_only_some_scenes_have_are_left_out_too(name: str, title: str) -> None:
    variants = feature_variants(load_scene(name))
    whole, rest = compile_scene(load_scene(name)), compile_scene(variants[title])
    x = np.tile(whole.layout.initial_state, (1, 1))
    u = np.ones((1, whole.n_u))
    assert not np.allclose(whole.forward_dynamics(x, u), rest.forward_dynamics(x, u))


def test_a_payload_needs_a_link() -> None:
    variants = feature_variants(load_scene("payload"))
    assert "with 1 link" in variants
    assert "with 0 links" not in variants


def test_a_planar_scene_gets_no_tip_wrench_and_stays_in_its_plane(short_scene: Scene) -> None:
    assert list(feature_variants(short_scene)) == [
        "short, as it is",
        "without base torque",
        "without joint torques",
        "with springs and dampers",
        "with random target",
        "with random masses",
        "with 0 links",
    ]


@pytest.mark.parametrize("name", list_scenes())
def test_parts_of_every_scene_make_scenes(name: str) -> None:
    """Each of them is validated; here, that there is something to compare."""
    variants = feature_variants(load_scene(name))
    whole = variants.pop(f"{name}, as it is")
    assert len(variants) >= 10
    assert len({variant.content_hash() for variant in variants.values()} - {whole.content_hash()}) == len(
        variants
    )


def test_what_a_scene_draws_is_left_out_and_what_it_does_not_draw_is_added() -> None:
    drawing = feature_variants(load_scene("random-masses"))
    assert drawing["without random masses"].spread.payload_mass == 0.0
    assert drawing["without payload"].spread.link_masses == 0.1
    assert drawing["without random starts"].spread.joint_angles == 0.0
    assert drawing["with random target"].spread.target_position > 0.0
    assert feature_variants(load_scene("paper"))["with random masses"].spread.link_inertias > 0.0


def test_springs_that_a_scene_has_are_left_out(short_scene: Scene) -> None:
    sprung = feature_variants(short_scene)["with springs and dampers"]
    assert sprung.links[0].stiffness > 0.0
    rest = feature_variants(sprung)["without springs and dampers"]
    assert (rest.links[0].stiffness, rest.links[0].damping) == (0.0, 0.0)


@pytest.mark.parametrize("name", ["paper", "six-joint", "tip-load", "payload"])
def test_in_the_plane_the_bodies_keep_their_masses_and_the_arm_its_length(name: str) -> None:
    scene = load_scene(name)
    flat = in_the_plane(scene)
    assert flat.base.motion == "planar"
    assert [link.mass for link in flat.links] == [link.mass for link in scene.links]
    assert (flat.payload is None) == (scene.payload is None)
    assert (flat.tip_wrench is None) == (scene.tip_wrench is None)
    for link, own in zip(flat.links, scene.links, strict=True):
        assert sum(link.joint.position) == pytest.approx(sum(own.joint.position))


def test_without_wrist_the_tip_stays_where_it_is_at_zero_angles() -> None:
    paper = load_scene("paper")
    stiff = compile_scene(without_wrist(paper))
    x = compile_scene(paper).layout.initial_state.copy()
    x[compile_scene(paper).layout.state.wrist_angles] = 0.0
    reduced = np.delete(x, compile_scene(paper).layout.state.wrist_angles)
    assert stiff.tip_pose(reduced) == pytest.approx(compile_scene(paper).tip_pose(x), abs=1e-15)


@pytest.mark.parametrize("count", [0, 1, 2])
@pytest.mark.parametrize("name", ["paper", "no-wrist"])
def test_a_shorter_arm_ends_where_the_next_joint_was(name: str, count: int) -> None:
    scene = load_scene(name)
    shorter = with_links(scene, count)
    assert shorter is not None
    assert shorter.links == scene.links[:count]
    end = shorter.tip if shorter.wrist is None else shorter.wrist.frame
    assert end == scene.links[count].joint
    assert shorter.initial_state.joint_angles == scene.initial_state.joint_angles[:count]


def test_start_up_is_measured_with_caches_of_its_own(
    short_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path))
    times = measure_start_up(short_scene, 2)
    assert {name: len(values) for name, values in times.items()} == {
        IMPORT: 2,
        f"{MAKE}, {WARM}": 2,
        f"{MAKE}, {EMPTY}": 1,
        f"{LINEARIZE}, {WARM}": 2,
        f"{LINEARIZE}, {EMPTY}": 1,
    }
    assert all(0.0 < value < math.inf for values in times.values() for value in values)
    assert not list(tmp_path.iterdir())
