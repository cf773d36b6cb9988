"""How much of the work-precision report is measured."""

from __future__ import annotations

from dataclasses import dataclass, field

from dq_space_arm_env import list_scenes
from experts.report.throughput.timing import Effort as TimingEffort


@dataclass(frozen=True)
class Effort:
    """How much to measure.

    Attributes:
        cases: Names of the motions (`cases.CASES`).
        scenes: Names of the scenes whose maneuvers are followed too, to choose their integrators.
        duration: How long each motion should be, s; see `cases.make_case`.
        most_steps: Steps that a motion is divided into at most.
        scene_steps: The same for the maneuvers of scenes.
        tolerances: Those that adaptive integrators are given, relative.
        timing: Of steps and accelerations; its batch sizes are not used.
        states: States whose accelerations are computed with 50 digits.
        second_reference: Whether the references are integrated twice, with two codes' dynamics.
    """

    cases: tuple[str, ...] = ("body", "maneuver", "spin", "stiff", "damped", "chain")
    scenes: tuple[str, ...] = field(default_factory=lambda: tuple(list_scenes()))
    duration: float = 15.0
    most_steps: int = 1_100_000
    scene_steps: int = 16_000
    tolerances: tuple[float, ...] = tuple(10.0**-digits for digits in range(3, 14))
    timing: TimingEffort = field(default=TimingEffort(repeats=25, sample_seconds=0.002))
    states: int = 20
    second_reference: bool = True


FULL = Effort()
QUICK = Effort(
    cases=("body", "maneuver", "stiff"),
    scenes=("planar",),
    duration=3.0,
    most_steps=12_000,
    tolerances=(1e-8,),
    timing=TimingEffort(repeats=9, sample_seconds=0.001),
    states=5,
    second_reference=False,
)
