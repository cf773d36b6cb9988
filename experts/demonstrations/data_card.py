"""The data card: what the data are, how they were made, how to read them, and what to watch out for.

It begins with metadata for the Hugging Face Hub. It follows from the data alone, without dates and times, so
equal data have equal cards.
"""

from __future__ import annotations

from dataclasses import replace
from math import isfinite
from string import Template

from dq_space_arm_env.common.shown_text import markdown_text
from dq_space_arm_env.common.tables import TextTable
from dq_space_arm_env.validation import dump_yaml
from experts.demonstrations import facts as tables
from experts.demonstrations.facts import Facts
from experts.demonstrations.shard import (
    FAILURES,
    PARAMETERS,
    SUMMARIES,
    TRAJECTORIES,
    array_kinds,
    with_parameters,
)

MEANINGS = {
    "states": "states of the environment, including the last one",
    "observations": "its observations of them",
    "actions": "inputs as fractions of their limits, in [-1, 1]",
    "rewards": "rewards of the environment; their sum is -J",
    "feedback_gains": "G of the policy clip(action + G (x (-) state), -1, 1); zero rows at limits",
    "index": "number of the problem",
    "seed": "`env.reset(seed=seed)` starts at the same state",
    "cost": "J",
    "iterations": "of the solve",
    "stop_reason": "why the solve ended; in words when loaded",
    "guess": "initial guess of the solve; in words when loaded",
    "start_errors": "of the tip: attitude [deg] and position [m]",
    "final_errors": "the same at the end",
    "clamped_share": "share of the inputs, over all stages, at a limit",
    PARAMETERS: "what varied in the scene; `demonstration.episode_scene` is the scene with these numbers",
}
"""Meanings of the arrays of a demonstration."""

_TEMPLATE = Template("""\
---
$pretty_name
task_categories:
- reinforcement-learning
- robotics
tags:
- demonstrations
- imitation-learning
- optimal-control
- feedback-gains
- gymnasium$tags
size_categories:
- $size_category$configurations
---

# $demonstrations optimal maneuvers, scene $scene

A spacecraft floats freely and moves so that the tip of its arm reaches a target pose. Each
demonstration is a locally optimal maneuver from a random start, found by control-limited differential dynamic
programming, with the feedback gains of the optimal policy around it: how to respond where an agent drifts
off.
The environment is `DQSpaceArm-v0`; its documentation explains observations, actions and rewards.

$contents

## How it was made

`env.reset(seed=...)` draws starts from the spread of the scene, uniformly in each component. A problem is
solved from the best of several guesses, and again where the policy of a neighbor, followed from its start,
points to a cheaper minimum. A demonstration has converged, ends within the tolerances of the scene
($tolerances),$catches and its actions, replayed in the environment, cost J.
$failures

## Numbers

$numbers

## What is in a demonstration

$arrays

Failures are kept separately, with $failure_columns.

## How to read it

```python
from experts import load_demonstrations

demonstrations = load_demonstrations(".")  # the folder of this file
training, test = demonstrations.split(0.9, 0.1)
for batch in training.batches(256, ("observations", "actions", "feedback_gains"), seed=0):
    break
demonstration = demonstrations[0]
deviations = demonstrations.tangent(demonstration.states[:1], demonstration.states[1:2])
```

The shards are safetensors files, which other libraries can read as well.$copy

## How to reproduce it

The complete scene is in `settings.json`; `demonstrations.scene.to_yaml("scene.yaml")` writes it to a file.

```bash
dq-space-arm demonstrations generate --scene scene.yaml \\
    -n $problems --seed $seed --shard-size $shard_size
```

The same code and versions on the same kind of processor give the same bytes. The SHA-256 of the settings is
`$settings_hash`, that of the code `$source_hash`.

## What to keep in mind

- Each demonstration is a local minimum. Neighbors have checked it, but nothing proves it to be global.
- Where the cheapest maneuver would end outside the tolerances, these are constraints of the solve, and their
  multipliers shape the gains: $at_tolerance of $demonstrations demonstrations end at a tolerance of the pose.
  Their cost J is the least with which the target is reached, with 5 % of the tolerances kept free.
- The model is exact: no noise, delay or disturbance. The gains respond to small deviations, and become less
  accurate as these grow.
- Starts cover the spread of the scene and nothing beyond it. Failed problems are missing, so the hardest
  starts are rarer than among those drawn.
- Time steps of one demonstration are correlated: split by problem, as `split` does, never by time step.

## Source

A. Valverde and P. Tsiotras, "Modeling of Spacecraft-Mounted Robot Dynamics and Control Using Dual
Quaternions", American Control Conference, 2018: the robot, the maneuver and the cost of scene `paper`.
""")

_CONFIGURATIONS = """
configs:
- config_name: default
  data_files: data/*/*.parquet"""
