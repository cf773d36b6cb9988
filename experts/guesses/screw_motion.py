"""A kinematic guess: one screw motion of the tip to its target, and an arm that follows it.

The tip follows the shortest screw motion to its target pose (ScLERP) with minimum-jerk timing; its initial
velocity fades out on the way. The arm follows by resolved motion rates (Whitney 1969): joints and wrist give
the tip the desired velocity as far as moderate rates allow (damped least squares, Nakamura & Hanafusa 1986).
The base floats: its velocity follows from the momentum (Umetani & Yoshida 1989). Thrust is expensive, so
linear momentum is conserved; a torque on the base, where there is one, removes angular momentum, and a wrench
at the tip changes both. A target out of reach is approached as closely as possible. Torques follow from
inverse dynamics.

The arm's motion is integrated on a coarse grid of knots, then made smooth and consistent on the grid of the
stages: joint angles are splines, and the base's velocity follows from their rates and the momentum.
"""

from typing import NamedTuple

import numpy as np

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import dual_vectors, poses, screw
from experts.guesses.free_floating import FreeFloatingArm, indices
from experts.problems.arm_problem import ArmProblem
from experts.problems.shooting_problem import FloatArray, check_array, stage_bounds

DURATION = 0.15
"""Default duration of the tip's path, as a share of the horizon: the cost rewards haste."""
N_INTERVALS = 60
"""Intervals between knots."""
DAMPING = 0.05
"""Weight of joint and wrist rates relative to the velocity of the tip, rad/s and m/s per rad/s."""
CORRECTION_INTERVALS = 3.0
"""Intervals in which the tip recovers a lag."""
LARGEST_CORRECTION = 0.3
"""Largest velocity of that recovery, rad/s and m/s."""


class ScrewMotion(NamedTuple):
    """A guess of a maneuver: kinematically consistent, and dynamically within the actuators' limits."""

    states: FloatArray  # shape (N + 1, n_x), units of the state
    controls: FloatArray  # within the bounds, shape (N, n_u), units of the inputs


class TipPath(NamedTuple):
    """Desired motion of the tip at K + 1 times."""

    poses: FloatArray  # q_{G/I}, shape (K + 1, 8)
    velocities: FloatArray  # dual velocities in the axes of these poses, shape (K + 1, 6), rad/s and m/s


class _Knots(NamedTuple):
    """Motion at the knots."""

    states: FloatArray  # configurations, with the velocities of the start, shape (K + 1, n_x)
    momenta: FloatArray  # momentum in inertial axes, shape (K + 1, n_b)


def screw_motion(
    problem: ArmProblem, x0: FloatArray | None = None, *, duration: float | None = None
) -> ScrewMotion:
    """Guess the maneuver from a start, by default the problem's initial state.

    The tip's path ends at the target after `duration` s, by default `DURATION` of the horizon; the arm may
    need the rest to catch up. The first state of the guess is x0.
    """
    start = np.array(problem.initial_state if x0 is None else x0, dtype=np.float64)
    check_array("x0", start, (problem.n_states,))
    horizon = problem.horizon * problem.time_step
    end = DURATION * horizon if duration is None else float(duration)
    if not 0.0 < end <= horizon:
        raise ValueError(f"duration is {end} s; it must be positive and at most the horizon, {horizon} s")
    times = np.linspace(0.0, horizon, N_INTERVALS + 1)
    return follow_path(problem, start, tip_path(problem, start, end, times))


def follow_path(problem: ArmProblem, start: FloatArray, path: TipPath) -> ScrewMotion:
    """Let the arm follow a path of its tip from a start; the path's times divide the horizon evenly."""
    motion, step = _ArmMotion(problem), problem.horizon * problem.time_step / (len(path.poses) - 1)
    return motion.on_stages(motion.follow(start, path, step))


def free_floating_arm(problem: ArmProblem) -> FreeFloatingArm:
    """The robot of a problem with its parameters at the start."""
    return FreeFloatingArm(problem.kernels, problem.parameters.rows[0])


