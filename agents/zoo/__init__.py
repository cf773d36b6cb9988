"""The zoo: trained policies that ship with the package and fly with NumPy alone, each with its card.

    policy = load_policy(list_policies()[0])
    action = policy(observation)

A card describes a policy, the command that trains it, and its results on the evaluation starts. `evaluate`
and the command line take its name wherever they take a policy.
"""

from agents.zoo.shelf import ZooError, list_policies, load_policy

__all__ = ["ZooError", "list_policies", "load_policy"]
