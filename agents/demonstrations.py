"""Demonstrations for agents: generated for a run, or those that are there, checked to fit its scene."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

from agents.configuration.demonstrations import DemonstrationSource
from agents.evaluation.expert_costs import SEED_OF_SEEDS
from agents.minari_reading import read_from_minari
from dq_space_arm_env import Scene
from experts.arm_problem import in_double_precision
from experts.demonstrations import (
    Advance,
    Demonstrations,
    DemonstrationsError,
    generate_demonstrations,
    load_demonstrations,
)
from experts.demonstrations.folder import LOG
from experts.demonstrations.settings import differences


def prepare_demonstrations(
    source: DemonstrationSource,
    scene: Scene,
    folder: Path,
    *,
    workers: int | None = None,
    progress: Callable[[Advance], None] | None = None,
) -> Demonstrations:
    """Get the demonstrations that an agent learns from, and check that it may.

    Args:
        source: Which ones.
        scene: What the agent is for.
        folder: Where to generate them, or to write what is read from Minari; what is there already of the
            same remains, so that an interrupted run goes on.
        workers: Processes that generate them; one for each processor by default.
        progress: Called at the beginning and now and then while they are generated.

    Returns:
        The demonstrations.

    Raises:
        DemonstrationsError: If they cannot be made or read, are of another scene, or begin where agents are
            evaluated.
        ValueError: If demonstrations of the scene are impossible.
        KeyboardInterrupt: If the user interrupts it; the same call goes on.
    """
    if source.folder is not None:
        demonstrations = load_demonstrations(source.folder)
    elif source.minari is not None:
        demonstrations = read_from_minari(source.minari, folder)
    else:
        _check_seed(source.seed)
        generated = generate_demonstrations(
            stricter(scene, source.tolerance_scale),
            source.problems,
            folder,
            source.seed,
            workers=workers,
            progress=progress,
        )
        assert generated is not None  # one part is all of it
        demonstrations = generated
    _check_seed(demonstrations.settings["seed"])
    check_scene(demonstrations, scene)
    return demonstrations


def expert_seconds(demonstrations: Demonstrations) -> float:
    """Add up what a folder of demonstrations took to generate, as its log says.

    Args:
        demonstrations: Of the folder.

    Returns:
        Time on one processor, s; 0 if there is no log.
    """
    lines = [
        json.loads(line)
        for path in sorted((demonstrations.path / LOG).glob("*.jsonl"))
        for line in path.read_text(encoding="utf-8").splitlines()
    ]
    # A shard may have been made more than once; the last time counts.
    shards = {line["shard"]: math.fsum(line["seconds"].values()) for line in lines if "shard" in line}
    return math.fsum(shards.values())


def stricter(scene: Scene, scale: float) -> Scene:
    """Make a scene whose success asks for more.

    Args:
        scene: The scene.
        scale: Of its tolerances, dimensionless, in (0, 1].

    Returns:
        The scene; the same one for a scale of 1.
    """
    if scale == 1.0:
        return scene
    tolerances = scene.success.model_dump()
    return scene.replace(success={name: scale * value for name, value in tolerances.items()})


def check_scene(demonstrations: Demonstrations, scene: Scene) -> None:
    """Check that a policy for a scene may learn from demonstrations.

    Args:
        demonstrations: What it learns from.
        scene: What it is for.

    Raises:
        DemonstrationsError: If their scene differs in more than name, description and tolerances of success.
    """
    theirs, ours = (
        each.model_dump(mode="json", exclude_none=True, exclude={"name", "description", "success"})
        for each in (demonstrations.scene, in_double_precision(scene))
    )
    found = differences(theirs, ours)
    if found:
        raise DemonstrationsError(
            f"{demonstrations.path} holds demonstrations of another scene than {scene.name!r}: "
            f"{'; '.join(found)}; only the tolerances of success may differ"
        )


def _check_seed(seed: int) -> None:
    if seed == SEED_OF_SEEDS:
        raise DemonstrationsError(
            f"demonstrations with seed {seed} begin where agents are evaluated: take another seed"
        )
