"""NaN, infinities and denormals in every input: refused in a sentence, or kept to their row and reported."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene, load_scene
from dq_space_arm_env.environment import DQSpaceArmEnv
from dq_space_arm_env.environment.vector import DQSpaceArmVectorEnv
from dq_space_arm_env.scene import INTEGRATORS
from experts.ddp.box_ddp import BoxDDP
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.stability.cases import Case, Handled, NotClaimed, Outcome, Refused, refusal
from scripts.benchmarks.stability.scenes import PRECISIONS, applied, paper
from scripts.benchmarks.stability.time_steps import moving_start

GROUP = "bad numbers"

BAD = {"NaN": np.nan, "inf": np.inf, "-inf": -np.inf}
DENORMAL = 5e-324


def cases() -> Iterator[Case]:
    confined = "other rows of a batch have the bits that they have alone; the row has no wrong finite numbers"
    for name, precision in product(INTEGRATORS, PRECISIONS):
        run = partial(_confined, name, precision)
        title = "NaN and infinities in each entry of x and u"
        yield Case(GROUP, title, f"step, {applied(name, precision)}", confined, run, 0.0, "rows")
        few = 5.0 * float(np.finfo(precision).eps)
        criterion = f"finite, and within {few:.0e} of the step from zero"
        run = partial(_denormal_step, name, precision)
        title = "denormals in every entry of x and u"
        yield Case(GROUP, title, f"step, {applied(name, precision)}", criterion, run, few, "1")
    run = partial(_confined, None, "float64")
    title = "NaN and infinities in each entry of x and u"
    yield Case(GROUP, title, "forward dynamics", confined, run, 0.0, "rows")
    criterion = "finite, and within 1e-15 of those at zero"
    yield Case(
        GROUP,
        "denormals in every entry of x and u",
        "forward dynamics",
        criterion,
        _denormal_dynamics,
        1e-15,
        "1",
    )
    for text, number in BAD.items():
        criterion = "refused, naming dt"
        run = partial(_time_step, number)
        yield Case(GROUP, f"{text} as dt", "step, simulate, linearize", criterion, run)
        yield Case(
            GROUP, f"{text} as duration", "integrate", "refused, naming it", partial(_duration, number)
        )
        criterion = "refused, naming the field; but limits may be infinite"
        yield Case(GROUP, f"{text} in each number of a scene", "scene", criterion, partial(_scene, number))
        criterion = "refused, naming the option"
        run = partial(_reset, number)
        yield Case(GROUP, f"{text} in each entry of the initial state", "environment, reset", criterion, run)
        yield Case(GROUP, f"{text} in x0", "expert", "refused, naming x0", partial(_expert, number))
        yield Case(
            GROUP, f"{text} in u_init", "expert", "refused, naming u_init", partial(_expert_controls, number)
        )
    yield Case(GROUP, "NaN in each entry of an action", "environment, step", "refused", _nan_action)
    criterion = "refused, naming the copy"
    title = "NaN in an action of one copy"
    yield Case(GROUP, title, "vector environment, step", criterion, _nan_action_of_one_copy, 0.0, "copies")
    criterion = "clipped to the limits: the bits of an action of 1 or -1"
    title = "infinities in each entry of an action"
    yield Case(GROUP, title, "environment, step", criterion, _infinite_action, 0.0, "entries")
    criterion = "finite, and within 1e-15 of no action"
    yield Case(GROUP, "denormal action", "environment, step", criterion, _denormal_action, 1e-15, "1")
    yield Case(GROUP, "velocities of 1e200", "environment", "refused, naming the option", _overflowing_reset)
    criterion = "terminated and diverged; observation and reward finite"
    title = "states that overflow during an episode"
    yield Case(GROUP, title, "environment, step", criterion, _overflow, 0.0, "numbers")


def _rows(kernels: Kernels) -> tuple[FloatArray, FloatArray]:
    """A batch of sound states and inputs."""
    count = 2 * kernels.lanes + 1
    rng = np.random.default_rng(0)
    return np.tile(moving_start(kernels), (count, 1)), rng.normal(size=(count, kernels.n_u))


def _confined(integrator: str | None, precision: str, effort: Effort) -> Outcome:
    kernels = paper(precision)
    states, controls = _rows(kernels)

    def results(x: FloatArray, u: FloatArray) -> Any:
        if integrator is None:
            return kernels.forward_dynamics(x, u)
        return kernels.step(x, u, integrator=integrator)

    sound = np.array([results(*row) for row in zip(states, controls, strict=True)])
    touched, quiet, hit = 0, 0, 2
    others = [row for row in range(len(states)) if row != hit]
    with np.errstate(all="ignore"):
        for array in (states, controls):
            for entry in range(array.shape[1]):
                for number in BAD.values():
                    kept, array[hit, entry] = array[hit, entry], number
                    found = results(states, controls)
                    array[hit, entry] = kept
                    finite = np.isfinite(found[hit])
                    touched += int(not np.array_equal(found[others], sound[others]))
                    touched += int(not np.array_equal(found[hit, finite], sound[hit, finite]))
                    quiet += int(finite.all())
    note = f"{quiet} of the bad entries do not enter the result" if quiet else "each shows as NaN or inf"
    return Handled(float(touched), note)


def _denormals(kernels: Kernels) -> tuple[FloatArray, FloatArray]:
    """The paper's robot at the origin, every zero replaced by the smallest number."""
    smallest = float(np.finfo(kernels.dtype).smallest_subnormal)
    x, u = np.full(kernels.n_x, smallest), np.full(kernels.n_u, smallest)
    x[0] = 1.0
    return x, u


