"""A solver that tests share: what it solves depends on the start alone."""

import pytest

from experts import GuidedDDP


@pytest.fixture(scope="package")
def paper():
    solver = GuidedDDP("paper")
    assert solver.coarsening == (8,)  # prepared before a test takes a part of the preparation's place
    return solver
