"""The vector environment: bit for bit the single one, in every autoreset mode."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from short_scenes import diverging, short

from dq_space_arm_env import DQSpaceArmVectorEnv, list_scenes


def twins(scene, copies, mode):
    native = gymnasium.make_vec("DQSpaceArm-v0", copies, scene=scene, autoreset_mode=mode)
    assert isinstance(native.unwrapped, DQSpaceArmVectorEnv)
    single = [lambda: gymnasium.make("DQSpaceArm-v0", scene=scene) for _ in range(copies)]
    return native, SyncVectorEnv(single, autoreset_mode=mode)


def assert_same(actual, expected, path="result"):
    if isinstance(expected, dict):
        assert actual.keys() == expected.keys(), path
        for key in expected:
            assert_same(actual[key], expected[key], f"{path}[{key!r}]")
    elif isinstance(expected, tuple) or (isinstance(expected, np.ndarray) and expected.dtype == object):
        for i, (a, b) in enumerate(zip(actual, expected, strict=True)):
            assert_same(a, b, f"{path}[{i}]")
    else:
        np.testing.assert_array_equal(actual, expected, err_msg=path)


MODES = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
QUICK_SCENES = ("paper", "planar", "random-masses", "random-target")
CASES = [
    pytest.param(
        name,
        "float64",
        9,
        AutoresetMode.NEXT_STEP,
        marks=[pytest.mark.slow] if name not in QUICK_SCENES else [],
    )
    for name in list_scenes()
]
CASES += [("paper", "float64", copies, mode) for copies in (1, 3, 11) for mode in MODES]
CASES += [(name, "float32", 19, mode) for name in ("paper", "random-masses", "planar") for mode in MODES]


@pytest.mark.sampled
@pytest.mark.parametrize(("scene", "precision", "copies", "mode"), CASES)
def test_bits_are_those_of_single_environments_over_several_episodes(scene, precision, copies, mode):
    native, sync = twins(short(scene, 5, precision), copies, mode)
    first = native.reset(seed=1)
    assert first[0].dtype == native.observation_space.dtype == native.unwrapped.states.dtype == precision
    assert_same(first, sync.reset(seed=1))
    native.action_space.seed(0)
    for step in range(13):
        actions = native.action_space.sample() * np.float32(1.2)  # some beyond their bounds
        assert_same(native.step(actions), sync.step(actions), f"step {step}")


def test_only_what_a_batch_needs_is_compiled(short_scene):
    environment = DQSpaceArmVectorEnv(3, short_scene.replace(simulation={"steps": 61}))
    loaded = {(name, lanes) for name, _, lanes in environment.kernels._kernels}
    names = "environment_start", "environment_observe", "environment_step_float32_actions"
    assert loaded == {(name, environment.kernels.lanes) for name in names}


def test_threads_give_the_same_bits():
    one, two = (DQSpaceArmVectorEnv(2500, short("random-masses", 4), threads=threads) for threads in (1, 2))
    assert_same(one.reset(seed=0), two.reset(seed=0))
    one.action_space.seed(0)
    for _ in range(9):
        actions = one.action_space.sample()
        assert_same(one.step(actions), two.step(actions))


def test_episodes_that_end_at_different_times_are_those_of_single_environments():
    copies, scene = 9, short("random-target", 6)
    native = DQSpaceArmVectorEnv(copies, scene, AutoresetMode.DISABLED)
    single = [gymnasium.make("DQSpaceArm-v0", scene=scene) for _ in range(copies)]
    seen = [env.reset(seed=i)[0] for i, env in enumerate(single)]
    np.testing.assert_array_equal(native.reset(seed=0)[0], seen)
    rng = np.random.default_rng(0)
    over, ended = np.zeros(copies, dtype=bool), 0
    for _ in range(25):
        mask = over | (rng.random(copies) < 0.3)
        if mask.any():
            for i in np.flatnonzero(mask):
                seen[i] = single[i].reset()[0]
            np.testing.assert_array_equal(native.reset(options={"reset_mask": mask})[0], seen)
        actions = rng.uniform(-1, 1, (copies, 12)).astype(np.float32)
        results = [env.step(action) for env, action in zip(single, actions, strict=True)]
        seen, rewards, ends = (list(part) for part in zip(*(result[:3] for result in results), strict=True))
        observations, native_rewards, over, *_ = native.step(actions)
        np.testing.assert_array_equal(observations, seen)
        np.testing.assert_array_equal(native_rewards, rewards)
        np.testing.assert_array_equal(over, ends)
        ended += over.sum()
    assert ended > 5


def test_a_refused_step_changes_nothing():
    venv = DQSpaceArmVectorEnv(9, short())
    venv.reset(seed=0)
    before, actions = venv.states, np.zeros((9, 12))
    actions[4, 3] = np.nan
    with pytest.raises(ValueError, match=r"NaN for sub-environments \[4\]"):
        venv.step(actions)
    np.testing.assert_array_equal(venv.states, before)
    twin = DQSpaceArmVectorEnv(9, short())
    twin.reset(seed=0)
    assert_same(venv.step(np.zeros((9, 12))), twin.step(np.zeros((9, 12))))


@pytest.mark.parametrize("name", ["wheels", "thrusters", "motors"])
def test_nan_in_any_input_is_refused_whatever_actuators_do_with_it(name):
    venv = DQSpaceArmVectorEnv(2, short(name))
    venv.reset(seed=0)
    for column in range(venv.single_action_space.shape[0]):
        actions = np.zeros((2, venv.single_action_space.shape[0]))
        actions[1, column] = np.nan
        with pytest.raises(ValueError, match=r"NaN for sub-environments \[1\]"):
            venv.step(actions)


def test_actions_of_a_copy_that_is_being_reset_do_not_matter():
    venv = DQSpaceArmVectorEnv(2, short(steps=1))
    venv.reset(seed=0)
    venv.step(np.zeros((2, 12)))
    *_, info = venv.step(np.full((2, 12), np.nan))
    assert not info["diverged"].any()


def test_actions_may_be_read_only_strided_or_whole_numbers():
    results = []
    base = np.repeat(np.ones((3, 12), np.float32), 2, axis=1)
    frozen = np.ones((3, 12))
    frozen.setflags(write=False)
    for actions in (np.ones((3, 12)), frozen, base[:, ::2], np.ones((3, 12), int), [[1] * 12] * 3):
        venv = DQSpaceArmVectorEnv(3, short())
        venv.reset(seed=0)
        results.append(venv.step(actions))
    for result in results[1:]:
        assert_same(result, results[0])


def test_copies_are_reset_by_hand_where_autoreset_is_disabled():
    native, sync = twins(short(steps=4), 5, AutoresetMode.DISABLED)
    assert_same(native.reset(seed=2), sync.reset(seed=2))
    mask = np.array([True, False, False, True, False])
    actions = np.zeros((5, 12), dtype=np.float32)
    for _ in range(2):
        assert_same(native.step(actions), sync.step(actions))
    restart = {"seed": [7, None, None, 9, None], "options": {"reset_mask": mask}}
    assert_same(*(env.reset(**copy.deepcopy(restart)) for env in (native, sync)))
    for _ in range(2):
        result = native.step(actions)
        assert_same(result, sync.step(actions))
    assert result[2].tolist() == (~mask).tolist()
    with pytest.raises(ResetNeeded, match=r"sub-environments \[1, 2, 4\] are over"):
        native.step(actions)
    native.reset(options={"reset_mask": ~mask})
    native.step(actions)


def test_diverged_copies_end_as_single_ones_do():
    native, sync = twins(diverging(), 4, AutoresetMode.SAME_STEP)
    assert_same(native.reset(seed=0), sync.reset(seed=0))
    actions = np.zeros((4, 12))
    ended = 0
    for step in range(60):
        result = native.step(actions)
        assert_same(result, sync.step(actions), f"step {step}")
        if "final_info" in result[4]:
            ended += int(result[4]["final_info"]["diverged"].sum())
    assert ended >= 4


def test_vector_environments_pickle():
    venv = gymnasium.make_vec("DQSpaceArm-v0", 3, scene=short(), autoreset_mode=AutoresetMode.SAME_STEP)
    assert venv.observation_space.contains(venv.reset(seed=0)[0])
    twin = pickle.loads(pickle.dumps(venv))
    assert twin.autoreset_mode is AutoresetMode.SAME_STEP
    assert_same(twin.reset(seed=1), venv.reset(seed=1))


def test_starts_can_be_given():
    venv = DQSpaceArmVectorEnv(3, short())
    nominal = venv.kernels.layout.initial_state
    venv.reset(options={"nominal": True})
    np.testing.assert_array_equal(venv.states, np.tile(nominal, (3, 1)))
    venv.reset(seed=0)
    drawn = venv.states
    venv.reset(options={"initial_state": drawn})
    np.testing.assert_allclose(venv.states, drawn, rtol=0, atol=1e-15)
    venv.reset(options={"initial_state": drawn[1]})
    np.testing.assert_allclose(venv.states, np.tile(drawn[1], (3, 1)), rtol=0, atol=1e-15)


def test_results_that_are_kept_stay_as_they_are():
    venv = DQSpaceArmVectorEnv(4, short(steps=50))
    venv.reset(seed=0)
    venv.action_space.seed(0)
    kept, copies = [], []
    addresses = {venv.step(venv.action_space.sample())[0].ctypes.data for _ in range(20)}
    assert len(addresses) <= 4  # what nobody holds is used again
    for step in range(20):
        observations, rewards, _, _, info = venv.step(venv.action_space.sample())
        # Any part of a result keeps it: here in turns the whole, a view, and a view of a view.
        view = observations[1:, 2:]
        part = (observations, rewards, view[0], info["is_success"], info["position_error"][2:])[step % 5]
        kept.append(part)
        copies.append(part.copy())
    assert_same(tuple(kept), tuple(copies))


def test_what_a_caller_does_to_results_does_not_matter():
    venv, twin = DQSpaceArmVectorEnv(4, short(steps=3)), DQSpaceArmVectorEnv(4, short(steps=3))
    venv.reset(seed=0)
    twin.reset(seed=0)
    actions = np.zeros((4, 12))
    for _ in range(5):
        result = venv.step(actions)
        assert_same(result, twin.step(actions))
        *arrays, info = result
        for array in (*arrays, *(value for key, value in info.items() if not key.startswith("_"))):
            array[:] = 1
        assert not info["_attitude_error"].flags.writeable


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda v: v.step(np.zeros((3, 12))), r"shape \(3, 12\), should be \(4, 12\)"),
        (lambda v: v.reset(seed=[1, 2]), "2 seeds, should be 4"),
        (lambda v: v.reset(seed=1.5), "seed: 1.5, should be a whole number, or one for each"),
        (lambda v: v.reset(seed=-2), "seed: -2, should be a whole number of at least 0"),
        (lambda v: v.reset(seed=[0, None, 2.5, 3]), "seed: 2.5, should be a whole number of at least 0"),
        (lambda v: v.reset(seed=[[0], [1], [2], [3]]), r"seed: \[0\], should be a whole number"),
        (lambda v: v.reset(seed="0123"), "seed: '0', should be a whole number of at least 0"),
        (lambda v: v.reset(options={"reset_mask": np.zeros(4, dtype=bool)}), "False everywhere"),
        (lambda v: v.reset(options={"reset_mask": [True] * 4}), "should be a bool array"),
        (lambda v: v.reset(options={"nominel": True}), r"\['nominel'\] unknown; choose from nominal"),
        (lambda v: v.perturb(np.full((4, v.kernels.n_t), np.inf)), "should be finite"),
        (lambda v: v.perturb(np.full((4, v.kernels.n_t), 1e200)), "a norm of inf, should be at most 500000"),
    ],
)
def test_bad_input_is_refused(call, message):
    venv = DQSpaceArmVectorEnv(4, short())
    venv.reset(seed=0)
    with pytest.raises(ValueError, match=message):
        call(venv)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_copies_that_a_first_reset_leaves_out_begin_at_the_next_step(mode):
    """Until then they stand at the scene's own start; Gymnasium's own fail at such a reset."""
    venv, twin = (DQSpaceArmVectorEnv(2, short(), mode) for _ in range(2))
    seen, _ = venv.reset(seed=5, options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(seen[1], twin.reset(options={"nominal": True})[0][1])
    np.testing.assert_array_equal(seen[0], twin.reset(seed=5)[0][0])
    np.testing.assert_array_equal(venv.observe(), seen)
    if mode is AutoresetMode.DISABLED:
        with pytest.raises(ResetNeeded, match=r"\[1\] are over"):
            venv.step(np.zeros((2, 12)))
        return
    start = twin.states[1]
    twin.step(np.zeros((2, 12)))
    _, rewards, over, _, _ = venv.step(np.zeros((2, 12)))
    np.testing.assert_array_equal(venv.states, [twin.states[0], start])
    assert rewards[1] == 0.0
    assert not over.any()


def test_the_seed_is_that_of_gymnasiums_own_generator_too():
    venv, twin = (DQSpaceArmVectorEnv(2, short()) for _ in range(2))
    for each in (venv, twin):
        each.reset(seed=7)
        assert each.np_random_seed == 7
    assert venv.np_random.random() == twin.np_random.random()


@pytest.mark.parametrize("mode", AutoresetMode)
def test_who_is_pushed_and_not_reset_shows_where_it_is(mode):
    venv = DQSpaceArmVectorEnv(2, short(), mode)
    venv.reset(seed=5)
    venv.perturb(np.full((2, venv.kernels.n_t), 0.01))
    pushed = venv.observe()[1]
    observations, _ = venv.reset(options={"reset_mask": np.array([True, False])})
    np.testing.assert_array_equal(observations[1], pushed)


def test_bad_construction_is_refused():
    with pytest.raises(ValueError, match="num_envs: True, should be a whole number of at least 1"):
        DQSpaceArmVectorEnv(True)
    for number in (0, 1.5):
        with pytest.raises(ValueError, match=f"num_envs: {number}, should be a whole number of at least 1"):
            DQSpaceArmVectorEnv(number)
        with pytest.raises(ValueError, match=f"threads: {number}, should be a whole number of at least 1"):
            DQSpaceArmVectorEnv(2, threads=number)
    for mode in ("NEXT_STEP", None):
        with pytest.raises(ValueError, match=f"autoreset_mode: {mode!r}, should be one of NextStep"):
            DQSpaceArmVectorEnv(2, autoreset_mode=mode)
    with pytest.raises(ValueError, match="render_mode: 'human'"):
        DQSpaceArmVectorEnv(2, render_mode="human")


def test_nothing_is_read_before_the_first_reset():
    env = DQSpaceArmVectorEnv(2, "random-target")
    for name in ("states", "parameters", "targets", "stage_parameters"):
        with pytest.raises(ResetNeeded, match=r"call reset\(\) before reading"):
            getattr(env, name)
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before step\(\)"):
        env.step(np.zeros((2, 12)))


def test_episodes_are_cut_off_by_single_environments_alone():
    with pytest.raises(
        ValueError, match=r"max_episode_steps: 3, should be left out.*vectorization_mode='sync'"
    ):
        gymnasium.make_vec("DQSpaceArm-v0", 2, scene=short(), max_episode_steps=3)
    cut = gymnasium.make_vec(
        "DQSpaceArm-v0", 2, scene=short(), max_episode_steps=3, vectorization_mode="sync"
    )
    cut.reset(seed=0)
    ends = [cut.step(np.zeros((2, 12), dtype=np.float32))[3].all() for _ in range(3)]
    assert ends == [False, False, True]


def test_the_final_info_of_copies_that_go_on_is_zero():
    venv = gymnasium.make_vec("DQSpaceArm-v0", 2, scene=short(), autoreset_mode=AutoresetMode.SAME_STEP)
    venv.reset(seed=0)
    venv.step(np.zeros((2, 12)))
    venv.reset(options={"reset_mask": np.array([False, True])})
    info = {}
    while "final_info" not in info:
        *_, info = venv.step(np.zeros((2, 12)))
    assert info["_final_info"].tolist() == [True, False]
    final = {name: value for name, value in info["final_info"].items() if not name.startswith("_")}
    assert final["cost_pose"][0] > 0.0
    assert not any(np.any(value[1]) for value in final.values())


def test_what_two_kinds_of_resets_draw_in_one_step_is_told_of_both():
    """A copy that was over begins, and another ends and begins."""
    scene, idle = short("random-target"), np.zeros((2, 12))
    first, venv = DQSpaceArmVectorEnv(2, scene), DQSpaceArmVectorEnv(2, scene, "SameStep")
    first.reset(seed=0)
    first.step(idle)
    first.reset(options={"reset_mask": np.array([False, True])})
    for _ in range(scene.simulation.steps - 1):
        first.step(idle)
    venv.set_state(first.get_state())
    *_, info = venv.step(idle)
    assert info["_final_info"].tolist() == [False, True]
    assert info["_parameters"].tolist() == [True, True]
    drawn = [info["parameters"][name] for name in venv.kernels.parameters.names]
    np.testing.assert_array_equal(np.transpose(drawn), venv.parameters)
