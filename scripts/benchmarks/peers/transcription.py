"""A maneuver as a program over all its states and controls, with exact derivatives, for IPOPT and fatrop.

Steps are those of the scene's integrator except for the pose: the classical Runge-Kutta method integrates its
stored numbers, where the expert moves it by exponentials. The two independent ways are 1e-7 apart.

What varies from stage to stage, such as the pose of a target that moves, enters as numbers of each stage.

CasADi alone takes several seconds for the second derivatives of a thousand Runge-Kutta steps. The chain rule
over the four stages, with derivatives of one stage from CasADi, takes a tenth of that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import casadi
import numpy as np

from dq_space_arm_env import Scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.scene import StateLayout
from dq_space_arm_env.scene.constraint_rows import path_rows, terminal_rows
from dq_space_arm_env.task.constraint_residuals import path_residuals
from dq_space_arm_env.task.equations import SceneEquations
from dq_space_arm_env.task.terminal_residuals import terminal_residuals
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray
from scripts.benchmarks.subjects import COMPARED_INTEGRATORS

_OFFSETS = (0.0, 0.5, 0.5, 1.0)
_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


@dataclass(frozen=True, eq=False)
class Transcription:
    """A maneuver as a program for `casadi.nlpsol`, stage by stage.

    The variables are x_0, u_0, x_1, u_1, .., x_N. The rows of a stage are its gaps x_{k+1} - step(x_k, u_k),
    and then those of the constraints; the last are those of the end.
    """

    steps: int
    n_x: int
    n_u: int
    n_path: int  # rows of the constraints at each stage
    variables: Any
    cost: Any
    rows: Any
    row_bounds: tuple[FloatArray, FloatArray]  # least and greatest value of each row
    jacobian: Any  # function of variables and parameters (none): the rows, and their Jacobian
    hessian: Any  # function of these, the cost's weight and the rows' multipliers: of the Lagrangian

    @property
    def gaps(self) -> Any:
        """The rows of the dynamics, shape (N n_x,)."""
        return casadi.vec(casadi.reshape(self.rows[: self._n_stage_rows], -1, self.steps)[: self.n_x, :])

    @property
    def _n_stage_rows(self) -> int:
        return self.steps * (self.n_x + self.n_path)

    def join(self, states: FloatArray, controls: FloatArray) -> FloatArray:
        """Values of the variables, from states (N + 1, n_x) and controls (N, n_u)."""
        return np.concatenate([np.hstack([states[:-1], controls]).ravel(), states[-1]])

    def split(self, values: Any) -> tuple[FloatArray, FloatArray]:
        """States (N + 1, n_x) and controls (N, n_u), from values of the variables."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        stages = flat[: -self.n_x].reshape(self.steps, self.n_x + self.n_u)
        return np.vstack([stages[:, : self.n_x], flat[-self.n_x :]]), stages[:, self.n_x :]


class _Piece(NamedTuple):
    """Functions of the state, input and parameters of a stage, or of the last state and parameters."""

    cost: Any
    rows: Any
    jacobian: Any  # of the rows, by state and input
    hessian: Any  # of weight * cost + multipliers . rows, the two being further arguments


def not_given(scene: Scene) -> str | None:
    """What a scene has that no program is written for; None for nothing."""
    if scene.phases:
        return "phases"
    if StateLayout.of(scene).chains:
        return "actuators that delay or lag"
    if scene.simulation.integrator not in COMPARED_INTEGRATORS:
        return f"steps of {scene.simulation.integrator}"
    return "tips of other arms" if scene.other_tips else None


