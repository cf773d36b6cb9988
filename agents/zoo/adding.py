"""Adding a policy to the zoo: its weights, the record of its evaluation, and the card that follows from both.

The record has

| key | value |
|---|---|
| `scene` | name of the scene, one that ships with the package |
| `physics` | hash of what a policy flies in, see `agents.evaluation.conditions.physics_hash` |
| `success` | tolerances of the scene |
| `sha256`, `bytes` | of the file of weights |
| `training_command` | the command that trains it |
| `trained_here` | whether it was trained in the very scene that it was evaluated in; None if nobody knows |
| `evaluations` | a summary for each condition, see `Evaluation.summary`, "training" first |
| `seeds`, `is_success` | of the first flights of "training", one by one, to be repeated by tests |
| `versions`, `processor`, `date` | of the evaluation |
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from agents.evaluation.conditions import CONDITIONS, physics_hash
from agents.evaluation.evaluating import Advance, Evaluation, evaluate
from agents.evaluation.expert_costs import EVALUATION_SEEDS
from agents.evaluation.policies import policy_path
from agents.evaluation.runs import training_command
from agents.policies import ExportedPolicy
from agents.zoo.cards import card
from agents.zoo.shelf import MOST_BYTES, SHELF, ZooError, file_hash, list_policies
from dq_space_arm_env import Scene, list_scenes, load_scene
from experts.demonstrations.executors import Executor
from experts.files import write_atomically
from experts.report.provenance import provenance

REPEATED = 32
"""Flights whose seeds and ends a record keeps."""
_VERSIONS = ("dq-space-arm", "numpy", "python")


def add_to_zoo(
    run: str | Path,
    name: str | None = None,
    *,
    conditions: Sequence[str] = CONDITIONS,
    n: int = EVALUATION_SEEDS,
    training: str | None = None,
    shelf: Path = SHELF,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Path:
    """Evaluate a policy, and put it into the zoo with its card; one of the same name is replaced.

    Args:
        run: Folder of a training run, or an exported policy in it.
        name: Name in the zoo; the agent's by default.
        conditions: What to evaluate it under; "training" is always the first.
        n: Number of evaluation starts, the first ones of the 500.
        training: The command that trains it, where it does not follow from a configuration that ships with
            the package.
        shelf: Folder of the zoo.
        workers: Number of processes of the expert; one for each processor by default.
        executor: Who solves, in place of processes.
        progress: Called now and then.

    Returns:
        The card.

    Raises:
        ZooError: If the name is none, the scene does not ship with the package, nobody knows how the policy
            was trained, or the zoo would become too large.
        PolicyError, PolicyFileError: If the policy cannot be read, or does not fit its scene.
        ValueError: If n or a condition is out of range.
        DemonstrationsError: If processes of the expert are killed again and again.
        KeyboardInterrupt: If the user interrupts it; the zoo is as before.
        OSError: If the folder cannot be written.
    """
    file = policy_path(run)
    policy, content = ExportedPolicy.load(file), file.read_bytes()
    chosen = name or str(policy.metadata.get("agent", ""))
    command = training or training_command(policy.metadata)
    scene = _checked(policy, file, chosen, command, shelf)
    assert command is not None
    ordered = ["training", *(condition for condition in conditions if condition != "training")]
    evaluations = [
        evaluate(
            policy,
            scene,
            n,
            condition=condition,
            label=chosen,
            workers=workers,
            executor=executor,
            progress=lambda advance, condition=condition: progress(  # type: ignore[misc]
                advance._replace(stage=f"{condition}: {advance.stage}")
            ),
        )
        for condition in ordered
    ]
    shelf.mkdir(parents=True, exist_ok=True)
    weights = shelf / f"{chosen}.npz"
    write_atomically(weights, content)  # what was evaluated, whatever is in the file by now
    record = _record(scene, weights, command, evaluations)
    write_atomically(weights.with_suffix(".json"), json.dumps(record, indent=1, allow_nan=False) + "\n")
    write_atomically(weights.with_suffix(".md"), card(chosen, policy, record))
    return weights.with_suffix(".md")


def _checked(policy: ExportedPolicy, file: Path, name: str, command: str | None, shelf: Path) -> Scene:
    """The scene of a policy that the zoo can take."""
    if not re.fullmatch(r"[a-z0-9][a-z0-9-]*", name):
        raise ZooError(f"name: {name!r}, should be of lower-case letters, digits and hyphens, such as 'ppo'")
    scene = policy.metadata.get("scene")
    if scene not in list_scenes():
        raise ZooError(
            f"{file} was trained for scene {scene!r}, which does not ship with the package; the zoo has "
            f"policies for {', '.join(list_scenes())}"
        )
    if command is None:
        raise ZooError(
            f"{file} does not follow from a configuration that ships with the package, so nobody could train "
            "it again: put its configuration into configs/agents, under the name of the agent, or give the "
            "command that trains it"
        )
    others = sum((shelf / f"{other}.npz").stat().st_size for other in list_policies(shelf) if other != name)
    size = file.stat().st_size
    if others + size > MOST_BYTES:
        raise ZooError(
            f"{file} has {size:,} bytes, and the zoo {others:,} without it: together they should be at most "
            f"{MOST_BYTES:,}"
        )
    return load_scene(scene)


def _record(scene: Scene, weights: Path, command: str, evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    first, origin = evaluations[0], provenance()
    return {
        "scene": scene.name,
        "physics": physics_hash(scene),
        "success": scene.success.model_dump(),
        "sha256": file_hash(weights),
        "bytes": weights.stat().st_size,
        "training_command": command,
        "trained_here": first.same_scene,
        "evaluations": [_rounded(evaluation.summary()) for evaluation in evaluations],
        "seeds": first.seeds[:REPEATED].tolist(),
        "is_success": first.flights.is_success[:REPEATED].tolist(),
        "versions": {package: origin["versions"][package] for package in _VERSIONS},
        "processor": origin["machine"]["processor_name"],
        "date": origin["date"],
    }


def _rounded(value: Any) -> Any:
    """Numbers with as many digits as a reader could want."""
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
