"""The project measured against its declared bounds and against its peers: `python -m scripts.benchmarks`.

harness          rows, claims, tables, figures, files and exit status of every benchmark
effort           the workload: quick, standard, full
subjects         kernels and environments to be timed
robots           one scene of each distinct robot
peers            Pinocchio, MuJoCo, Crocoddyl and IPOPT with a scene's robot or maneuver; all optional
work_precision   error against run time of integrators and formulations
stability        stiff and extreme cases
scene_cost       cost of scenes, their parts, outputs, processes and the installation
solvers          cost gap of the expert against seconds
throughput       states and environment steps per second
rendering        pictures per second
basilisk         the same motion in Basilisk; optional
devices          the step in JAX, on a processor and a GPU; optional
"""
