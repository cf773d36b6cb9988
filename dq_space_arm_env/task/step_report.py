"""Columns of what the environment's step reports; apart from `episode`, as they are read without CasADi."""

from typing import Any

from dq_space_arm_env.scene.constraint_rows import exact_rows, path_rows
from dq_space_arm_env.scene.layout import StateLayout
from dq_space_arm_env.scene.parameters import moving_numbers, observed_masses
from dq_space_arm_env.scene.schema import Scene

# The costs are those of the stage before the step and the terminal ones after it, which are zero before the
# end of the episode; the tip's errors are those after the step, in deg and m. The step's error is the largest
# estimate of a substep in units of the scene's tolerance; NaN where nothing estimates it.
REPORT = (
    "reward",
    "cost_pose",
    "cost_base_velocity",
    "cost_control",
    "terminal_cost_pose",
    "terminal_cost_base_velocity",
    "attitude_error",
    "position_error",
    "step_error",
)
FLAGS = ("terminated", "is_success", "diverged")

# What a step hands to the next besides the state: steps taken, and the stage cost's terms of the state; then
# pose and velocity of a target that moves.
MEMORY = ("steps_taken", "cost_pose", "cost_base_velocity")


CONSTRAINT = "constraints."
"""Prefix of the columns of residuals."""


def has_twist_errors(scene: Scene) -> bool:
    """Tell whether the tip's velocity relative to the target counts: it moves, or success asks for it."""
    success = scene.success
    asked = (success.angular_velocity_error_deg, success.velocity_error)
    return scene.target.motion is not None or any(largest is not None for largest in asked)


def report_names(scene: Scene) -> tuple[str, ...]:
    """Names of the report of a scene: `REPORT`, and what only some scenes have.

    The velocities of the tip relative to the target are those after the step with the wrist held, in deg/s
    and m/s. The phase is that of the next step; `caught` is 1 unless a catch has failed; the shocks are the
    impulse [N s] on a payload that the step has caught, and the angular impulse about the tip [N m s].
    Of constraints the sum of violations over tolerances and every residual come last.
    """
    names = list(REPORT)
    if has_twist_errors(scene):
        names[-1:-1] = ["angular_velocity_error", "velocity_error"]
    if scene.phases:
        names.insert(-1, "phase")
    if any(phase.catch is not None for phase in scene.phases):
        names[-1:-1] = ["caught", "shock", "angular_shock"]
    if scene.constraints:
        names += ["cost", *(CONSTRAINT + name for name in constraint_names(scene))]
    if any(scene.cost.terminal_tip_twist):
        names.insert(names.index("attitude_error"), "terminal_cost_tip_twist")
    if any(scene.cost.tip_twist):
        names.insert(names.index("terminal_cost_pose"), "cost_tip_twist")
    return tuple(names)


def constraint_names(scene: Scene) -> tuple[str, ...]:
    """Names of the residuals that a step reports last: those of the path, and of what is exact at the end."""
    return tuple(row.name for row in (*path_rows(scene), *exact_rows(scene)))


def grouped(info: dict[str, Any]) -> dict[str, Any]:
    """Gather the columns of residuals in a dictionary of their own, `constraints`; there is none without."""
    residuals = {name: value for name, value in info.items() if name.startswith(CONSTRAINT)}
    if not residuals:
        return info
    rest = {name: value for name, value in info.items() if name not in residuals}
    return rest | {"constraints": {name.removeprefix(CONSTRAINT): each for name, each in residuals.items()}}


def cost_names(scene: Scene) -> tuple[str, ...]:
    """Names of the terms of a scene's cost: those of the stage, then the terminal ones."""
    return tuple(name for name in report_names(scene) if name.startswith(("cost_", "terminal_cost_")))


def observation_entries(scene: Scene) -> list[tuple[str, str]]:
    """Names and units of an observation's entries, in the order of `SceneEquations.observe`."""
    layout = StateLayout.of(scene)
    state = list(zip(layout.state.names, layout.state.units, strict=True))
    where = layout.state
    pose = [(name.removeprefix("base pose "), unit) for name, unit in state[where.pose]]
    twist = [(name.removeprefix("base "), unit) for name, unit in state[where.base_velocity]]
    moves, rows = scene.target.motion is not None, path_rows(scene)
    return [
        *((f"target from the tip {name}", unit) for name, unit in pose),
        *state[where.base_velocity],
        *state[where.joint_angles],
        *state[where.wrist_angles],
        *state[where.joint_rates.start :],
        *([("phase", "1")] if scene.phases else []),
        *((f"target {name}", unit) for name, unit in pose if scene.target.observed),
        *((f"relative change of {drawn.name}", "1") for drawn in observed_masses(scene)),
        *((f"goal from {tip.name} {name}", unit) for tip in scene.other_tips for name, unit in pose),
        *((f"margin of {row.name}", "1") for row in rows if row.observed is not None),
        *((f"tip relative to the target {name}", unit) for name, unit in twist if moves),
        *((f"target in tip axes {name}", unit) for name, unit in twist if moves),
        ("time left", "s"),
    ]


def n_observations(scene: Scene) -> int:
    """Count the entries of an observation."""
    return len(observation_entries(scene))


def memory_names(scene: Scene) -> tuple[str, ...]:
    """Names of what a step of a scene hands to the next."""
    held = ("held",) if any(phase.catch is not None for phase in scene.phases) else ()
    return (*MEMORY, *(number.name for number in moving_numbers(scene)), *held)


# A state whose norm (m, rad, m/s, rad/s) is larger, or NaN, comes from a simulation that has blown up. It
# keeps every entry of an observation within twice this number.
STATE_LIMIT = 5e5
OBSERVATION_LIMIT = 2.0 * STATE_LIMIT
"""Bound of every observation of a simulation that has not diverged, m, rad, m/s, rad/s."""
