"""The expert's controllers in a scene that draws targets and masses: they know those of each flight."""

import numpy as np
import pytest

pytest.importorskip("torch")

from agents.evaluation.plan_followers import FEEDBACK, OPEN_LOOP
from agents.evaluation.planned_flights import fly_plans, fly_receding
from experts.executors import ProcessExecutor, SerialExecutor

pytestmark = pytest.mark.agents


@pytest.mark.slow
def test_controllers_fly_to_the_target_of_each_flight(drawn):
    found = fly_plans(drawn.scene, [OPEN_LOOP, FEEDBACK], ["training"], 5, SerialExecutor())
    receding = fly_receding(drawn.scene, "training", 5, ProcessExecutor(2))
    for planned in (*found.values(), receding):
        assert planned.flights.is_success.all()
    (plan, feedback), cost = found.values(), receding.flights.cost
    np.testing.assert_allclose(plan.flights.cost, feedback.flights.cost, rtol=1e-9)
    np.testing.assert_allclose(cost, feedback.flights.cost, rtol=1e-2)
