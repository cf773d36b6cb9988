"""Error against run time: of the integrators on motions with a reference, and of the formulations.

cases           motions that every integrator follows
rigid_body      the torque-free body in 30 digits
references      where each motion ends, from independent codes
methods         ways to take a step: the integrators by name, and the paper's own formulation
measurement     error and time for each method and step
choices         observed orders, the cheapest method and step for an accuracy, a scene's default
formulations    accelerations in different formulations and precisions: error and time
benchmark       all of it for an effort, and what falls short of the accuracy declared here
tables, records   for terminal and page; for the file

The picture is in `figures.work_precision`. The solvers' cost gap against seconds is `experts.report.solvers`.
"""
