"""A user's program over the public names; `mypy --strict` accepts it, and it is never run.

`test_installation.py` checks it against the installed wheel.
"""

from pathlib import Path
from typing import assert_type

import numpy as np
from numpy.typing import NDArray

from agents import (
    DQSpaceArmVecEnv,
    ExportedPolicy,
    SB3VecEnv,
    compare,
    evaluate,
    export_policy,
    train,
)
from agents.zoo import list_policies, load_policy
from dq_space_arm_env import (
    CasadiDynamics,
    DQSpaceArmEnv,
    DQSpaceArmGoalEnv,
    DQSpaceArmGoalVectorEnv,
    DQSpaceArmVectorEnv,
    JaxDynamics,
    Kernels,
    Scene,
    SceneError,
    TorchDynamics,
    casadi_dynamics,
    compile_scene,
    from_pinocchio,
    generalized_forces,
    jax_dynamics,
    list_scenes,
    load_scene,
    pinocchio_model,
    scene_from_urdf,
    scene_to_mjcf,
    scene_to_urdf,
    to_pinocchio,
    torch_dynamics,
)
from experts import (
    BoxDDP,
    CasadiProblem,
    GuidedDDP,
    PythonProblem,
    RecedingHorizonExpert,
    ShootingProblem,
    Solution,
    StopReason,
    generate_demonstrations,
    load_demonstrations,
    runge_kutta,
)


def simulate(name: str) -> float:
    """Fly an episode, and a batch of states."""
    env = DQSpaceArmEnv(scene=name)
    env.reset(seed=0)
    _, reward, _, _, _ = env.step(env.action_space.sample())
    many = DQSpaceArmVectorEnv(8, name)
    observations, _ = many.reset(seed=0)
    goals = DQSpaceArmGoalEnv(scene="random-target")
    goals.reset(seed=0)
    DQSpaceArmGoalVectorEnv(8, "random-target").reset(seed=0)
    kernels = compile_scene(name)
    assert_type(kernels, Kernels)
    x = kernels.step(kernels.layout.initial_state, np.zeros(kernels.n_u))
    a, b = kernels.linearize(x, np.zeros(kernels.n_u))
    return float(reward) + float(np.sum(a)) + float(np.sum(b)) + len(observations)


def solve(scene: Scene) -> Solution:
    """Solve, in all ways that there are."""
    solution = BoxDDP(scene, threads=2).solve()
    assert_type(solution, Solution)
    control = solution.policy()(solution.states[0], 0)
    action = RecedingHorizonExpert(scene, horizon=50)(solution.states[0])
    other = GuidedDDP(scene).solve(solution.states[0])
    solution.save(Path("solution.npz"))
    return other if control.size + action.size else Solution.load("solution.npz")


def optimize(problem: ShootingProblem) -> StopReason:
    """Solve a problem of one's own."""
    return BoxDDP(problem).solve(problem.initial_state).stop_reason


def own_problems() -> list[StopReason]:
    """Write problems of one's own."""
    step = runge_kutta(lambda x, u: [x[1], u[0]], 0.1)
    given = step, lambda x, u: u[0] ** 2, lambda x: x[0] ** 2 + x[1] ** 2
    symbolic = CasadiProblem(*given, initial_state=[1, 0], n_controls=1, horizon=9, control_upper=1.0)
    plain = PythonProblem(*given, initial_state=np.ones(2), n_controls=1, horizon=9, parameters=())
    return [optimize(symbolic), optimize(plain)]


def other_engines(scene: Scene) -> NDArray[np.float64]:
    """Hand the dynamics to CasADi, PyTorch, JAX and Pinocchio."""
    dynamics = casadi_dynamics(scene, "rk4")
    assert_type(dynamics, CasadiDynamics)
    x, u = dynamics.layout.initial_state, np.zeros(dynamics.layout.n_u)
    assert_type(torch_dynamics(scene, threads=2), TorchDynamics)
    assert_type(jax_dynamics(scene, kernels=True), JaxDynamics)
    print(jax_dynamics(scene, "rk4").rollout(x, u[None]))
    print(dynamics.step(x, u, 0.01), pinocchio_model(scene), generalized_forces(scene, x, u))
    q, v = to_pinocchio(scene, x)
    return from_pinocchio(scene, q, v, (0.0, 0.0, 0.0))


def scenes(urdf: str) -> list[Scene]:
    """Load, change, import and export scenes."""
    try:
        scene = load_scene("paper").replace(base={"mass": 200.0, "inertia": [20.0, 20.0, 18.0]})
    except SceneError as error:
        raise SystemExit(str(error)) from error
    print(scene.to_yaml(), scene_to_urdf(scene), scene_to_mjcf(scene))
    return [scene, scene_from_urdf(urdf, "tool0"), *map(load_scene, list_scenes())]


def learn() -> NDArray[np.float64]:
    """Make demonstrations, train, compare."""
    generate_demonstrations("planar", n=8, out="demonstrations", seed=0)
    demonstrations = load_demonstrations("demonstrations")
    train("cloning", "run")
    adapter: type[SB3VecEnv] = DQSpaceArmVecEnv
    print(adapter.__name__, export_policy.__name__)
    copies = DQSpaceArmVecEnv(4, "planar", seed=0)
    print(copies.reset(), copies.num_envs)
    policy: ExportedPolicy = load_policy(list_policies()[0])
    evaluation = evaluate(policy, "paper", 8)
    compare(["run"])
    print(evaluation.success_rate, demonstrations[0].cost)
    return np.asarray(policy(np.zeros(24)), dtype=np.float64)