def tip_path(problem: ArmProblem, start: FloatArray, duration: float, times: FloatArray) -> TipPath:
    """Lead the tip from its pose and velocity at the start to rest at the target.

    The pose is q_{G/I}(0) exp(d) exp(s w): w is the screw motion to the target, s rises from 0 to 1, and d
    starts with the tip's velocity, with the wrist at rest, and ends at 0; both with minimum jerk.
    """
    arm, layout = free_floating_arm(problem), problem.kernels.layout
    entries = layout.state
    frames = problem.kernels.frame_poses(start[None])
    jacobian = arm.tip_jacobian(start[None], frames)
    drift = jacobian.base[0] @ start[entries.base_velocity] + jacobian.joints[0] @ start[entries.joint_rates]
    first, target = frames[0, -1], problem.target
    path = _target_path(problem, times) if problem.kernels.parameters.moving else None
    if path is not None:  # the same, relative to a target that moves
        begin = tuple(path.poses[0].tolist())
        first = np.array(dq.multiply(dq.conjugate(begin), tuple(first.tolist())))
        own = poses.to_matrix(tuple(first.tolist()))
        drift = drift - np.array(dual_vectors.inverse_transform(*own, tuple(path.velocities[0].tolist())))
        target = np.array(dq.IDENTITY)
    way = screw.logarithm(dq.multiply(dq.conjugate(first), tuple(target.tolist())))
    t = np.minimum(times / duration, 1.0)
    rise, rise_rate = t**3 * (10.0 - 15.0 * t + 6.0 * t**2), 30.0 * (t * (1.0 - t)) ** 2 / duration
    fade = t * (1.0 - t) ** 3 * (1.0 + 3.0 * t) * duration
    fade_rate = (1.0 - t) ** 2 * (1.0 + 2.0 * t - 15.0 * t**2)
    onward = screw.exponential(dual_vectors.scale(rise, way))
    pose = dq.multiply(first, dq.multiply(screw.exponential(dual_vectors.scale(fade, drift)), onward))
    carried = dual_vectors.inverse_transform(*poses.to_matrix(onward), dual_vectors.scale(fade_rate, drift))
    velocity = dual_vectors.add(carried, dual_vectors.scale(rise_rate, way))
    if path is not None:
        along = dual_vectors.inverse_transform(*poses.to_matrix(pose), tuple(path.velocities.T))
        pose, velocity = dq.multiply(tuple(path.poses.T), pose), dual_vectors.add(velocity, along)
    return TipPath(np.stack(pose, axis=-1), np.stack(velocity, axis=-1))


def _target_path(problem: ArmProblem, times: FloatArray) -> TipPath:
    """Poses and velocities of a target that moves, at the stages nearest to some times."""
    layout, rows = problem.kernels.layout, problem.parameters.rows
    rows = rows[np.rint(times / problem.time_step).astype(int)]
    return TipPath(layout.target_with(rows), layout.target_velocity_with(rows))


