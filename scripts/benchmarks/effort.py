"""The workload of the benchmarks: one dataclass, and its three levels QUICK, STANDARD and FULL."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

from dq_space_arm_env import list_scenes
from dq_space_arm_env.validation import YAMLError, parse_yaml


class Sampling(NamedTuple):
    """Samples of each timed case, and the shortest duration of a sample."""

    repeats: int
    seconds: float


_MAY_BE_ZERO = ("seed", "compared_starts")
"""Numbers without which something is measured all the same."""


@dataclass(frozen=True)
class Effort:
    """Workload; the defaults are the standard level."""

    name: str = "standard"
    scenes: tuple[str, ...] = ()  # names or files, in place of a benchmark's own choice
    only: tuple[str, ...] = ()  # groups of stability cases, motions, or parts of a benchmark; empty: all
    methods: tuple[str, ...] = ()  # integrators in work-precision; empty: all
    seed: int = 0  # of random starts and disturbances

    # stability
    mass_ratios: tuple[float, ...] = tuple(10.0**k for k in range(-6, 7))  # base to arm
    samples: int = 8  # random states of a case
    steps: int = 10_000_000  # time steps of the cases with many
    action_episodes: int = 100  # of each kind of actions
    energy_steps: int = 10_000_000  # of the long motions
    stiffness: tuple[float, ...] = tuple(10.0**k for k in range(2, 9))  # N m/rad
    long_horizon: int = 20_000  # stages
    slow_cases: bool = True

    # work-precision
    motions: tuple[str, ...] = ("body", "maneuver", "spin", "stiff", "damped", "chain")
    maneuvers: tuple[str, ...] = ()  # scenes whose maneuvers are followed too; empty: all that are shipped
    duration: float = 15.0  # s
    most_steps: int = 1_100_000
    maneuver_steps: int = 16_000
    tolerances: tuple[float, ...] = tuple(10.0**-digits for digits in range(3, 14))  # relative
    step_timing: Sampling = field(default=Sampling(25, 0.002))
    accuracy_states: int = 20  # states whose accelerations are computed with 50 digits
    second_reference: bool = True  # integrate the references with two codes' dynamics

    # solvers
    repeats: int = 5  # solves of each kind; the median of their times counts
    piece_repeats: int = 30
    max_iterations: int = 200
    compared_starts: int = 1  # random starts on which solvers are compared, besides the nominal one
    starts: int = 40  # random starts of each scene
    horizons: tuple[int, ...] = (25, 50, 100, 200)  # stages
    episodes: int = 1  # of each random disturbance
    flown_starts: int = 20  # random starts from which each mismatch is flown
    other_masses: bool = True  # each is a scene to compile
    papers_states: bool = True  # the paper's formulation: half a minute to compile
    peers: bool = True  # other solvers, those that are installed
    slow_peers: bool = False  # also those that take minutes

    # throughput and rendering
    batch_sizes: tuple[int, ...] = (1, 8, 64, 256, 1024, 4096, 16384)
    kernel_timing: Sampling = field(default=Sampling(9, 0.02))
    pictures: int = 40  # samples of 5 steps with a picture each

    # scene-cost; ratios need the best time of each: many short samples find a quiet moment
    cost_scenes: tuple[str, ...] = ()  # and of stability's actions; empty: all that are shipped
    cost_timing: Sampling = field(default=Sampling(200, 0.0005))
    compilations: int = 2
    processes: int = 6  # new processes with a warm cache

    def shipped(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """The scenes asked for, or else these; all that are shipped if there are none."""
        return self.scenes or names or tuple(list_scenes())

    def changed(self, settings: tuple[str, ...]) -> Effort:
        """Apply settings like "starts=100" or "only=[stiff joints, masses]"."""
        known = {each.name: getattr(self, each.name) for each in fields(self)}
        changes: dict[str, Any] = {}
        for setting in settings:
            name, given, text = setting.partition("=")
            if not given or name not in known:
                raise ValueError(f"setting {setting!r}: must be NAME=VALUE with one of {', '.join(known)}")
            try:
                value = parse_yaml(text)
            except YAMLError as error:
                raise ValueError(f"setting {name}: {text!r} is not a YAML value") from error
            old = known[name]
            if not isinstance(old, tuple):
                changes[name] = _checked(name, value, old)
                continue
            items = value if isinstance(value, list) else [value]
            if not items and getattr(Effort, name):
                raise ValueError(f"setting {name}: {value!r}, must have an entry, or nothing is measured")
            if isinstance(old, Sampling) and len(items) != len(old):
                raise ValueError(f"setting {name}: {value!r} must be {len(old)} numbers")
            # A list has entries of one kind: names where the default is empty.
            likes = old if isinstance(old, Sampling) else (*getattr(Effort, name), "")[:1] * len(items)
            entries = [_checked(name, each, like) for each, like in zip(items, likes, strict=True)]
            changes[name] = Sampling(*entries) if isinstance(old, Sampling) else tuple(entries)
        return replace(self, **changes)


def _checked(name: str, value: Any, like: Any) -> Any:
    """A value of the type of another, if it is a possible one."""
    kinds = (int, float) if isinstance(like, float) else (type(like),)
    if type(value) not in kinds:
        raise ValueError(f"setting {name}: {value!r} must be of type {type(like).__name__}")
    if isinstance(value, int | float) and not 0 <= value < math.inf:
        raise ValueError(f"setting {name}: {value}, must be finite and not negative")
    if value == 0 and not isinstance(value, bool) and name not in _MAY_BE_ZERO:
        raise ValueError(f"setting {name}: {value}, must be more than 0, or nothing is measured")
    return value


STANDARD = Effort()
FULL = Effort(
    "full",
    energy_steps=100_000_000,
    repeats=9,
    piece_repeats=100,
    compared_starts=4,
    starts=200,
    episodes=5,
    flown_starts=100,
    slow_peers=True,
)
QUICK = Effort(
    "quick",
    mass_ratios=(1e-6, 1e-3, 1.0, 1e3, 1e6),
    samples=3,
    steps=100_000,
    action_episodes=4,
    energy_steps=1_000_000,
    stiffness=(1e2, 1e5, 1e8),
    long_horizon=2_000,
    slow_cases=False,
    motions=("body", "maneuver", "stiff"),
    maneuvers=("planar",),
    duration=3.0,
    most_steps=12_000,
    tolerances=(1e-8,),
    step_timing=Sampling(9, 0.001),
    accuracy_states=5,
    second_reference=False,
    repeats=1,
    piece_repeats=5,
    starts=2,
    horizons=(25,),
    other_masses=False,
    papers_states=False,
    peers=False,
    batch_sizes=(1, 64, 1024),
    kernel_timing=Sampling(3, 0.002),
    pictures=5,
    cost_scenes=("paper", "no-wrist", "planar"),
    cost_timing=Sampling(50, 0.0005),
    compilations=1,
    processes=2,
)
