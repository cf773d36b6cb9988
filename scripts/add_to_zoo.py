"""Put a trained policy into the zoo: its weights, the record of its evaluation, and its model card.

The policy flies the 500 evaluation starts under all conditions; the card follows from the policy's file and
this record alone, so that it cannot go stale or be embellished. The record (`<name>.json`) has

| key | value |
|---|---|
| `scene` | name of a scene that ships with the package |
| `physics` | hash of the dynamics, see `agents.evaluation.conditions.physics_hash` |
| `success` | tolerances of the scene |
| `sha256`, `bytes` | of the file of weights |
| `training_command` | the command that trains it |
| `trained_here` | whether it was trained in the very scene it was evaluated in; null if unknown |
| `evaluations` | a summary per condition, see `Evaluation.summary`, "training" first |
| `elsewhere` | `scene`, `episodes` and `success_rate` in other scenes, if there are any (`--also`) |
| `seeds`, `is_success` | the first flights of "training", one by one, which the tests repeat |
| `versions`, `processor`, `date` | of the evaluation |
"""

from __future__ import annotations

import argparse
import hashlib
import json
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any

from rich.console import Console

from agents.evaluation.conditions import CONDITIONS, physics_hash, scene_under
from agents.evaluation.evaluating import Advance, Evaluation, evaluate
from agents.evaluation.evaluation_verbs import progress_bar
from agents.evaluation.expert_costs import EVALUATION_SEEDS
from agents.evaluation.training_runs import training_command
from agents.policies import ExportedPolicy, PolicyFileError
from agents.policies.policy_files import noted_effort
from agents.zoo.finding import as_policy, check_fit, policy_path
from agents.zoo.shelf import MOST_BYTES, SHELF, ZooError, list_policies
from dq_space_arm_env import Scene, list_scenes, load_scene
from dq_space_arm_env.command_line.verb_program import run_to_end
from dq_space_arm_env.common.console import FAILURE, SUCCESS, complain
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.provenance import provenance
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.common.tables import TextTable
from dq_space_arm_env.validation import dump_yaml
from experts.demonstrations import DemonstrationsError
from experts.executors import Executor

REPEATED = 32  # flights whose seeds and results a record keeps
_ELSEWHERE = ("scene", "episodes", "success_rate")
_VERSIONS = ("dq-space-arm", "numpy", "python")


def add_to_zoo(
    run: str | Path,
    name: str | None = None,
    *,
    conditions: Sequence[str] = CONDITIONS,
    n: int = EVALUATION_SEEDS,
    also: Sequence[str] = (),
    training: str | None = None,
    shelf: Path = SHELF,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[Advance], None] = lambda advance: None,
) -> Path:
    """Evaluate a policy and put it into the zoo with its card, which is returned; replaces one of that name.

    Condition "training" always comes first; `also` are further scenes to fly it in. `training` is the
    command that trains it, needed if it does not follow from a shipped configuration.
    """
    file = policy_path(run)
    policy, content = ExportedPolicy.load(file), file.read_bytes()
    chosen = name or str(policy.metadata.get("agent", ""))
    command = training or training_command(policy.metadata)
    scene = _checked(policy, file, chosen, command, shelf)
    assert command is not None
    others = [load_scene(other) for other in also]
    for other in others:  # before hours of flights
        check_fit(as_policy(policy), other)
    ordered = ["training", *(condition for condition in conditions if condition != "training")]
    for condition in ordered:
        scene_under(scene, condition)  # likewise
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
    elsewhere = [evaluate(policy, other, n, label=chosen, expert=False).summary() for other in others]
    record = _record(scene, content, command, evaluations)
    told = [{key: summary[key] for key in _ELSEWHERE} for summary in elsewhere]
    record |= {"elsewhere": _rounded(told)} if told else {}
    # All are made before the first is written: a shelf has what belongs together.
    text, described = json.dumps(record, indent=1, allow_nan=False) + "\n", card(chosen, policy, record)
    shelf.mkdir(parents=True, exist_ok=True)
    weights = shelf / f"{chosen}.npz"
    write_atomically(weights, content)  # as evaluated, even if the file changed since
    write_atomically(weights.with_suffix(".json"), text)
    write_atomically(weights.with_suffix(".md"), described)
    return weights.with_suffix(".md")


