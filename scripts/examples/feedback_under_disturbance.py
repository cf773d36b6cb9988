"""Measure what feedback is worth: one plan flown open loop, with its gains, and replanned at every step.

Three pushes change the base's twist by up to 0.02 rad/s and m/s. The expert's feedback gains,
u = u_k + K_k (x (-) x_k), correct for them; the receding horizon replans the next 1.5 s at every step.
Expect: the open loop misses from 0.005 on, the gains arrive up to 0.01, the receding horizon always arrives.

    python scripts/examples/feedback_under_disturbance.py [--scene paper] [--out results/examples]
"""

import argparse
import sys
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env import compile_scene
from dq_space_arm_env.command_line.verb_program import run_to_end
from experts import BoxDDP, RecedingHorizonExpert
from experts.maneuver import Maneuver


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--pushes", type=float, nargs="+", default=[0.0, 0.005, 0.01, 0.02])
    parser.add_argument("--out", type=Path, default=Path("results/examples"))
    options = parser.parse_args(arguments)

    kernels = compile_scene(options.scene)
    solution = BoxDDP(options.scene).solve()
    horizon = RecedingHorizonExpert(options.scene)
    layout, twist = kernels.layout, kernels.layout.tangent.base_velocity
    rows = solution.parameters  # of the stages: what phases and targets change
    controllers: dict[str, Callable[[NDArray[np.float64], int], NDArray[np.float64]]] = {
        "plan alone": lambda x, k: solution.controls[k],
        "with gains": solution.policy(),
        "receding horizon": lambda x, k: layout.to_control(horizon(x), rows[k]),
    }
    steps, success = len(solution.controls), kernels.scene.success
    flights: dict[str, Maneuver] = {}
    print(f"{'push':>6}  {'controller':16} {'attitude, deg':>13} {'position, m':>11} {'us per action':>13}")
    for push in options.pushes:
        for name, controller in controllers.items():
            rng, seconds = np.random.default_rng(0), 0.0  # the same pushes for everyone
            horizon.reset(solution.states[0])
            states = [solution.states[0]]
            for k in range(steps):
                x = states[-1]
                if k in (steps // 4, steps // 2, 3 * steps // 4):
                    jump = np.zeros(kernels.n_t)
                    jump[twist] = push * rng.uniform(-1, 1, len(jump[twist]))
                    x = kernels.retract(x, jump)
                seconds -= perf_counter()
                u = controller(x, k)
                seconds += perf_counter()
                states.append(kernels.step(x, u, p=rows[k]))
            flights[name] = flown = Maneuver(kernels.scene, np.array(states), solution.controls)
            angle, distance = np.degrees(flown.angle[-1]), flown.distance[-1]
            arrives = angle <= success.attitude_error_deg and distance <= success.position_error
            facts = f"{angle:13.2f} {distance:11.3f} {seconds / steps * 1e6:13.1f}"
            print(f"{push:6g}  {name:16} {facts}  {'arrives' if arrives else 'misses'}")

    if find_spec("matplotlib") is None:
        print('no picture: it needs matplotlib (pip install "dq-space-arm[plots]")')
        return
    from matplotlib.figure import Figure

    axes = (figure := Figure(figsize=(7, 3.5), layout="constrained")).subplots()
    for name, flown in flights.items():
        axes.semilogy(flown.time, np.degrees(flown.angle), label=name)
    axes.axhline(success.attitude_error_deg, color="gray", linestyle=":", label="tolerance")
    axes.set(
        xlabel="time, s", ylabel="attitude error, deg", title=f"pushes of {options.pushes[-1]} rad/s, m/s"
    )
    axes.legend()
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "feedback_under_disturbance.png", dpi=120)
    print(f"picture: {options.out / 'feedback_under_disturbance.png'}")


if __name__ == "__main__":
    sys.exit(run_to_end(main))  # errors of the input as sentences
