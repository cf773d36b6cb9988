"""Run by test_processors.py, or on another machine: compute what a scene gives.

    python portable_results.py OUT.npz SCENE [--whole] [--cpu NAME --features avx,avx2,...]

With --cpu, all machine code is compiled for that processor and these instruction sets instead of those of
this machine. The file holds the arrays, and the kinds of instructions in the code of a step.
"""

import argparse
import re
from typing import Any

import llvmlite.binding as llvm
import numpy as np

VECTORS = ("avx", "avx2", "avx512f", "fma")


def pretend(cpu: str, features: set[str]) -> None:
    """Have LLVM describe another processor, to this package and to numba."""
    described = llvm.targets.FeatureMap({name: name in features for name in VECTORS})
    llvm.get_host_cpu_name = lambda: cpu
    llvm.get_host_cpu_features = lambda: described


def instructions(kernels: Any) -> list[str]:
    """Kinds of registers and arithmetic in the vector code of a step."""
    from dq_space_arm_env.compiler import native
    from dq_space_arm_env.compiler.build import assembly

    program = kernels._programs.build("step", kernels.scene.simulation.integrator)
    module, machine = native._optimized(assembly(program, kernels.lanes, "float64"))
    return sorted(
        set(re.findall(r"\b[xyz]mm(?=\d)|\bvfn?m(?:add|sub)|\bfmla", machine.emit_assembly(module)))
    )


def results(scene: str, *, whole: bool) -> dict[str, Any]:
    """Arrays of a scene's step and derivatives; as a whole also of its environment and solution."""
    from dq_space_arm_env import compile_scene

    kernels, rng = compile_scene(scene), np.random.default_rng(0)
    x = np.tile(kernels.layout.initial_state, (19, 1))  # no multiple of any vector width
    pose = x[:, kernels.layout.state.pose].copy()
    x += rng.normal(scale=0.3, size=x.shape)
    x[:, kernels.layout.state.pose] = pose
    u = rng.normal(size=(19, kernels.n_u))
    a, b = kernels.linearize(x, u)
    found = {"step": kernels.step(x, u), "A": a, "B": b, "instructions": instructions(kernels)}
    if whole:
        import gymnasium

        from experts import BoxDDP

        env = gymnasium.make_vec("DQSpaceArm-v0", 5, scene=scene)
        seen = [env.reset(seed=0)[0]]
        env.action_space.seed(0)
        seen += [env.step(env.action_space.sample())[0] for _ in range(50)]
        solution = BoxDDP(scene).solve()
        found |= {"one_step": kernels.step(x[0], u[0]), "observations": np.array(seen)}
        found |= {"J": solution.cost, "iterations": len(solution.history), "states": solution.states}
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("out")
    parser.add_argument("scene")
    parser.add_argument("--whole", action="store_true")
    parser.add_argument("--cpu")
    parser.add_argument("--features", default="")
    options = parser.parse_args()
    if options.cpu:
        pretend(options.cpu, set(options.features.split(",")))
    np.savez(options.out, **results(options.scene, whole=options.whole))
