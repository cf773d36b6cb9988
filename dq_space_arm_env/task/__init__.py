"""The task of a scene: cost, observation, episodes, and the record of a maneuver.

equations    cost and observation over plain scalars
episode      a step of the environment: actions, reward, success, end
trajectory   the record of a maneuver and its file
"""