def transcribe(problem: ArmProblem) -> Transcription:
    """Write a maneuver with its present parameters as a program; ValueError if there is none for it."""
    scene = problem.scene
    if more := not_given(scene):
        raise ValueError(f"interior-point methods are left out: they are not given {more}.")
    equations = SceneEquations.of(scene)
    n_x, n_u, n = equations.layout.n_x, equations.layout.n_u, scene.simulation.steps
    stage, end = _stage(equations), _end(equations)
    n_rows = stage.rows.numel_out(0)
    variables = casadi.MX.sym("z", n * (n_x + n_u) + n_x)
    stages, last = casadi.reshape(variables[: n * (n_x + n_u)], n_x + n_u, n), variables[-n_x:]
    x, u = stages[:n_x, :], stages[n_x:, :]
    following, given = casadi.horzcat(x[:, 1:], last), problem.parameters.rows
    p, p_end = casadi.DM(given[:-1].T), casadi.DM(given[-1])
    cost = casadi.sum2(stage.cost.map(n)(x, u, p)) + end.cost(last, p_end)
    rows = stage.rows.map(n)(x, u, p) + casadi.vertcat(following, casadi.MX(n_rows - n_x, n))
    rows = casadi.vertcat(casadi.vec(rows), end.rows(last, p_end))

    def along_diagonal(of_stages: Any, of_end: Any) -> Any:
        return casadi.diagcat(*casadi.horzsplit(of_stages, n_x + n_u), of_end)

    stage_numbers, entries = (each.ravel().tolist() for each in np.mgrid[:n, :n_x])
    of_gaps = [k * n_rows + i for k, i in zip(stage_numbers, entries, strict=True)]
    of_states = [(k + 1) * (n_x + n_u) + i for k, i in zip(stage_numbers, entries, strict=True)]
    shape = rows.numel(), variables.numel()
    shift = casadi.DM.triplet(of_gaps, of_states, casadi.DM.ones(n * n_x), *shape)
    jacobian = along_diagonal(stage.jacobian.map(n)(x, u, p), end.jacobian(last, p_end)) + shift

    parameters, weight = casadi.MX.sym("p", 0), casadi.MX.sym("lam_f")
    multipliers = casadi.MX.sym("lam_g", rows.numel())
    of_stages = casadi.reshape(multipliers[: n * n_rows], n_rows, n)
    hessian = along_diagonal(
        stage.hessian.map(n)(x, u, p, casadi.repmat(weight, 1, n), of_stages),
        end.hessian(last, p_end, weight, multipliers[n * n_rows :]),
    )
    arguments = [variables, parameters]
    return Transcription(
        steps=n,
        n_x=n_x,
        n_u=n_u,
        n_path=n_rows - n_x,
        variables=variables,
        cost=cost,
        rows=rows,
        row_bounds=_row_bounds(scene, n_x),
        jacobian=casadi.Function("jac_g", arguments, [rows, jacobian]),
        hessian=casadi.Function("hess_lag", [*arguments, weight, multipliers], [hessian]),
    )


def _row_bounds(scene: Scene, n_x: int) -> tuple[FloatArray, FloatArray]:
    """Bounds of the rows; at stage 0, whose state is given, only rows with the input have any."""
    path, at_end = (path_rows(scene), terminal_rows(scene)) if scene.constraints else ((), ())
    gaps, below = np.zeros(n_x), np.full(len(path), -np.inf)
    first = [0.0 if row.has_input else np.inf for row in path]
    lower = [*np.tile([*gaps, *below], scene.simulation.steps)]
    upper = [*gaps, *first, *np.zeros((scene.simulation.steps - 1) * (n_x + len(path)))]
    lower += [0.0 if row.is_equality else -np.inf for row in at_end]
    return np.array(lower), np.array([*upper, *np.zeros(len(at_end))])


def _stage(equations: SceneEquations) -> _Piece:
    """Cost of a stage, its step, negative, and the residuals of the path with the expert's margins."""
    layout, constraints = equations.layout, equations.scene.constraints
    x, u = casadi.SX.sym("x", layout.n_x), casadi.SX.sym("u", layout.n_u)
    multiplier, both = casadi.SX.sym("l", layout.n_x), casadi.vertcat(x, u)
    x_next, by_both, twice = _step(equations, x, u, -multiplier)
    path = casadi.SX(0, 1)
    if constraints:
        entries = casadi.vertsplit(x)
        place = equations.base_pose(entries), equations.y(entries)
        path = casadi.vertcat(*path_residuals(equations, *place, casadi.vertsplit(u)))
        path += casadi.DM([row.margin for row in path_rows(equations.scene)])
    jacobian = casadi.vertcat(-by_both, casadi.jacobian(path, both))
    cost, rows = _stage_cost(equations, x, u), casadi.vertcat(-x_next, path)
    return _piece(equations, [x, u], cost, rows, jacobian, multiplier, twice)


