"""The report of a scene: its numbers against known truths, its files, and what an interrupt leaves."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from dq_space_arm_env import DQSpaceArmEnv, Scene, compile_scene, load_scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.common.files import json_value
from dq_space_arm_env.common.report_page import Section
from dq_space_arm_env.common.tables import Row
from dq_space_arm_env.kernels.library import KernelLibrary
from dq_space_arm_env.scene import INTEGRATORS
from experts import BoxDDP, GuidedDDP
from experts.problems.arm_problem import ArmProblem
from experts.report import expert_trials, integrator_precision, part_costs, scene_report, stability_envelope
from experts.report.effort import Announce, Effort
from experts.report.integrator_precision import (
    Motion,
    expert_motion,
    observed_order,
    reference_end,
    step_call,
    tip_error,
)
from experts.report.stability_envelope import SLOW, largest, on_springs

pytestmark = pytest.mark.slow  # every integrator and variant of a scene is compiled

Limits = dict[tuple[str, str], float]
EFFORT = Effort((1, 2, 4, 8, 16, 32, 64), 2, 1e-4, starts=3, ratio=1.05, all_parts=False)


def announce(what: str, done: int, total: int) -> None:
    assert 0 <= done <= total


@pytest.fixture(scope="module")
def precision(short_scene: Scene) -> dict[str, list[dict[str, object]]]:
    coarse = short_scene.replace(simulation={"dt": 0.25, "steps": 12})  # where order 8 shows above rounding
    return integrator_precision.measure(coarse, EFFORT, announce)  # type: ignore[return-value]


@pytest.fixture(scope="module")
def limits(short_scene: Scene) -> Limits:
    found = stability_envelope.measure(short_scene, EFFORT, announce)
    rows = found["envelope"]
    section = stability_envelope.section(short_scene, found)
    assert [row["integrator"] for row in section.record["limits"]] == list(INTEGRATORS)
    return {(row["integrator"], row["quantity"]): row["largest"] for row in rows}


def test_integrators_show_their_order(short_scene: Scene, precision: dict) -> None:
    section = integrator_precision.section(short_scene, precision)
    shown = {row["integrator"]: row["observed_order"] for row in section.record["integrators"]}
    for name in ("rk4", "rk8", "momentum_rk4"):
        assert shown[name] == pytest.approx(INTEGRATORS[name].order, abs=0.3), name


def test_observed_order_of_a_power_law() -> None:
    steps = [0.1 / 2**i for i in range(6)]
    assert observed_order(steps, [1e-3 * step**3 for step in steps]) == pytest.approx(3.0)
    # Below the uncertainty of the reference, errors show nothing.
    assert observed_order(steps, [1e-3 * step**3 for step in steps], uncertainty=1.0) is None


@pytest.mark.parametrize(
    ("name", "tolerance", "told"),
    [
        ("rk4", None, "steps of 0.05 s, ends"),
        ("rodas4", 1e-3, "steps of 0.05 s and a tolerance of 0.001, ends"),
    ],
)
def test_the_error_of_the_own_integrator_is_told_with_its_tolerance(
    name: str, tolerance: float | None, told: str, short_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Section, "add_figure", lambda *given: None)
    point = {"integrator": name, "order": 4, "step_s": 0.05, "tolerance": tolerance, "error": 1e-4}
    found = {
        "points": [{**point, "single_us": 1.0, "batch_us": 1.0}],
        "reference": [{"uncertainty": 1e-12, "duration_s": 3.0}],
    }
    own = short_scene.replace(simulation={"integrator": name})
    assert told in integrator_precision.section(own, found).notes[-1]


def test_steps_of_a_method_that_iterates_are_timed_at_each_length(precision: dict) -> None:
    def step_times(name: str) -> set[float]:
        points = [point for point in precision["points"] if point["integrator"] == name]
        return {round(point["single_us"] * point["step_s"], 12) for point in points}

    assert len(step_times("gauss6")) > 1 == len(step_times("rk4"))
    assert [name for name, entry in INTEGRATORS.items() if entry.iterates] == ["gauss6"]


def test_the_reference_is_more_precise_than_what_it_judges(precision: dict) -> None:
    assert precision["reference"][0]["uncertainty"] < 1e-11
    assert precision["reference"][0]["duration_s"] == pytest.approx(3.0)


def test_no_error_is_below_the_uncertainty_of_the_reference(precision: dict) -> None:
    """The method of order 8 in the steps of the reference would have no error at all."""
    uncertainty = precision["reference"][0]["uncertainty"]
    least = min(point["error"] for point in precision["points"] if point["error"] is not None)
    assert least == uncertainty > 0.0


def test_stiff_joints_get_a_stiff_reference(short_scene: Scene) -> None:
    (link,) = short_scene.links
    stiff = short_scene.replace(links=[link.model_copy(update={"stiffness": 1e9})])
    start = np.array(compile_scene(stiff).layout.initial_state)
    motion = Motion(stiff, start, np.tile([0.5, 0.3], (60, 1)))
    end, uncertainty = reference_end(motion)
    assert np.isfinite(end).all()
    assert uncertainty < 1e-9
    timed, _ = integrator_precision._along(motion, compile_scene(stiff), 8)
    assert np.isfinite(timed).all()


def test_a_reference_on_which_no_two_methods_agree_is_refused(
    short_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = np.array(compile_scene(short_scene).layout.initial_state)
    motion = Motion(short_scene, start, np.zeros((1, 2)))
    monkeypatch.setattr(Motion, "end", lambda *given: start)
    monkeypatch.setattr(integrator_precision, "tip_error", lambda *given: 1.5)
    with pytest.raises(ValueError, match="no two integrators follow"):
        reference_end(motion)


def test_integrators_follow_the_expert_through_phases() -> None:
    """What is caught weighs from then on, in shorter steps too."""
    scene = load_scene("capture-and-detumble")
    solution, motion = BoxDDP(scene, max_iterations=1).solve(), expert_motion(scene, 1)
    kernels, method = compile_scene(motion.scene), scene.simulation.integrator
    np.testing.assert_array_equal(motion.end(kernels, method, 1), solution.states[-1])
    assert tip_error(kernels, motion.end(kernels, method, 4), solution.states[-1]) < 1e-5


@pytest.mark.parametrize("joint", ["left hand", "right hand"])
def test_errors_are_those_of_every_tip(joint: str) -> None:
    kernels = compile_scene(load_scene("dual-arm"))
    x = np.array(kernels.layout.initial_state)
    moved = x.copy()
    moved[kernels.layout.state.names.index(f"{joint} angle")] += 1e-3
    assert tip_error(kernels, moved, x) == pytest.approx(1e-3, rel=1e-9)
    motion, still = np.stack([x, moved]), np.zeros((1, kernels.n_u))
    assert kernels.numerical_error(motion, still)[-1] == pytest.approx(1e-3, rel=1e-9)


def test_stiffness_ends_where_the_stability_polynomial_says(short_scene: Scene, limits: Limits) -> None:
    # The fastest vibration, from accelerations of the sprung arm slightly deflected.
    kernels, deflection = compile_scene(on_springs(short_scene)), 1e-6
    x = kernels.layout.initial_state.copy()
    x[kernels.layout.state.joint_angles] += deflection
    frequency = math.sqrt(-kernels.forward_dynamics(x, np.zeros(kernels.n_u))[-1] / deflection)
    for name, entry in INTEGRATORS.items():
        product = frequency * short_scene.simulation.dt * math.sqrt(limits[name, "stiffness"])
        if entry.is_stiff:
            assert product > 100.0, name
        else:
            assert product == pytest.approx(entry.imaginary_interval, rel=0.06), name


def test_spherical_joints_are_on_no_springs() -> None:
    """Their coordinates are a quaternion: three degrees of freedom, four numbers."""
    scene = load_scene("heavy-wrist")
    sprung = on_springs(scene)
    assert [link.stiffness for link in sprung.links] == [1.0, 1.0, 1.0, 0.0]
    assert [link.rest_angle for link in sprung.links] == [-0.6, 0.9, -1.6, 0.0]
    assert not any(link.damping for link in sprung.links)
    assert stability_envelope._sprung_coordinates(scene) == [0, 1, 2]
    holds = stability_envelope._vibration(scene)
    assert holds("rk4", 1.0)
    assert not holds("rk4", 1e7)


def test_integrators_that_do_not_take_the_scene_are_left_out_and_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene, able = load_scene("heavy-wrist"), ["rk4", "rk6", "rk8", "dormand_prince"]
    variants = integrator_precision._variants(scene)
    assert list(dict.fromkeys(name for name, _, _ in variants)) == able
    for motion in ("_slow_motion", "_fast_motion", "_vibration"):
        monkeypatch.setattr(stability_envelope, motion, lambda scene: lambda integrator, value: True)
    found = stability_envelope.measure(scene, EFFORT, announce)
    assert list(dict.fromkeys(row["integrator"] for row in found["envelope"])) == able
    monkeypatch.setattr(Section, "add_figure", lambda *given: None)
    assert "symplectic_euler, rodas4, rodas5p" in stability_envelope.section(scene, found).notes[-1]
    assert integrator_precision.left_out(load_scene("paper")) == []


@pytest.mark.parametrize("name", ["motors", "elastic-joints", "wheels"])
def test_swings_have_no_time_constant_but_that_of_the_springs(name: str) -> None:
    """The search varies steps in place of stiffness: friction, elastic gears and wheels must be out of it."""
    scene, ends = load_scene(name), []
    if name == "wheels":
        scene = scene.replace(initial_state={"wheel_speeds": [380.0] * 4})
    sprung, dt = on_springs(scene), 0.05
    for ratio in (1.0, 4.0):
        links = [link.model_copy(update={"stiffness": ratio * link.stiffness}) for link in sprung.links]
        kernels = compile_scene(sprung.replace(links=links))
        x, joints = stability_envelope._deflected(kernels)
        steps = kernels.simulate(x, np.zeros(kernels.n_u), 100, dt / math.sqrt(ratio), "rk4")
        ends.append(steps[:, joints] - x[joints])
    assert np.abs(ends[0]).max() > 0.5 * stability_envelope.DEFLECTION
    np.testing.assert_allclose(ends[1], ends[0], rtol=0.0, atol=1e-12)


def test_higher_order_holds_longer_steps_and_slow_motions(short_scene: Scene, limits: Limits) -> None:
    """Without springs only rate times step counts; the steps of a motion are whole."""
    steps = [limits[name, "step"] for name in ("symplectic_euler", "rk4", "rk8")]
    assert steps == sorted(steps)
    for name in ("symplectic_euler", "rk4"):
        turned = limits[name, "rate"] * short_scene.simulation.dt
        assert turned == pytest.approx(SLOW * limits[name, "step"], rel=0.35), name


def test_search_finds_a_limit_between_its_ends() -> None:
    assert largest(lambda value: value < 123.0, 1.0, 1e-6, 1e6, 1.01) == pytest.approx(123.0, rel=0.01)
    assert largest(lambda value: value < 1e-3, 1.0, 1e-6, 1e6, 1.01) == pytest.approx(1e-3, rel=0.01)
    assert largest(lambda value: True, 1.0, 1e-6, 1e6, 1.01) == 1e6
    assert largest(lambda value: False, 1.0, 1e-6, 1e6, 1.01) == 0.0


def test_parts_that_are_left_out_cost_nothing(spread_scene: Scene) -> None:
    single = spread_scene.replace(simulation={"dt": 0.05, "steps": 60, "precision": "float32"})
    rows = {row["part"]: row for row in part_costs.measure(single, EFFORT, announce)["parts"]}
    whole = rows["short, as it is"]
    assert whole["operations_ratio"] == whole["time_ratio"] == 1.0
    assert whole["states"] == compile_scene(spread_scene).n_x
    # Starts are drawn in resets, not in steps.
    assert rows["without random starts"]["step_operations"] == whole["step_operations"]
    fewer = rows["without joint torques"]
    assert fewer["inputs"] == whole["inputs"] - 1
    assert fewer["step_operations"] < whole["step_operations"]


@pytest.fixture
def drawing(spread_scene: Scene) -> Scene:
    """Draws target and masses as well."""
    return spread_scene.replace(spread={"target_position": 0.02, "link_masses": 0.2})


def test_a_timed_step_is_that_of_the_kernels(drawing: Scene) -> None:
    kernels = compile_scene(drawing)
    states, controls = part_costs.moving_states(kernels, 3)
    call = step_call(kernels, "rk4", states, controls, 0.05)
    call(len(states))
    found = call._kept[-1]
    np.testing.assert_allclose(found, kernels.step(states, controls, 0.05, "rk4"), rtol=1e-12, atol=1e-14)


def test_starts_are_those_of_the_seeds(drawing: Scene) -> None:
    rows = expert_trials.measure(drawing, EFFORT, announce)["starts"]
    env = DQSpaceArmEnv(drawing)
    env.reset(seed=2)
    expected = GuidedDDP(drawing).solve(np.asarray(env.state), parameters=env.parameters)
    assert [row["seed"] for row in rows] == [0, 1, 2]
    assert rows[2]["cost"] == pytest.approx(expected.cost, rel=1e-9)
    assert all(row["converged"] and row["success"] for row in rows)


def test_a_start_that_is_led_to_the_target_compiles_nothing(
    spread_scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its seconds are those of the solve."""
    loaded, load, solve = [], KernelLibrary._load, expert_trials.solve_episode

    def loading(library: KernelLibrary, name: str, *others: Any) -> Any:
        loaded.append(name)
        return load(library, name, *others)

    def led(*given: Any) -> Row:
        monkeypatch.setattr(ArmProblem, "is_success", lambda *given: False)
        loaded.clear()
        return solve(*given)

    monkeypatch.setattr(KernelLibrary, "_load", loading)
    monkeypatch.setattr(expert_trials, "solve_episode", led)
    own = spread_scene.replace(simulation={"steps": 48})  # of which no other test has kernels
    expert_trials.measure(own, Effort(starts=1), announce)
    of_the_row = {"tip_errors"}  # after the solve, unless the preparation was not kept
    assert {name for name in loaded if not name.startswith("environment_")} <= of_the_row


