"""A maneuver as a program over all its states and controls, with exact derivatives, for IPOPT.

Steps are those of the scene's integrator except for the pose: the classical Runge-Kutta method integrates its
stored numbers, where the expert moves it by exponentials. The two independent ways are 1e-7 apart.

CasADi alone takes several seconds for the second derivatives of a thousand Runge-Kutta steps. The chain rule
over the four stages, with derivatives of one stage from CasADi, takes a tenth of that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.constraint_rows import path_rows, terminal_rows
from dq_space_arm_env.task.constraint_residuals import path_residuals, terminal_residuals
from dq_space_arm_env.task.equations import SceneEquations
from experts.problems.paper_problem import beyond_the_paper

_OFFSETS = (0.0, 0.5, 0.5, 1.0)
_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


@dataclass(frozen=True, eq=False)
class Transcription:
    """A maneuver as a program for `casadi.nlpsol`."""

    variables: Any
    cost: Any
    gaps: Any  # steps less the states that they should lead to, shape (N n_x,)
    rows: Any  # of the constraints at all stages, then at the end
    row_bounds: tuple[Any, Any]  # least and greatest value of each row
    derivatives: dict[str, Any]


def transcribe(scene: Scene) -> Transcription:
    """Write a maneuver as a program over all its states and controls; ValueError if its target moves."""
    if more := beyond_the_paper(scene.replace(constraints=())):
        raise ValueError(f"IPOPT is left out: it is not given {' or '.join(more)}.")
    equations = SceneEquations.of(scene, StateLayout.of(scene).parameters.nominal.tolist())
    n_x, n_u, n = equations.layout.n_x, equations.layout.n_u, scene.simulation.steps
    step, step_jacobian, step_hessian = _step(equations)
    stage, terminal = _costs(equations)
    states, controls = casadi.MX.sym("X", n_x, n + 1), casadi.MX.sym("U", n_u, n)
    variables = casadi.veccat(states, controls)
    start = states[:, :-1]
    cost = casadi.sum2(stage.map(n)(start, controls)) + terminal(states[:, -1])
    gaps = casadi.vec(step.map(n)(start, controls) - states[:, 1:])
    path, at_end = _constraints(equations)
    rows = casadi.vertcat(casadi.vec(path.map(n)(start, controls)), at_end(states[:, -1]))

    by_state, by_control = (
        casadi.diagcat(*casadi.horzsplit(part, width))
        for part, width in zip(step_jacobian.map(n)(start, controls), (n_x, n_u), strict=True)
    )
    last = casadi.MX(n * n_x, n_x)
    shift = casadi.horzcat(casadi.DM(n * n_x, n_x), casadi.DM.eye(n * n_x))
    jacobian = casadi.horzcat(casadi.horzcat(by_state, last) - shift, by_control)
    if scene.constraints:
        jacobian = casadi.vertcat(jacobian, _row_jacobian(path, at_end, states, controls))

    parameters, lam_f = casadi.MX.sym("p", 0), casadi.MX.sym("lam_f")
    lam_g = casadi.MX.sym("lam_g", n * n_x + rows.numel())
    multipliers = casadi.reshape(lam_g[: n * n_x], n_x, n)
    stage_hessian, terminal_hessian = (_hessian(function) for function in (stage, terminal))
    total = step_hessian.map(n)(start, controls, multipliers) + lam_f * stage_hessian.map(n)(start, controls)
    end = lam_f * terminal_hessian(states[:, -1])
    if scene.constraints:
        n_path = path.numel_out(0)
        pushed = casadi.reshape(lam_g[n * n_x :][: n * n_path], n_path, n)
        total += _weighted_hessian(path).map(n)(start, controls, pushed)
        end += _weighted_hessian(at_end)(states[:, -1], lam_g[n * (n_x + n_path) :])
    blocks = casadi.horzsplit(total, n_x + n_u)
    xx = casadi.diagcat(*(block[:n_x, :n_x] for block in blocks), end)
    xu = casadi.diagcat(*(block[:n_x, n_x:] for block in blocks), casadi.MX(n_x, 0))
    uu = casadi.diagcat(*(block[n_x:, n_x:] for block in blocks))
    hessian = casadi.triu(casadi.vertcat(casadi.horzcat(xx, xu), casadi.horzcat(casadi.MX(*xu.T.shape), uu)))
    derivatives = {
        "jac_g": casadi.Function("jac_g", [variables, parameters], [casadi.vertcat(gaps, rows), jacobian]),
        "hess_lag": casadi.Function("hess_lag", [variables, parameters, lam_f, lam_g], [hessian]),
    }
    return Transcription(variables, cost, gaps, rows, _row_bounds(scene), derivatives)


def _constraints(equations: SceneEquations) -> tuple[Any, Any]:
    """Residuals of the path's rows and of those at the end, with the margins that the expert keeps."""
    scene, layout = equations.scene, equations.layout
    x, u = casadi.SX.sym("x", layout.n_x), casadi.SX.sym("u", layout.n_u)
    entries = casadi.vertsplit(x)
    place = equations.base_pose(entries), equations.y(entries)
    if not scene.constraints:
        none = casadi.SX(0, 1)
        return casadi.Function("path", [x, u], [none]), casadi.Function("at_end", [x], [none])
    along = casadi.vertcat(*path_residuals(equations, *place, casadi.vertsplit(u)))
    at_end = casadi.vertcat(*terminal_residuals(equations, *place))
    along += casadi.DM([row.margin for row in path_rows(scene)])
    at_end += casadi.DM([row.margin for row in terminal_rows(scene)])
    return casadi.Function("path", [x, u], [along]), casadi.Function("at_end", [x], [at_end])


