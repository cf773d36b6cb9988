"""PPO of Stable-Baselines3 on the paper's maneuver: the wrappers that make it learn, and the trained policy.

Left alone, PPO learns next to nothing here. It learns with actions held for 0.3 s, gentle thrusters and base
torques, and rewards that grow like errors, not their squares: three wrappers. Needs the extra `agents`. The
output folder receives model.zip and vecnormalize.pkl, as Stable-Baselines3 saves them, and policy.npz, which
flies with NumPy alone.
Expect: in a minute on one core (4 million steps) the median errors at the end fall from 106 deg and 1.9 m to
6 deg and 0.35 m, and the median cost from 72,000 to 2,200; the optimum is 1,422 from the nominal start.
`dq-space-arm train ppo` trains longer, with an adaptive step size, and succeeds in 9 of 10 episodes.

    python scripts/examples/train_ppo.py [--steps 4000000] [--out results/examples/ppo]
"""

import argparse
import sys
from pathlib import Path
from time import perf_counter

import gymnasium
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize

import dq_space_arm_env  # registers the environments
from agents import SB3VecEnv, evaluate, export_policy
from agents.wrappers.vector import RepeatAction, ShapeReward, ShrinkActionSpace
from dq_space_arm_env.command_line.verb_program import run_to_end

REPEAT = 20
"""Time steps for which an action is held: 0.3 s in scene `paper`."""


def make_environment(scene: str, copies: int) -> VecNormalize:
    """Make the training environment."""
    env = gymnasium.make_vec(
        "DQSpaceArm-v0", num_envs=copies, scene=scene, autoreset_mode=AutoresetMode.SAME_STEP
    )
    env = RepeatAction(env, REPEAT)
    env = ShrinkActionSpace(env, {"base_force": 0.003, "base_torque": 0.05})
    env = RescaleAction(env, -1, 1)
    env = ShapeReward(env, scale=0.005, power=0.5, success_reward=0.5)
    return VecNormalize(SB3VecEnv(env), norm_reward=False)


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=4_000_000, help="environment steps of all copies")
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--copies", type=int, default=128)
    parser.add_argument("--starts", type=int, default=100, help="evaluation starts")
    parser.add_argument("--out", type=Path, default=Path("results/examples/ppo"))
    options = parser.parse_args(arguments)

    environment = make_environment(options.scene, options.copies)
    decisions = dq_space_arm_env.load_scene(options.scene).simulation.steps // REPEAT
    model = PPO(
        "MlpPolicy",
        environment,
        learning_rate=LinearSchedule(1e-3, 5e-5, 1.0),
        n_steps=decisions,  # a whole episode of each copy
        batch_size=min(1600, options.copies * decisions),
        n_epochs=10,
        gamma=0.98,
        policy_kwargs={"net_arch": [128, 128], "log_std_init": -1.0},
        seed=0,
        device="cpu",
    )
    untrained = evaluate(model, options.scene, options.starts, expert=False)
    started = perf_counter()
    model.learn(options.steps // REPEAT)
    print(f"trained for {perf_counter() - started:.0f} s")

    options.out.mkdir(parents=True, exist_ok=True)
    model.save(options.out / "model.zip")
    environment.save(str(options.out / "vecnormalize.pkl"))
    policy = export_policy(model, {"agent": "ppo example", "scene": options.scene})
    policy.save(options.out / "policy.npz")
    trained = evaluate(policy, options.scene, options.starts, expert=False)
    print(f"{'':>10} {'success':>8} {'attitude, deg':>14} {'position, m':>12} {'cost':>10}   (medians)")
    for name, found in (("untrained", untrained), ("trained", trained)):
        row = found.summary()
        errors = f"{row['attitude_error']:14.2f} {row['position_error']:12.3f} {row['median_cost']:10.0f}"
        print(f"{name:>10} {row['success_rate'][0]:8.0%} {errors}")
    print(f"watch the agent: dq-space-arm evaluate show {options.out / 'policy.npz'} --gif agent.gif")


if __name__ == "__main__":
    sys.exit(run_to_end(main))  # errors of the input as sentences