class _ArmMotion:
    """Motion of a problem's arm along a path of its tip."""

    def __init__(self, problem: ArmProblem) -> None:
        self.problem, self.kernels, self.layout = problem, problem.kernels, problem.kernels.layout
        self.arm = free_floating_arm(problem)
        n, wrist = self.layout.n_joints, self.layout.control.wrist_rate
        self._driven = [*self.layout.actuated_joints, *(n + i for i in range(wrist.stop - wrist.start))]
        self._limits = np.full(len(self._driven), np.inf)
        self._limits[len(self.layout.actuated_joints) :] = stage_bounds(problem)[1][:, wrist].min(axis=0)

    # The knots.

    def follow(self, start: FloatArray, path: TipPath, step: float) -> _Knots:
        """Integrate the rates along the path (two-step Adams-Bashforth)."""
        states = np.repeat(start[None], len(path.poses), axis=0)
        momenta = self._kept_momentum(start, len(states))
        gained = np.zeros(momenta.shape[1])
        change = np.zeros(self.kernels.n_t)
        configuration = slice(0, self.layout.tangent.base_velocity.start)
        before = None
        for k in range(len(states) - 1):
            rates, load = self._rates(states[k], momenta[k], path.poses[k], path.velocities[k], step)
            change[configuration] = step * self._changes(
                states[k], rates if before is None else 1.5 * rates - 0.5 * before
            )
            states[k + 1] = self.kernels.retract(states[k], change)
            self.arm.scale_quaternions(states[k + 1])
            gained += step * load
            momenta[k + 1] += gained
            before = rates
        return _Knots(states, momenta)

    def _changes(self, state: FloatArray, rates: FloatArray) -> FloatArray:
        """Rates of base, joint and wrist angles in tangent coordinates."""
        base, n = len(self.arm.twist_entries), self.layout.n_joints
        angles = state[self.layout.state.joint_angles]
        joints = self.arm.angle_rates(angles, rates[base : base + n])
        return np.concatenate([rates[:base], joints, rates[base + n :]])

    def _kept_momentum(self, start: FloatArray, count: int) -> FloatArray:
        """Remaining share of the initial momentum at the knots, shape (K + 1, n_b).

        Linear momentum is conserved: only thrusters could change it. A torque on the base, where there is
        one, removes angular momentum, which would turn the arm away from the target.
        """
        momentum = self.arm.momentum_of_bodies(start[None])[:, self.arm.momentum_entries]
        momenta, control = np.repeat(momentum, count, axis=0), self.layout.control
        if any(map(indices, (control.base_torque, control.wheel_torque, control.thruster_force))):
            angular = [i for i, entry in enumerate(self.arm.momentum_entries) if entry >= 3]
            momenta[:, angular] *= np.linspace(1.0, 0.0, count)[:, None] ** 2
        return momenta

    def _rates(
        self, state: FloatArray, momentum: FloatArray, pose: FloatArray, velocity: FloatArray, step: float
    ) -> tuple[FloatArray, FloatArray]:
        """Rates with which the tip follows a moving pose, and the rate of change of the momentum."""
        states = state[None]
        frames = self.kernels.frame_poses(states)
        tip, system = self.arm.tip_jacobian(states, frames), self.arm.momentum_map(states)
        solved = np.linalg.solve(system.base[0], np.column_stack([momentum, -system.joints[0]]))
        coasting, reaction = solved[:, 0], solved[:, 1:]
        generalized = np.hstack([tip.base[0] @ reaction + tip.joints[0], tip.wrist[0]])
        behind = dq.multiply(dq.conjugate(frames[0, -1]), pose)
        correction = np.array(screw.logarithm(behind)) / (CORRECTION_INTERVALS * step)
        correction *= LARGEST_CORRECTION / max(LARGEST_CORRECTION, float(np.linalg.norm(correction)))
        wanted = dual_vectors.transform(*poses.to_matrix(behind), velocity) + correction
        # Where the tip cannot follow, weaker damping would overshoot due to the error's curvature.
        damping = DAMPING**2 + float(np.linalg.norm(correction)) * step
        rates = self._drive(generalized, wanted - tip.base[0] @ coasting, damping)
        base = coasting + reaction @ rates[: self.layout.n_joints]
        return np.concatenate([base, rates]), self.arm.tip_load(states, system)[0]

    def _drive(self, jacobian: FloatArray, wanted: FloatArray, damping: float) -> FloatArray:
        """Joint and wrist rates of least damped error; the wrist keeps its limits."""
        rates = np.zeros(jacobian.shape[1])
        driven, limits = np.array(self._driven, dtype=int), self._limits
        while len(driven):
            columns = jacobian[:, driven]
            normal = columns.T @ columns + damping * np.eye(len(driven))
            found = np.linalg.solve(normal, columns.T @ wanted)
            over = np.abs(found) > limits
            rates[driven] = np.clip(found, -limits, limits)
            if not over.any():
                break
            wanted = wanted - columns[:, over] @ rates[driven[over]]
            driven, limits = driven[~over], limits[~over]
        return rates

    # The stages.

    def on_stages(self, knots: _Knots) -> ScrewMotion:
        """Interpolate a motion at the stages, smooth and consistent."""
        problem, entries, control = self.problem, self.layout.state, self.layout.control
        n, dt = problem.horizon, problem.time_step
        place = np.linspace(0.0, len(knots.states) - 1, n + 1)
        step = n * dt / (len(knots.states) - 1)
        states = np.repeat(knots.states[:1], n + 1, axis=0)
        controls = np.zeros((n, problem.n_controls))
        given = knots.states[:, entries.joint_angles]
        first = self.arm.angle_rates(given[0], states[0, entries.joint_rates])
        angles, rates = _spline(given, step * first, place)
        states[:, entries.joint_angles] = angles
        states[:, entries.joint_rates] = self.arm.joint_rates(angles, rates / step)
        self.arm.scale_quaternions(states)
        if indices(control.wrist_rate):
            angles, _ = _spline(knots.states[:, entries.wrist_angles], np.zeros(3), place)
            controls[:, control.wrist_rate] = np.diff(angles, axis=0) / dt
            controls = self._within_bounds(controls)
            states[1:, entries.wrist_angles] += dt * np.cumsum(controls[:, control.wrist_rate], axis=0)
        self._add_base_motion(states, knots, place)
        self.arm.drive_along(states)
        states[0] = knots.states[0]
        accelerations = np.diff(states[:, self.arm.velocity_entries], axis=0) / dt
        controls = self._within_bounds(controls + self.arm.controls(states[:-1], accelerations))
        states[1:, entries.wheel_momenta] += dt * np.cumsum(controls[:, control.wheel_torque], axis=0)
        flows = [each.mass_flow for each in self.kernels.scene.actuators.thrusters or ()]
        burnt = dt * np.cumsum(controls[:, control.thruster_force] @ np.array(flows))
        states[1:, entries.propellant] -= burnt[:, None]
        problem.keep_previous(states, controls)
        return ScrewMotion(states, controls)

    def _within_bounds(self, controls: FloatArray) -> FloatArray:
        return np.clip(controls, self.problem.control_lower, self.problem.control_upper)

    def _add_base_motion(self, states: FloatArray, knots: _Knots, place: FloatArray) -> None:
        """Set pose and velocity of the base according to joint rates and momentum.

        The momentum is known in inertial axes, so the attitude enters: first the knots', which is as good as
        their integration, then the one that follows.
        """
        entries = self.layout.state
        interval = np.minimum(place.astype(int), len(knots.states) - 2)
        share = place - interval
        momenta = knots.momenta[interval] + share[:, None] * (
            knots.momenta[interval + 1] - knots.momenta[interval]
        )
        at_knots = self.kernels.frame_poses(knots.states)[:, 0].T
        pose = screw.interpolate(at_knots[:, interval], at_knots[:, interval + 1], share)
        for last in (False, True):
            states[:, entries.pose] = np.stack(pose, axis=-1)[:, self.arm.pose_entries]
            system = self.arm.momentum_map(states)
            left = momenta[:, :, None] - system.joints @ states[:, entries.joint_rates, None]
            velocities = np.linalg.solve(system.base, left)[:, :, 0]
            if not last:
                pose = tuple(self._integrate(at_knots[:, 0], velocities))
        states[:, entries.base_velocity] = velocities

    def _integrate(self, first: FloatArray, velocities: FloatArray) -> FloatArray:
        """Poses of a base with given velocities at the stages, shape (8, N + 1)."""
        increments = np.zeros((6, len(velocities) - 1))
        mean = 0.5 * (velocities[1:] + velocities[:-1])
        increments[self.arm.twist_entries] = self.problem.time_step * mean.T
        product = np.concatenate([first[:, None], np.stack(screw.exponential(increments))], axis=1)
        reach = 1  # a column is the product of so many factors, or of all before it
        while reach < product.shape[1]:
            product[:, reach:] = np.stack(dq.multiply(product[:, :-reach], product[:, reach:]))
            reach *= 2
        return product


def _spline(values: FloatArray, first_slope: FloatArray, place: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Evaluate a cubic spline with knots at 0, 1, 2, ..., uncurved at its end; return values and slopes."""
    # Continuous second derivatives: d_{i-1} + 4 d_i + d_{i+1} = 3 (y_{i+1} - y_{i-1}) for the slopes d.
    count = len(values)
    system = 4.0 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)
    system[0], system[-1, -1] = np.eye(count)[0], 2.0
    right = np.empty_like(values)
    right[0], right[1:-1], right[-1] = (
        first_slope,
        3.0 * (values[2:] - values[:-2]),
        3.0 * (values[-1] - values[-2]),
    )
    slopes = np.linalg.solve(system, right)
    i = np.minimum(place.astype(int), count - 2)
    s = (place - i)[:, None]
    rise, begin, end = values[i + 1] - values[i], slopes[i], slopes[i + 1]
    square, cube = 3.0 * rise - 2.0 * begin - end, begin + end - 2.0 * rise
    return (values[i] + s * (begin + s * (square + s * cube)), begin + s * (2.0 * square + 3.0 * s * cube))