def _row_bounds(scene: Scene) -> tuple[Any, Any]:
    """Bounds of the rows; at stage 0, whose state is given, only rows with the input have any."""
    if not scene.constraints:
        return np.zeros(0), np.zeros(0)
    path, at_end = path_rows(scene), terminal_rows(scene)
    rows = [*path * scene.simulation.steps, *at_end]
    lower = np.array([0.0 if row.is_equality else -np.inf for row in rows])
    upper = np.zeros(len(rows))
    upper[: len(path)] = [0.0 if row.has_input else np.inf for row in path]
    return lower, upper


def _row_jacobian(path: Any, at_end: Any, states: Any, controls: Any) -> Any:
    """Jacobian of all rows by all states and controls."""
    n, n_x, n_u = controls.shape[1], states.shape[0], controls.shape[0]
    arguments = path.sx_in()
    jacobian = casadi.jacobian(path(*arguments), casadi.veccat(*arguments))
    parts = casadi.Function("jacobian", arguments, [jacobian[:, :n_x], jacobian[:, n_x:]], {"cse": True})
    by_state, by_control = (
        casadi.diagcat(*casadi.horzsplit(part, width))
        for part, width in zip(parts.map(n)(states[:, :-1], controls), (n_x, n_u), strict=True)
    )
    (x,) = at_end.sx_in()
    last = casadi.Function("last", [x], [casadi.jacobian(at_end(x), x)], {"cse": True})(states[:, -1])
    return casadi.horzcat(
        casadi.diagcat(by_state, last), casadi.vertcat(by_control, casadi.MX(last.shape[0], n * n_u))
    )


def _weighted_hessian(function: Any) -> Any:
    """Hessian of weights . rows by all their arguments together; the weights are a further argument."""
    arguments, weights = function.sx_in(), casadi.SX.sym("w", function.numel_out(0))
    hessian = casadi.hessian(casadi.dot(weights, function(*arguments)), casadi.veccat(*arguments))[0]
    return casadi.Function("hessian", [*arguments, weights], [hessian], {"cse": True})


def _hessian(function: Any) -> Any:
    """Hessian of a cost by all its arguments together."""
    arguments = function.sx_in()
    hessian = casadi.hessian(function(*arguments), casadi.veccat(*arguments))[0]
    return casadi.Function("hessian", arguments, [hessian], {"cse": True})


def _step(equations: SceneEquations) -> tuple[Any, Any, Any]:
    """A step as functions of (x, u): itself, its Jacobians by x and u, and with a multiplier its Hessian."""
    scene, field = equations.scene, equations.field
    x, u, multiplier = (
        casadi.SX.sym("x", field.n_x),
        casadi.SX.sym("u", field.n_u),
        casadi.SX.sym("l", field.n_x),
    )
    if scene.simulation.integrator == "rk4":
        x_next, jacobian, hessian = _runge_kutta_step(
            _rates(equations), x, u, multiplier, scene.simulation.dt
        )
    else:
        x_next = _euler_step(equations, x, u)
        both = casadi.vertcat(x, u)
        jacobian = casadi.jacobian(x_next, both)
        hessian = casadi.hessian(casadi.dot(multiplier, x_next), both)[0]
    cse = {"cse": True}
    return (
        casadi.Function("step", [x, u], [x_next], cse),
        casadi.Function("step_jacobian", [x, u], [jacobian[:, : field.n_x], jacobian[:, field.n_x :]], cse),
        casadi.Function("step_hessian", [x, u, multiplier], [hessian], cse),
    )


def _rates(equations: SceneEquations) -> Any:
    """Time derivative of the stored state, a function of (x, u)."""
    field = equations.field
    x, u = casadi.SX.sym("x", field.n_x), casadi.SX.sym("u", field.n_u)
    stored = field.n_x - field.n_y
    others = field.rates(casadi.vertsplit(x[stored:]), casadi.vertsplit(u))
    rates = casadi.vertcat(_pose_rates(equations, x[:stored], x[stored:]), *others)
    return casadi.Function("rates", [x, u], [rates], {"cse": True})


def _pose_rates(equations: SceneEquations, pose: Any, y: Any) -> Any:
    """Rates of the stored numbers of the pose, eq. (3): 1/2 q omega."""
    coordinates = equations.field.pose
    twist = coordinates.full_twist([y[i] for i in coordinates.twist_indices])
    return casadi.vertcat(
        *coordinates.reduced(dq.derivative(coordinates.full(casadi.vertsplit(pose)), twist))
    )


