"""A scene's dynamics as CasADi functions, for your own optimal control and estimation.

They hold the operations and constants of the compiled kernels. CasADi differentiates them, and they work
wherever its functions do: `Opti`, `nlpsol`, generated C.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi

from dq_space_arm_env.algebra import dual_quaternion
from dq_space_arm_env.compiler.graph import EXPRESSIONS, trace
from dq_space_arm_env.compiler.program import Buffer, Program
from dq_space_arm_env.dynamics.vector_field import split_state
from dq_space_arm_env.integrators.method import program_inputs
from dq_space_arm_env.interoperability.traced_functions import evaluated, step_of_fixed_stages
from dq_space_arm_env.kernels.programs.scene_programs import ScenePrograms
from dq_space_arm_env.scene import Scene, StateLayout, load_scene

Scalar = Any


@dataclass(frozen=True, eq=False)
class CasadiDynamics:
    """A scene's equations as `casadi.Function`s of dense columns, in double precision.

    States, inputs and units are those of `layout`. The inputs are not clipped to their limits,
    `layout.control_limit`. Nothing normalizes the pose q_{e0/I}: constrain a state that a solver may
    choose to |q_r| = 1, q_r . q_d = 0, which `step` and the flow of `xdot` preserve. In a scene with
    parameters, every function takes them after the state: `step` is (x, parameters, u, h). Where a target
    moves or phases change, each stage has its row of `Kernels.stage_parameters`. A step whose row says that a
    payload is caught ends with the impact. Limits of inputs that phases change are in the row, see
    `StateLayout.limits_with`.

    Attributes:
        scene: The scene.
        layout: Names, units and places of the entries of states and inputs.
        forward_dynamics: (x, u) to accelerations: those of the base, in base axes, angular then linear, the
            time derivatives of its twist, 6 (planar: 3), rad/s^2 and m/s^2, then the joints', rad/s^2.
        xdot: (x, u) to the time derivative of the state, (n_x,); that of the pose is q_{e0/I} omega / 2; that
            of previous controls, which only steps change, 0.
        step: (x, u, h) to the state after h seconds under constant inputs, (n_x,), by the integrator.
        tip_pose: (x) to the pose q_{G/I} of the tip, 8 numbers, m.
        cost: (x, u) to the stage cost, without a factor dt, dimensionless.
        terminal_cost: (x) to the terminal cost, dimensionless.
        constraints: (x, u) to the residuals c of the rows along the path, which hold where c <= 0; their
            names, units and tolerances are those of `dq_space_arm_env.scene.path_rows(scene)`.
        terminal_constraints: (x) to those at the end, of `dq_space_arm_env.scene.terminal_rows(scene)`: the
            path's rows without input, success, and what is zero there.
    """

    scene: Scene
    layout: StateLayout
    forward_dynamics: casadi.Function
    xdot: casadi.Function
    step: casadi.Function
    tip_pose: casadi.Function
    cost: casadi.Function
    terminal_cost: casadi.Function
    constraints: casadi.Function
    terminal_constraints: casadi.Function


def casadi_dynamics(scene: Scene | str | Path, integrator: str | None = None) -> CasadiDynamics:
    """Write a scene's dynamics as CasADi functions.

    Args:
        scene: A scene, the name of a shipped one, or a path to a YAML file.
        integrator: Name of the integrator of `step`; the scene's by default. One that takes a fixed number
            of stages: CasADi cannot differentiate a loop that ends when tolerances are met.

    Returns:
        The functions.

    Raises:
        ValueError: If the integrator is unknown, adaptive or implicit.
    """
    scene = load_scene(scene)
    programs = ScenePrograms(scene)
    step = step_of_fixed_stages(programs, integrator, "CasADi")
    return CasadiDynamics(
        scene=scene,
        layout=programs.layout,
        forward_dynamics=_function(programs.build("forward_dynamics")),
        xdot=_function(_state_derivative(programs)),
        step=_function(step),
        tip_pose=_function(programs.build("tip_pose")),
        cost=_function(programs.build("cost")),
        terminal_cost=_function(programs.build("terminal_cost")),
        constraints=_function(programs.build("constraints")),
        terminal_constraints=_function(programs.build("terminal_constraints")),
    )


def _state_derivative(programs: ScenePrograms) -> Program:
    equations, field = programs.equations, programs.field

    def outputs(x: Sequence[Scalar], u: Sequence[Scalar]) -> Mapping[str, Sequence[Scalar]]:
        y = split_state(field, x)[1]
        motion = field.motion(y)
        twist = (*motion.angular, *motion.linear)
        pose = field.pose.reduced(dual_quaternion.derivative(equations.base_pose(x), twist))
        kept = [0.0] * (len(motion.previous_controls) + len(motion.drives))
        start = 0
        for chain in programs.layout.chains:
            output = len(motion.previous_controls) + start + chain.delay
            if chain.time_constant is not None:
                followed = motion.drives[start] if chain.delay else u[chain.control]
                kept[output] = (followed - motion.drives[start + chain.delay]) / chain.time_constant
            start += len(chain.names)
        return {"xdot": [*pose, *field.rates(y, field.acting(motion.drives, u)), *kept]}

    inputs = program_inputs(field, Buffer("x", field.n_x), Buffer("u", field.n_u))
    program = Program("xdot", inputs, [Buffer("xdot", field.n_x)])
    sizes = {"x": field.n_x, "u": field.n_u}
    program.call(trace("xdot_graph", sizes, outputs, parameters=field.parameters))
    return program


def _function(program: Program) -> casadi.Function:
    """Convert a program without loops to a function of columns."""
    buffers = {name: [casadi.SX(0.0)] * size for name, size in program.scratch_sizes().items()}
    inputs = {buffer.name: casadi.SX.sym(buffer.name, buffer.size) for buffer in program.inputs}
    for name, column in inputs.items():
        buffers[name] = [column[i] for i in range(column.shape[0])]
    for call in program.calls:
        arguments = [buffers[call.bindings.get(name, name)] for name, _ in call.graph.inputs]
        results = evaluated(call.graph, arguments, EXPRESSIONS, casadi.SX)
        for (name, _), values in zip(call.graph.outputs, results, strict=True):
            buffers[call.bindings.get(name, name)] = values
    outputs = [casadi.densify(casadi.vertcat(*buffers[buffer.name])) for buffer in program.outputs]
    return casadi.Function(
        program.name, [*inputs.values()], outputs, [*inputs], [buffer.name for buffer in program.outputs]
    )