def _denormal_step(integrator: str, precision: str, effort: Effort) -> Outcome:
    kernels = paper(precision)
    x, u = _denormals(kernels)
    zero = np.zeros(kernels.n_x)
    zero[0] = 1.0
    exact = kernels.step(zero, np.zeros(kernels.n_u), integrator=integrator)
    return Handled(float(np.abs(kernels.step(x, u, integrator=integrator) - exact).max()))


def _denormal_dynamics(effort: Effort) -> Outcome:
    kernels = compile_scene("paper")
    return Handled(float(np.abs(kernels.forward_dynamics(*_denormals(kernels))).max()))


def _time_step(number: float, effort: Effort) -> Outcome:
    kernels = compile_scene("paper")
    x, u = moving_start(kernels), np.zeros(kernels.n_u)
    calls = (
        partial(kernels.step, x, u, number),
        partial(kernels.simulate, x, u, 10, number),
        partial(kernels.linearize, x, u, number),
    )
    return _all_refused(calls, "dt")


def _duration(number: float, effort: Effort) -> Outcome:
    kernels = compile_scene("paper")
    x, u = moving_start(kernels), np.zeros(kernels.n_u)
    return refusal(lambda: kernels.integrate(x, u, number), naming="duration")


def _scene(number: float, effort: Effort) -> Outcome:
    data = load_scene("paper").model_dump()
    sentences = []
    for path in _numbers(data):
        if number == np.inf and "limit" in path[-2:]:
            continue
        attempt = partial(Scene.model_validate, _replaced(data, path, number))
        field = next(key for key in reversed(path) if isinstance(key, str))
        sentences.append(refusal(attempt, naming=field).sentence)
    return Refused(sentences[0])


def _numbers(data: Any, path: tuple[str | int, ...] = ()) -> Iterator[tuple[str | int, ...]]:
    """Paths of the numbers in nested dictionaries and lists."""
    if isinstance(data, dict | list | tuple):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from _numbers(value, (*path, key))
    elif isinstance(data, int | float) and not isinstance(data, bool):
        yield path


def _replaced(data: Any, path: tuple[str | int, ...], number: float) -> Any:
    """The same with another number in one place."""
    if not path:
        return number
    entries = dict(data.items() if isinstance(data, dict) else enumerate(data))
    entries[path[0]] = _replaced(entries[path[0]], path[1:], number)
    return entries if isinstance(data, dict) else list(entries.values())


