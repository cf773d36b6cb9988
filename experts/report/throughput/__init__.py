"""How fast kernels and environments are, beside other engines, each time with an error.

timing                  what is timed, and how
variants                the ways to run a scene: float64 or float32, one thread or two
kernels, environments   what is timed of ours
peers, robot, pinocchio_peer, mujoco_peer, mujoco_environment   the same robot elsewhere
agreement               how far the results are apart
measurement, ratios     everything about a scene; our times and the peers'
scene_costs, features   what scenes cost, and what their parts do
tables, cost_tables, formats   on the terminal
records                 for the file

The picture is in `figures.throughput`, the peak of a core in `peak`, the start of processes in `start_up`.
"""