def _end(equations: SceneEquations) -> _Piece:
    """Cost of the end, and the residuals there with the margins that the expert keeps."""
    x, rows = casadi.SX.sym("x", equations.layout.n_x), casadi.SX(0, 1)
    if equations.scene.constraints:
        entries = casadi.vertsplit(x)
        rows = casadi.vertcat(
            *terminal_residuals(equations, equations.base_pose(entries), equations.y(entries))
        )
        rows += casadi.DM([row.margin for row in terminal_rows(equations.scene)])
    cost, none = _terminal_cost(equations, x), casadi.SX(x.numel(), x.numel())
    return _piece(equations, [x], cost, rows, casadi.jacobian(rows, x), casadi.SX(0, 1), none)


def _piece(
    equations: SceneEquations,
    place: Sequence[Any],
    cost: Any,
    rows: Any,
    jacobian: Any,
    multiplier: Any,
    twice: Any,
) -> _Piece:
    """Functions of a place and the parameters; `twice`: Hessian of the first rows with their multiplier."""
    weight, others = casadi.SX.sym("w"), casadi.SX.sym("m", rows.numel() - multiplier.numel())
    both, cse = casadi.vertcat(*place), {"cse": True}
    arguments = [*place, _parameters(equations)]
    lagrangian = weight * cost + casadi.dot(others, rows[multiplier.numel() :])
    hessian = twice + casadi.hessian(lagrangian, both)[0]
    given = [*arguments, weight, casadi.vertcat(multiplier, others)]
    return _Piece(
        casadi.Function("cost", arguments, [cost], cse),
        casadi.Function("rows", arguments, [rows], cse),
        casadi.Function("jacobian", arguments, [jacobian], cse),
        casadi.Function("hessian", given, [hessian], cse),
    )


def _parameters(equations: SceneEquations) -> Any:
    """The symbols for what varies, a column."""
    return casadi.vertcat(casadi.SX(0, 1), *equations.field.parameters)


def _step(equations: SceneEquations, x: Any, u: Any, multiplier: Any) -> tuple[Any, Any, Any]:
    """A step, its Jacobian by (x, u), and the Hessian of multiplier . step."""
    kept, n = list(equations.layout.previous_controls), equations.layout.of_motion.n_x
    motion, by_both, twice = _motion_step(equations, x[:n], u, multiplier[:n])
    # Previous controls, the last entries of the state, move nothing, and follow from the input.
    size, places = x.numel() + u.numel(), [*range(n), *range(x.numel(), x.numel() + u.numel())]
    jacobian, hessian = casadi.SX(x.numel(), size), casadi.SX(size, size)
    jacobian[:n, places], hessian[places, places] = by_both, twice
    for row, control in enumerate(kept, n):
        jacobian[row, x.numel() + control] = 1.0
    return casadi.vertcat(motion, u[kept]), jacobian, hessian


def _motion_step(equations: SceneEquations, x: Any, u: Any, multiplier: Any) -> tuple[Any, Any, Any]:
    """The same of the motion alone."""
    if equations.scene.simulation.integrator == "rk4":
        p, h = _parameters(equations), equations.scene.simulation.dt
        return _runge_kutta_step(_rates(equations), x, u, p, multiplier, h)
    x_next, both = _euler_step(equations, x, u), casadi.vertcat(x, u)
    twice = casadi.hessian(casadi.dot(multiplier, x_next), both)[0]
    return x_next, casadi.jacobian(x_next, both), twice


