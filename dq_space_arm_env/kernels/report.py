"""What the compiled step of the environment reports besides state and observation, column by column."""

# Costs: the reward, the terms of the stage cost before the step, those of the terminal cost after it (zero
# before the end of the episode); then the tip's errors after the step, deg and m.
REPORT = (
    "reward",
    "cost_pose",
    "cost_base_velocity",
    "cost_control",
    "terminal_cost_pose",
    "terminal_cost_base_velocity",
    "attitude_error",
    "position_error",
)
FLAGS = ("terminated", "is_success", "diverged")

# What one step hands on to the next besides the state: steps taken in the episode, and the terms of the stage
# cost that depend on the state.
MEMORY = ("steps_taken", "cost_pose", "cost_base_velocity")

# A state whose norm (m, rad, m/s, rad/s) is beyond this, or not a number, comes from a simulation that has
# blown up. It keeps every entry of an observation within twice this number.
STATE_LIMIT = 5e5
