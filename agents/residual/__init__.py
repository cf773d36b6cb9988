"""Corrections of an expert's plans, learned where the world differs from its model.

An agent adds a little to each action of a plan with feedback gains, clip(a + c): residual reinforcement
learning after Johannink et al. (ICRA 2019) and Silver et al. (2018). Masses differ from the plan's,
measurements are noisy, and there are pushes.

corrections           observations of corrections, and controllers that add them to a plan
mismatch              conditions, random worlds, and flights in them
environment           vector environment for Stable-Baselines3
residual_training     from a configuration to a policy
informed              optimal costs of an expert that knows the masses
mismatch_comparison   all controllers from the same starts, under the same disturbances

Training needs the extra `agents`; flying an exported policy does not.
"""
