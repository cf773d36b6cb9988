"""Fly a planar quadrotor whose rotors only push: a problem of your own, with a target that varies.

The target is a parameter: the second solve flies elsewhere with the same machine code, and starts from the
controls of the first.
Expect: both solves converge within some dozens of iterations, each well below a millisecond, and end at rest
at their targets. Some thrusts are zero on the way. The first run compiles machine code.

    python scripts/examples/planar_quadrotor.py
"""

from typing import Any

import casadi
import numpy as np

from experts import BoxDDP, CasadiProblem, runge_kutta

MASS, INERTIA, ARM, GRAVITY = 0.5, 0.004, 0.15, 9.81  # kg, kg m^2, m, m/s^2
HOVER = 0.5 * MASS * GRAVITY  # thrust of each rotor that holds the weight, N
TIME_STEP = 0.02  # s


def rate(x: Any, u: Any, target: Any) -> Any:
    """Derivative of x, z, tilt and their rates, under the thrusts of the right and left rotor, N."""
    lift = (u[0] + u[1]) / MASS
    return casadi.vertcat(
        x[3:],
        -lift * casadi.sin(x[2]),
        lift * casadi.cos(x[2]) - GRAVITY,
        ARM * (u[0] - u[1]) / INERTIA,
    )


def error(x: Any, target: Any) -> Any:
    """Deviation from rest at a target (x, z), m, with no tilt."""
    return x - casadi.vertcat(target, casadi.DM.zeros(4))


def stage_cost(x: Any, u: Any, target: Any) -> Any:
    return TIME_STEP * (casadi.sumsqr(error(x, target)) + 0.1 * casadi.sumsqr(u - HOVER))


def terminal_cost(x: Any, target: Any) -> Any:
    return 50.0 * casadi.sumsqr(error(x, target))


def planar_quadrotor() -> CasadiProblem:
    """Make the problem: 2 s from a tilt of 1 rad, 2 m away; thrusts up to twice those of hovering."""
    return CasadiProblem(
        runge_kutta(rate, TIME_STEP),
        stage_cost,
        terminal_cost,
        initial_state=[-2.0, 1.0, 1.0, 0.0, 0.0, 0.0],
        n_controls=2,
        horizon=100,
        time_step=TIME_STEP,
        control_lower=0.0,
        control_upper=2.0 * HOVER,
        parameters=[0.0, 0.0],
    )


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    solver = BoxDDP(planar_quadrotor())
    controls = np.full((100, 2), HOVER)
    for target in ([0.0, 0.0], [1.0, 0.5]):
        solution = solver.solve(u_init=controls, parameters=target)
        missed = float(np.abs(solution.states[-1] - [*target, 0.0, 0.0, 0.0, 0.0]).max())
        milliseconds = 1e3 * float(np.median(solution.history["seconds"]))
        print(
            f"to {target}: {solution.stop_reason} after {solution.iterations} iterations of "
            f"{milliseconds:.2f} ms, cost {solution.cost:.6f}, final error {missed:.1e}"
        )
        controls = solution.controls


if __name__ == "__main__":
    main()
