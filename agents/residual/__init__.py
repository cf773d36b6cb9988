"""Corrections of an expert, learned where the world is not the one that it planned for.

An expert's plan with its feedback gains flies, and an agent adds a little to each action, clip(a + c):
residual reinforcement learning after Johannink et al. (ICRA 2019) and Silver et al. (2018). True masses are
others than the plan's, measurements are noisy, and pushes come from nowhere.

worlds        what differs from the plan: masses, pushes, noise; and flights in it
controllers   who flies: the plan alone, with gains, with a correction; the receding-horizon expert
environment   the same as a vector environment for Stable-Baselines3
training      from a configuration to a policy
conditions    how worlds differ from the plan's where controllers are compared
informed      what the expert pays that knows the masses
evaluation    all controllers on the same starts, under the same disturbances
tables        the comparison as a table, and as JSON
figure        the comparison as a picture

Training needs the extra `agents`; flying a policy that was exported does not.
"""
