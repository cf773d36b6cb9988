"""Model cards: what a policy of the zoo is, how it was trained, how it does, and what nobody knows of it.

A card follows from the policy's file and the record of its evaluation alone, so that nobody has to keep it up
to date, or could embellish it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from string import Template
from typing import Any

from agents.policies import ExportedPolicy
from dq_space_arm_env.validation import dump_yaml
from experts.report.page.rendering import markdown_table
from experts.report.tables import TextTable

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
optimum of the scene that is flown in; median and 95th percentile. The other columns are medians. Brackets:
95 % intervals. By the protocol nothing may be tuned on these starts.

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
    "spin": "base turns at the start",
}


def card(name: str, policy: ExportedPolicy, record: Mapping[str, Any]) -> str:
    """Write the card of a policy.

    Args:
        name: Its name in the zoo.
        policy: The policy.
        record: Its record, see `agents.zoo.adding`.

    Returns:
        Markdown.
    """
    metadata = policy.metadata
    configuration = metadata.get("configuration", {})
    success = record["success"]
    conditions = " ".join(summary["condition"] for summary in record["evaluations"])
    starts = record["evaluations"][0]["episodes"]
    return _TEMPLATE.substitute(
        name=name,
        description=configuration.get("description") or f"The agent {metadata.get('agent', name)}.",
        scene=record["scene"],
        facts="\n\n".join(markdown_table(_facts(policy, record))),
        training=record["training_command"],
        effort=_effort(metadata.get("training", {})),
        configuration=dump_yaml(dict(configuration), "").strip(),
        evaluation="\n\n".join(markdown_table(_table(record))),
        angle=f"{success['attitude_error_deg']:g}",
        distance=f"{success['position_error']:g}",
        again=f"dq-space-arm evaluate {name} --scene {record['scene']} -n {starts} --condition {conditions}",
        limits="\n".join(f"- {sentence}" for sentence in _limits(record)),
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
    versions = origin.get("versions", {})
    return {name: versions[name] for name in names if versions.get(name)}


def _effort(training: Mapping[str, Any]) -> str:
    """What training took, in a sentence."""
    parts = []
    if training.get("environment_steps"):
        parts.append(f"{training['environment_steps']:,} environment steps")
    if training.get("updates"):
        parts.append(f"{training['updates']:,} updates")
    if training.get("expert_solves"):
        parts.append(f"{training['expert_solves']:,} problems solved by the expert")
    if training.get("seconds"):
        parts.append(f"{training['seconds'] / 60.0:.1f} minutes")
    return f"That took {', '.join(parts)}." if parts else "Nobody wrote down what that took."


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


def _limits(record: Mapping[str, Any]) -> Iterator[str]:
    """What the evaluation says about where not to use it."""
    yield (
        f"It knows the scene `{record['scene']}` and its target alone: another robot, another time step, or "
        "another target is another task."
    )
    training = _first(record)["success_rate"][0]
    worst = min(record["evaluations"], key=lambda summary: summary["success_rate"][0])
    if worst["success_rate"][0] < training:
        rate = _percent(worst["success_rate"])
        yield f"It does worst with this change: {_MEANINGS[worst['condition']]}, {rate} % success."
    missed = 1.0 - training
    if missed > 0.0:
        yield f"It misses the target in {100.0 * missed:.1f} % of the flights even as trained."
    unknown = _first(record)["unknown_optima"]
    if unknown:
        yield f"Of {unknown} starts the optimum is not known; they are without a cost gap."
    yield "Delays, sensor noise and faults were not part of the evaluation."
    if record["trained_here"] is False:
        yield "It was trained in another version of the scene than it was evaluated in."


def _first(record: Mapping[str, Any]) -> Mapping[str, Any]:
    first: Mapping[str, Any] = record["evaluations"][0]
    return first


def _percent(interval: list[float] | None) -> str:
    if interval is None:
        return "-"
    value, low, high = (
        f"{100.0 * bound:.3g}" if bound < 1.0 else f"{100.0 * bound:.0f}" for bound in interval
    )
    return f"{value} [{low}, {high}]"
