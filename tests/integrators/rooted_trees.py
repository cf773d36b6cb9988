"""Order conditions of Runge-Kutta methods, from rooted trees (Hairer, Norsett & Wanner I, section II.2).

A tree is the sorted tuple of the trees that hang on its root.
"""

from collections import Counter
from functools import cache
from math import factorial, prod

import numpy as np


@cache
def forests(size):
    """Multisets of trees with `size` vertices in all, each sorted."""
    if size == 0:
        return ((),)
    found = {
        tuple(sorted((tree, *rest)))
        for n in range(1, size + 1)
        for tree in trees(n)
        for rest in forests(size - n)
    }
    return tuple(sorted(found))


@cache
def trees(size):
    """Trees with `size` vertices."""
    return forests(size - 1)


def vertices(tree):
    return 1 + sum(vertices(branch) for branch in tree)


def density(tree):
    return vertices(tree) * prod(density(branch) for branch in tree)


def symmetry(tree):
    """Number of ways to exchange equal branches."""
    counts = Counter(tree)
    return prod(symmetry(branch) ** count * factorial(count) for branch, count in counts.items())


def elementary_weights(tree, a):
    """Of each stage: the product over the branches of a times their weights."""
    weights = np.ones(len(a))
    for branch in tree:
        weights = weights * (a @ elementary_weights(branch, a))
    return weights


def defects(size, a, b, theta=1.0):
    """How much b . weights misses theta^size / density, for every tree of a size."""
    return np.array([b @ elementary_weights(t, a) - theta**size / density(t) for t in trees(size)])