def _all_refused(attempts: Iterable[Callable[[], object]], naming: str) -> Outcome:
    sentences = [refusal(attempt, naming=naming) for attempt in attempts]
    return sentences[0]


def _reset(number: float, effort: Effort) -> Outcome:
    env = DQSpaceArmEnv("paper")
    attempts: list[Callable[[], object]] = []
    for entry in range(env.kernels.n_x):
        x = env.kernels.layout.initial_state.copy()
        x[entry] = number
        attempts.append(partial(env.reset, options={"initial_state": x}))
    return _all_refused(attempts, "initial_state")


def _expert_controls(number: float, effort: Effort) -> Outcome:
    solver = BoxDDP("planar", max_iterations=1)
    controls = np.zeros((solver.problem.horizon, solver.problem.n_controls))
    controls[-1, -1] = number
    return refusal(lambda: solver.solve(u_init=controls), naming="u_init")


def _expert(number: float, effort: Effort) -> Outcome:
    solver = BoxDDP("planar", max_iterations=1)
    x = np.array(solver.problem.initial_state)
    x[-1] = number
    return refusal(lambda: solver.solve(x), naming="x0")


def _begun() -> DQSpaceArmEnv:
    env = DQSpaceArmEnv("paper")
    env.reset(options={"nominal": True})
    return env


def _nan_action(effort: Effort) -> Outcome:
    attempts: list[Callable[[], object]] = []
    for scene in ("paper", "wheels", "thrusters"):
        env = DQSpaceArmEnv(scene)
        env.reset(options={"nominal": True})
        for entry in range(env.kernels.n_u):
            action = np.zeros(env.kernels.n_u)
            action[entry] = np.nan
            attempts.append(partial(env.step, action))
    return _all_refused(attempts, "action")


def _nan_action_of_one_copy(effort: Effort) -> Outcome:
    env = DQSpaceArmVectorEnv(scene="paper", num_envs=5)
    env.reset(options={"nominal": True})
    actions = np.zeros(env.action_space.shape or ())
    actions[2, 3] = np.nan
    return refusal(lambda: env.step(actions), naming="sub-environments [2]")


def _infinite_action(effort: Effort) -> Outcome:
    differing = 0
    for entry in range(compile_scene("paper").n_u):
        for number in (np.inf, -np.inf):
            action = np.zeros(compile_scene("paper").n_u)
            action[entry] = number
            found = _begun().step(action)[0]
            action[entry] = np.sign(number)
            differing += int(not np.array_equal(found, _begun().step(action)[0]))
    return Handled(float(differing))


def _denormal_action(effort: Effort) -> Outcome:
    n_u = compile_scene("paper").n_u
    still, moved = _begun().step(np.zeros(n_u))[0], _begun().step(np.full(n_u, DENORMAL))[0]
    return Handled(float(np.abs(still - moved).max()))


def _overflowing_reset(effort: Effort) -> Outcome:
    env = DQSpaceArmEnv("paper")
    x = env.kernels.layout.initial_state.copy()
    x[env.kernels.layout.state.base_velocity] = 1e200
    return refusal(lambda: env.reset(options={"initial_state": x}), naming="initial_state")


def _overflow(effort: Effort) -> Outcome:
    env = DQSpaceArmEnv("paper")
    x = env.kernels.layout.initial_state.copy()
    x[env.kernels.layout.state.joint_rates] = 1e5
    env.reset(options={"initial_state": x})
    for _ in range(env.scene.simulation.steps):
        observation, reward, terminated, _, info = env.step(np.zeros(env.kernels.n_u))
        info.pop("step_error")  # of a step that is given up it is NaN
        numbers = np.array([*observation, reward, *(float(value) for value in info.values())])
        if not np.isfinite(numbers).all():
            return Handled(np.inf, "an observation or a reward is not finite")
        if terminated:
            break
    if not (terminated and info["diverged"]):
        return NotClaimed("the motion did not overflow")
    return Handled(0.0, "the episode ends, diverged")
