"""Numbers as the tables of throughput write them."""

from __future__ import annotations

from collections.abc import Mapping

from experts.report.peak import Peak
from experts.report.throughput.records import share_of_peak
from experts.report.throughput.timing import Timing

_TITLES = {"symplectic_euler": "Euler", "rk4": "RK4"}
"""Short names of the integrators."""


def three_digits(value: float) -> str:
    """Three digits, or all of them before the point."""
    return f"{value:,.0f}" if value >= 99.95 else f"{value:#.3g}".rstrip(".")


def nanoseconds(timing: Timing) -> str:
    """Best and median time per state, ns."""
    return f"{three_digits(timing.best_ns)} ({three_digits(timing.median_ns)})"


def per_second(time_ns: float) -> str:
    """A rate from the time per state, in thousands (k) or millions (M) per second."""
    rate = 1e9 / time_ns
    return f"{three_digits(rate / 1e6)}M" if rate >= 999_500.0 else f"{three_digits(rate / 1e3)}k"


def rates(timing: Timing) -> str:
    """Best and median number of states per second."""
    return f"{per_second(timing.best_ns)} ({per_second(timing.median_ns)})"


def utilization(timing: Timing, peaks: Mapping[str, Peak]) -> str:
    """Operations per ns and their share of the peak; empty if the operations are not known."""
    rate, share = timing.operations_per_ns, share_of_peak(timing, peaks)
    return "" if rate is None or share is None else f"{rate:.1f}, {share:.0%}"


def integrator_title(name: str) -> str:
    """What tables call an integrator.

    Args:
        name: Its name in the scene file; empty for none.

    Returns:
        A title.
    """
    return _TITLES.get(name, name)