def _rates(equations: SceneEquations) -> Any:
    """Time derivative of the stored motion, a function of (x, u, p)."""
    field = equations.field.of_motion
    x, u = casadi.SX.sym("x", field.n_x), casadi.SX.sym("u", field.n_u)
    stored = field.n_x - field.n_y
    others = field.rates(casadi.vertsplit(x[stored:]), casadi.vertsplit(u))
    rates = casadi.vertcat(_pose_rates(equations, x[:stored], x[stored:]), *others)
    return casadi.Function("rates", [x, u, _parameters(equations)], [rates], {"cse": True})


def _pose_rates(equations: SceneEquations, pose: Any, y: Any) -> Any:
    """Rates of the stored numbers of the pose, eq. (3): 1/2 q omega."""
    coordinates = equations.field.pose
    twist = coordinates.full_twist([y[i] for i in coordinates.twist_indices])
    return casadi.vertcat(
        *coordinates.reduced(dq.derivative(coordinates.full(casadi.vertsplit(pose)), twist))
    )


def _euler_step(equations: SceneEquations, x: Any, u: Any) -> Any:
    """Symplectic Euler: new velocities, then all else with them."""
    field, h = equations.field.of_motion, equations.scene.simulation.dt
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


def _runge_kutta_step(rates: Any, x: Any, u: Any, p: Any, multiplier: Any, h: float) -> tuple[Any, Any, Any]:
    """A step, its Jacobian by (x, u), and the Hessian of multiplier . step, by the chain rule over stages."""
    arguments = rates.sx_in()
    weight = casadi.SX.sym("w", x.numel())
    slope, both = rates(*arguments), casadi.vertcat(*arguments[:2])
    jacobian = casadi.Function("jacobian", arguments, [casadi.jacobian(slope, both)], {"cse": True})
    twice = casadi.hessian(casadi.dot(weight, slope), both)[0]
    hessian = casadi.Function("hessian", [*arguments, weight], [twice], {"cse": True})

    n_x, n = x.numel(), both.numel()
    states, slopes = _stages(lambda state: rates(state, u, p), x, h)
    jacobians = [jacobian(state, u, p) for state in states]
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
        total += casadi.mtimes(change.T, casadi.mtimes(hessian(state, u, p, costate), change))
    x_next = x + h * sum(weight * k for weight, k in zip(_WEIGHTS, slopes, strict=True))
    by_both = identity[:n_x, :] + h * sum(
        weight * k for weight, k in zip(_WEIGHTS, slope_changes, strict=True)
    )
    return x_next, by_both, total


def _stage_cost(equations: SceneEquations, x: Any, u: Any) -> Any:
    """Cost of a stage: of the state, the effort, and the tip's twist with the wrist's rates."""
    effort = _weighted(equations.control_weights, u)
    rates = equations.field.inputs(casadi.vertsplit(u)).wrist_rates
    return _state_cost(equations, x, "", rates) + effort


def _terminal_cost(equations: SceneEquations, x: Any) -> Any:
    """Cost of the end, where the wrist is held."""
    return _state_cost(equations, x, "terminal_", None)


def _state_cost(equations: SceneEquations, x: Any, when: str, wrist_rates: Any) -> Any:
    """Cost of a state by the weights of stages or of the end."""
    entries, target = casadi.vertsplit(x), equations.scene.target
    motion = equations.field.motion(equations.y(entries))
    tip, reference = equations.compared_poses(equations.tip(entries))
    pose = casadi.vertcat(*tip) - casadi.vertcat(*reference)
    twist = casadi.vertcat(*motion.angular, *motion.linear) - casadi.DM(target.base_velocity)
    if target.base_velocity_relative:
        twist -= casadi.vertcat(*equations.target_twist(equations.base_pose(entries)))
    relative = casadi.vertcat(*equations.relative_twist(entries, wrist_rates))
    errors = {"pose": pose, "base_velocity": twist, "tip_twist": relative}
    return sum(_weighted(equations.state_weights(when + name), error) for name, error in errors.items())


def _weighted(weights: Sequence[Any], errors: Any) -> Any:
    """Sum of squares with weights."""
    return casadi.dot(casadi.vertcat(*weights), errors**2)
