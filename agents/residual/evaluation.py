"""All controllers from the same starts, under the same disturbances: what a correction is worth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from agents.demonstrations import check_scene
from agents.evaluation import (
    EVALUATION_SEEDS,
    Interval,
    bootstrap_interval,
    evaluation_seeds,
    wilson_interval,
)
from agents.evaluation.conditions import PAYLOAD_CHANGE
from agents.evaluation.expert_costs import SEED_OF_SEEDS
from agents.policies import ExportedPolicy
from agents.residual.controllers import Controller, Corrected, GainScheduled, OpenLoop, RecedingHorizon
from agents.residual.flights import Adversity, Flown, fly
from agents.residual.plans import FloatArray, Plans
from dq_space_arm_env import Scene, compile_scene
from experts import BoxDDP
from experts.demonstrations import Demonstrations, generate_demonstrations
from experts.report.solvers.receding import NOISE, PUSH, PUSHES, with_masses

OPEN_LOOP, GAINS, CORRECTED, RECEDING = (
    "plan, open loop",
    "plan, gains",
    "plan, gains, residual",
    "receding horizon",
)
"""Names of the controllers."""


class Condition(NamedTuple):
    """How worlds differ from the plan's.

    Attributes:
        name: What tables call it.
        mass_factor: Factor of mass and inertia of the payload, or of the last link without one.
        noise: Standard deviation of what is measured, rad, m, rad/s, m/s.
        push: Standard deviation of the jumps of the base's velocities, rad/s, m/s.
    """

    name: str
    mass_factor: float = 1.0
    noise: float = 0.0
    push: float = 0.0


LIGHT, HEAVY = 1.0 - PAYLOAD_CHANGE, 1.0 + PAYLOAD_CHANGE
CONDITIONS = (
    Condition("as planned"),
    Condition("light", mass_factor=LIGHT),
    Condition("heavy", mass_factor=HEAVY),
    Condition("noise", noise=NOISE),
    Condition("small pushes", push=PUSH / 4.0),
    Condition("pushes", push=PUSH),
    Condition("light, noise, pushes", LIGHT, NOISE, PUSH),
    Condition("heavy, noise, pushes", HEAVY, NOISE, PUSH),
)
"""As for the benchmark of the receding-horizon expert, with the masses of the evaluation protocol."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """What controllers pay under one condition, from the same starts.

    Attributes:
        condition: The condition.
        informed_cost: Of the expert that knows the masses, and meets neither noise nor pushes, shape (B,);
            NaN where it found no optimum.
        flown: What became of the flights of each controller, by its name.
    """

    condition: Condition
    informed_cost: FloatArray
    flown: Mapping[str, Flown]

    def success_rate(self, name: str) -> Interval:
        """Estimate how often a controller arrives.

        Args:
            name: Of the controller.

        Returns:
            The rate, with a 95 % interval.
        """
        success = self.flown[name].is_success
        return wilson_interval(int(success.sum()), len(success))

    def cost_gap(self, name: str) -> Interval:
        """Estimate what a controller pays beyond the informed expert.

        Args:
            name: Of the controller.

        Returns:
            Median of J / J_informed - 1, with a 95 % interval.
        """
        gaps = self.flown[name].cost / self.informed_cost - 1.0
        return bootstrap_interval(gaps[~np.isnan(gaps)], _median)

    def saving(self, name: str = CORRECTED, base: str = GAINS) -> Interval:
        """Estimate what a controller saves, flight by flight.

        Args:
            name: Of the controller.
            base: Of the one that it is compared with.

        Returns:
            One minus the geometric mean of J / J_base, with a 95 % interval.
        """
        ratios = np.log(self.flown[name].cost / self.flown[base].cost)
        return bootstrap_interval(ratios, lambda values: 1.0 - float(np.exp(np.mean(values))))

    def summary(self) -> list[dict[str, Any]]:
        """Write the comparison down.

        Returns:
            JSON values, a dictionary for each controller.
        """
        return [
            {
                "condition": self.condition._asdict(),
                "controller": name,
                "episodes": len(flown.cost),
                "success_rate": list(self.success_rate(name)),
                "median_cost": float(np.median(flown.cost)),
                "mean_cost": float(np.mean(flown.cost)),
                "median_cost_gap": list(self.cost_gap(name)),
                "saving": list(self.saving(name)) if GAINS in self.flown else None,
                "attitude_error": float(np.median(flown.attitude_error)),
                "position_error": float(np.median(flown.position_error)),
            }
            for name, flown in self.flown.items()
        ]


def compare_under_mismatch(
    policy: ExportedPolicy | str | Path | None,
    demonstrations: Demonstrations,
    scene: Scene | None = None,
    *,
    conditions: Sequence[Condition] = CONDITIONS,
    receding_horizon: int = 50,
    receding_flights: int = 0,
    seed: int = 0,
    progress: Callable[[str], None] = lambda what: None,
) -> list[Comparison]:
    """Fly all controllers from where demonstrations begin.

    Args:
        policy: Correction that was exported, its file, or the folder of its run; None to fly without one.
        demonstrations: Plans of the flights, B of them.
        scene: What they are for, whose tolerances tell success; that of the demonstrations by default, which
            may have stricter ones.
        conditions: How the worlds differ.
        receding_horizon: Stages that the receding-horizon expert looks ahead.
        receding_flights: Flights of the receding-horizon expert, a second each: the first ones. If there are
            fewer than B, all controllers are compared on these flights only; 0 leaves it out.
        seed: Of noise and pushes; the same for all controllers.
        progress: Called with what comes next.

    Returns:
        A comparison for each condition.

    Raises:
        PolicyFileError: If the policy's file cannot be read.
        ValueError: If it is no correction, or the scene does not fit it.
        DemonstrationsError: If the demonstrations are of another scene.
    """
    scene = scene or demonstrations.scene
    check_scene(demonstrations, scene)
    if receding_flights:
        demonstrations = demonstrations[:receding_flights]
    controllers: dict[str, Controller] = {OPEN_LOOP: OpenLoop(), GAINS: GainScheduled(scene)}
    if policy is not None:
        controllers[CORRECTED] = Corrected.by(_read(policy), scene)
    if receding_flights:
        controllers[RECEDING] = RecedingHorizon(scene, receding_horizon)
    plans = Plans.of(demonstrations)
    costs = _InformedCosts(scene, plans, demonstrations.column("cost").astype(np.float64))
    comparisons = []
    for condition in conditions:
        progress(f"{condition.name}: what the informed expert pays")
        informed = costs.under(condition.mass_factor)
        adversity = Adversity(condition.mass_factor, condition.noise, condition.push, PUSHES, seed)
        flown = {}
        for name, controller in controllers.items():
            progress(f"{condition.name}: {name}")
            flown[name] = fly(controller, scene, plans, adversity)
        comparisons.append(Comparison(condition, informed, flown))
    return comparisons


def evaluation_plans(
    scene: Scene, folder: Path, n: int = EVALUATION_SEEDS, *, workers: int | None = None
) -> Demonstrations:
    """Plan the maneuvers from the evaluation starts of a scene, for evaluations only.

    Args:
        scene: The scene.
        folder: Where to write the plans; those that are there remain.
        n: Number of starts, the first ones. The few that the expert fails at are left out.
        workers: Processes that plan; one for each processor by default.

    Returns:
        The plans.

    Raises:
        DemonstrationsError: If they cannot be written.
        ValueError: If demonstrations of the scene are impossible, or n is out of range.
    """
    evaluation_seeds(scene, n)  # these are the seeds that follow from the seed of the data set, if n is one
    plans = generate_demonstrations(scene, n, folder, SEED_OF_SEEDS, workers=workers)
    assert plans is not None  # one part is all of it
    return plans


def comparison_table(comparisons: Sequence[Comparison]) -> Table:
    """Lay comparisons out.

    Args:
        comparisons: One for each condition.

    Returns:
        A table for the terminal.
    """
    table = Table(title="Controllers under model mismatch")
    for name in ("condition", "controller", "success", "gap to informed expert", "saves", "deg", "m"):
        table.add_column(name, justify="left" if name in ("condition", "controller") else "right")
    for comparison in comparisons:
        for name, flown in comparison.flown.items():
            gap, saving = comparison.cost_gap(name), comparison.saving(name)
            table.add_row(
                comparison.condition.name,
                name,
                _percent(comparison.success_rate(name)),
                _percent(gap, 1),
                "" if name == GAINS else _percent(saving, 1),
                f"{np.median(flown.attitude_error):.1f}",
                f"{np.median(flown.position_error):.3f}",
            )
        table.add_section()
    return table


class _InformedCosts:
    """What the expert pays who knows the masses, solved once for each of them."""

    def __init__(self, scene: Scene, plans: Plans, planned: FloatArray) -> None:
        self._scene, self._plans = scene, plans
        self._known: dict[float, FloatArray] = {1.0: planned}

    def under(self, factor: float) -> FloatArray:
        """Costs, shape (B,); the solver begins with what the feedback of the plans does there."""
        if factor not in self._known:
            recorder = _Recorder(GainScheduled(self._scene))
            fly(recorder, self._scene, self._plans, Adversity(factor, 0.0, 0.0, 0.0, seed=0))
            solver = BoxDDP(with_masses(self._scene, factor))
            guesses = np.stack(recorder.actions, axis=1) * compile_scene(self._scene).layout.control_limit
            self._known[factor] = np.array(
                [
                    _cost(solver, start, guess)
                    for start, guess in zip(self._plans.starts, guesses, strict=True)
                ]
            )
        return self._known[factor]


class _Recorder:
    """A controller that remembers its actions."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self.actions: list[NDArray[Any]] = []

    def begin(self, plans: Plans) -> None:
        self._controller.begin(plans)

    def __call__(self, stage: int, measured: FloatArray) -> NDArray[Any]:
        self.actions.append(self._controller(stage, measured))
        return self.actions[-1]


def _cost(solver: BoxDDP, start: FloatArray, guess: FloatArray) -> float:
    solution = solver.solve(x0=start, u_init=guess)
    return solution.cost if solution.converged else np.nan


def _read(policy: ExportedPolicy | str | Path) -> ExportedPolicy:
    if isinstance(policy, ExportedPolicy):
        return policy
    path = Path(policy)
    return ExportedPolicy.load(path / "policy.npz" if path.is_dir() else path)


def _median(values: NDArray[np.float64]) -> float:
    return float(np.median(values))


def _percent(interval: Interval, digits: int = 0) -> str:
    value, low, high = (100.0 * each for each in interval)
    return f"{value:.{digits}f} % [{low:.{digits}f}, {high:.{digits}f}]"
