"""How fast the compiled kernels and the environments are, timed on one thread beside other engines.

Times are wall-clock times per state, the best and the median of several samples; the samples of all cases
take turns, so that a disturbance of the machine does not fall on one of them alone. With every engine's time
stands how far its results are from ours, or from a reference.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene
from dq_space_arm_env.scene import INTEGRATORS
from dq_space_arm_env.scene.start import number_of_draws, start_from_draws
from experts.problem import FloatArray

if TYPE_CHECKING:
    from experts.report.throughput_peers import Peer

DYNAMICS, STEP, ENVIRONMENT = "forward dynamics", "step", "environment step"
OURS = "dq-space-arm"
SCALAR, VECTOR = "scalar kernel", "vector kernel"
MAKE, MAKE_VEC, UNWRAPPED = "gymnasium.make", "gymnasium.make_vec", "without wrappers"
COMPARED_STATES, COMPARED_STEPS = 64, 64
_REFERENCE_SUBSTEPS = 16


@dataclass(frozen=True)
class Case:
    """Something to time.

    Attributes:
        what: DYNAMICS, STEP or ENVIRONMENT.
        engine: Who computes it.
        way: How it is called.
        integrator: Name of the integrator; empty for dynamics.
        batch: States that a call of `run` handles.
        run: Does it.
        operations: Arithmetic operations per state; None if not known.
        arrays: What `run` works on, where it only knows addresses; kept alive with the case.
    """

    what: str
    engine: str
    way: str
    integrator: str
    batch: int
    run: Callable[[], object]
    operations: int | None = None
    arrays: Sequence[FloatArray] = ()


@dataclass(frozen=True)
class Timing:
    """Time of a case, per state.

    Attributes:
        what: As of the case, and so are engine, way, integrator, batch and operations.
        best_ns: Shortest sample, ns per state.
        median_ns: Median of the samples, ns per state.
    """

    what: str
    engine: str
    way: str
    integrator: str
    batch: int
    operations: int | None
    best_ns: float
    median_ns: float


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes:
        batch_sizes: States per call.
        repeats: Samples of each case.
        sample_seconds: Shortest duration of a sample, s.
    """

    batch_sizes: tuple[int, ...] = (1, 8, 64, 256, 1024, 4096, 16384)
    repeats: int = 9
    sample_seconds: float = 0.02


QUICK = Effort((1, 64, 1024), repeats=3, sample_seconds=0.002)


@dataclass(frozen=True)
class Agreement:
    """How far an engine's results are off.

    Attributes:
        quantity: What is compared.
        engine: Whose results.
        reference: What they are compared with.
        integrator: Name of the integrator; empty for dynamics.
        error: Largest error over the compared states.
        unit: Its unit; "1" for relative errors.
    """

    quantity: str
    engine: str
    reference: str
    integrator: str
    error: float
    unit: str


@dataclass(frozen=True)
class SceneThroughput:
    """What is measured of a scene.

    Attributes:
        scene: Its name.
        dt: Its time step, s.
        timings: All times.
        agreements: All errors.
        notes: What is left out.
    """

    scene: str
    dt: float
    timings: list[Timing]
    agreements: list[Agreement]
    notes: list[str]


@dataclass(frozen=True)
class Ratio:
    """A peer's time and ours for the same thing.

    Attributes:
        peer: The peer's time.
        kernel: Our kernel's: called on one state if the peer is, otherwise at the fastest batch size.
        environment: Our vector environment's at its fastest batch size; None for dynamics.
    """

    peer: Timing
    kernel: Timing
    environment: Timing | None

    @property
    def kernel_speed(self) -> float:
        """Our kernel's states per second over the peer's."""
        return self.peer.best_ns / self.kernel.best_ns

    @property
    def environment_speed(self) -> float | None:
        """Our environment's steps per second, with observation and reward, over the peer's without them."""
        return None if self.environment is None else self.peer.best_ns / self.environment.best_ns


def ratios(result: SceneThroughput) -> list[Ratio]:
    """Compare each peer's times with ours.

    Args:
        result: What is measured of a scene.

    Returns:
        The comparisons, in the order of the peers' times.
    """

    def fastest(what: str, integrator: str, single: bool) -> Timing | None:
        ours = [
            timing
            for timing in result.timings
            if (timing.engine, timing.what, timing.integrator) == (OURS, what, integrator)
            and (not single or timing.batch == 1)
        ]
        return min(ours, key=lambda timing: timing.best_ns, default=None)

    found = []
    for peer in result.timings:
        if peer.engine != OURS:
            kernel = fastest(peer.what, peer.integrator, single=peer.batch == 1)
            if kernel is not None:
                environment = fastest(ENVIRONMENT, peer.integrator, single=False)
                found.append(Ratio(peer, kernel, environment))
    return found


