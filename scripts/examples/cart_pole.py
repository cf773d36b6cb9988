"""Swing up a cart-pole: a problem of your own, from its equations to optimal controls.

Expect: the solver converges within some dozens of iterations, each well below a millisecond. The force
touches its bounds on the way, and the pole ends upright and at rest. The first run compiles machine code.

    python scripts/examples/cart_pole.py
"""

from typing import Any

import casadi
import numpy as np

from experts import BoxDDP, CasadiProblem, runge_kutta

CART, POLE, LENGTH, GRAVITY = 1.0, 0.2, 0.5, 9.81  # kg, kg, m, m/s^2; the pole's mass is at its end
UPRIGHT = np.array([0.0, np.pi, 0.0, 0.0])  # position, m; angle from hanging, rad; their rates
FORCE = 8.0  # largest force, N
TIME_STEP = 0.02  # s


def rate(x: Any, u: Any) -> Any:
    """Derivative of position, angle and their rates, under a force on the cart, N."""
    sine, cosine = casadi.sin(x[1]), casadi.cos(x[1])
    mass, pull = CART + POLE * sine**2, POLE * sine * (LENGTH * x[3] ** 2 + GRAVITY * cosine)
    acceleration = (u[0] + pull) / mass
    turn = -(acceleration * cosine + GRAVITY * sine) / LENGTH
    return casadi.vertcat(x[2], x[3], acceleration, turn)


def stage_cost(x: Any, u: Any) -> Any:
    weights = casadi.DM([1.0, 1.0, 0.1, 0.1])
    return TIME_STEP * (casadi.dot(weights, (x - UPRIGHT) ** 2) + 0.1 * u[0] ** 2)


def terminal_cost(x: Any) -> Any:
    return casadi.dot(casadi.DM([100.0, 100.0, 10.0, 10.0]), (x - UPRIGHT) ** 2)


def cart_pole() -> CasadiProblem:
    """Make the problem: 3 s from hanging to upright, with a force of at most 8 N."""
    return CasadiProblem(
        runge_kutta(rate, TIME_STEP),
        stage_cost,
        terminal_cost,
        initial_state=np.zeros(4),
        n_controls=1,
        horizon=150,
        time_step=TIME_STEP,
        control_lower=-FORCE,
        control_upper=FORCE,
    )


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    solution = BoxDDP(cart_pole()).solve()
    error = float(np.abs(solution.states[-1] - UPRIGHT).max())
    milliseconds = 1e3 * float(np.median(solution.history["seconds"]))
    print(f"{solution.stop_reason} after {solution.iterations} iterations of {milliseconds:.2f} ms")
    print(f"cost {solution.cost:.6f}, final error {error:.1e}")
    print(f"at a bound in {int((np.abs(solution.controls) == FORCE).sum())} of 150 stages")


if __name__ == "__main__":
    main()
