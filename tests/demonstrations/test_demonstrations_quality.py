"""Only what is optimal, successful and true to the environment is a demonstration."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from demonstration_files import solved_problems

from dq_space_arm_env import Scene
from dq_space_arm_env.environment.rollouts import Rollout
from experts import BoxDDP, StopReason, generate_demonstrations
from experts.demonstrations import Demonstrations, SerialExecutor, shard
from experts.demonstrations.outcomes import (
    MISSED_TARGET,
    NEIGHBOR,
    Expert,
    Outcome,
    find_better_ways,
    solve_again,
)
from experts.demonstrations.settings import Settings
from experts.demonstrations.shard import Task, draw_starts, make_shard, replay
from experts.problems.shooting_problem import FloatArray


@pytest.fixture
def solved(quick_scene: Scene) -> tuple[Expert, list[Outcome]]:
    return solved_problems(Settings.of(quick_scene, 16, 3, 16))


def spoil(expert: Expert, outcome: Outcome) -> Outcome:
    """Solve from zero controls with long first steps, which wind the joints up."""
    solution = BoxDDP(expert.problem, initial_regularization=1.0).solve(outcome.start)
    success = solution.converged and expert.problem.is_success(solution.states, solution.controls)
    reason = StopReason.CONVERGED.value if success else MISSED_TARGET
    return replace(outcome, solution=solution, guess="zero controls", reason=reason)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("position", "is_demonstration", "excess"), [(1, True, 0.002), (5, False, 2.0)], ids=["poor", "failed"]
)
def test_a_poor_minimum_is_found_out_by_its_neighbors_and_solved_again(
    solved: tuple[Expert, list[Outcome]], position: int, is_demonstration: bool, excess: float
):
    expert, outcomes = solved
    cost = outcomes[position].solution.cost
    outcomes[position] = spoiled = spoil(expert, outcomes[position])
    assert spoiled.is_good == is_demonstration
    assert spoiled.solution.cost > (1.0 + excess) * cost
    retries = find_better_ways(expert, outcomes)
    assert position in [retry.position for retry in retries]
    solve_again(expert, outcomes, retries)
    assert outcomes[position].is_good
    assert outcomes[position].guess == NEIGHBOR
    assert outcomes[position].solution.cost == pytest.approx(cost, rel=1e-6)


@pytest.mark.slow
def test_a_second_solve_never_makes_anything_worse(solved: tuple[Expert, list[Outcome]]):
    expert, outcomes = solved
    before = list(outcomes)
    retries = find_better_ways(expert, outcomes)
    solve_again(expert, outcomes, retries)
    assert retries
    for old, new in zip(before, outcomes, strict=True):
        assert new is old or (new.is_good and (new.solution.cost < old.solution.cost or not old.is_good))


@pytest.fixture(scope="module")
def hard(quick_scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Demonstrations:
    """Starts so far away that not every one is solved."""
    scene = quick_scene.replace(spread={"base_position": 1.5})
    made = generate_demonstrations(
        scene, 8, tmp_path_factory.mktemp("hard"), shard_size=8, executor=SerialExecutor()
    )
    assert made is not None
    return made


@pytest.mark.slow
def test_failures_are_recorded_and_never_mixed_in(hard: Demonstrations):
    failures = hard.failures()
    assert len(hard) + len(failures["index"]) == 8
    assert "missed_target" in failures["reason"]
    assert hard.manifest["failures"] == Counter(failures["reason"].tolist())
    assert set(failures) == {"index", "seed", "cost", "start", "final_errors", "reason"}
    assert not set(failures["index"]) & set(hard.column("index"))
    success = hard.scene.success
    attitude, position = hard.column("final_errors").T
    assert (attitude <= success.attitude_error_deg).all()
    assert (position <= success.position_error).all()
    angle, distance = failures["final_errors"][list(failures["reason"]).index("missed_target")]
    assert angle > success.attitude_error_deg or distance > success.position_error
    starts = draw_starts(hard.scene, failures["seed"].tolist())
    np.testing.assert_array_equal(failures["start"], starts.states)


def test_what_the_environment_charges_otherwise_is_a_failure(
    quick_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    settings = Settings.of(quick_scene, 3, 0, 3)
    odd = settings.problem_seed(1)

    def cheat(scene: Scene, seeds: list[int], actions: FloatArray) -> Rollout:
        episodes = replay(scene, seeds, actions)
        if odd in seeds:
            episodes.rewards[seeds.index(odd), 10] *= 1.0 + 1e-5
        return episodes

    honest = make_shard(Task(settings, 0))
    monkeypatch.setattr(shard, "replay", cheat)
    assert (honest.demonstrations, honest.failures) == (3, 0)
    made = generate_demonstrations(settings.scene, 3, tmp_path, shard_size=3, executor=SerialExecutor())
    assert made is not None
    assert made.column("index").tolist() == [0, 2]
    assert made.failures()["reason"].tolist() == ["replay_differs"]


def test_a_shard_may_have_no_demonstration(
    quick_scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(shard, "REPLAY_TOLERANCE", -1.0)
    made = generate_demonstrations(quick_scene, 4, tmp_path, shard_size=2, executor=SerialExecutor())
    assert made is not None
    assert len(made) == 0
    assert made.column("cost").shape == (0,)
    assert made.failures()["index"].tolist() == [0, 1, 2, 3]
    assert list(made.batches(10)) == []