def measure_scene(scene: Scene, effort: Effort) -> SceneThroughput:
    """Time kernels, environments and the installed peers on one scene.

    Args:
        scene: The scene.
        effort: How much to measure.

    Returns:
        Times and errors.
    """
    # Imported here: it needs this module's cases.
    from experts.report.throughput_peers import peers_of

    kernels = compile_scene(scene)
    peers, notes = peers_of(kernels)
    x, u = sample_states(kernels, max(COMPARED_STATES, *effort.batch_sizes))
    cases = [*_kernel_cases(kernels, x, u, effort), *_environment_cases(scene, effort)]
    for peer in peers:
        cases += peer.cases(x[:1024], u[:1024])
    agreements = _agreements(kernels, peers, x[:COMPARED_STATES], u[:COMPARED_STATES])
    return SceneThroughput(scene.name, scene.simulation.dt, time_cases(cases, effort), agreements, notes)


def sample_states(kernels: Kernels, count: int) -> tuple[FloatArray, FloatArray]:
    """Draw moving states around the scene's start, and inputs within their limits, always the same.

    Args:
        kernels: Functions of the scene.
        count: How many.

    Returns:
        States, shape (count, n_x), and inputs, shape (count, n_u); an input without limit is within 1 unit.
    """
    rng = np.random.default_rng(0)
    layout, scene = kernels.layout, kernels.scene
    x = start_from_draws(scene, rng.uniform(-1.0, 1.0, (count, number_of_draws(scene))))
    for part, size in ((layout.state.base_velocity, 0.2), (layout.state.joint_rates, 0.5)):
        x[:, part] += rng.uniform(-size, size, x[:, part].shape)
    limit = np.where(np.isfinite(layout.control_limit), layout.control_limit, 1.0)
    return x, limit * rng.uniform(-1.0, 1.0, (count, kernels.n_u))


def time_cases(cases: Sequence[Case], effort: Effort) -> list[Timing]:
    """Time cases, each warmed up, in turns.

    Args:
        cases: What to time.
        effort: How much to measure.

    Returns:
        Their times, in the same order.
    """
    calls = []
    for case in cases:
        case.run()
        once = _seconds(case.run, 1)
        calls.append(max(1, math.ceil(effort.sample_seconds / max(once, 1e-9))))
    samples: list[list[float]] = [[] for _ in cases]
    for _ in range(effort.repeats):
        for case, count, times in zip(cases, calls, samples, strict=True):
            case.run()  # the cases before have filled the processor's caches
            times.append(1e9 * _seconds(case.run, count) / (count * case.batch))
    return [
        Timing(
            case.what,
            case.engine,
            case.way,
            case.integrator,
            case.batch,
            case.operations,
            min(times),
            float(np.median(times)),
        )
        for case, times in zip(cases, samples, strict=True)
    ]


