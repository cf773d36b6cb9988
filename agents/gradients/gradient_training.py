"""Train an agent by analytic policy gradients: configuration -> episodes -> updates -> exported policy.

Through exact derivatives of the simulation, as in Brax (Freeman et al., 2021, arXiv:2106.13281).
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from agents.configuration.gradients import GradientConfiguration
from agents.gradients.disturbed_flights import Met, calm
from agents.gradients.episodes import Episodes, decision_times, every_step
from agents.gradients.fallback import LEAST_RATE, Fallback
from agents.gradients.first_units import first_units
from agents.gradients.layers import Layers, random_weights
from agents.gradients.soap import SOAP
from agents.gradients.starts import Starts
from agents.policies import ExportedPolicy
from agents.run_folder import (
    POLICY,
    DivergedError,
    RunFolder,
    RunFolderError,
    validate,
    validation_seeds,
)
from agents.zoo.starting import load_start, spent_before
from dq_space_arm_env import Scene, load_scene
from dq_space_arm_env.common.bounded_formats import ARRAY_BYTES, read_arrays
from dq_space_arm_env.common.bounded_reading import UnreadableError
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.progress import Advance, Status
from dq_space_arm_env.scene import INTEGRATORS, StateLayout

Array = NDArray[Any]

WARM_UP = 50  # updates in which the learning rate rises
FINAL_RATE = 3e-3  # learning rate at the end, relative to its peak
UNITS_PER_SIZE = 4.0  # units that they become, relative to the root mean square of the inputs
FASTEST_UNITS = 1.03  # largest factor by which units change in an update
TRAVELLED = 0.3  # share of the updates after which missing the tolerances has a price
MISSING = 0.25  # share of episodes that miss them, up to which the end weight falls
LIGHTER = 1.01  # factor of its fall in an update
COARSE = 1e-4  # tolerance of methods that adapt their steps, rad and m; at least the scene's
EVERY_STEP = 0.9  # share of the updates after which constrained episodes decide at every time step
BETWEEN_DIVISIONS = 20  # updates between measurements of the integration's errors
TOLERATED = 1e-3  # share of the cost by which the integration may change it, divided by the decisions
BETWEEN_MESSAGES = 20  # updates
CHECKPOINT = "checkpoint.npz"


class Learned(NamedTuple):
    """Result of a training run: its folder, and the exported policy."""

    folder: Path
    policy: ExportedPolicy


def train_by_gradients(
    configuration: GradientConfiguration,
    out: str | os.PathLike[str],
    report: Callable[[Advance], None] = lambda advance: None,
) -> Learned:
    """Train an agent in a run folder, resuming from its last checkpoint."""
    scene = load_scene(configuration.scene)
    folder = RunFolder(Path(out), configuration)
    learner = _Learner(configuration, scene, blank=folder.checkpoint() is not None)
    learner.resume(folder)
    # On small matrices several threads wait for each other.
    with threadpool_limits(configuration.threads, user_api="blas"):
        learner.learn(folder, report)
    policy = learner.export(folder.metadata(configuration, scene, learner.effort()))
    policy.save(folder.path / POLICY)
    return Learned(folder.path, policy)


def coarser(scene: Scene) -> Scene:
    """The scene, with larger tolerances where its integrator adapts its steps: reverse mode takes long."""
    simulation = scene.simulation
    coarse = INTEGRATORS[simulation.integrator].within(COARSE)
    coarse = {key: max(each, simulation.tolerance_of(key)) for key, each in coarse.items()}
    return scene.replace(simulation=coarse) if coarse else scene


class _Learner:
    """The network, its episodes and its optimizer.

    A blank one, whose weights and units a checkpoint is to replace, does not need the policy of `start_from`.
    """

    def __init__(self, configuration: GradientConfiguration, scene: Scene, *, blank: bool = False) -> None:
        self._settings, self._configuration, self._scene = configuration.algorithm, configuration, scene
        settings, rng = configuration.algorithm, np.random.default_rng(configuration.seed)
        self._times = decision_times(scene, settings.decisions, settings.crowding)
        self._decisions = len(self._times) - 1  # until those of every time step
        self._mismatch = configuration.mismatch
        self._flown, self._starts = self._drawn(settings.starts)
        self._mean, self._scale, units = first_units(scene, self._times, rng, configuration.seed)
        sizes = [len(self._mean), *configuration.network.hidden, StateLayout.of(scene).n_u]
        self._weights = random_weights(sizes, rng)
        given = None if blank else configuration.start_from
        self._before = spent_before(given)
        self._begin_with(load_start(given, configuration.network, sizes[0], sizes[-1]), units)
        self._episodes = self._begin_episodes(units)
        constrained = self._episodes.penalties.is_constrained
        self._every_step_from = math.ceil(EVERY_STEP * settings.updates) if constrained else math.inf
        self._optimizer = SOAP(self._weights)
        self._updates, self._seconds = 0, 0.0
        self._end_weight = settings.end_weight
        self._fallback = Fallback(self._state())

    def _begin_episodes(self, units: Array) -> Episodes:
        """Episodes that decide at the present times."""
        mismatch = self._mismatch
        layers = Layers(self._weights, len(self._times) - 1, self._settings.copies)
        noisy = mismatch is not None and mismatch.noise > 0.0
        return Episodes(coarser(self._flown), layers, self._times, units, noisy=noisy)

    def _drawn(self, count: int, *seeds: int) -> tuple[Scene, Starts]:
        """Starts of the configuration's seed and others, and the scene that has their masses."""
        factors = (1.0,) if self._mismatch is None else self._mismatch.mass_factors
        return Starts.draw(self._scene, count, self._times, [self._configuration.seed, *seeds], factors)

    def _decide_at_every_step(self) -> None:
        """Go on as in flight: what violates a constraint for a moment may do so between decisions."""
        if len(self._times) > self._scene.simulation.steps:
            return  # they do already
        before = self._episodes
        self._times = every_step(self._scene)
        self._episodes = self._begin_episodes(before.units)
        self._episodes.follow_on(before)
        self._fallback.forget_costs()

    def _begin_with(self, policy: ExportedPolicy | None, units: Array) -> None:
        """Take the weights of a policy, and its units; outputs have some of their own."""
        if policy is None:
            return
        self._mean, self._scale = policy.mean, policy.scale
        factor = (1.0 if policy.action_scale is None else policy.action_scale) / units
        for index, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
            last = factor if index == len(policy.biases) - 1 else 1.0
            self._weights[2 * index : 2 * index + 2] = [
                np.asarray(each * last, np.float32) for each in (weight, bias)
            ]

    def learn(self, folder: RunFolder, report: Callable[[Advance], None]) -> None:
        """Update to the end; flights and checkpoints on the way."""
        progression, total = self._configuration.progression, self._settings.updates
        begin = perf_counter() - self._seconds
        seeds = validation_seeds(progression.evaluation_episodes)
        curve = folder.evaluations(names=["updates"])
        while self._updates < total:
            cost = self._update()
            self._seconds = perf_counter() - begin
            done = self._updates
            if done % BETWEEN_MESSAGES == 0:
                left = self._seconds * (total - done) / max(1, done)
                reached = f", success {curve[-1]['success_rate']:.0%}" if curve else ""
                line = f"{done} of {total} updates, median cost {cost:.5g}{reached}"
                report(Status(done, total, f"{line}, {timedelta(seconds=round(left))} left"))
            if done % progression.evaluate_every == 0 or done == total:
                found = validate(self.export({}), self._scene, seeds)
                # A resumed run repeats what came after its checkpoint.
                curve = [*(line for line in curve if line["updates"] < done), {**self.effort(), **found}]
                folder.write_evaluations(curve)
                begin = perf_counter() - self._seconds  # flights are no training
            if done % progression.checkpoint_every == 0 or done == total:
                folder.add_checkpoint(done, self._write)

    def _update(self) -> float:
        """Fly episodes, take a step, and return their median cost."""
        settings, fallback, done = self._settings, self._fallback, self._updates
        warm = done > WARM_UP
        if done == self._every_step_from:
            self._decide_at_every_step()
        # Seeded by the update, so that checkpoints need no generator's state.
        rng = np.random.default_rng([self._configuration.seed, done])
        if done < self._every_step_from:
            rows = rng.integers(len(self._starts.states), size=settings.copies)
        else:  # new ones: from those that it was trained on, fewer flights violate constraints
            self._starts, rows = self._drawn(settings.copies, done)[1], np.arange(settings.copies)
        self._episodes.parameters[:] = self._starts.at(rows)
        starts = self._starts.states[rows]
        since = (done / settings.updates - TRAVELLED) / (1.0 - TRAVELLED)
        self._episodes.penalties.hardening = max(since, 0.0)
        if self._mismatch is not None:
            self._episodes.meet(Met.draw(self._mismatch, self._flown, self._times, len(rows), rng))
        gradient, median = self._fly(starts)
        is_unstable = fallback.is_needed(median, warm)  # lost motions err without being worth substeps
        if done % BETWEEN_DIVISIONS == 0 and not is_unstable and self._divide(median):
            gradient, median = self._fly(starts)
            is_unstable = fallback.is_needed(median, warm)
        missing = fallback.pays_for_missing(median)
        if is_unstable:
            self._restore(fallback.kept.arrays)
            before = self._fly(starts)[1]
            fallback.go_back(before, other_costs=self._divide(before))
        else:
            self._follow(gradient, median)
        if fallback.rate < LEAST_RATE:
            reason = missing or (
                f"flights cost {median:.4g} where they did {fallback.cost:.4g}, again and again; reduce "
                f"algorithm.learning_rate = {settings.learning_rate:g}"
            )
            raise DivergedError(f"training diverged: at update {done + 1} {reason}")
        self._updates += 1
        return median

    def _fly(self, starts: Array) -> tuple[list[Array], float]:
        """The gradient of episodes, and their median cost; infinite where all diverge, or slopes overflow."""
        gradient, costs = self._episodes.gradient(starts, self._mean, self._scale, self._end_weight)
        finite, is_sound = costs[np.isfinite(costs)], all(np.isfinite(each).all() for each in gradient)
        return gradient, float(np.median(finite)) if len(finite) and is_sound else math.inf

    def _divide(self, median: float) -> bool:
        """Divide decisions whose integration errs too much, down to time steps; whether there were any.

        Otherwise the policy would learn to profit from errors that it does not meet in flight.
        """
        episodes, dt = self._episodes, self._scene.simulation.dt
        errors, most = episodes.errors(), np.ceil(np.diff(self._times) / dt - 1e-9).astype(int)
        tolerated = TOLERATED * median / len(errors) if math.isfinite(median) else 0.0
        wrong = (errors > tolerated) & (episodes.substeps < most)
        if not wrong.any():
            return False
        episodes.divide(np.where(wrong, np.minimum(2 * episodes.substeps, most), episodes.substeps))
        self._fallback.forget_costs()
        return True

    def _follow(self, gradient: Sequence[Array], median: float) -> None:
        """Take a step against the gradient of episodes with a median cost."""
        done, settings, fallback = self._updates, self._settings, self._fallback
        if fallback.takes_copy(done):
            fallback.copy(self._state())
        fallback.recover()
        warm_up = min(1.0, (done + 1) / WARM_UP)
        falling = FINAL_RATE + (1.0 - FINAL_RATE) * 0.5 * (1.0 + math.cos(math.pi * done / settings.updates))
        # Relative to the cost, which differs by orders between scenes, a gradient has the norm 1 at most.
        norm = math.sqrt(sum(float(np.square(each, dtype=np.float64).sum()) for each in gradient))
        relative = [each / np.float32(max(norm, median)) for each in gradient]
        self._optimizer.update(relative, fallback.rate * warm_up * falling * settings.learning_rate)
        fallback.note_cost(median)
        self._adapt()

    def _adapt(self) -> None:
        """Let the end weight fall, prices follow violations, and the outputs' units the inputs flown."""
        settings, episodes = self._settings, self._episodes
        reaches = episodes.misses() <= 1.0  # those that diverge do not
        if 1.0 - reaches.mean() <= MISSING:
            self._end_weight = max(self._end_weight / LIGHTER, 1.0)
        judged = settings.copies if self._mismatch is None else calm(settings.copies)
        self._fallback.note_misses(1.0 - reaches[:judged].mean())
        travelled = self._updates > TRAVELLED * settings.updates
        episodes.price_violations(self._fallback.cost, judged if travelled else 0)
        episodes.price_roughness()
        factors = UNITS_PER_SIZE * episodes.sizes() / episodes.units
        growth = 1.0 if self._fallback.happened else FASTEST_UNITS
        factors = np.clip(factors, 1.0 / FASTEST_UNITS, growth)
        episodes.units *= factors
        for weight in self._weights[-2:]:  # the policy stays what it is
            weight /= factors.astype(np.float32)

    def effort(self) -> dict[str, Any]:
        """What the training has taken; an environment step is one between decisions."""
        at_every_step = max(0, self._updates - self._every_step_from)
        decided = (self._updates - at_every_step) * self._decisions
        decided += at_every_step * self._scene.simulation.steps
        solves, seconds = self._before
        spent = {"expert_solves": solves, "seconds": round(seconds + self._seconds, 3)}
        steps = decided * self._settings.copies
        return {"environment_steps": steps, "updates": self._updates, **spent}

    def export(self, metadata: dict[str, Any]) -> ExportedPolicy:
        """The policy now, with the units of its actions folded into the last layer."""
        *weights, last = self._weights[::2]
        *biases, end = self._weights[1::2]
        return ExportedPolicy(
            weights=tuple(np.array(each) for each in (*weights, last * self._episodes.units)),
            biases=tuple(np.array(each) for each in (*biases, end * self._episodes.units)),
            activation="tanh",
            mean=self._mean,
            scale=self._scale,
            metadata=metadata,
        )

    def _state(self) -> dict[str, Array]:
        """Copies of weights and optimizer by name, and of what changes with them."""
        weights = {f"weight{index}": each for index, each in enumerate(self._weights)}
        everything = {**weights, **self._optimizer.arrays(), "units": self._episodes.units}
        everything["end_weight"] = np.array(self._end_weight)
        everything["prices"] = self._episodes.penalties.prices
        return {name: np.array(each) for name, each in everything.items()}

    def _restore(self, arrays: Mapping[str, Array]) -> None:
        for index, weight in enumerate(self._weights):
            weight[:] = arrays[f"weight{index}"]
        self._optimizer.restore(arrays)
        self._episodes.units[:], self._end_weight = arrays["units"], float(arrays["end_weight"])
        self._episodes.penalties.prices[:] = arrays["prices"]

    def _everything(self) -> dict[str, Array]:
        """The arrays of a checkpoint by name."""
        arrays = {**self._state(), **self._fallback.arrays(), "seconds": np.array(self._seconds)}
        arrays |= {"mean": self._mean, "scale": self._scale, "substeps": self._episodes.substeps}
        arrays["expert_solves"], arrays["seconds_before"] = map(np.array, self._before)
        arrays["cost"] = np.array(self._episodes.penalties.cost)
        arrays["roughness"] = np.array(self._episodes.roughness)
        return arrays

    def _write(self, path: Path) -> None:
        stream = io.BytesIO()
        np.savez(stream, **self._everything())  # type: ignore[arg-type]
        write_atomically(path / CHECKPOINT, stream.getvalue())

    def resume(self, folder: RunFolder) -> None:
        """Go on from the folder's checkpoint, if it has one."""
        place = folder.checkpoint()
        if place is None:
            return
        if int(place.name) > self._every_step_from:
            self._decide_at_every_step()
        try:
            expected = sum(8 * each.size for each in self._everything().values())
            arrays = read_arrays(place / CHECKPOINT, most=expected + ARRAY_BYTES)
            self._restore(arrays)
            self._updates = int(place.name)
            self._episodes.divide(arrays["substeps"])
            self._episodes.roughness = float(arrays["roughness"])
            self._fallback.restore(arrays)  # after the division, which forgets costs
            self._seconds = float(arrays["seconds"])
            self._mean, self._scale = arrays["mean"], arrays["scale"]
            self._episodes.penalties.cost = float(arrays["cost"])
            tells = "expert_solves" in arrays
            if tells:
                self._before = int(arrays["expert_solves"]), float(arrays["seconds_before"])
        except (KeyError, ValueError, OSError, UnreadableError) as error:
            raise RunFolderError(
                f"{place} cannot be read ({error}); remove it to restart the training"
            ) from error
        if not tells:  # an earlier one
            self._before = spent_before(self._configuration.start_from)
