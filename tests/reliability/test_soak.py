"""Long runs, many processes and many threads: the same bits, flat memory, one sound file for each kernel."""

import hashlib
import json
import multiprocessing
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from dq_space_arm_env import DQSpaceArmVectorEnv, Kernels, Scene
from experts import BoxDDP

HERE = Path(__file__).parent
THREADS = 8


def count(small, large, marker=pytest.mark.slow):
    """A small count for every day, and the full one."""
    return pytest.mark.parametrize(
        "count", [pytest.param(small, marks=marker), pytest.param(large, marks=pytest.mark.endurance)]
    )


def at_once(work, threads=THREADS):
    """Results of work(i) in as many threads, which begin together."""
    met = threading.Barrier(threads, timeout=60)

    def begin(i):
        met.wait()
        return work(i)

    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(begin, range(threads)))


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads resident memory in /proc")
@count(1_000_000, 1_000_000_000)
def test_a_second_run_gives_the_same_bits_in_the_same_memory(count):
    command = [sys.executable, HERE / "soaking.py", str(count), "7"]
    first, second = (
        json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout) for _ in range(2)
    )
    for scene in first:
        memory = [first[scene].pop("memory"), second[scene].pop("memory")]
        print(scene, first[scene], "MB:", [(samples[4], samples[-1]) for samples in memory])
        for samples in memory:
            assert max(samples[4:]) - samples[4] < 8, scene
    assert first == second
    assert sum(case["steps"] for case in first.values()) >= 0.99 * count


COMPILE = """
import hashlib, sys, time, pathlib
import casadi, numpy as np
from dq_space_arm_env import DQSpaceArmVectorEnv, Scene, compile_scene
scene, start = Scene.model_validate_json(sys.argv[1]), pathlib.Path(sys.argv[2])
print("ready", flush=True)
while not start.exists():
    time.sleep(0.01)
venv = DQSpaceArmVectorEnv(5, scene)
seen = [venv.reset(seed=0)[0]] + [venv.step(np.ones((5, 2)))[0] for _ in range(20)]
seen += compile_scene(scene).linearize(venv.states, np.ones((5, 2)))
print(hashlib.sha256(b"".join(array.tobytes() for array in seen)).hexdigest())
"""


@count(6, 24)
def test_processes_that_compile_at_once_leave_one_sound_file_each(count, short_scene: Scene, tmp_path: Path):
    cache, start = tmp_path / "cache", tmp_path / "start"

    def begin():
        command = [sys.executable, "-c", COMPILE, short_scene.model_dump_json(), start]
        environment = os.environ | {"DQ_SPACE_ARM_CACHE": str(cache)}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        process = subprocess.Popen(command, env=environment, text=True, **pipes)
        assert process.stdout.readline() == "ready\n", process.communicate()
        return process

    processes = [begin() for _ in range(count)]
    start.touch()
    printed = [process.communicate() for process in processes]
    assert {process.returncode for process in processes} == {0}, printed
    assert len({out for out, _ in printed}) == 1
    assert sum("compiling what is used of scene" in messages for _, messages in printed) > 1
    assert not [messages for _, messages in printed if "Warning" in messages]
    kernels = sorted(path.name for path in cache.rglob("*.kernel"))
    assert len({name.rpartition("-")[2] for name in kernels}) == len(kernels) > 5
    assert not [path for path in cache.rglob("*") if path.suffix in (".tmp", ".part")]
    # All are sound: another process has nothing to compile.
    assert begin().communicate() == (printed[0][0], "")
    assert sorted(path.name for path in cache.rglob("*.kernel")) == kernels


def flight(env, seed, steps):
    """Bytes of what an environment, single or vector, returns in some steps."""
    env.action_space.seed(seed)
    digest = hashlib.sha256(env.reset(seed=seed)[0].tobytes())
    for _ in range(steps):
        observation, reward, ended, *_ = env.step(env.action_space.sample())
        digest.update(observation.tobytes() + np.asarray(reward).tobytes())
        if ended is True:
            env.reset()
    return digest.hexdigest()


@count(300, 20_000, marker=())
def test_threads_with_an_environment_each_see_what_one_thread_sees(count, spread_scene: Scene):
    def fly(i):
        return flight(gymnasium.make("DQSpaceArm-v0", scene=spread_scene), i, count)

    assert at_once(fly) == [fly(i) for i in range(THREADS)]


@count(20, 2000, marker=())
def test_threads_with_a_vector_environment_each_share_their_helpers(count, spread_scene: Scene):
    def fly(i, threads=1 + 2):
        return flight(DQSpaceArmVectorEnv(3000 + i, spread_scene, threads=threads), i, count)

    assert at_once(fly) == [fly(i, threads=1) for i in range(THREADS)]


@count(1, 20)
def test_threads_share_kernels_from_the_first_call_on(count, short_scene: Scene, tmp_path, monkeypatch):
    rng = np.random.default_rng(0)

    def work(i):
        scaled = states[i] + 0.0
        return (
            kernels.step(scaled, inputs[i]),
            *kernels.linearize(scaled, inputs[i]),
            kernels.tip_pose(scaled),
            kernels.cost(scaled[0], inputs[i][0]),
            kernels.step(scaled[0], inputs[i][0], integrator="dormand_prince"),
        )

    for trial in range(count):
        # Nothing is compiled yet, neither here nor on disk.
        monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path / str(trial)))
        kernels = Kernels(short_scene)
        states = np.tile(kernels.layout.initial_state, (THREADS, 50, 1))
        moves = rng.normal(scale=0.2, size=(THREADS * 50, kernels.n_t))
        inputs = rng.normal(size=(THREADS, 50, kernels.n_u))
        states = Kernels(short_scene).retract(states.reshape(-1, kernels.n_x), moves).reshape(states.shape)
        shared = at_once(work)
        kernels = Kernels(short_scene)
        for i in range(THREADS):
            for found, expected in zip(shared[i], work(i), strict=True):
                np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
def test_threads_with_a_solver_each_find_what_one_thread_finds(short_scene: Scene):
    def solve(i):
        solution = BoxDDP(short_scene, max_iterations=15 + i).solve()
        return solution.states.tobytes() + solution.controls.tobytes() + solution.feedback_gains.tobytes()

    assert at_once(solve) == [solve(i) for i in range(THREADS)]


def fly_and_send(pipe, scene, seed):
    pipe.send(flight(DQSpaceArmVectorEnv(2500, scene, threads=2), seed, 20))


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork")
@pytest.mark.parametrize("method", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_processes_started_after_use_see_the_same(method, spread_scene: Scene):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {method} here")
    expected = [flight(DQSpaceArmVectorEnv(2500, spread_scene, threads=2), seed, 20) for seed in range(2)]
    context = multiprocessing.get_context(method)
    for seed in range(2):
        here, there = context.Pipe()
        process = context.Process(target=fly_and_send, args=(there, spread_scene, seed))
        process.start()
        assert here.poll(120)
        assert here.recv() == expected[seed]
        process.join(60)
        assert process.exitcode == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork")
@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_gymnasiums_worker_processes_see_the_same(method, spread_scene: Scene):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"no {method} here")
    makers = [lambda: gymnasium.make("DQSpaceArm-v0", scene=spread_scene) for _ in range(3)]
    workers = AsyncVectorEnv(makers, context=method)
    try:
        assert flight(workers, 5, 150) == flight(SyncVectorEnv(makers), 5, 150)
    finally:
        workers.close()