def test_success_is_that_of_the_environment_where_the_target_moves(short_scene: Scene) -> None:
    """Errors are those at the end, to where the target is then; tolerances of velocities count."""
    motion = {"kind": "screw", "linear_velocity": [0.1, 0.0, 0.0]}
    wide = {"attitude_error_deg": 30.0, "position_error": 0.5}
    moving = short_scene.replace(target={"motion": motion}, success=wide)
    expert, env = GuidedDDP(moving), DQSpaceArmEnv(moving)
    row = expert_trials.solve_episode(expert, env, 0)
    planned = expert.solve(np.asarray(env.state))
    kernels = compile_scene(moving)
    errors = kernels.tip_errors(planned.states[-1], p=kernels.stage_parameters()[-1])
    assert [row["attitude_error_deg"], row["position_error_m"]] == pytest.approx(errors[:2].tolist())
    strict = moving.replace(success={"velocity_error": 0.5 * float(errors[3])})
    assert row["success"]
    assert not expert_trials.solve_episode(GuidedDDP(strict, reach_target=False), env, 0)["success"]


def test_a_missed_catch_is_no_success(monkeypatch: pytest.MonkeyPatch) -> None:
    expert = GuidedDDP("capture-and-detumble", library=[], screw_motion=False, coarsening=1, max_iterations=0)
    monkeypatch.setattr(ArmProblem, "misses", lambda *given: 0.0)  # the tip ends within the tolerances
    env = DQSpaceArmEnv("capture-and-detumble")
    assert not expert_trials.solve_episode(expert, env, 0)["success"]


