"""Columns of what the environment's step reports; apart from `episode`, as they are read without CasADi."""

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

# What a step hands to the next besides the state: steps taken, and the stage cost's terms of the state.
MEMORY = ("steps_taken", "cost_pose", "cost_base_velocity")

# A state whose norm (m, rad, m/s, rad/s) is larger, or NaN, comes from a simulation that has blown up. It
# keeps every entry of an observation within twice this number.
STATE_LIMIT = 5e5
OBSERVATION_LIMIT = 2.0 * STATE_LIMIT
"""Bound of every observation of a simulation that has not diverged, m, rad, m/s, rad/s."""
