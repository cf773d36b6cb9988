"""The machines of a Ray cluster give what this process gives, also when one of them is lost."""

import os
import pickle
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from demonstration_files import contents

from dq_space_arm_env import Scene
from experts import generate_demonstrations, ray_executor
from experts.demonstrations import Demonstrations, DemonstrationsError, RayExecutor
from experts.demonstrations.settings import Settings, software
from experts.demonstrations.shard import Task
from experts.executors import ExecutorError


def wait_until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


class LocalCluster:
    """Machines with a processor each, all of them this one."""

    def __init__(self, folder: str) -> None:
        from ray.cluster_utils import Cluster

        self._cluster = Cluster()
        self._nodes = [self._cluster.add_node(num_cpus=1, temp_dir=folder, include_dashboard=False)]

    @property
    def address(self) -> str:
        return self._cluster.address

    @property
    def victim(self) -> str:
        """The machine that will be killed."""
        return self._nodes[-1].node_id

    def fill_up(self) -> None:
        """Three machines in all."""
        while len(self._nodes) < 3:
            self._nodes.append(self._cluster.add_node(num_cpus=1))

    def kill_machine(self) -> None:
        """Kill everything that runs on the victim, all at once."""
        import psutil  # which Ray brings along

        node = self._nodes.pop()
        raylet = psutil.Process(node.all_processes["raylet"][0].process.pid)
        victims = [raylet, *raylet.children(recursive=True)]
        assert any("ray::" in " ".join(victim.cmdline()) for victim in victims)
        for victim in victims:
            victim.send_signal(signal.SIGKILL)
        self._cluster.remove_node(node, allow_graceful=False)

    def shut_down(self) -> None:
        import ray

        ray.shutdown()
        self._cluster.shutdown()


@pytest.fixture(scope="module")
def machines() -> Iterator[LocalCluster]:
    pytest.importorskip("ray")
    # The paths of its sockets have to be short.
    folder = tempfile.mkdtemp(prefix="ray-", dir="/tmp")
    # Ray notes the address of a cluster here, whatever its own folder, and expects the folder to exist.
    Path("/tmp/ray").mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")  # 15 by default: other tests would starve its tasks
        cluster = LocalCluster(folder)
    try:
        yield cluster
    finally:
        cluster.shut_down()
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def cluster(machines: LocalCluster) -> LocalCluster:
    machines.fill_up()
    return machines


@pytest.fixture
def tasks(quick_scene: Scene) -> list[Task]:
    """Those of the whole data set."""
    settings = Settings.of(quick_scene, 18, 3, 4)
    return [Task(settings, shard) for shard in range(settings.n_shards)]


def direct(monkeypatch: pytest.MonkeyPatch, folder: Path, victim: str, victim_hangs: bool) -> Path:
    """Make the order of events certain; the file gets a line for each task that begins, with its machine.

    Either the victim begins first, and never ends, or it alone makes shards until there is a file `go`.
    """
    begun, go, original = folder / "begun", folder / "go", ray_executor.remote_task()

    def make(expected: dict[str, Any], software: bytes, packed: bytes) -> Any:
        import ray

        machine = ray.get_runtime_context().get_node_id()
        with begun.open("a") as file:
            file.write(f"{machine}\n")
        if victim_hangs:
            while machine == victim or victim not in begun.read_text():
                time.sleep(0.05)
        else:
            while machine != victim and not go.exists():
                time.sleep(0.05)
        return original(expected, software, packed)

    monkeypatch.setattr(ray_executor, "remote_task", lambda: make)
    return begun


@pytest.mark.ray
@pytest.mark.slow
def test_a_machine_killed_under_way_changes_no_byte(
    cluster: LocalCluster,
    whole: Demonstrations,
    quick_scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
):
    begun = direct(monkeypatch, tmp_path, cluster.victim, victim_hangs=True)
    handler, advances = signal.getsignal(signal.SIGTERM), []

    def kill(advance) -> None:
        advances.append(advance)
        if len(advances) == 2:
            cluster.kill_machine()

    out, executor = tmp_path / "data", RayExecutor(cluster.address)
    made = generate_demonstrations(quick_scene, 18, out, 3, shard_size=4, executor=executor, progress=kill)
    assert made is not None
    assert contents(out) == contents(whole.path)
    assert len(begun.read_text().splitlines()) == 6
    assert len(advances) == 6
    # It leaves no trace, neither on the terminal nor in this process.
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""
    assert signal.getsignal(signal.SIGTERM) == handler


