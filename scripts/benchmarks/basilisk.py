"""The same motion in Basilisk: an arm of six joints on a base that floats freely, error against run time.

Torques of all joints, drawn once and held for half a second each, move the robot of scene `six-joint` without
thrusters and wheels. Basilisk has it as a hub with a `spinningBodyNDOF` effector. The end of the motion is
known from SciPy's DOP853 on Pinocchio's dynamics, with which neither shares code.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from time import process_time

import numpy as np

from dq_space_arm_env import Kernels, compile_scene, load_scene
from dq_space_arm_env.algebra import poses
from dq_space_arm_env.common.tables import Column
from dq_space_arm_env.scene import INTEGRATORS
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.effort import Effort
from scripts.benchmarks.harness import Benchmark, Row, Table, claim, note, time_column
from scripts.benchmarks.work_precision.motions import MotionCase

HOLD = 0.5  # s
STEPS = (0.1, 0.02, 0.005)  # s
METHODS = {"Euler": "symplectic_euler", "RK4": "rk4", "RKF78": "rk8"}
"""Basilisk's integrators, and ours beside each."""
_SHARE = 0.02  # of the limits of the torques
_BOUND = 1e-9  # largest distance of both with the finest step and the highest order, m or rad
_TINY = "{:.0e}".format


def measure(effort: Effort) -> Iterator[Row]:
    """Fly the motion in both with each integrator and step."""
    missing = [name for name in ("Basilisk", "scipy", "mpmath") if find_spec(name) is None]
    if missing:
        needed = " and ".join(missing)
        yield note(f"Basilisk is left out: {needed} not installed (pip install bsk scipy mpmath pin).")
        return
    from scripts.benchmarks.work_precision.measurement import errors_of
    from scripts.benchmarks.work_precision.references import reference_of

    case = motion(effort.duration, effort.seed)
    kernels, reference = compile_scene(case.scene), reference_of(case)
    yield note(f"The end is that of {reference.source}.")
    for theirs, own in METHODS.items():
        for step in STEPS:
            row: Row = {"table": "motion", "duration_s": case.duration, "step_s": step}
            ends = []
            for engine, method, fly in (("ours", own, fly_here), ("theirs", theirs, fly_there)):
                flights = [fly(case, kernels, method, step) for _ in range(effort.repeats)]
                seconds, x = min(flight[0] for flight in flights), flights[0][1]
                ends.append(x)
                row[f"{engine}_method"], row[f"{engine}_us"] = method, 1e6 * seconds * step / case.duration
                row[f"{engine}_error"] = errors_of(kernels, x, reference.state)["error"]
                row[f"{engine}_base"], row[f"{engine}_joints"] = _parts(kernels, x, reference.state)
            row |= {"ratio": row["theirs_us"] / row["ours_us"], "apart": errors_of(kernels, *ends)["error"]}
            yield row
    name = f"{row['ours_method']} and {row['theirs_method']} end"
    yield claim("basilisk", name, "the same motion", row["apart"], _BOUND, unit="m, rad")


def motion(duration: float, seed: int = 0) -> MotionCase:
    """Joint torques and their opposites in turn, from the start of scene `six-joint`, at rest."""
    free = {"actuators.base_force": None, "actuators.base_torque": None, "name": "six-joint, floating"}
    scene = load_scene("six-joint").replace(free)
    kernels = compile_scene(scene)
    holds = max(2 * round(duration / HOLD / 2), 2)
    draws = np.random.default_rng(seed).uniform(-_SHARE, _SHARE, (holds // 2, kernels.n_u))
    controls = np.stack([draws, -draws], axis=1).reshape(holds, -1) * kernels.layout.control_limit
    start = kernels.layout.initial_state.astype(np.float64)
    return MotionCase("six-joint", "Six joints, floating", scene, start, controls, HOLD, 1, _BOUND)


def fly_here(case: MotionCase, kernels: Kernels, method: str, step: float) -> tuple[float, FloatArray]:
    """Processor time of a motion here, s, and its end as a state of the scene, shape (n_x,)."""
    from scripts.benchmarks.work_precision.methods import Method, Walk

    walk = Walk(Method(method, INTEGRATORS[method].order), kernels, case)
    begin = process_time()
    walk.run(round(case.hold / step))
    return process_time() - begin, walk.state


def fly_there(case: MotionCase, kernels: Kernels, method: str, step: float) -> tuple[float, FloatArray]:
    """The same in Basilisk."""
    from scripts.benchmarks.peers.basilisk_peer import BasiliskTwin

    twin = BasiliskTwin(kernels, step, method)
    efforts = twin.add_chain(case.controls[0].tolist())
    twin.fly(0.0)  # makes it ready
    begin = process_time()
    for k, torques in enumerate(case.controls.tolist()):
        twin.write(efforts, "ArrayMotorTorque", "motorTorque", torques)
        twin.fly((k + 1) * case.hold)
    return process_time() - begin, twin.state()


def _parts(kernels: Kernels, x: FloatArray, reference: FloatArray) -> tuple[float, float]:
    """Errors of the base's attitude and of the joint furthest off, rad."""
    state = kernels.layout.state
    base, right = (tuple(kernels.frame_poses(each)[0].tolist()) for each in (x, reference))
    joints = np.abs(x[state.joint_angles] - reference[state.joint_angles]).max()
    return float(poses.error_angle(base, right)), float(joints)


BENCHMARK = Benchmark(
    "basilisk",
    "Beside Basilisk",
    "Six joints on a base that floats freely, moved by torques that are held for half a second each: the "
    "same motion in Basilisk's spinningBodyNDOF and here, with integrators of equal order. RKF78 divides "
    "steps.",
    measure,
    tables=(
        Table(
            "motion",
            "{duration_s:g} s\nerror of the tip at the end, m or rad, of the base's attitude and of the "
            "joints, rad;\nµs of processor time per step; how far apart both tips end, m or rad",
            (
                Column("step_s", "step\ns", "g"),
                Column("ours_method", "ours"),
                Column("ours_error", "error", _TINY),
                Column("ours_base", "base", _TINY),
                Column("ours_joints", "joints", _TINY),
                time_column("ours_us", "µs"),
                Column("theirs_method", "Basilisk"),
                Column("theirs_error", "error", _TINY),
                Column("theirs_base", "base", _TINY),
                Column("theirs_joints", "joints", _TINY),
                time_column("theirs_us", "µs"),
                time_column("ratio", "times\nours"),
                Column("apart", format=_TINY),
            ),
        ),
    ),
    packages=("bsk", "numpy", "pin", "scipy"),
)
