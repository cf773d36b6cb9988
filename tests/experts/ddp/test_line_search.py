"""The line searches take no step that raises the cost, or lowers it by less than they demand."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experts.ddp.backward_pass import PASS_COMPLETED, PassResult
from experts.ddp.multiple_shooting import MODEL_SHARE, MultipleShooting
from experts.ddp.parallel_rollouts import LANES
from experts.ddp.shooting import ACCEPTANCE, SHORTER_STEPS, STEP_LENGTHS, line_search

COST = 10.0
PREDICTED = PassResult(PASS_COMPLETED, 0, linear=-2.0, quadratic=1.0, clamped=0)


class Steps:
    """A workspace whose steps cost what the test says; it tells what was accepted."""

    def __init__(self, full: float, shorter: np.ndarray) -> None:
        self.current, self.full, self.shorter = SimpleNamespace(cost=COST), full, shorter
        self.accepted: list[float] = []

    def try_step(self, alpha: float) -> float:
        assert alpha == 1.0
        self.tried = self.full
        return self.full

    def try_steps(self, step_lengths: np.ndarray) -> np.ndarray:
        np.testing.assert_array_equal(step_lengths, SHORTER_STEPS)
        return self.shorter

    def choose(self, lane: int, cost: float) -> None:
        assert cost == self.shorter[lane]
        self.tried = cost

    def accept(self) -> None:
        self.accepted.append(self.tried)


def searched(full: float, shorter: Any) -> tuple[float, list[float]]:
    work = Steps(full, np.broadcast_to(np.asarray(shorter, dtype=float), LANES).copy())
    return line_search(work, PREDICTED), work.accepted  # type: ignore[arg-type]


@pytest.mark.parametrize("change", [0.0, 1e-9, 5.0, np.inf, np.nan])
def test_no_step_is_taken_where_all_cost_as_much_or_more(change: float) -> None:
    assert searched(COST + change, COST + change) == (0.0, [])


def test_a_reduction_must_be_a_share_of_the_predicted_one() -> None:
    demanded = ACCEPTANCE * PREDICTED.predicted_reduction(1.0)
    assert searched(COST - 0.9 * demanded, COST) == (0.0, [])
    assert searched(COST - 1.1 * demanded, COST) == (1.0, [COST - 1.1 * demanded])
    shorter = np.array([PREDICTED.predicted_reduction(alpha) for alpha in SHORTER_STEPS]) * ACCEPTANCE
    assert searched(np.inf, COST - 0.9 * shorter) == (0.0, [])


def test_of_the_shorter_steps_the_cheapest_acceptable_one_is_taken() -> None:
    costs = np.full(LANES, COST + 1.0)
    costs[[1, 3]] = COST - 1.0, COST - 2.0
    assert searched(np.inf, costs) == (SHORTER_STEPS[3], [COST - 2.0])


def test_the_cheapest_step_may_fall_short_of_its_prediction_and_another_not() -> None:
    half, quarter = (ACCEPTANCE * PREDICTED.predicted_reduction(alpha) for alpha in SHORTER_STEPS[:2])
    assert quarter < 0.8 * half
    costs = np.full(LANES, COST + 1.0)
    costs[:2] = COST - 0.9 * half, COST - 0.8 * half
    assert searched(np.inf, costs) == (SHORTER_STEPS[1], [costs[1]])


@pytest.mark.parametrize("excess", [-1e-3, 1e-3])
def test_with_gaps_a_step_may_cost_more_by_the_weight_of_the_gaps_it_closes(excess: float) -> None:
    """Merit: cost + weight s. With L = 2, Q = 1 the weight is raised to 3 / (1 - MODEL_SHARE) at s = 1."""
    linear, quadratic, accepted = 2.0, 1.0, []
    weight = (linear + quadratic) / (1.0 - MODEL_SHARE)

    def try_step(alpha: float) -> float:
        predicted = alpha * (weight - linear - alpha * quadratic)
        return COST + alpha * weight - ACCEPTANCE * predicted + (excess if alpha != 0.25 else -1e-3)

    search = SimpleNamespace(
        share=1.0, weight=0.0, work=SimpleNamespace(current=SimpleNamespace(cost=COST)),
        try_step=try_step, accept=accepted.append,
    )  # fmt: skip
    taken = MultipleShooting.line_search(search, linear, quadratic)  # type: ignore[arg-type]
    assert search.weight == pytest.approx(weight)
    assert taken == (1.0 if excess < 0.0 else 0.25)
    assert accepted == [taken]
    assert taken in STEP_LENGTHS


def test_a_predicted_gain_of_the_second_order_makes_no_gap_cheaper() -> None:
    """The weight is raised by L + max(Q, 0): Q is no bargain."""
    accepted: list[float] = []
    search = SimpleNamespace(
        share=0.5, weight=0.0, work=SimpleNamespace(current=SimpleNamespace(cost=COST)),
        try_step=lambda alpha: COST - 10.0, accept=accepted.append,
    )  # fmt: skip
    assert MultipleShooting.line_search(search, 2.0, -0.5) == 1.0  # type: ignore[arg-type]
    assert search.weight == pytest.approx(2.0 / ((1.0 - MODEL_SHARE) * 0.5))
    search.weight = 100.0  # it never falls
    MultipleShooting.line_search(search, 2.0, -0.5)  # type: ignore[arg-type]
    assert search.weight == 100.0
