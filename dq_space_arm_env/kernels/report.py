"""What the compiled step of the environment reports besides state and observation."""

# One number each: the terms of the stage cost before the step, those of the terminal cost after it, the tip's
# errors # [deg, m] after it, both sums, and the square of the observation's norm, which is huge or NaN when
# the simulation has # blown up.
REPORT = (
    "cost_pose",
    "cost_base_velocity",
    "cost_control",
    "terminal_cost_pose",
    "terminal_cost_base_velocity",
    "attitude_error",
    "position_error",
    "stage_cost",
    "terminal_cost",
    "observation_square",
)
