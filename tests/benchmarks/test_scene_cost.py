"""What scenes leave out: sizes, operations, imports, and programs that are there or not; never how long."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest

from dq_space_arm_env import Scene, compile_scene, load_scene
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.kernels.programs.environment_programs import EnvironmentPrograms
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from experts.report.scene_variants import feature_variants
from scripts.benchmarks import subjects
from scripts.benchmarks.effort import QUICK, Sampling
from scripts.benchmarks.harness import Row, select, shortcomings
from scripts.benchmarks.scene_cost.mechanisms import mechanism_rows
from scripts.benchmarks.scene_cost.preparations import preparation_rows
from scripts.benchmarks.scene_cost.processes import IMPORT, MAKE, STEP, WRENCHES, process_rows
from scripts.benchmarks.scene_cost.sizes import BATCH, OUTPUTS, output_rows, program_row, scene_rows, size_row
from scripts.benchmarks.subjects import COMPARED_INTEGRATORS

pytestmark = pytest.mark.slow  # they compile many variants of scenes

SHORT = replace(QUICK, cost_timing=Sampling(1, 1e-4))


@cache
def operations(scene: Scene) -> Mapping[str, int]:
    """Of each program that every scene has."""
    programs, environments = ScenePrograms(scene), EnvironmentPrograms(scene)
    counts = {name: programs.build("step", name).operation_count for name in COMPARED_INTEGRATORS}
    counts["dynamics"] = programs.build("forward_dynamics").operation_count
    counts["environment"] = environments.build("environment_step", "rk4").operation_count
    return counts


@pytest.mark.parametrize(
    "name",
    [
        "paper",
        "random-masses",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("payload", "planar", "six-joint", "tip-load")
        ),
    ],
)
def test_a_part_never_makes_a_scene_cheaper(name: str) -> None:
    scene = load_scene(name)
    whole = operations(scene)
    variants = feature_variants(scene)
    assert operations(variants.pop(f"{name}, as it is")) == whole
    for title, variant in variants.items():
        added = title.startswith("with ") and "link" not in title
        for program, count in operations(variant).items():
            assert (count >= whole[program]) if added else (count <= whole[program]), (title, program)


def test_random_starts_change_no_step_targets_that_of_the_environment_and_masses_hardly_any() -> None:
    variants = feature_variants(load_scene("paper"))
    whole = operations(variants["paper, as it is"])
    assert operations(variants["without random starts"]) == whole
    changed = dict(operations(variants["with random target"]).items() - whole.items())
    assert changed.keys() == {"environment"}
    assert whole["environment"] < changed["environment"] < 1.02 * whole["environment"]
    for program, count in operations(variants["with random masses"]).items():
        assert whole[program] < count < 1.1 * whole[program], program


def test_mechanisms_cost_what_the_page_says_and_never_less_than_nothing() -> None:
    page = (Path(__file__).parents[2] / "docs/report.md").read_text(encoding="utf-8")
    whole, *others = rows = list(mechanism_rows(load_scene("paper")))
    for row in rows:
        counts = [f"{row[key]:,}" for key in ("dynamics", "step", "derivatives", "environment")]
        counts.insert(2, f"{row['step_ratio']:.2f}")
        cells = (row["title"], f"{row['states']}, {row['inputs']}", *counts)
        assert f"| {' | '.join(cells)} |\n" in page
    for row in others:
        assert all(row[key] >= whole[key] for key in ("states", "inputs", "dynamics", "step", "derivatives"))
        assert row["environment"] > whole["environment"]


# States, tangent states, inputs, entries of an observation; the pose has 8 numbers and 6 directions.
SIZES = {
    "without wrist": (20, 18, 9, 21),
    "without base force and torque": (23, 21, 6, 24),
    "with 0 links": (17, 15, 9, 18),
    "in the plane, without wrist": (13, 12, 6, 14),
}


@pytest.mark.parametrize("title", SIZES)
def test_sizes_of_parts(title: str) -> None:
    size = size_row(feature_variants(load_scene("paper"))[title])
    keys = ("states", "tangent_states", "inputs", "observations")
    assert tuple(size[key] for key in keys) == SIZES[title]
    assert size["state_bytes"] == 8 * size["states"]


@pytest.mark.parametrize("name", ["planar", "tip-load"])
def test_sizes_of_scenes_are_those_of_kernels_and_environment(name: str) -> None:
    scene = load_scene(name)
    size, kernels, env = size_row(scene), compile_scene(scene), DQSpaceArmEnv(scene)
    sizes = (size["states"], size["tangent_states"], size["inputs"])
    assert sizes == (kernels.n_x, kernels.n_t, kernels.n_u)
    assert (size["observations"],) == env.observation_space.shape
    assert size["environment_operations"] == kernels.operation_count("environment_step")
    assert size["step_operations"] == size[f"{scene.simulation.integrator}_operations"]


@pytest.fixture(scope="module")
def shoulder() -> Scene:
    """A link on a spherical joint."""
    (link, *_) = load_scene("no-wrist").model_dump(mode="json")["links"]
    links = [{**link, "joint_type": "spherical"}]
    return load_scene("no-wrist").replace(name="shoulder", links=links, initial_state={}, spread={})


def test_integrators_that_do_not_take_a_scene_are_left_out_of_its_sizes(shoulder: Scene) -> None:
    size = size_row(shoulder)
    assert size["symplectic_euler_operations"] is None
    assert size["rk4_operations"] == size["step_operations"]


def test_integrators_that_do_not_take_a_scene_are_not_timed(
    shoulder: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def untimed(scene: Scene, what: str, integrator: str, *others: object) -> subjects.Case:
        return subjects.Case(subjects.Subject(what=what, engine="", way="", integrator=integrator), int)

    monkeypatch.setattr(subjects, "kernel_case", untimed)
    monkeypatch.setattr(subjects, "VARIANTS", (subjects.PLAIN,))
    timed = [*subjects.kernel_cases(shoulder, (1,)), *subjects.function_cases(shoulder, (1,))]
    timed += subjects.environment_cases(shoulder, (1,))
    assert {case.subject.integrator for case in timed} == {"", "rk4"}


def test_single_precision_halves_the_memory() -> None:
    scene = load_scene("planar")
    single = scene.replace(simulation={"precision": "float32"})
    double_cost, single_cost = (program_row(each, "step", "rk4") for each in (scene, single))
    assert double_cost["memory_bytes"] == 2 * single_cost["memory_bytes"]
    assert double_cost["operations"] == single_cost["operations"]


def test_scenes_are_compared_with_the_first(short_scene: Scene) -> None:
    scenes = {"one": short_scene, "other": load_scene("planar")}
    one, other = scene_rows("scenes", scenes, SHORT, vector=True)
    kernels = compile_scene(short_scene)
    assert one["environment_operations"] == kernels.operation_count("environment_step")
    ratios = [key for key in one if key.endswith("_ratio")]
    assert [one[key] for key in ratios] == [1.0] * 4
    assert all(other[key] == other[key[:-6]] / one[key[:-6]] for key in ratios)
    assert 0.0 < other["dynamics_ns"] < other["make_vec_ns"] * BATCH


def test_derivatives_cost_more_than_the_step_and_the_step_does_not_pay(short_scene: Scene) -> None:
    rows = list(output_rows(short_scene, 1))
    assert [row["program"] for row in rows] == list(OUTPUTS)
    cost = {row["program"]: row["operations"] for row in rows}
    assert cost["tip_pose"] < cost["step"] < cost["linearize"] < cost["lagrangian_hessian"]
    # Reactions need the accelerations, all but the turning of the base's axes: omega x v in the plane.
    assert cost["forward_dynamics"] - 4 <= cost["reaction_wrenches"]


@pytest.fixture(scope="module")
def processes() -> list[Row]:
    return list(process_rows(1, derivatives=False))


def test_only_what_is_called_is_compiled(processes: list[Row]) -> None:
    compiled = {row["stage"]: row["compiles"] for row in select(processes, table="processes", cache="empty")}
    assert compiled == {
        IMPORT: "",
        MAKE: "environment_observe, environment_start, environment_step_float32_actions",
        STEP: "step",
        WRENCHES: "reaction_wrenches",
    }
    assert not any(row["compiles"] for row in select(processes, table="processes", cache="warm"))


def test_nothing_optional_is_imported_and_casadi_only_to_compile(processes: list[Row]) -> None:
    assert shortcomings(processes) == []
    found = {cache: select(processes, table="processes", cache=cache) for cache in ("empty", "warm")}
    for rows in found.values():
        assert len(rows) == 4
        assert not any(name in rows[0]["imports"] for name in ("casadi", "llvmlite", "pydantic"))
    assert "casadi" in found["empty"][1]["imports"]
    used = ", ".join(row["imports"] for row in found["warm"])
    assert "llvmlite" in used
    assert "casadi" not in used


@pytest.mark.endurance
def test_a_solver_is_prepared_with_an_empty_and_with_a_full_cache() -> None:
    rows = list(preparation_rows(["planar"]))
    assert [(row["title"], row["cache"]) for row in rows] == [("planar", "empty"), ("planar", "warm")]
    times = ("kernels_cpu_s", "rest_cpu_s", "alone_wall_s", "cpu_s", "wall_s")
    assert all(row[key] >= 0.0 for row in rows for key in times)
    assert rows[0]["kernels_cpu_s"] > rows[1]["kernels_cpu_s"]  # those are loaded, not compiled