def test_starts_that_fail_are_listed_by_seed(spread_scene: Scene) -> None:
    rows = expert_trials.measure(spread_scene, Effort(starts=2, max_iterations=1), announce)["starts"]
    section = expert_trials.section(spread_scene, {"starts": rows})
    assert section.record["shares"] == [{"starts": 2, "converged": 0.0, "success": 0.0}]
    assert [row["seed"] for row in section.record["failed"]] == [0, 1]


def test_a_start_that_diverges_has_no_cost_in_the_distributions(short_scene: Scene) -> None:
    good = {"seed": 0, "converged": True, "success": True, "iterations": 3, "long_step_iterations": 5}
    good |= {"seconds": 0.1, "cost": 7.0, "attitude_error_deg": 0.1, "position_error_m": 0.01}
    lost = {**good, "seed": 1, "converged": False, "success": False, "cost": math.inf}
    lost |= {"attitude_error_deg": math.nan, "position_error_m": math.nan}
    for starts, median in (([good, lost], 7.0), ([lost], None)):
        section = expert_trials.section(short_scene, json_value({"starts": starts}))
        cost = next(row for row in section.record["quantiles"] if row["quantity"] == "cost")
        assert cost["median"] == cost["most"] == median
        assert [row["seed"] for row in section.record["failed"]] == [1]