_FILES = """ `dq-space-arm demonstrations export` makes a
Minari data set of them, or one of LeRobot. `summary/summary.html` shows distributions and sample
trajectories."""
_MINARI = """

This copy is the Minari data set `$id`, one HDF5 file instead of shards; the code above is for the original.

```python
import minari

dataset = minari.load_dataset("$id")
environment = dataset.recover_environment()
(metadata,) = dataset.storage.get_episode_metadata([0])
observation, info = environment.reset(seed=metadata["seed"])
for action in dataset[0].actions:
    observation, reward, terminated, truncated, info = environment.step(action)
```"""
_LEROBOT = """

This copy is a data set of LeRobot (LeRobotDataset v3.0), Parquet files instead of shards, without feedback
gains; the code above is for the original. `meta/demonstrations.json` holds the scene.

```python
from lerobot.datasets.lerobot_dataset import LeRobotDataset

dataset = LeRobotDataset("local/demonstrations", root=".")  # the folder of this file
frame = dataset[0]  # observation.state, action, next.reward, next.done, ...
```"""


def data_card(facts: Facts, minari_id: str | None = None, *, lerobot: bool = False) -> str:
    """Fill in the template; for a copy, the Minari data set of this name or a data set of LeRobot."""
    demonstrations, settings = facts.demonstrations, facts.demonstrations.settings
    scene, layout = demonstrations.scene, demonstrations.kernels.layout
    tolerances = zip(scene.success.tolerances, ("deg", "m", "deg/s", "m/s"), strict=True)
    return _TEMPLATE.substitute(
        scene=markdown_text(scene.name),
        pretty_name=_pretty_name(scene.name),
        demonstrations=len(demonstrations),
        size_category=_size_category(len(demonstrations)),
        contents="\n\n".join(_contents(facts).markdown()),
        tolerances=", ".join(f"{largest:g} {unit}" for largest, unit in tolerances if isfinite(largest)),
        catches=" has caught the payload," if any(phase.catch for phase in scene.phases) else "",
        failures=_failures(facts),
        at_tolerance=int(facts.at_tolerance.sum()),
        numbers=_numbers(facts),
        arrays="\n\n".join(line for table in _arrays(facts) for line in table.markdown()),
        failure_columns=", ".join(with_parameters(FAILURES, layout)).replace("_", " "),
        tags="\n- LeRobot" if lerobot else "",
        configurations=_CONFIGURATIONS if lerobot else "",
        copy=_LEROBOT if lerobot else _FILES if minari_id is None else _MINARI.replace("$id", minari_id),
        problems=facts.problems,
        seed=settings["seed"],
        shard_size=settings["shard_size"],
        settings_hash=markdown_text(demonstrations.manifest["settings_sha256"]),
        source_hash=markdown_text(str(settings["source"])),
    )


def _pretty_name(scene: str) -> str:
    """The line of the metadata, which are YAML."""
    text = f"Optimal maneuvers of a spacecraft with an arm, scene {scene}"
    return dump_yaml({"pretty_name": text}, header="").strip()


def _contents(facts: Facts) -> TextTable:
    """The table of contents, whose names others have chosen."""
    table = tables.contents(facts)
    return replace(table, rows=tuple((key, markdown_text(value)) for key, value in table.rows))


def _failures(facts: Facts) -> str:
    count = len(facts.failures["index"])
    if not count:
        return f"All {facts.problems} problems did."
    reasons = ", ".join(
        f"{n} {markdown_text(reason)}" for reason, n in facts.demonstrations.manifest["failures"].items()
    )
    return f"{count} of {facts.problems} problems did not ({reasons})."


def _numbers(facts: Facts) -> str:
    if not len(facts.demonstrations):
        return "There are no demonstrations."
    return "\n\n".join(tables.distributions(facts, with_times=False).markdown())


def _arrays(facts: Facts) -> list[TextTable]:
    """The arrays of a demonstration, and what varies in the scene if anything does."""
    layout = facts.demonstrations.kernels.layout
    kinds = array_kinds(facts.demonstrations.scene, layout)
    rows = (
        (f"`{name}`", str(kinds[name][1] or "a number"), MEANINGS[name])
        for name in with_parameters((*TRAJECTORIES, *SUMMARIES), layout)
    )
    arrays = TextTable("Its arrays", ("array", "shape", "meaning"), tuple(rows))
    return [arrays, tables.parameters(facts)] if layout.n_p else [arrays]


def _size_category(count: int) -> str:
    """The Hub's category for a number of demonstrations."""
    bounds = {1_000: "n<1K", 10_000: "1K<n<10K", 100_000: "10K<n<100K", 1_000_000: "100K<n<1M"}
    return next((word for bound, word in bounds.items() if count < bound), "n>1M")
