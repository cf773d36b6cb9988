import pytest

from experts.regularization import FACTOR, LARGEST, SMALLEST, Regularization


def test_repeated_raises_grow_quadratically() -> None:
    damping = Regularization(1.0)
    values = []
    for _ in range(3):
        damping.increase()
        values.append(damping.value)
    assert values == pytest.approx([FACTOR, FACTOR**3, FACTOR**6])


def test_repeated_reductions_reach_zero_and_leave_it_upward() -> None:
    damping = Regularization(1.0)
    for _ in range(8):
        damping.decrease()
    assert damping.value == 0.0
    damping.increase()
    assert damping.value == SMALLEST


@pytest.mark.parametrize(("alpha", "direction"), [(1.0, -1), (0.5, 0), (0.25, 0), (0.1, 1), (0.001, 1)])
def test_follows_the_accepted_step(alpha: float, direction: int) -> None:
    damping = Regularization(1.0)
    damping.follow(alpha)
    assert (damping.value > 1.0) - (damping.value < 1.0) == direction


def test_is_exhausted_beyond_its_range() -> None:
    damping = Regularization(LARGEST)
    assert not damping.exhausted
    damping.increase()
    assert damping.exhausted
