"""How good the expert is, and how soon: error against run time, beside other solvers.

runs            what one solve took and what it reached, the same for every solver
ours            the project's solvers as such runs
crocoddyl_maneuver, crocoddyl_peer, ipopt_peer, rollouts   other solvers on the same maneuver; all optional
contenders      who is compared
best_known      the lowest cost that many guesses lead to, which all are compared with
iterations, accuracy, random_starts, receding   what is measured
effort, benchmark   how much, and in which order
tables, records     on the terminal, and for the file

The picture is in `figures.solvers`.
"""