def test_a_scene_without_spread_is_solved_once(short_scene: Scene) -> None:
    told: list[tuple[int, int]] = []
    found = expert_trials.measure(short_scene, EFFORT, lambda what, done, total: told.append((done, total)))
    assert told == [(0, 2), (1, 2)]  # the nominal maneuver, and the only start
    assert len(found["starts"]) == 1
    assert "draws no starts" in expert_trials.section(short_scene, found).notes[0]


class MadeUpPart:
    """Counts how often it is measured; interrupts the first time if told to."""

    def __init__(self, interrupts: bool = False) -> None:
        self.measured, self._interrupts = 0, interrupts

    def measure(self, scene: Scene, effort: Effort, announce: Announce) -> dict[str, list[Row]]:
        announce("something", 0, 1)
        self.measured += 1
        if self._interrupts and self.measured == 1:
            raise KeyboardInterrupt
        return {"rows": [{"scene": scene.name, "error": float("nan")}]}

    def section(self, scene: Scene, found: dict[str, list[Row]]) -> Section:
        made = Section("made up", "Made up", "Nothing.")
        made.add_rows("table", found["rows"])
        return made


def test_an_interrupted_report_keeps_its_parts_and_resumes(
    short_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = MadeUpPart(), MadeUpPart(interrupts=True)
    monkeypatch.setattr(scene_report, "PARTS", {"first": first, "second": second})
    with pytest.raises(KeyboardInterrupt):
        scene_report.report(short_scene, tmp_path, Console(), quick=True)
    assert "Made up" in (tmp_path / "report.html").read_text()
    file, console = tmp_path / "report.json", Console(record=True, width=110)
    interrupted = file.read_text()
    scene_report.report(short_scene, tmp_path, console, quick=True)
    assert "Resuming: first" in console.export_text()
    assert (first.measured, second.measured) == (1, 2)
    # What is damaged is measured again.
    file.write_text(interrupted.replace('"rows"', '"row"'))
    scene_report.report(short_scene, tmp_path, console, quick=True)
    assert "first: the kept rows are damaged, and measured again" in console.export_text()
    assert (first.measured, second.measured) == (2, 3)
    # A finished report, and one of another scene or effort, is measured anew.
    for scene, quick in (
        (short_scene, True),
        (short_scene.replace(name="other"), True),
        (short_scene, False),
    ):
        before = first.measured
        page = scene_report.report(scene, tmp_path, Console(), quick=quick)
        assert first.measured == before + 1
    record = json.loads((tmp_path / "report.json").read_text())
    assert record["request"]["quick"] is False
    assert record["parts"]["first"]["rows"] == [{"scene": "short", "error": None}]
    assert page.shortcomings == []


def test_an_interrupt_before_the_first_part_does_not_promise_to_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    second = MadeUpPart()
    for parts in ({"first": MadeUpPart(interrupts=True)}, {"a": second, "b": MadeUpPart(interrupts=True)}):
        monkeypatch.setattr(scene_report, "PARTS", parts)
        assert main(["report", "planar", "--out", str(tmp_path / "rep")]) == 130
        said = " ".join(capsys.readouterr().err.split())
        kept = "the finished parts are in" if second.measured else "no part is finished, and nothing is saved"
        assert f"Interrupted: {kept}" in said


def test_an_interrupted_resumption_keeps_the_parts_that_it_found(
    short_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = {"first": MadeUpPart(), "second": MadeUpPart(), "third": MadeUpPart(interrupts=True)}
    monkeypatch.setattr(scene_report, "PARTS", parts)
    with pytest.raises(KeyboardInterrupt):
        scene_report.report(short_scene, tmp_path, Console(), quick=True)

    def interrupted(*given: object) -> Section:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(parts["second"], "section", interrupted)
        with pytest.raises(KeyboardInterrupt):
            scene_report.report(short_scene, tmp_path, Console(), quick=True)
    page = scene_report.report(short_scene, tmp_path, Console(), quick=True)
    assert [part.measured for part in parts.values()] == [1, 1, 2]
    assert [section.name for section in page.sections] == list(parts)


@pytest.mark.parametrize("changed", ["machine", "source"])
def test_times_of_another_machine_or_source_are_not_kept(
    short_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changed: str
) -> None:
    """A changed file of a checkout that was changed before leaves its commit as it is."""
    parts = {"first": MadeUpPart(), "second": MadeUpPart(interrupts=True)}
    monkeypatch.setattr(scene_report, "PARTS", parts)
    with pytest.raises(KeyboardInterrupt):
        scene_report.report(short_scene, tmp_path, Console(), quick=True)
    origin = scene_report.provenance()
    elsewhere = {**origin, "machine": {**origin["machine"], "processor_name": "another"}}
    if changed == "machine":
        monkeypatch.setattr(scene_report, "provenance", lambda: elsewhere)
    else:
        monkeypatch.setattr(scene_report, "source_hash", lambda without: "changed")
    scene_report.report(short_scene, tmp_path, Console(), quick=True)
    assert [part.measured for part in parts.values()] == [2, 2]


def test_a_part_that_refuses_the_scene_says_so(
    short_scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(scene_report, "PARTS", {"expert": expert_trials})
    actuators = {"base_torque": {"limit": math.inf}, "joint_torque": {"limit": 0.5}}
    endless = short_scene.replace(actuators=actuators)
    page = scene_report.report(endless, tmp_path, Console(), quick=True)
    assert "finite limit" in page.shortcomings[0]
    assert "finite limit" in (tmp_path / "report.md").read_text()
    file = tmp_path / "endless.yaml"
    endless.to_yaml(file)
    capsys.readouterr()
    assert main(["report", str(file), "--quick", "--out", str(tmp_path)]) == 1
    said = " ".join(capsys.readouterr().out.split())
    assert "expert: NOT measured: " in said
    assert "measured in" not in said
    assert "Exit status 1: expert is not measured: " in said
    monkeypatch.delenv("COLUMNS", raising=False)
    assert main(["report", str(file), "--quick", "--out", str(tmp_path), "--json"]) == 1
    assert 80 < max(map(len, capsys.readouterr().err.splitlines())) <= 110  # as tables of other verbs
    assert main(["report", "paper", "--out", "/dev/null/report"]) == 2