def _checked(policy: ExportedPolicy, file: Path, name: str, command: str | None, shelf: Path) -> Scene:
    """Refuse a policy that the zoo cannot take; return its scene."""
    if not re.fullmatch(r"[a-z0-9][a-z0-9-]*", name):
        raise ZooError(f"name: {name!r}, should be of lower-case letters, digits and hyphens, such as 'ppo'")
    scene = policy.metadata.get("scene")
    if scene not in list_scenes():
        raise ZooError(
            f"{file} was trained for scene {scene!r}, which does not ship with the package; the zoo takes "
            f"policies for {', '.join(list_scenes())}"
        )
    if command is None:
        raise ZooError(
            f"{file} does not follow from a configuration of the package, so nobody could reproduce it: put "
            "it into configs/agents under the agent's name, or give the command that trains it"
        )
    _check_told(policy.metadata, file)
    others = sum((shelf / f"{other}.npz").stat().st_size for other in list_policies(shelf) if other != name)
    size = file.stat().st_size
    if others + size > MOST_BYTES:
        raise ZooError(
            f"{file} has {size:,} bytes, and the zoo {others:,} without it: together they should be at most "
            f"{MOST_BYTES:,}"
        )
    return load_scene(scene)


def _check_told(metadata: Mapping[str, Any], file: Path) -> None:
    """Refuse metadata that the card cannot tell."""
    origin = metadata.get("provenance", {})
    told = {"configuration": metadata.get("configuration", {}), "provenance": origin}
    if isinstance(origin, Mapping):
        told |= {f"provenance.{name}": origin.get(name) or {} for name in ("commit", "versions")}
    for name, value in told.items():
        if not isinstance(value, Mapping):
            raise ZooError(f"{file}: metadata: {name}: {shortened(value)}, should be a mapping, or left out")


