"""Compare two integrators on one motion: error and run time for several time steps.

Symplectic Euler and Runge-Kutta-Munthe-Kaas of order 4 follow an arm with turning joints for three seconds,
without inputs. The reference is the adaptive method with tight tolerances.
Expect: halving the step halves the error of symplectic Euler and divides that of rk4 by sixteen. A step of
rk4 takes about three times as long, so at equal error rk4 is faster by orders of magnitude.

    python scripts/examples/compare_integrators.py [--scene paper] [--out results/examples]
"""

import argparse
import sys
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter

import numpy as np

from dq_space_arm_env import compile_scene
from dq_space_arm_env.command_line.verb_program import run_to_end

DURATION = 3.0  # s


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--scene", default="paper")
    parser.add_argument("--integrators", nargs="+", default=["symplectic_euler", "rk4"])
    parser.add_argument("--out", type=Path, default=Path("results/examples"))
    options = parser.parse_args(arguments)

    kernels = compile_scene(options.scene)
    start = kernels.layout.initial_state.copy()
    start[kernels.layout.state.joint_rates] = 0.5  # rad/s
    nothing = np.zeros(kernels.n_u)
    truth = kernels.integrate(start, nothing, DURATION, rtol=1e-13, atol=1e-13).x[-1]

    curves = {}
    print(f"{'integrator':18} {'step, ms':>9} {'error, rad and m':>17} {'order':>6} {'run time, us':>13}")
    for integrator in options.integrators:
        rows: list[tuple[float, float]] = []
        for steps in (50, 100, 200, 400, 800):
            times = []
            for _ in range(5):  # fastest of five: the machine may be shared
                begin = perf_counter()
                end = kernels.simulate(start, nothing, steps, DURATION / steps, integrator, every=steps)[-1]
                times.append(perf_counter() - begin)
            pose_and_angles = slice(0, kernels.layout.tangent.base_velocity.start)
            error = float(np.linalg.norm(kernels.difference(truth, end)[pose_and_angles]))
            order = np.log2(rows[-1][1] / error) if rows else np.nan
            rows.append((min(times) * 1e6, error))
            step = DURATION / steps * 1e3
            print(f"{integrator:18} {step:9.2f} {error:17.2e} {order:6.2f} {min(times) * 1e6:13.1f}")
        curves[integrator] = np.array(rows)

    if find_spec("matplotlib") is None:
        print('no picture: it needs matplotlib (pip install "dq-space-arm[plots]")')
        return
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator

    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    for name, curve in curves.items():
        axes.loglog(*curve.T, marker="o", label=name)
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("")
    axes.set(xlabel="run time, us", ylabel="error at the end, rad and m")
    axes.legend()
    options.out.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.out / "compare_integrators.png", dpi=120)
    print(f"picture: {options.out / 'compare_integrators.png'}")


if __name__ == "__main__":
    sys.exit(run_to_end(main))  # errors of the input as sentences
