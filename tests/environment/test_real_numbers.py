"""Actions, states and observations are real numbers; NumPy alone would make such of nearly anything."""

import numpy as np
import pytest

from agents import ExportedPolicy
from dq_space_arm_env import DQSpaceArmEnv, DQSpaceArmGoalEnv, DQSpaceArmVectorEnv, compile_scene

KINDS = {
    "complex": lambda shape: np.full(shape, 0.1 + 0.2j),
    "dates": lambda shape: np.full(shape, np.datetime64("1970-01-01", "ns")),
    "durations": lambda shape: np.full(shape, np.timedelta64(0, "ns")),
    "masked": lambda shape: np.ma.masked_array(
        np.full(shape, 0.1), np.arange(np.prod(shape)).reshape(shape) == 1
    ),
    "objects": lambda shape: np.full(shape, 0.1, dtype=object),
    "text": lambda shape: np.full(shape, "0.1"),
    "bytes": lambda shape: np.full(shape, b"0.1"),
    "list of complex": lambda shape: np.full(shape, 0.1j).tolist(),
}
GOOD = [
    np.full(6, 0.1),
    np.full(6, 0.1, np.float32),
    np.full(6, 0.1, np.float16),
    np.full(6, 0.1, ">f8"),
    np.zeros(6, np.int8),
    [0.1] * 6,
    tuple([0.1] * 6),
    np.full(12, 0.1)[::2],
]


@pytest.fixture(params=[DQSpaceArmEnv, DQSpaceArmGoalEnv])
def single(request):
    environment = request.param("planar")
    environment.reset(seed=0)
    return environment


@pytest.fixture
def vector():
    environment = DQSpaceArmVectorEnv(3, "planar")
    environment.reset(seed=0)
    return environment


@pytest.mark.parametrize("kind", KINDS)
def test_an_environment_refuses_them_before_anything_moves(kind, single, vector):
    for environment, shape in ((single, (6,)), (vector, (3, 6))):
        read = (lambda e=environment: e.states) if environment is vector else (lambda e=environment: e.state)
        before = read()
        with pytest.raises(TypeError, match=r"actions?: "):
            environment.step(KINDS[kind](shape))
        np.testing.assert_array_equal(read(), before)
        environment.step(np.zeros(shape))


@pytest.mark.parametrize("kind", KINDS)
def test_starts_displacements_and_goals_are_checked_likewise(kind, single, vector):
    n_x, n_t = vector.kernels.n_x, vector.kernels.n_t
    for refused in (
        lambda: single.reset(options={"initial_state": KINDS[kind]((n_x,))}),
        lambda: vector.perturb(KINDS[kind]((3, n_t))),
        lambda: vector.observe(KINDS[kind]((3, n_x))),
    ):
        with pytest.raises(TypeError, match="should be real numbers"):
            refused()


@pytest.mark.parametrize("kind", KINDS)
def test_the_functions_of_a_scene_and_policies_refuse_them(kind):
    kernels = compile_scene("planar")
    x = kernels.layout.initial_state
    layer = np.ones((len(x), 6), np.float32)
    policy = ExportedPolicy((layer,), (np.zeros(6, np.float32),), "tanh", np.zeros(len(x)), np.ones(len(x)))
    for refused in (
        lambda: kernels.step(x, KINDS[kind]((6,))),
        lambda: kernels.step(KINDS[kind]((2, len(x))), np.zeros((2, 6))),
        lambda: kernels.simulate(x, KINDS[kind]((6,)), 3),
        lambda: kernels.layout.to_control(KINDS[kind]((6,))),
        lambda: policy(KINDS[kind]((len(x),))),
    ):
        with pytest.raises(TypeError):
            refused()


@pytest.mark.parametrize("action", GOOD, ids=lambda action: getattr(action, "dtype", type(action).__name__))
def test_real_numbers_of_any_type_are_taken(action, single):
    observation, *_ = single.step(action)
    assert np.isfinite(observation["observation"] if isinstance(observation, dict) else observation).all()
    environment = DQSpaceArmVectorEnv(1, "planar")
    environment.reset(seed=0)
    environment.step([action])


def test_a_ragged_action_is_refused(single):
    with pytest.raises(ValueError, match="action: rows that differ in length"):
        single.step([[0.1, 0.2], [0.1]])
