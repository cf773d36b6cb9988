"""A scene with constraints."""

import pytest


@pytest.fixture(scope="session")
def limited(small_scene):
    """The small scene with limits of its joints and of its momentum."""
    limits = {
        "kind": "joint_limits",
        "name": "joints",
        "lower": -0.9,
        "upper": 0.9,
        "rate": 0.3,
    }  # rad, rad/s
    momentum = {"kind": "momentum", "name": "whole", "linear": 2.0, "margin": 0.1, "tolerance": 0.1}  # N s
    return small_scene.replace(name="limited", constraints=[limits, momentum])
