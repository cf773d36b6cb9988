"""Policies that a training starts from, and what these took."""

from __future__ import annotations

from agents.configuration import ConfigurationError
from agents.configuration.schema import Network
from agents.policies import ExportedPolicy, PolicyFileError
from agents.policies.policy_files import noted_effort
from agents.zoo.finding import PolicyError, policy_path


def load_start(
    start_from: str | None, network: Network, n_observation: int, n_action: int
) -> ExportedPolicy | None:
    """Load the policy that `start_from` names, and check that it fits network and environment."""
    if start_from is None:
        return None
    policy = _load(start_from)
    hidden = tuple(len(bias) for bias in policy.biases[:-1])
    problems = [
        f"{name} is {there} there and {here} here"
        for name, there, here in (
            ("network.hidden", list(hidden), list(network.hidden)),
            ("network.activation", policy.activation, network.activation),
            ("squash", policy.squash, "clip"),
            ("entries of observations", policy.n_observation, n_observation),
            ("entries of actions", policy.n_action, n_action),
        )
        if there != here
    ]
    if policy.normalized_limit != float("inf"):
        problems.append("normalized observations are clipped there and are not here")
    scale = policy.action_scale
    if scale is not None and (scale != 1.0).any():  # of a model whose actions were rescaled
        problems.append(f"action_scale is {scale.min():.3g} there, where actions are clipped, and 1 here")
    if problems:
        raise ConfigurationError(f"start_from: {start_from} does not fit: {'; '.join(problems)}")
    return policy


def spent_before(start_from: str | None) -> tuple[int, float]:
    """Problems that the expert solved for the policy of `start_from`, and seconds it took; 0 without one."""
    spent = {} if start_from is None else noted_effort(_load(start_from).metadata)
    return int(spent.get("expert_solves", 0)), float(spent.get("seconds", 0.0))


def _load(source: str) -> ExportedPolicy:
    try:
        path = policy_path(source)
        if not path.exists():
            raise ConfigurationError(
                f"start_from: there is no {path}; train a policy first, "
                "dq-space-arm train cloning-with-gains, and give its run folder"
            )
        return ExportedPolicy.load(path)
    except (PolicyError, PolicyFileError) as error:
        raise ConfigurationError(f"start_from: {error}") from error