def _seconds(run: Callable[[], object], calls: int) -> float:
    """Duration of some calls without the garbage collector, as `timeit` does it."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        start = time.perf_counter()
        for _ in range(calls):
            run()
        return time.perf_counter() - start
    finally:
        if collecting:
            gc.enable()


def _kernel_cases(kernels: Kernels, x: FloatArray, u: FloatArray, effort: Effort) -> list[Case]:
    """Forward dynamics and steps by scalar and vector kernels, for each batch size."""
    inputs = {"x": x, "u": u, "h": np.array([kernels.scene.simulation.dt])}
    programs = [(DYNAMICS, "forward_dynamics", ""), *((STEP, "step", name) for name in INTEGRATORS)]
    cases = []
    for what, program, integrator in programs:
        for way, lanes in ((SCALAR, 1), (VECTOR, None)):
            kernel = kernels.kernel(program, integrator=integrator or None, lanes=lanes)
            for batch in effort.batch_sizes:
                # The addresses are handed over once, as environments do it.
                arrays = [np.ascontiguousarray(inputs[spec.name][:batch]) for spec in kernel.inputs]
                arrays += [np.zeros((batch, spec.stride)) for spec in kernel.outputs]
                arrays.append(np.array([array.ctypes.data for array in arrays], dtype=np.int64))
                run = partial(kernel.native.function, 0, batch, arrays[-1].ctypes.data)
                count = kernel.operation_count
                cases.append(Case(what, OURS, way, integrator, batch, run, count, arrays))
    return cases


def _environment_cases(scene: Scene, effort: Effort) -> list[Case]:
    """Vector environments of each size and single ones, with each integrator, actions in [-1, 1]."""
    cases = []
    for integrator in INTEGRATORS:
        simulation = {**scene.simulation.model_dump(), "integrator": integrator}
        variant = scene.replace(simulation=simulation)
        env = gymnasium.make("DQSpaceArm-v0", scene=variant)
        bare = gymnasium.make("DQSpaceArm-v0", scene=variant).unwrapped
        for way, single in ((MAKE, env), (UNWRAPPED, bare)):
            cases.append(Case(ENVIRONMENT, OURS, way, integrator, 1, _single_run(single)))
        for batch in effort.batch_sizes:
            run = _vector_run(gymnasium.make_vec("DQSpaceArm-v0", num_envs=batch, scene=variant))
            cases.append(Case(ENVIRONMENT, OURS, MAKE_VEC, integrator, batch, run))
    return cases


def _alternating(space: gymnasium.Space[Any]) -> Any:
    """An action and its opposite in turns, so that the robot does not spin up."""
    space.seed(0)
    action = space.sample()
    return cycle((action, -action))


def _single_run(env: gymnasium.Env[Any, Any]) -> Callable[[], object]:
    actions = _alternating(env.action_space)
    env.reset(seed=0)

    def run() -> None:
        if env.step(next(actions))[2]:
            env.reset()

    return run


def _vector_run(env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> Callable[[], object]:
    actions = _alternating(env.action_space)
    env.reset(seed=0)
    return lambda: env.step(next(actions))


def _agreements(kernels: Kernels, peers: Sequence[Peer], x: FloatArray, u: FloatArray) -> list[Agreement]:
    """Accelerations against each peer's, and every engine's joint angles against a finer integration."""
    ours = kernels.forward_dynamics(x, u)
    one_by_one = np.array([kernels.forward_dynamics(*row) for row in zip(x, u, strict=True)])
    quantity, motion = "accelerations", f"joint angles after {COMPARED_STEPS} steps"
    found = [Agreement(quantity, VECTOR, SCALAR, "", _relative(ours, one_by_one), "1")]
    for peer in peers:
        found.append(Agreement(quantity, OURS, peer.name, "", _relative(ours, peer.accelerations(x, u)), "1"))
    substeps = COMPARED_STEPS * _REFERENCE_SUBSTEPS
    reference = _end_angles(kernels, x, "rk4", substeps, kernels.scene.simulation.dt / _REFERENCE_SUBSTEPS)
    finer = f"RK4 of {OURS}, dt/{_REFERENCE_SUBSTEPS}"
    for integrator in INTEGRATORS:
        angles: list[tuple[str, FloatArray | None]] = [
            (OURS, _end_angles(kernels, x, integrator, COMPARED_STEPS, kernels.scene.simulation.dt))
        ]
        angles += [(peer.name, peer.end_angles(x, integrator, COMPARED_STEPS)) for peer in peers]
        for engine, values in angles:
            if values is not None:
                error = float(np.abs(values - reference).max(initial=0.0))
                found.append(Agreement(motion, engine, finer, integrator, error, "rad"))
    return found


def _relative(actual: FloatArray, expected: FloatArray) -> float:
    """Largest relative error of a row."""
    error = np.linalg.norm(actual - expected, axis=1) / np.linalg.norm(expected, axis=1)
    return float(error.max())


def _end_angles(kernels: Kernels, x: FloatArray, integrator: str, steps: int, dt: float) -> FloatArray:
    """Joint angles after steps without inputs."""
    u = np.zeros((len(x), kernels.n_u))
    for _ in range(steps):
        x = kernels.step(x, u, dt, integrator)
    return x[:, kernels.layout.state.joint_angles]


def to_record(result: SceneThroughput) -> dict[str, Any]:
    """Write what is measured of a scene in JSON's types.

    Args:
        result: What is measured.

    Returns:
        Its fields, with states per second and operations per ns, and the ratios.
    """
    record = asdict(result)
    for timing in record["timings"]:
        timing["states_per_second"] = 1e9 / timing["best_ns"]
        if timing["operations"] is not None:
            timing["operations_per_ns"] = timing["operations"] / timing["best_ns"]
    record["ratios"] = [
        {
            **asdict(ratio),
            "kernel_speed": ratio.kernel_speed,
            "environment_speed": ratio.environment_speed,
        }
        for ratio in ratios(result)
    ]
    return record
