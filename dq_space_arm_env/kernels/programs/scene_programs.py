"""The programs of a scene, one per function of `Kernels`, traced on demand.

A program's inputs are arrays with one row per state: `x` (n_x), `u` (n_u), and others by name; `h`, the time
step in s, is shared by all rows. What varies in a scene is an input as well, `parameters` (n_p).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from dq_space_arm_env.algebra import dual_quaternion as dq
from dq_space_arm_env.algebra import poses, screw
from dq_space_arm_env.algebra.vectors import matrix_vector
from dq_space_arm_env.compiler.graph import trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics import elastic_gears, kinematics, minimal
from dq_space_arm_env.dynamics.vector_field import split_state
from dq_space_arm_env.integrators import checked_integrator_of
from dq_space_arm_env.integrators.actuated import append_measured_step
from dq_space_arm_env.integrators.method import MomentumIntegrator, program_inputs
from dq_space_arm_env.kernels.programs.constraint_programs import ConstraintPrograms
from dq_space_arm_env.kernels.programs.cotangent_programs import CotangentPrograms
from dq_space_arm_env.kernels.programs.derivative_programs import DerivativePrograms
from dq_space_arm_env.kernels.programs.parameter_programs import ParameterPrograms
from dq_space_arm_env.kernels.programs.quadratic_programs import QuadraticPrograms
from dq_space_arm_env.kernels.programs.robot_programs import RobotPrograms
from dq_space_arm_env.kernels.programs.stage_programs import of_stage, stage_method
from dq_space_arm_env.scene.parameters import moving_numbers
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.thrusters import burning_refusal
from dq_space_arm_env.task.actuator_limits import applied
from dq_space_arm_env.task.augmented_lagrangian import PenalizedEquations
from dq_space_arm_env.task.episode import next_target, seen, tip_errors, with_target
from dq_space_arm_env.task.equations import SceneEquations, total
from dq_space_arm_env.task.step_report import n_observations

Scalar = Any
Scalars = Sequence[Scalar]


class ScenePrograms:
    """Builds the programs of one scene by name."""

    def __init__(self, scene: Scene, *, penalized: bool = False) -> None:
        self.scene = scene
        self.equations = (PenalizedEquations if penalized else SceneEquations).of(scene)
        self.tree, self.layout = self.equations.tree, self.equations.layout
        self.field = self.equations.field
        derivatives = self._derivatives = DerivativePrograms(self.equations)
        quadratic = QuadraticPrograms(self.equations)
        robot = RobotPrograms(self.equations, self._program)
        cotangents = self._cotangents = CotangentPrograms(self.equations, self._program)
        self._builders: Mapping[str, Callable[[], Program]] = {
            "forward_dynamics": self._forward_dynamics,
            "forward_dynamics_with_tip_wrench": self._forward_dynamics_with_tip_wrench,
            "reaction_wrenches": self._reaction_wrenches,
            "tip_pose": self._tip_pose,
            "frame_poses": self._frame_poses,
            "momentum": self._momentum,
            "energy": self._energy,
            "mass_matrix": robot.mass_matrix,
            "bias_forces": robot.bias_forces,
            "tip_jacobian": robot.tip_jacobian,
            "generalized_jacobian": robot.generalized_jacobian,
            "tip_twist": robot.tip_twist,
            "cost": self._cost,
            "terminal_cost": self._terminal_cost,
            "emphasized_terminal_cost": self._emphasized_terminal_cost,
            **ConstraintPrograms(self.equations).builders,
            "cost_vjp": lambda: cotangents.of_cost(self._cost()),
            "emphasized_terminal_cost_vjp": lambda: cotangents.of_cost(self._emphasized_terminal_cost()),
            "observation_vjp": cotangents.observation,
            "cost_derivatives": derivatives.cost,
            "terminal_cost_derivatives": derivatives.terminal_cost,
            "terminal_cost_hessian": derivatives.terminal_cost_hessian,
            "quadratic_cost": quadratic.cost,
            "quadratic_cost_derivatives": quadratic.cost_derivatives,
            "cost_by_parameters": lambda: ParameterPrograms(self.equations).cost(),
            "terminal_cost_by_parameters": lambda: ParameterPrograms(self.equations).terminal_cost(),
            "difference": self._difference,
            "retract": self._retract,
            "measured_step": self._measured_step,
            "observation": self._observation,
            "applied_inputs": self._applied_inputs,
            "tip_errors": self._tip_errors,
            "relative_twist": self._relative_twist,
            "next_target": self._next_target,
            "observation_jacobian": robot.observation_jacobian,
            "state_from_observation": self._state_from_observation,
        }

    def build(self, name: str, integrator: str = "") -> Program:
        """Trace a program by name, with an integrator if it takes a step; KeyError if either is unknown."""
        if integrator and self.tree.tank is not None and (why := burning_refusal(integrator)):
            raise ValueError(f"integrator: {integrator!r} {why}")
        if name in ("step", "step_with_cost", "checked_step"):
            return self._step(name, integrator)
        if name == "walk":
            return self._walk(integrator)
        if name == "linearize":
            return self._derivatives.linearize(integrator)
        if name in ("vjp", "step_with_cost_vjp"):
            return self._cotangents.step(integrator, with_cost=name != "vjp")
        if name == "linearize_parameters":
            return ParameterPrograms(self.equations).linearize(integrator)
        if name == "lagrangian_hessian":
            return self._derivatives.lagrangian_hessian(integrator)
        return self._builders[name]()

    # Functions of a state, and of an input.

    def _program(
        self, name: str, outputs: Callable[..., Mapping[str, Scalars]], varies: bool = True, **sizes: int
    ) -> Program:
        """Program of a single graph; `varies` if it may depend on parameters."""
        inputs = [Buffer(key, size) for key, size in sizes.items()]
        parameters = self.field.parameters if varies else ()
        graph = trace(name + "_graph", sizes, outputs, parameters=parameters)
        program = Program(
            name,
            program_inputs(self.field, *inputs) if varies else inputs,
            [Buffer(key, size) for key, size in graph.outputs],
        )
        program.call(graph)
        return program

    def _forward_dynamics(self) -> Program:
        field = self.field
        return self._program(
            "forward_dynamics",
            lambda x, u: {"accelerations": field.accelerations(self.equations.y(x), u)},
            x=field.n_x,
            u=field.n_u,
        )

    def _forward_dynamics_with_tip_wrench(self) -> Program:
        field = self.field
        return self._program(
            "forward_dynamics_with_tip_wrench",
            lambda x, u, w_tip: {"accelerations": field.accelerations(self.equations.y(x), u, w_tip)},
            x=field.n_x,
            u=field.n_u,
            w_tip=6,
        )

    def _reaction_wrenches(self) -> Program:
        field = self.field
        return self._program(
            "reaction_wrenches",
            lambda x, u: {"wrenches": field.reaction_wrenches(self.equations.y(x), u)},
            x=field.n_x,
            u=field.n_u,
        )

    def _tip_pose(self) -> Program:
        return self._program("tip_pose", lambda x: {"pose": self.equations.tip(x)}, x=self.field.n_x)

    def _frame_poses(self) -> Program:
        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            motion = self.field.motion(self.equations.y(x))
            frames = kinematics.frame_poses(
                self.tree, self.equations.base_pose(x), motion.joint_angles, motion.wrist_angles
            )
            return {"poses": [entry for frame in frames for entry in frame]}

        return self._program("frame_poses", outputs, x=self.field.n_x)

    def _velocities(self, x: Scalars) -> tuple[Any, Any, Any]:
        motion = self.field.motion(self.equations.y(x))
        frames = minimal.link_frames(self.tree, motion.joint_angles)
        velocities = kinematics.body_velocities(
            self.tree, frames, (*motion.angular, *motion.linear), motion.joint_rates
        )
        return motion, frames, velocities

    def _momentum(self) -> Program:
        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            motion, frames, velocities = self._velocities(x)
            tree = self.field.loaded(motion)
            linear, angular, _ = kinematics.momentum(tree, frames, velocities, motion.wheel_momenta)
            attitude, _ = poses.to_matrix(self.equations.base_pose(x))
            return {"momentum": [*matrix_vector(attitude, linear), *matrix_vector(attitude, angular)]}

        return self._program("momentum", outputs, x=self.field.n_x)

    def _energy(self) -> Program:
        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            motion, _, velocities = self._velocities(x)
            moving = velocities, motion.wheel_momenta
            kinetic, potential = kinematics.energy(self.field.loaded(motion), motion.joint_angles, *moving)
            motors = (motion.motor_angles, motion.motor_rates)
            driving = elastic_gears.drive_energy(self.tree, motion.joint_angles, *motors)
            return {"energy": [kinetic + potential + driving]}

        return self._program("energy", outputs, x=self.field.n_x)

    # The cost.

    def _cost(self) -> Program:
        field = self.field
        return self._program(
            "cost", lambda x, u: {"cost": [total(self.equations.cost_terms(x, u))]}, x=field.n_x, u=field.n_u
        )

    def _terminal_cost(self) -> Program:
        return self._program(
            "terminal_cost",
            lambda x: {"cost": [total(self.equations.terminal_cost_terms(x))]},
            x=self.field.n_x,
        )

    def _emphasized_terminal_cost(self) -> Program:
        def outputs(x: Scalars, emphasis: Scalars) -> Mapping[str, Scalars]:
            pose, velocity, *others = self.equations.terminal_cost_terms(x)
            return {"cost": [emphasis[0] * total([pose, *others]) + velocity]}

        return self._program("emphasized_terminal_cost", outputs, x=self.field.n_x, emphasis=1)

    # Tangent coordinates.

    def _difference(self) -> Program:
        field = self.field

        def outputs(x_reference: Scalars, x: Scalars) -> Mapping[str, Scalars]:
            relative = dq.multiply(
                dq.conjugate(self.equations.base_pose(x_reference)), self.equations.base_pose(x)
            )
            twist = screw.logarithm(relative)
            rest = [a - b for a, b in zip(self.equations.y(x), self.equations.y(x_reference), strict=True)]
            return {"dx": [*(twist[i] for i in field.pose.directions), *rest]}

        return self._program("difference", outputs, varies=False, x_reference=field.n_x, x=field.n_x)

    def _retract(self) -> Program:
        field = self.field

        def outputs(x: Scalars, dx: Scalars) -> Mapping[str, Scalars]:
            n = len(field.pose.directions)
            pose = field.pose.moved(split_state(field, x)[0], field.pose.full_twist(dx[:n]))
            return {"x_next": [*pose, *(a + b for a, b in zip(self.equations.y(x), dx[n:], strict=True))]}

        return self._program("retract", outputs, varies=False, x=field.n_x, dx=field.n_t)

    # Observations.

    def _observation(self) -> Program:
        return self._program(
            "observation",
            lambda x, time_left: seen(self.equations, x, time_left[0]),
            x=self.field.n_x,
            time_left=1,
        )

    def _applied_inputs(self) -> Program:
        """What actuators do with their inputs."""

        def outputs(x: Scalars, u: Scalars) -> Mapping[str, Scalars]:
            return {"applied": applied(self.equations, x, u)}

        return self._program("applied_inputs", outputs, x=self.field.n_x, u=self.field.n_u)

    def _tip_errors(self) -> Program:
        """Errors of the tips as the environment reports them."""

        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            return {"errors": tip_errors(self.equations, x, seen(self.equations, x, 0.0)["errors"])}

        return self._program("tip_errors", outputs, x=self.field.n_x)

    def _relative_twist(self) -> Program:
        """Twist of the tip relative to the target."""

        def outputs(x: Scalars, u: Scalars) -> Mapping[str, Scalars]:
            return {"twist": self.equations.relative_twist(x, self.field.inputs(u).wrist_rates)}

        return self._program("relative_twist", outputs, x=self.field.n_x, u=self.field.n_u)

    def _next_target(self) -> Program:
        """From the numbers of a target that moves to those of the next stage."""

        def outputs(x: Scalars) -> Mapping[str, Scalars]:
            return {"x_next": next_target(with_target(self.equations, x), ())}

        size = len(moving_numbers(self.scene))
        return self._program("next_target", outputs, varies=False, x=size)

    def _state_from_observation(self) -> Program:
        field, state = self.field, self.layout.state
        n_pose = len(field.pose.stored)
        angles = (state.joint_angles, state.wrist_angles)
        motors = (state.motor_angles, state.motor_rates)
        kept = (state.wheel_momenta, state.propellant, state.actuators, state.drives)
        parts = (state.base_velocity, *angles, state.joint_rates, *motors, *kept)

        def outputs(observation: Scalars) -> Mapping[str, Scalars]:
            x: list[Scalar] = [0.0] * field.n_x
            start = n_pose
            for entries in parts:
                size = entries.stop - entries.start
                x[entries] = observation[start : start + size]
                start += size
            # q_{D/G} = q_{G/I}* q_{D/I} and q_{G/I} = q_{e0/I} q_{G/e0}: solved for the base.
            error = dq.normalize(field.pose.full(observation[:n_pose]))
            motion = field.motion(self.equations.y(x))
            arm = kinematics.arm_pose(self.tree, motion.joint_angles, motion.wrist_angles)
            tip = dq.multiply(self.equations.target, dq.conjugate(error))
            x[:n_pose] = field.pose.reduced(dq.multiply(tip, dq.conjugate(arm)))
            return {"x": x}

        return self._program("state_from_observation", outputs, observation=n_observations(self.scene))

    # Steps.

    def _step(self, name: str, integrator: str) -> Program:
        """A step alone, or with its cost."""
        field = self.field
        x, u, h = Buffer("x", field.n_x), Buffer("u", field.n_u), Buffer("h", 1, shared=True)
        program = Program(name, program_inputs(field, x, u, h), [Buffer("x_next", field.n_x)])
        method: Any = stage_method(self.equations, integrator)
        if name == "checked_step":
            checked = checked_integrator_of(self.scene.simulation, integrator)
            assert checked is not None  # `Kernels.checked_step` refuses it
            method = of_stage(self.equations, checked)
        method.append_step(program, field)
        if name == "checked_step":
            program.outputs = [*program.outputs, Buffer("checked_error", 1)]
        if name == "step_with_cost":
            sizes = {"x": field.n_x, "u": field.n_u}
            program.call(
                trace(
                    "cost_graph",
                    sizes,
                    lambda x, u: {"cost": [total(self.equations.cost_terms(x, u))]},
                    parameters=field.parameters,
                )
            )
            program.outputs = [*program.outputs, Buffer("cost", 1)]
        return program

    def _measured_step(self) -> Program:
        """A step of an embedded pair, with its error and dense output."""
        field = self.field
        inputs = [Buffer("x", field.n_x), Buffer("u", field.n_u)]
        inputs += [Buffer(name, size, shared=True) for name, size in (("h", 1), ("tolerances", 2))]
        outputs = [Buffer("x_next", field.n_x), Buffer("error", 1), Buffer("dense", 4 * field.n_t)]
        program = Program("measured_step", program_inputs(field, *inputs), outputs)
        append_measured_step(program, field)
        return program

    def _walk(self, integrator: str) -> Program:
        """A step of many in a row; a momentum-preserving method hands on the momentum besides the state."""
        field, method = self.field, stage_method(self.equations, integrator)
        x, u, h = Buffer("x", field.n_x), Buffer("u", field.n_u), Buffer("h", 1, shared=True)
        if not isinstance(method, MomentumIntegrator):
            program = Program("walk", program_inputs(field, x, u, h), [Buffer("x_next", field.n_x)])
            method.append_step(program, field)
            return program
        outputs = [Buffer("x_next", field.n_x), Buffer("momentum_next", 6)]
        program = Program("walk", program_inputs(field, x, Buffer("momentum", 6), u, h), outputs)
        method.append_walk(program, field)
        return program
