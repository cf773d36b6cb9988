"""A scene as a shooting problem: its kernels, bounds, horizon and start under the names the solver uses."""

import copy
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from dq_space_arm_env import Kernels, Scene, compile_scene, load_scene
from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses
from dq_space_arm_env.kernels.library import PENALIZED
from dq_space_arm_env.kernels.parallel_compilation import Request, compiling_aside
from dq_space_arm_env.scene import INTEGRATORS
from dq_space_arm_env.scene.constraint_rows import (
    n_multipliers,
    path_rows,
    penalized_rows,
    rates_of,
    slew_limits,
    terminal_rows,
)
from dq_space_arm_env.scene.constraints import ControlRate
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.parameters import CATCH, PHASE
from dq_space_arm_env.scene.pose import PLANAR_POSE, PLANAR_TWIST
from dq_space_arm_env.scene.start import episode_scene, unit_quaternions
from experts.problems.shooting_problem import (
    FloatArray,
    Kernel,
    RateLimits,
    ShootingProblem,
    StageParameters,
    check_interface,
    check_problem,
)
from experts.problems.stage_constraints import StageConstraints

NO_STATE = 1e-3
"""How far a given start may be from unit quaternions, as `multiple_shooting.LARGEST_PROJECTION`."""


class ArmProblem:
    """The maneuver of a scene in minimal coordinates, in double precision; implements `ShootingProblem`.

    Attributes:
        parameters: What varies in the scene, as in `kernels.parameters`.
        terminal_inputs: The last stage's parameters, if there are any, and the weight of the terminal cost's
            pose, shape (1,): 1, or less in long steps, see `coarsened`.
        constraints: Those of the scene and of success at its end; None without.
        reserve: Share of the tolerances of success that those keep free.
        has_second_order: Whether the registry of integrators names second derivatives for the scene's; the
            solver uses Gauss-Newton's model where there are none.
    """

    has_retraction = True

    def __init__(
        self,
        scene: Scene | str | Path | Mapping[str, Any],
        integrator: str | None = None,
    ) -> None:
        self.scene = in_double_precision(load_scene(scene), integrator)
        self.kernels = compile_scene(self.scene)
        self.integrator: str = self.scene.simulation.integrator
        self.has_second_order = INTEGRATORS[self.integrator].curvature is not None
        layout = self.kernels.layout
        # Rates of controls are bounds of the inputs.
        self.is_constrained = any(not isinstance(each, ControlRate) for each in self.scene.constraints)
        mixed_rows = any(row.has_input for row in penalized_rows(self.scene))
        # The wrist's rates turn the tip.
        twists = any(self.scene.cost.tip_twist) and "wrist psi rate" in layout.control.names
        self.has_mixed_cost = twists or mixed_rows
        self.n_states, self.n_tangent, self.n_controls = layout.n_x, layout.n_t, layout.n_u
        self.horizon = self.scene.simulation.steps
        self.time_step = self.scene.simulation.dt
        self.initial_state: FloatArray = layout.initial_state
        self._limits_vary = not set(layout.control.limits).isdisjoint(layout.parameters.names)
        self._end_weight, self.reserve = 1.0, 0.0
        self._make_inputs()

    def __copy__(self) -> "ArmProblem":
        """Share all, parameters too, until `_make_inputs`; `__reduce__` is for deep copies and pickles."""
        twin = object.__new__(type(self))
        twin.__dict__.update(self.__dict__)
        return twin

    def __reduce__(self) -> NoReturn:
        self.parameters.__reduce__()

    def constrained(self, reserve: float = 0.0) -> "ArmProblem":
        """Return the same maneuver with success as constraint, for a scene that has no constraints.

        Args:
            reserve: Share of the tolerances to keep free.
        """
        twin = copy.copy(self)
        twin.is_constrained, twin.reserve = True, reserve
        twin._make_inputs()
        return twin

    def _make_inputs(self) -> None:
        """Allocate what may change between solves, and what follows from the number of stages."""
        entries = self.kernels.parameters
        changing = self._in_stages if entries.moving or entries.staged else None
        n_rows = n_multipliers(self.scene) if self.is_constrained else 0
        nominal = self.kernels.parameters.nominal
        check = partial(episode_scene, self.scene)
        self.parameters = StageParameters(self.horizon, nominal, changing, 2 * n_rows, check)
        self.constraints = self.constraints_of(self.parameters)
        last = (rows[-1:] for rows in self.parameters.inputs)
        self.terminal_inputs: tuple[FloatArray, ...] = (*last, np.full(1, self._end_weight))
        self.rate_limits = self._limits_of_rates()

    def _limits_of_rates(self) -> RateLimits:
        """Limits of how much controls change from stage to stage."""
        layout = self.kernels.layout
        state, tangent = layout.state.actuators, layout.tangent.actuators
        return RateLimits(
            controls=np.array(layout.previous_controls, np.int64),
            states=np.arange(state.start, state.stop),
            tangents=np.arange(tangent.start, tangent.stop),
            change=np.array([limit.rate for limit in rates_of(self.scene)]) * self.time_step,
        )

    def keep_previous(self, states: FloatArray, controls: FloatArray) -> None:
        """Set the previous controls in states, (N + 1, n_x), to those of a guess, (N, n_u), in place."""
        layout = self.kernels.layout
        states[1:, layout.state.actuators] = controls[:, layout.previous_controls]
        self._keep_chains(states, controls)

    def _keep_chains(self, states: FloatArray, controls: FloatArray) -> None:
        """Likewise what is on its way from commands to outputs."""
        layout, h = self.kernels.layout, self.time_step
        start = layout.state.drives.start
        for chain in layout.chains:
            n, waiting = chain.delay, states[:, start : start + chain.delay]
            for step, u in enumerate(controls[:, chain.control]):
                followed = u
                if n:
                    followed = waiting[step, 0]
                    waiting[step + 1] = [*waiting[step, 1:], u]
                if chain.time_constant is not None:
                    e = math.exp(-h / chain.time_constant)
                    states[step + 1, start + n] = e * states[step, start + n] + (1.0 - e) * followed
            start += len(chain.names)

    def constraints_of(self, parameters: StageParameters) -> StageConstraints | None:
        """Constraints of stages with given parameters, whose further numbers are their multipliers."""
        if not self.is_constrained:
            return None
        path, terminal, kernels = penalized_rows(self.scene), terminal_rows(self.scene), self.kernels
        which = [not row.is_rate for row in path_rows(self.scene)]
        reserve = self.reserve * np.array([0.0 if row.is_equality else row.tolerance for row in terminal])

        def residuals(states: FloatArray, controls: FloatArray) -> tuple[FloatArray, FloatArray]:
            rows, along = parameters.rows, np.zeros((len(controls), 0))
            if path:
                along = kernels.constraints(states[:-1], controls, p=rows[:-1])[:, which]
            at_end = kernels.terminal_constraints(states[-1], p=rows[-1])
            at_end = at_end + [row.margin for row in terminal] + reserve
            return along + [row.margin for row in path], at_end

        def slopes(state: FloatArray) -> FloatArray:
            return kernels.terminal_constraint_jacobian(state, p=parameters.rows[-1])

        multipliers, penalties = np.split(parameters.more, 2, axis=1)
        given = path, terminal, multipliers, penalties, residuals, slopes
        return StageConstraints(*given, reserve, self._end_weight)

    def _in_stages(self, parameters: FloatArray) -> FloatArray:
        """Parameters of the stages, (N + 1, n_p), from those at the start: the target moves."""
        return self.in_long_steps(self.kernels.stage_parameters(parameters))

    def in_long_steps(self, rows: FloatArray) -> FloatArray:
        """Parameters of this problem's stages, (N + 1, n_p), from those of shorter ones, (factor N + 1, n_p).

        A long step has the mean weights of its stages, and the catch at its end.
        """
        factor = (len(rows) - 1) // self.horizon
        found = rows[::factor].copy()
        if factor > 1 and self.kernels.parameters.staged:
            blocks = rows[:-1].reshape(self.horizon, factor, -1)
            weights, caught = (self.kernels.parameters.indices(path) for path in ("cost", CATCH))
            found[:-1, weights] = blocks[:, :, weights].mean(axis=1)
            found[:-1, caught] = blocks[:, -1, caught]
        return found

    @property
    def _has_delays(self) -> bool:
        return any(chain.delay for chain in self.kernels.layout.chains)

    def can_coarsen(self, factor: int) -> bool:
        """Tell whether long steps of so many stages end where the robot changes, and no delay counts steps.

        Args:
            factor: Steps in one of the longer steps; it divides the number of stages.
        """
        if factor > 1 and self._has_delays:
            return False
        entries = self.kernels.parameters
        others = {index for path in ("cost", "actuators", PHASE, CATCH) for index in entries.indices(path)}
        robot = [index for index in entries.staged if index not in others]
        rows = self.kernels.stage_parameters()[:-1, robot]
        changes = np.flatnonzero((rows[1:] != rows[:-1]).any(axis=1)) + 1
        return not (changes % factor).any()

    def coarsened(self, factor: int) -> "ArmProblem":
        """Return the same maneuver in fewer, longer steps; its costs are smaller by the factor.

        Only stages count in the cost, not their duration: the final pose loses weight as they become fewer.
        The integrator is the one whose second derivatives serve the maneuver, so that they are exact.

        Args:
            factor: Steps in one of the longer steps; it divides the number of stages.

        Raises:
            ValueError: If it is no whole number, or does not.
        """
        if not isinstance(factor, int | np.integer) or factor < 1 or self.horizon % factor:
            raise ValueError(f"factor is {factor!r}; it must divide the {self.horizon} stages")
        if factor > 1 and self._has_delays:
            raise ValueError(
                f"factor is {factor}; it must be 1: delays of actuators are whole steps, longer in long ones"
            )
        if not self.can_coarsen(factor):
            raise ValueError(
                f"factor is {factor}; it must divide the stages of the phases that change the robot"
            )
        coarse = copy.copy(self)
        coarse.horizon, coarse.time_step = self.horizon // factor, self.time_step * factor
        coarse.integrator = INTEGRATORS[self.integrator].curvature or self.integrator
        coarse._end_weight = self._end_weight / factor
        coarse._make_inputs()
        return coarse

    @property
    def control_upper(self) -> FloatArray:
        """Limits of the inputs, shape (n_u,); (N, n_u) where a limit is a parameter."""
        return self.limits(self.parameters.rows)

    @property
    def control_lower(self) -> FloatArray:
        """Lower bounds, zero for thrusters."""
        return self.kernels.layout.lower_limits(self.control_upper)

    def limits(self, rows: FloatArray) -> FloatArray:
        """Limits of the inputs with parameters of M stages and the end, (M + 1, n_p): (n_u,) or (M, n_u).

        Where a rate is limited and the environment switches off at once, they come down in time.
        """
        layout = self.kernels.layout
        if not self._limits_vary:
            return layout.control_limit
        limits, slewing = layout.limits_with(rows[:-1]), slew_limits(self.scene)
        for control, change in zip(self.rate_limits.controls, self.rate_limits.change, strict=True):
            if control in [each.control for each in slewing]:
                continue  # it runs down in the environment, too
            # Before a smaller limit a control has to be so near that its rate leads it there in time.
            own, way = limits[:, control], change * np.arange(len(limits))
            later = np.minimum.accumulate((own + way)[::-1])[::-1]
            limits[:, control] = np.where(later < own + way, later - way, own)
        return limits

    @property
    def target(self) -> FloatArray:
        """Target q_{D/I} of the tip at the end, shape (8,)."""
        return self.kernels.layout.target_with(self.parameters.rows[-1])

    def carried(self, states: FloatArray, parameters: FloatArray) -> FloatArray | None:
        """See `carried_along`, with the present parameters."""
        return carried_along(self.kernels.layout, states, parameters, self.parameters.rows)

    def check_state(self, name: str, state: FloatArray) -> None:
        """Raise ValueError if poses and rotations are far from unit ones, in (n_x,) or in rows (M, n_x)."""
        layout, rows = self.kernels.layout, np.atleast_2d(state)
        real, dual = np.split(rows[:, layout.state.pose], 2, axis=1)
        units = [real, *(rows[:, where] for where in unit_quaternions(self.scene))]
        lengths = np.array([np.linalg.norm(unit, axis=1) for unit in units])
        products = np.zeros(len(rows)) if layout.planar else (real * dual).sum(axis=1)
        overlaps = np.abs(products) / (1.0 + np.linalg.norm(dual, axis=1))
        off = np.maximum(overlaps, np.abs(lengths - 1.0).max(axis=0)) > NO_STATE
        if off.any():
            k = int(off.argmax())
            where = name if state.ndim == 1 else f"{name}[{k}]"
            found = ", ".join(f"{length:.4g}" for length in lengths[:, k])
            raise ValueError(
                f"{where} is no state: its rotations have the lengths {found}, and q_r . q_d of its pose is "
                f"{products[k]:.3g}; a pose must be a unit dual quaternion"
            )

    def misses(self, state: FloatArray) -> float:
        """Largest of the tip's errors at a final state, each relative to its tolerance."""
        return float(misses(self.kernels, state, self.parameters.rows[-1]))

    def is_success(self, states: FloatArray, controls: FloatArray) -> bool:
        """Whether an episode is a success by its last states, (M + 1, n_x), and inputs, (M, n_u).

        The tip ends within the tolerances; what is to be caught in these stages is caught, which long steps,
        see `coarsened`, leave open.
        """
        if not self.misses(states[-1]) <= 1.0:  # NaN is no success
            return False
        if not self.scene.phases or self.horizon < self.scene.simulation.steps:
            return True
        from dq_space_arm_env.environment.catches import catches, ends_held  # loads the environments

        first = self.horizon - len(controls)
        return ends_held(catches(self.kernels, self.parameters.rows, states, controls, first))

    def kernel(self, name: str, *, batched: bool = False) -> Kernel:
        """Return a kernel of `ShootingProblem`."""
        return self.kernels.kernel(**self._request(name, batched=batched)._asdict())

    def compiling_aside(
        self, wanted: Sequence[tuple[str, bool]], before: Callable[[], None] | None
    ) -> AbstractContextManager[None]:
        """Let another process compile kernels, given by name and whether batched, while a block runs."""
        requests = [self._request(name, batched=batched) for name, batched in wanted]
        return compiling_aside(self.kernels, requests, before)

    def _request(self, name: str, *, batched: bool) -> Request:
        name = "emphasized_terminal_cost" if name == "terminal_cost" else name
        integrator: str | None = self.integrator
        if name == "lagrangian_hessian":
            integrator = INTEGRATORS[self.integrator].curvature
        if self.is_constrained and name not in ("difference", "retract"):
            name = PENALIZED + name
        return Request(name, integrator, None if batched else 1)


