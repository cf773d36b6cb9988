"""First steps: an episode without any input, and the optimal one from the same start.

Shows how to create an environment, solve its scene with the expert, and fly the solution step by step.
Expect: doing nothing leaves the tip far from its target. The expert's controls bring it there, within the
scene's tolerances, and that episode's rewards sum to minus the solution's cost. The first run compiles
machine code, which takes about a minute; later runs load it from the cache.

    python scripts/examples/first_steps.py [--scene paper] [--out results/examples]
"""

import argparse
import sys
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np

from dq_space_arm_env import compile_scene  # importing it registers the environment
from dq_space_arm_env.command_line.verb_program import run_to_end
from experts import BoxDDP


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--out", type=Path, default=Path("results/examples"))
    options = parser.parse_args(arguments)

    solution = BoxDDP(options.scene).solve()
    env = gymnasium.make("DQSpaceArm-v0", scene=options.scene)
    kernels = compile_scene(options.scene)
    planned = kernels.layout.to_action(solution.controls)  # from N, N m, rad/s to fractions of the limits

    flights = {"nothing": np.zeros_like(planned), "expert": planned}
    curves = {}
    print(f"{'who flies':10} {'return':>10} {'attitude, deg':>14} {'position, m':>12}  success")
    for name, actions in flights.items():
        _, info = env.reset(options={"nominal": True})
        errors, total = [], 0.0
        for action in actions:
            _, reward, _, _, info = env.step(action)
            total += float(reward)
            errors.append((info["attitude_error"], info["position_error"]))
        curves[name] = np.array(errors)
        end = f"{info['attitude_error']:14.2f} {info['position_error']:12.3f}  {info['is_success']}"
        print(f"{name:10} {total:10.1f} {end}")
    print(f"the expert: {solution.message}; J = {solution.cost:.1f} after {solution.iterations} iterations")

    if find_spec("matplotlib") is None:
        print('no picture: it needs matplotlib (pip install "dq-space-arm[plots]")')
        return
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.2), layout="constrained")
    for column, (axes, label) in enumerate(
        zip(figure.subplots(1, 2), ("attitude error, deg", "position error, m"), strict=True)
    ):
        for name, curve in curves.items():
            times = np.arange(1, len(curve) + 1) * kernels.scene.simulation.dt
            axes.plot(times, curve[:, column], label=name)
        axes.set(xlabel="time, s", ylabel=label, ylim=(0, None))
        axes.legend()
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "first_steps.png", dpi=120)
    print(f"picture: {options.out / 'first_steps.png'}")


if __name__ == "__main__":
    sys.exit(run_to_end(main))  # errors of the input as sentences
