"""The expert's optimum on scene `paper`, handed to an independent solver: IPOPT."""

import casadi
import numpy as np
import pytest

from dq_space_arm_env import load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.dynamics import kinematics
from dq_space_arm_env.dynamics.chain import Chain
from dq_space_arm_env.kernels.field import SpaceArmField
from dq_space_arm_env.scene.layout import StateLayout
from experts import BoxDDP


def maneuver(scene):
    """Step (classical RK4 on the stored numbers), stage cost and terminal cost as CasADi functions."""
    chain, layout = Chain.from_scene(scene), StateLayout.of(scene)
    field = SpaceArmField(chain, layout)
    x, u = casadi.SX.sym("x", layout.n_x), casadi.SX.sym("u", layout.n_u)

    def rates(state):
        entries, inputs = casadi.vertsplit(state), casadi.vertsplit(u)
        twist = entries[layout.state.base_velocity]
        return casadi.vertcat(*dq.derivative(entries[:8], twist), *field.rates(entries[8:], inputs))

    h = scene.simulation.dt
    k1 = rates(x)
    k2 = rates(x + 0.5 * h * k1)
    k3 = rates(x + 0.5 * h * k2)
    k4 = rates(x + h * k3)
    step = casadi.Function("step", [x, u], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)], {"cse": True})

    entries = casadi.vertsplit(x)
    motion = field.motion(entries[8:])
    tip = casadi.vertcat(*kinematics.tip_pose(chain, entries[:8], motion.joint_angles, motion.wrist_angles))
    error = casadi.sumsqr(tip - casadi.DM(scene.target.pose.dual_quaternion))
    speed = casadi.sumsqr(casadi.vertcat(*motion.angular, *motion.linear))
    effort = casadi.dot(casadi.DM(layout.control_weight), u**2)
    stage = casadi.Function("stage", [x, u], [15 * error + speed + effort])
    return step, stage, casadi.Function("terminal", [x], [150 * error + speed])


@pytest.mark.slow
def test_ipopt_finds_nothing_better_near_the_experts_plan():
    scene = load_scene("paper")
    solution = BoxDDP(scene).solve()
    step, stage, terminal = maneuver(scene)
    n = scene.simulation.steps
    layout = StateLayout.of(scene)
    states, controls = casadi.MX.sym("X", layout.n_x, n + 1), casadi.MX.sym("U", layout.n_u, n)
    cost = casadi.sum2(stage.map(n)(states[:, :-1], controls)) + terminal(states[:, -1])
    gaps = casadi.vec(step.map(n)(states[:, :-1], controls) - states[:, 1:])
    variables = casadi.veccat(states, controls)
    # The two discretizations differ by 1e-7: the expert moves the pose by exponentials.
    plan = np.concatenate([solution.states.ravel(), solution.controls.ravel()])
    replay = casadi.Function("replay", [variables], [cost, gaps])
    assert float(replay(plan)[0]) == pytest.approx(solution.cost, rel=1e-7)
    assert float(casadi.norm_inf(replay(plan)[1])) < 1e-6

    free = np.full(solution.states.shape, np.inf)
    limit = np.tile(layout.control_limit, (n, 1))
    lower, upper = (
        np.concatenate([-free.ravel(), -limit.ravel()]),
        np.concatenate([free.ravel(), limit.ravel()]),
    )
    lower[: layout.n_x] = upper[: layout.n_x] = solution.states[0]
    options = {
        "ipopt": {
            "max_iter": 100,
            "print_level": 0,
            "mu_init": 1e-4,
            "warm_start_init_point": "yes",
            "fixed_variable_treatment": "make_constraint",
        },
        "print_time": False,
    }
    solver = casadi.nlpsol("ipopt", "ipopt", {"x": variables, "f": cost, "g": gaps}, options)
    result = solver(x0=plan, lbx=lower, ubx=upper, lbg=0.0, ubg=0.0)
    assert solver.stats()["success"], solver.stats()["return_status"]
    assert solution.cost <= (1.0 + 1e-4) * float(result["f"])