def misses(kernels: Kernels, states: FloatArray, parameters: FloatArray) -> FloatArray:
    """Largest of the tip's errors at final states, each relative to its tolerance.

    Args:
        kernels: Those of the scene, whose `success` has the tolerances.
        states: Shape (n_x,) or (B, n_x), units of the state.
        parameters: Of the end, shape (n_p,) or (B, n_p), units of `parameters`.

    Returns:
        Errors, at most 1 in success, shape () or (B,); NaN or infinite where a state is.
    """
    errors = kernels.tip_errors(states, parameters if kernels.n_p else None)
    return np.asarray(np.max(errors / kernels.scene.success.tolerances[: errors.shape[-1]], axis=-1))


def carried_along(
    layout: StateLayout, states: FloatArray, before: FloatArray, now: FloatArray
) -> FloatArray | None:
    """Move the states of a maneuver as the target has moved; None if it has not.

    A rigid motion of base and target together leaves a maneuver what it is: nothing else is in space. Where
    the target moves differently now, the base moves along with it, stage by stage.

    Args:
        layout: Of the states.
        states: Shape (M, n_x).
        before: Parameters of that maneuver's stages, shape (M, n_p).
        now: Present parameters of the stages, shape (M, n_p).

    Returns:
        States that have the same pose relative to the present target, shape (M, n_x).
    """
    targets = layout.target_with(before), layout.target_with(now)
    velocities = layout.target_velocity_with(before), layout.target_velocity_with(now)
    if np.array_equal(*targets) and np.array_equal(*velocities):
        return None
    stored, entries = list(PLANAR_POSE if layout.planar else range(8)), layout.state.pose
    pose, moved = np.zeros((8, len(states))), states.copy()
    pose[stored] = states[:, entries].T
    old, new = (tuple(target.T) for target in targets)
    # q_{D'/I} q_{D/I}* q_{e0/I}, with the new target D'
    motion = dq.multiply(new, dq.conjugate(old))
    moved[:, entries] = np.array(dq.multiply(motion, tuple(pose)))[stored].T
    faster = velocities[1] - velocities[0]
    if faster.any():  # of D' than of D, in its axes: the base gains this velocity, carried to its own
        relative = poses.to_matrix(dq.multiply(dq.conjugate(old), tuple(pose)))
        gained = np.array(dual_vectors.inverse_transform(*relative, tuple(faster.T)))
        free = list(PLANAR_TWIST if layout.planar else range(6))
        moved[:, layout.state.base_velocity] += gained[free].T
    return moved


def as_problem(scene_or_problem: Any) -> ShootingProblem:
    """Turn a scene into a problem, and check sizes and bounds; a problem passes unchanged.

    Raises TypeError for what is neither, and ValueError for a problem that contradicts itself.
    """
    if isinstance(scene_or_problem, Scene | str | Path | Mapping):
        arm = ArmProblem(scene_or_problem)
        if not arm.n_controls:
            raise ValueError(
                f"scene {arm.scene.name!r} has no actuator; give it one with a finite limit, such as "
                "actuators: {base_torque: {limit: 2.0}}"
            )
        problem: ShootingProblem = arm
    else:
        check_interface(scene_or_problem)
        problem = scene_or_problem
    check_problem(problem)
    return problem


def in_double_precision(scene: Scene, integrator: str | None = None) -> Scene:
    """Return the scene in double precision, which convergence needs, and with an integrator."""
    changes = {"precision": "float64", "integrator": integrator or scene.simulation.integrator}
    return scene.replace(simulation=changes)