def _euler_step(equations: SceneEquations, x: Any, u: Any) -> Any:
    """Symplectic Euler: new velocities, then all else with them."""
    field, h = equations.field, equations.scene.simulation.dt
    stored, inputs = field.n_x - field.n_y, casadi.vertsplit(u)
    velocities = list(field.rate_indices)
    others = [i for i in range(field.n_y) if i not in set(velocities)]
    y = casadi.SX(x[stored:])
    y[velocities] += h * casadi.vertcat(*field.rates(casadi.vertsplit(y), inputs))[velocities]
    y[others] += h * casadi.vertcat(*field.rates(casadi.vertsplit(y), inputs))[others]
    pose = casadi.SX(x[:stored])
    stages = _stages(lambda q: _pose_rates(equations, q, y), pose, h)[1]
    change = sum(weight * k for weight, k in zip(_WEIGHTS, stages, strict=True))
    return casadi.vertcat(pose + h * change, y)


def _stages(rates: Callable[[Any], Any], x: Any, h: float) -> tuple[list[Any], list[Any]]:
    """States and rates at the four stages of the classical Runge-Kutta method."""
    states: list[Any] = []
    slopes: list[Any] = []
    for offset in _OFFSETS:
        states.append(x + offset * h * slopes[-1] if slopes else x)
        slopes.append(rates(states[-1]))
    return states, slopes


def _runge_kutta_step(rates: Any, x: Any, u: Any, multiplier: Any, h: float) -> tuple[Any, Any, Any]:
    """A step, its Jacobian by (x, u), and the Hessian of multiplier . step, by the chain rule over stages."""
    arguments = rates.sx_in()
    weight = casadi.SX.sym("w", x.numel())
    slope, both = rates(*arguments), casadi.vertcat(*arguments)
    jacobian = casadi.Function("jacobian", arguments, [casadi.jacobian(slope, both)], {"cse": True})
    twice = casadi.hessian(casadi.dot(weight, slope), both)[0]
    hessian = casadi.Function("hessian", [*arguments, weight], [twice], {"cse": True})

    n_x, n = x.numel(), both.numel()
    states, slopes = _stages(lambda state: rates(state, u), x, h)
    jacobians = [jacobian(state, u) for state in states]
    identity = casadi.SX.eye(n)
    changes: list[Any] = []  # of (state of the stage, u) by (x, u)
    slope_changes: list[Any] = []
    for offset, by_both in zip(_OFFSETS, jacobians, strict=True):
        change = casadi.SX(identity)
        if slope_changes:
            change = casadi.vertcat(identity[:n_x, :] + offset * h * slope_changes[-1], identity[n_x:, :])
        changes.append(change)
        slope_changes.append(casadi.mtimes(by_both, change))
    # Multipliers of the slopes, the last one first: a slope acts on the step and on the next stage.
    multipliers = [h * _WEIGHTS[3] * multiplier]
    for i in (2, 1, 0):
        following = casadi.mtimes(jacobians[i + 1][:, :n_x].T, multipliers[0])
        multipliers.insert(0, h * (_WEIGHTS[i] * multiplier + _OFFSETS[i + 1] * following))
    total = casadi.SX(n, n)
    for state, change, costate in zip(states, changes, multipliers, strict=True):
        total += casadi.mtimes(change.T, casadi.mtimes(hessian(state, u, costate), change))
    x_next = x + h * sum(weight * k for weight, k in zip(_WEIGHTS, slopes, strict=True))
    by_both = identity[:n_x, :] + h * sum(
        weight * k for weight, k in zip(_WEIGHTS, slope_changes, strict=True)
    )
    return x_next, by_both, total


def _costs(equations: SceneEquations) -> tuple[Any, Any]:
    """Stage cost and terminal cost."""
    scene, layout = equations.scene, equations.layout
    x, u = casadi.SX.sym("x", layout.n_x), casadi.SX.sym("u", layout.n_u)
    entries = casadi.vertsplit(x)
    motion = equations.field.motion(equations.y(entries))
    pose = casadi.vertcat(*equations.tip(entries)) - casadi.DM([float(entry) for entry in equations.target])
    twist = casadi.vertcat(*motion.angular, *motion.linear) - casadi.DM(scene.target.base_velocity)

    def state_cost(pose_weights: Sequence[float], twist_weights: Sequence[float]) -> Any:
        return casadi.dot(casadi.DM(pose_weights), pose**2) + casadi.dot(casadi.DM(twist_weights), twist**2)

    cost = scene.cost
    stage = state_cost(cost.pose, cost.base_velocity) + casadi.dot(casadi.DM(layout.control_weight), u**2)
    terminal = state_cost(cost.terminal_pose, cost.terminal_base_velocity)
    return casadi.Function("stage", [x, u], [stage]), casadi.Function("terminal", [x], [terminal])
