"""Demonstrations for an agent: generated or existing, and checked to fit its scene."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path

from agents.configuration.schema import RESERVED_SEED, DemonstrationSource
from agents.minari_reading import read_from_minari
from dq_space_arm_env import Scene
from dq_space_arm_env.common.files import differences
from experts.demonstrations import (
    Advance,
    Demonstrations,
    DemonstrationsError,
    generate_demonstrations,
    load_demonstrations,
)
from experts.demonstrations.facts import read_log
from experts.executors import Executor
from experts.problems.arm_problem import in_double_precision


def prepare_demonstrations(
    source: DemonstrationSource,
    scene: Scene,
    folder: Path,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[Advance], None] | None = None,
) -> Demonstrations:
    """Generate or load the demonstrations an agent learns from, and check that they fit its scene.

    Generated ones, and those read from Minari, go to `folder`; an interrupted call resumes there.
    """
    if source.folder is not None:
        demonstrations = load_demonstrations(source.folder, verify=True)
    elif source.minari is not None:
        demonstrations = read_from_minari(source.minari, folder)
    else:
        if source.seed is None:
            raise ValueError("demonstrations.seed is absent: give one, or `configuration.resolved()`")
        _check_seed(source.seed)
        generated = generate_demonstrations(
            stricter(scene, source.tolerance_scale),
            source.problems,
            folder,
            source.seed,
            workers=workers,
            executor=executor,
            progress=progress,
        )
        assert generated is not None  # not one part of several
        demonstrations = generated
    _check_seed(demonstrations.settings["seed"])
    check_scene(demonstrations, scene)
    return demonstrations


def expert_seconds(demonstrations: Demonstrations) -> float:
    """Processor time that generating a folder of demonstrations took, s; 0 without a log."""
    return math.fsum(read_log(demonstrations).seconds.values())


def fingerprint(demonstrations: Demonstrations) -> str:
    """Hash that identifies a selection of a folder's demonstrations."""
    return hashlib.sha256(demonstrations.column("index").tobytes()).hexdigest()[:16]


def stricter(scene: Scene, scale: float) -> Scene:
    """Scale the tolerances of success, in (0, 1]; the same scene for 1."""
    if scale == 1.0:
        return scene
    tolerances = scene.success.model_dump()
    return scene.replace(success={name: scale * value for name, value in tolerances.items()})


def check_scene(demonstrations: Demonstrations, scene: Scene) -> None:
    """Refuse demonstrations whose scene differs in more than name, description and tolerances of success."""
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


def check_gains(demonstrations: Demonstrations, need: str) -> None:
    """Refuse demonstrations without feedback gains, as Minari may give them; `need` tells who needs them."""
    if len(demonstrations) and not demonstrations[0].feedback_gains.any():
        raise ValueError(
            f"{demonstrations.path}: these demonstrations have no feedback gains, which {need}, or export "
            "with gains"
        )


def _check_seed(seed: int) -> None:
    if seed == RESERVED_SEED:
        raise DemonstrationsError(
            f"demonstrations with seed {seed} start where agents are evaluated: use another seed"
        )
