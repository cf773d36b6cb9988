"""The zoo: trained policies that ship with the package and fly with NumPy alone, each with its card.

    policy = load_policy(list_policies()[0])
    action = policy(observation)

A card says what a policy is, how it was trained, by which command, and how it does on the evaluation starts.
Wherever a policy is asked for, in `evaluate` and on command lines, its name will do.
"""

from agents.zoo.shelf import ZooError, list_policies, load_policy

__all__ = ["ZooError", "list_policies", "load_policy"]