@pytest.mark.ray
@pytest.mark.endurance
def test_shards_lost_with_the_machine_that_has_made_them_are_made_again(
    cluster: LocalCluster,
    whole: Demonstrations,
    tasks: list[Task],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
):
    """The victim makes three of five, and one is fetched. A connection that is there is used, and kept."""
    import ray

    begun = direct(monkeypatch, tmp_path, cluster.victim, victim_hangs=False)
    ray.init(cluster.address, log_to_driver=False, logging_level="ERROR")
    try:
        results = RayExecutor().run(tasks)
        made = [next(results)]
        wait_until(lambda: begun.read_text().count(cluster.victim) == 3)
        wait_until(lambda: ray.available_resources().get("CPU") == 1.0)
        cluster.kill_machine()
        (tmp_path / "go").touch()
        made += results
        assert ray.is_initialized()
    finally:
        ray.shutdown()
    assert len(begun.read_text().splitlines()) == 7
    digests = [entry["sha256"] for entry in whole.manifest["shards"]]
    assert {result.shard: result.sha256 for result in made} == dict(enumerate(digests))
    assert len(made) == 5


class _Cluster:
    """What the executor asks of Ray; `outcome` of a shard and its attempt names an error, or is None."""

    class exceptions:  # noqa: N801 - named like Ray's module
        RayError = type("RayError", (Exception,), {})
        RayTaskError = type("RayTaskError", (RayError,), {})
        WorkerCrashedError = type("WorkerCrashedError", (RayError,), {})
        NodeDiedError = type("NodeDiedError", (RayError,), {})
        ObjectLostError = type("ObjectLostError", (RayError,), {})
        OutOfMemoryError = type("OutOfMemoryError", (RayError,), {})
        LocalRayletDiedError = type("LocalRayletDiedError", (RayError,), {})

    def __init__(self, outcome: Callable[[int, int], str | None]) -> None:
        self.outcome, self.attempts, self.orders_to_end = outcome, [], Counter()

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2.0}

    def remote(self, **options: Any) -> Callable[[Any], "_Cluster"]:
        assert options["max_retries"] == 0
        self_ = self

        class Remote:
            def remote(self, expected: Any, software: bytes, packed: bytes) -> tuple[int, int]:
                shard = pickle.loads(packed).shard
                self_.attempts.append(shard)
                return shard, self_.attempts.count(shard)

        return lambda function: Remote()

    def wait(
        self, references: list[Any], num_returns: int = 1, **options: Any
    ) -> tuple[list[Any], list[Any]]:
        if not self.orders_to_end:
            return references[:num_returns], references[num_returns:]
        ended = [
            reference for reference in references if self.orders_to_end[reference] > 1
        ]  # the first is lost
        return ended, [reference for reference in references if reference not in ended]

    def get(self, reference: tuple[int, int]) -> Any:
        failure = self.outcome(*reference)
        if failure is not None:
            raise getattr(self.exceptions, failure)(f"{failure}: gone\nand more")
        return reference, None

    def cancel(self, reference: tuple[int, int], force: bool) -> None:
        assert force
        self.orders_to_end[reference] += 1


def test_losses_are_counted_shard_by_shard(tasks: list[Task], monkeypatch: pytest.MonkeyPatch):
    """A shard that is lost now and then is made again; one that is always lost ends the run."""
    monkeypatch.setattr(ray_executor, "sleep", lambda seconds: None)
    kinds = ["WorkerCrashedError", "NodeDiedError", "ObjectLostError", "OutOfMemoryError"]
    sometimes = _Cluster(lambda shard, attempt: kinds[attempt % 4] if attempt <= shard else None)
    made = list(ray_executor._run_on(sometimes, tasks))
    assert sorted(made) == [(shard, shard + 1) for shard in range(5)]
    always = _Cluster(lambda shard, attempt: "WorkerCrashedError" if shard == 2 else None)
    with pytest.raises(DemonstrationsError, match=r"shard 2 was lost 11 times .*: WorkerCrashedError: gone$"):
        list(ray_executor._run_on(always, tasks))
    assert always.attempts.count(2) == ray_executor.MOST_LOSSES + 1


def test_a_lost_cluster_is_not_a_shard_lost_eleven_times(tasks: list[Task]):
    cluster = _Cluster(lambda shard, attempt: "LocalRayletDiedError")
    with pytest.raises(ExecutorError, match=r"^the Ray cluster cannot go on: LocalRayletDiedError"):
        list(ray_executor._run_on(cluster, tasks))
    assert len(cluster.attempts) <= len(tasks)


