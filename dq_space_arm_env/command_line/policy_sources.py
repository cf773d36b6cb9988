"""Policies that verbs fly: the built-in ones, and those that packages bring by entry points.

An entry point of the group `dq_space_arm.policies` names a module with three functions:

    policy_names() -> dict[str, str]                    descriptions by name; fast, for completion
    owns_policy(policy: str) -> bool                        whether it can load this name or path
    load_policy(policy, start, console, seed, trust) -> Pilot  for an episode that begins at `start`;
                                                            executes no code of the file unless `trust`

A source of models (.zip) takes one more argument where `--normalize` is given, the file of their statistics.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dq_space_arm_env.command_line.names import Named
from dq_space_arm_env.common.entry_points import entry_points, load
from dq_space_arm_env.common.suggestions import did_you_mean

if TYPE_CHECKING:
    from rich.console import Console

    from dq_space_arm_env.command_line.simulated_episode import Pilot, Start

GROUP = "dq_space_arm.policies"
_RANDOM = 2  # stream of random numbers that belongs to a seed
_BUILT_IN = {"zero": "no input", "random": "uniformly random inputs within their limits"}


def policy_names() -> dict[str, str]:
    """List all named policies, descriptions by name."""
    names = dict(_BUILT_IN)
    for source in _sources():
        names |= source.policy_names()
    return names


def load_policy(
    policy: str,
    start: Start,
    console: Console,
    seed: int | None,
    *,
    trust: bool = False,
    normalize: Path | None = None,
) -> Pilot:
    """Load a policy by name or path; `console` shows the progress of a solve."""
    statistics = statistics_by_model([policy], normalize).values()
    if policy.lower() in _BUILT_IN:
        return _built_in(policy.lower(), start, seed)
    for source in _sources():
        if source.owns_policy(policy):
            pilot: Pilot = source.load_policy(policy, start, console, seed, trust, *statistics)
            return pilot
    known = list(policy_names())
    if Path(policy).exists():
        raise ValueError(
            f"{policy} is not a policy: give a solution (.npz), an exported policy (.npz, .onnx), a model "
            f"(.zip), the folder of a training run, or one of {', '.join(known)}"
        )
    policies = (
        f"the policies are {', '.join(known)}; give your own as a file (.npz, .onnx, .zip) or the folder of "
        "its run"
    )
    raise ValueError(
        f"no policy is named {policy!r}, and there is no such file; {did_you_mean(policy, known, policies)}"
    )


def statistics_by_model(policies: Sequence[str], normalize: Path | None) -> dict[str, Path]:
    """The file of `--normalize`, if any, by the one model (.zip) among the policies, to which it belongs."""
    if normalize is None:
        return {}
    models = [policy for policy in policies if Path(policy).suffix == ".zip"]
    if len(models) != 1:
        raise ValueError(
            f"--normalize: {normalize} belongs to one model (.zip), and there are {len(models)}: give each "
            "its own, one at a time"
        )
    return {models[0]: normalize}


def owns_policy(policy: str) -> bool:
    """Tell whether a name or a path is a policy, rather than a recorded flight."""
    return policy.lower() in _BUILT_IN or any(source.owns_policy(policy) for source in _sources())


def _built_in(name: str, start: Start, seed: int | None) -> Pilot:
    import numpy as np

    from dq_space_arm_env.command_line.simulated_episode import Pilot
    from dq_space_arm_env.scene import StateLayout

    shape = (1, StateLayout.of(start.scene).n_u)
    if name == "zero":
        return Pilot("zero inputs", lambda observations: np.zeros(shape))
    generator = np.random.default_rng([seed or 0, _RANDOM])
    return Pilot("random inputs", lambda observations: generator.uniform(-1.0, 1.0, shape))


def _sources() -> Iterator[Any]:
    for reference in entry_points(GROUP).values():
        yield load(reference)


POLICY = Named("policy", policy_names)