def _record(scene: Scene, content: bytes, command: str, evaluations: Sequence[Evaluation]) -> dict[str, Any]:
    first, origin = evaluations[0], provenance()
    return {
        "scene": scene.name,
        "physics": physics_hash(scene),
        "success": scene.success.model_dump(),
        "sha256": hashlib.sha256(content).hexdigest(),
        "bytes": len(content),
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
    """Round numbers to six digits."""
    if isinstance(value, dict):
        return {key: _rounded(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_rounded(entry) for entry in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


_TEMPLATE = Template("""\
# $name

$description

It flies the scene `$scene` of `DQSpaceArm-v0`, with NumPy alone:

```python
from agents.zoo import load_policy

policy = load_policy("$name")
action = policy(observation)
```

$facts

## Training

```bash
$training
```

$effort

<details><summary>The configuration</summary>

```yaml
$configuration
```

</details>

## Evaluation

$evaluation

Success: the tip ends within $angle° and $distance m of its target. Cost gap: J / J_expert - 1, with the
optimum in the scene flown; median and 95th percentile. The other columns are medians. Brackets: 95 %
intervals. The protocol forbids tuning on these starts.

```bash
$again
```

## Limits

$limits
""")
_MEANINGS = {
    "training": "as in training",
    "wide_starts": "starts spread 1.5 times as far",
    "light_payload": "last link or payload 30 % lighter",
    "heavy_payload": "last link or payload 30 % heavier",
    "spin": "base turning at the start",
    "delay": "actions 0.15 s late",
    "noise": "noise of 0.01 rad, m, rad/s, m/s on what is measured",
    "push": "three pushes of 0.05 rad/s and 0.05 m/s",
}


def card(name: str, policy: ExportedPolicy, record: Mapping[str, Any]) -> str:
    """Write the card of a policy, Markdown."""
    metadata = policy.metadata
    configuration = metadata.get("configuration", {})
    success = record["success"]
    conditions = " ".join(summary["condition"] for summary in record["evaluations"])
    starts = record["evaluations"][0]["episodes"]
    return _TEMPLATE.substitute(
        name=name,
        description=configuration.get("description") or f"The agent {metadata.get('agent', name)}.",
        scene=record["scene"],
        facts="\n\n".join(_facts(policy, record).markdown()),
        training=record["training_command"],
        effort=_effort(noted_effort(metadata)),
        configuration=dump_yaml(dict(configuration), "").strip(),
        evaluation="\n\n".join(_table(record).markdown()),
        angle=f"{success['attitude_error_deg']:g}",
        distance=f"{success['position_error']:g}",
        again=f"dq-space-arm evaluate {name} --scene {record['scene']} -n {starts} --condition {conditions}",
        limits="\n".join(f"- {sentence}" for sentence in _limits(name, record)),
    )


def _facts(policy: ExportedPolicy, record: Mapping[str, Any]) -> TextTable:
    sizes = [policy.n_observation, *(len(bias) for bias in policy.biases)]
    parameters = sum(array.size for array in (*policy.weights, *policy.biases))
    origin = policy.metadata.get("provenance", {})
    versions = {**record["versions"], **_trained_with(origin)}
    commit = (origin.get("commit") or {}).get("hash", "unknown")
    rows = (
        (
            "network",
            f"{' - '.join(map(str, sizes))}, {policy.activation}; {parameters:,} parameters, float32",
        ),
        ("file", f"{record['bytes']:,} bytes, SHA-256 {record['sha256']}"),
        ("time per action", f"{1e6 * _first(record)['action_seconds']:.0f} us on {record['processor']}"),
        ("trained at commit", commit),
        ("versions", ", ".join(f"{package} {version}" for package, version in sorted(versions.items()))),
    )
    return TextTable("The file", ("", ""), rows)


def _trained_with(origin: Mapping[str, Any]) -> dict[str, str]:
    names = ("sb3-contrib", "stable-baselines3", "torch")
    versions = origin.get("versions") or {}
    return {name: versions[name] for name in names if versions.get(name)}


def _effort(training: Mapping[str, Any]) -> str:
    """The training effort in a sentence."""
    parts = []
    if training.get("environment_steps"):
        parts.append(f"{training['environment_steps']:,} environment steps")
    if training.get("updates"):
        parts.append(f"{training['updates']:,} updates")
    if training.get("expert_solves"):
        parts.append(f"{training['expert_solves']:,} problems solved by the expert")
    if training.get("seconds"):
        parts.append(f"{training['seconds'] / 60.0:.1f} minutes")
    return f"Training took {', '.join(parts)}." if parts else "The training effort was not recorded."


def _table(record: Mapping[str, Any]) -> TextTable:
    headings = (
        "condition",
        "success [%]",
        "cost gap [%]",
        "95th percentile [%]",
        "angle [deg]",
        "distance [m]",
        "effort",
        "base turn [deg]",
    )
    rows = tuple(
        (
            _MEANINGS.get(summary["condition"], summary["condition"]),
            _percent(summary["success_rate"]),
            _percent(summary["median_cost_gap"]),
            _percent(summary["tail_cost_gap"]),
            f"{summary['attitude_error']:.2f}",
            f"{summary['position_error']:.3f}",
            f"{summary['effort']:.3g}",
            f"{summary['base_turn']:.1f}",
        )
        for summary in record["evaluations"]
    )
    starts = _first(record)["episodes"]
    return TextTable(
        f"The first {starts} evaluation starts of scene {record['scene']}", headings, rows, right=1
    )


_NOT_FLOWN = {"delay": "delays", "noise": "sensor noise", "push": "pushes"}


def _limits(name: str, record: Mapping[str, Any]) -> Iterator[str]:
    """Limits that the evaluation shows."""
    yield (
        f"It knows only the robot and the maneuver of scene `{record['scene']}`: another robot or time step "
        "is another task. It sees the target relative to the tip alone: base and target may be "
        "anywhere together."
    )
    for summary in record.get("elsewhere", ()):
        rate, command = _percent(summary["success_rate"]), f"dq-space-arm evaluate {name} --scene"
        yield f"In scene `{summary['scene']}` {rate} % succeed: `{command} {summary['scene']}`."
    training = _first(record)["success_rate"][0]
    worst = min(record["evaluations"], key=lambda summary: summary["success_rate"][0])
    if worst["success_rate"][0] < training:
        rate = _percent(worst["success_rate"])
        yield f"Its worst condition is: {_MEANINGS[worst['condition']]}, {rate} % success."
    missed = 1.0 - training
    if missed > 0.0:
        yield f"It misses the target in {100.0 * missed:.1f} % of the flights even under training conditions."
    unknown = _first(record)["unknown_optima"]
    if unknown:
        yield f"The optimum is unknown for {unknown} starts, which have no cost gap."
    flown = {summary["condition"] for summary in record["evaluations"]}
    left_out = [what for condition, what in _NOT_FLOWN.items() if condition not in flown]
    missing = f"{', '.join(left_out)} and faults" if left_out else "faults"
    yield f"{missing.capitalize()} were not part of the evaluation."
    if record["trained_here"] is False:
        yield "It was trained in another version of the scene than the one it was evaluated in."


def _first(record: Mapping[str, Any]) -> Mapping[str, Any]:
    first: Mapping[str, Any] = record["evaluations"][0]
    return first


def _percent(interval: list[float | None] | None) -> str:
    if interval is None:
        return "-"
    value, *bounds = (
        f"{100.0 * bound:.3g}" if bound < 1.0 else f"{100.0 * bound:.0f}"
        for bound in interval
        if bound is not None
    )
    return f"{value} [{', '.join(bounds)}]" if bounds else value


_DESCRIPTION = """Put a trained policy into the zoo, with its evaluation and its model card.

It is evaluated on the 500 evaluation starts under all conditions. The zoo takes policies trained from a
configuration and a scene of the package, up to 2 MB in all.
Exit status: 0; 1 if the expert had to stop or the policy's file is damaged; 2 if the input is unusable; 130
if interrupted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command with these arguments, those of the process by default; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=_DESCRIPTION, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", help="folder of a training run, or an exported policy (.npz)")
    parser.add_argument("--name", help="name in the zoo (default: the agent's)")
    parser.add_argument(
        "--condition",
        nargs="+",
        default=list(CONDITIONS),
        choices=CONDITIONS,
        help="what to evaluate it under, besides training (default: all)",
    )
    parser.add_argument("--also", nargs="+", default=[], metavar="SCENE", help="other scenes to fly it in")
    parser.add_argument(
        "-n", type=int, default=EVALUATION_SEEDS, help="number of evaluation starts (default: all 500)"
    )
    parser.add_argument(
        "--training", metavar="COMMAND", help="what trains it, if that is no configuration of the package"
    )
    parser.add_argument("--zoo", type=Path, default=SHELF, help="folder of the zoo (default: the package's)")
    parser.add_argument("--workers", type=int, help="processes of the expert (default: one per processor)")
    options = parser.parse_args(arguments)
    return run_to_end(lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    try:
        with progress_bar() as show:
            written = add_to_zoo(
                options.run,
                options.name,
                conditions=options.condition,
                also=options.also,
                n=options.n,
                training=options.training,
                shelf=options.zoo,
                workers=options.workers,
                progress=show,
            )
    except (DemonstrationsError, PolicyFileError) as error:
        complain(str(error))
        return FAILURE
    Console(highlight=False).print(f"{written}: its card; weights and evaluation beside it", markup=False)
    return SUCCESS


if __name__ == "__main__":
    sys.exit(main())