def test_tasks_that_miss_the_order_to_end_get_it_again(tasks: list[Task]):
    cluster = _Cluster(lambda shard, attempt: None)
    results = ray_executor._run_on(cluster, tasks)
    next(results)
    results.close()
    assert cluster.orders_to_end == {(task.shard, 1): 2 for task in tasks[1:]}


@pytest.mark.ray
@pytest.mark.endurance
def test_few_tasks_are_under_way_and_they_end_with_the_generator(cluster: LocalCluster, quick_scene: Scene):
    import ray

    settings, taken = Settings.of(quick_scene, 1_000_000, 3, 10_000), []  # minutes for each task

    def endless() -> Iterator[Task]:
        yield Task(Settings.of(quick_scene, 1, 3, 1), 0)
        for shard in range(settings.n_shards):
            taken.append(shard)
            yield Task(settings, shard)

    ray.init(cluster.address, log_to_driver=False, logging_level="ERROR")
    try:
        results = RayExecutor().run(endless())
        assert next(results).demonstrations == 1
        most = 3 * ray_executor.AHEAD + ray_executor.WAITING
        assert len(taken) <= most
        wait_until(lambda: "CPU" not in ray.available_resources())
        results.close()
        wait_until(lambda: ray.available_resources().get("CPU") == 3.0)
    finally:
        ray.shutdown()


@pytest.mark.ray
@pytest.mark.slow
def test_ctrl_c_ends_the_script_and_its_tasks(cluster: LocalCluster, quick_scene: Scene, tmp_path: Path):
    import ray

    quick_scene.to_yaml(tmp_path / "quick.yaml")
    out, root = tmp_path / "data", Path(__file__).parents[2]
    command = [sys.executable, "-m", "dq_space_arm_env", "demonstrations", "generate", "--out", str(out)]
    command += ["--scene", str(tmp_path / "quick.yaml"), "-n", "100000", "--ray", cluster.address]
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(root)},
    ) as process:
        wait_until(lambda: process.poll() is not None or len([*out.glob("shards/0*")]) >= 2, 120.0)
        os.killpg(process.pid, signal.SIGINT)
        output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "Interrupted: complete shards remain" in " ".join(output.split())
    assert "Traceback" not in output
    ray.init(cluster.address, log_to_driver=False, logging_level="ERROR")
    try:
        wait_until(lambda: ray.available_resources().get("CPU") == 3.0, 30.0)
    finally:
        ray.shutdown()


@pytest.mark.ray
@pytest.mark.slow
def test_machines_with_other_software_are_refused(
    cluster: LocalCluster, tasks: list[Task], monkeypatch: pytest.MonkeyPatch
):
    import ray

    def other() -> dict[str, Any]:
        return {**software(), "source": "another"}

    # Machines find the function under this name.
    other.__module__, other.__qualname__ = Task.__module__, "Task.software"
    monkeypatch.setattr(Task, "software", staticmethod(other))
    with pytest.raises(ExecutorError, match=r'other software: source is .* there and "another" here'):
        list(RayExecutor(cluster.address).run(tasks))
    assert not ray.is_initialized()


def test_a_machine_without_this_package_says_so(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delattr("experts.ray_executor")
    monkeypatch.setitem(sys.modules, "experts.ray_executor", None)
    _, sentence = ray_executor.remote_task()(software(), b"", b"")
    assert sentence is not None
    assert "cannot load this version of dq-space-arm" in sentence


def test_without_ray_a_sentence_tells_how_to_get_it(monkeypatch: pytest.MonkeyPatch, tasks: list[Task]):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ExecutorError, match=r"pip install 'dq-space-arm\[ray\]'"):
        next(RayExecutor().run(tasks))


@pytest.mark.ray
def test_a_cluster_that_is_not_there_is_noticed_soon(tasks: list[Task]):
    pytest.importorskip("ray")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(ExecutorError, match=f"no Ray cluster can be used at 127.0.0.1:{port}: .*refused"):
        next(RayExecutor(f"127.0.0.1:{port}").run(tasks))


def test_one_process_compiles_and_those_that_come_meanwhile_follow_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """The lock belongs to the open file, so threads stand for processes."""
    monkeypatch.setenv("DQ_SPACE_ARM_CACHE", str(tmp_path / "cache"))
    together = threading.Barrier(3)

    def follow() -> None:
        with ray_executor._first_alone():
            together.wait(30.0)

    followers = [threading.Thread(target=follow) for _ in range(2)]
    with ray_executor._first_alone():
        for follower in followers:
            follower.start()
        time.sleep(0.2)
        assert together.n_waiting == 0
    together.wait(30.0)
    for follower in followers:
        follower.join()
