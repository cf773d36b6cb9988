"""DAgger: the network flies, the expert labels the states it visits, and the network trains on them too.

A network that has only seen the expert's trajectories is lost where its own errors lead it. Training and
flying alternate, and all labels are kept: Ross, Gordon and Bagnell, "A Reduction of Imitation Learning and
Structured Prediction to No-Regret Online Learning" (AISTATS 2011), with the network flying from the first
round on.
"""

from __future__ import annotations

import copy
import io
import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from agents.configuration.imitation import Dagger
from agents.demonstrations import check_gains, fingerprint
from agents.imitation.cloning import Cloned, Making
from agents.imitation.labels import Solver, label_by_gains
from agents.imitation.objective import Objective
from agents.imitation.samples import COLUMNS, Corrections, Mixture, Statistics
from agents.imitation.trainer import CheckpointError, Progress, Record, Spent, Trainer, Watch, torch_threads
from agents.policies.exported import ExportedPolicy
from agents.policies.network import PolicyNetwork
from dq_space_arm_env.common.bounded_formats import read_arrays
from dq_space_arm_env.common.bounded_reading import UnreadableError, parse_json
from dq_space_arm_env.common.files import write_atomically
from dq_space_arm_env.common.progress import Status
from dq_space_arm_env.environment.rollouts import rollout
from experts.demonstrations import Demonstrations
from experts.demonstrations.shard import PARAMETERS

CORRECTIONS = "corrections.npz"


class Round(NamedTuple):
    """The network's flights at the start of a round, and their labeling."""

    number: int  # from 0
    success: float  # share of flights within the tolerances of the demonstrations
    gap: float  # median of J / J_expert - 1 over the flights
    corrections: int  # time steps labeled so far
    solves: int  # plans made in this round
    seconds: float  # to fly and to label


@dataclass(frozen=True, eq=False)
class Aggregated:
    """A network trained by DAgger."""

    network: PolicyNetwork
    rounds: list[Round]
    history: list[Record]  # of the cloning and of every round, see `Trainer`
    facts: dict[str, Any]  # metadata of the exported policy, JSON values

    def export(self) -> ExportedPolicy:
        """Export the policy, which needs NumPy alone."""
        return self.network.export(self.facts)


def aggregate(
    cloned: Cloned[PolicyNetwork],
    demonstrations: Demonstrations,
    settings: Dagger | None = None,
    folder: str | os.PathLike[str] | None = None,
    *,
    making: Making | None = None,
    starts: Demonstrations | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Aggregated:
    """Train a cloned network with DAgger; the same call resumes an interrupted run.

    Args:
        cloned: Where to start; it is left as it is.
        demonstrations: What it was trained on; the expert plans to their tolerances.
        settings: Settings of DAgger; objective and checkpoint interval are those of its `cloning`.
        folder: Where to keep labels and checkpoints; None for nowhere.
        making: Seed and threads; `Making()` by default.
        starts: Demonstrations from whose starts the network flies; `demonstrations` by default.
        progress: Called now and then in every round.
        watch: Called with the network at every validation; its result is added to the history.

    Returns:
        The network, with the rounds and the history of its training.

    Raises:
        CheckpointError: If the folder holds another run, or a damaged file.
        DemonstrationsError: If the expert finds no plan from any visited state.
        ValueError: If labels are to follow from gains that are missing.
    """
    settings, making = settings or Dagger(), making or Making()
    starts = demonstrations if starts is None else starts
    check_labels(settings, starts)
    chosen = settings.model_dump(mode="json", exclude={"cloning"})
    given = {
        "dagger": settings.model_dump(mode="json"),
        "starts": [starts.manifest["settings_sha256"], fingerprint(starts)],
        "seed": making.seed,
        "threads": making.threads,
    }
    facts = {**cloned.facts, "aggregation": {**chosen, "starts": fingerprint(starts)}}
    network = copy.deepcopy(cloned.network)
    statistics = Statistics.of(demonstrations)
    expert = _Expert(starts, settings, making.seed, progress)
    environment_steps = expert.episodes * starts.scene.simulation.steps  # per round
    rounds: list[Round] = []
    corrections: list[Corrections] = []
    history = list(cloned.history)
    for number in range(settings.rounds):
        place = None if folder is None else Path(folder) / f"round-{number:02d}"
        identity = {"training": facts["training"], **given, "round": number}
        done, found = _corrections(place, identity, partial(expert.correct, network, number))
        corrections.append(found)
        rounds.append(done._replace(corrections=sum(len(part) for part in corrections)))
        mixture = Mixture(demonstrations, Corrections.joined(corrections), settings.share)
        with torch_threads(making.threads):
            trainer = Trainer(
                network,
                Objective(demonstrations.kernels, statistics, settings.cloning.objective),
                settings.optimization,
                validate_every=settings.cloning.validate_every,
                seed=making.seed + 1 + number,
                part=_part(number),
                before=_spent(history[-1], done, environment_steps),
            )
            trainer.train(mixture, None, place, identity, progress=progress, watch=watch)
        history += trainer.history
    return Aggregated(network, rounds, history, facts)


def check_labels(settings: Dagger, starts: Demonstrations) -> None:
    """Refuse demonstrations without the gains that labels are to follow from."""
    if settings.labels == "gains":
        check_gains(starts, "labels: gains follows: give labels: solve")


def _spent(last: Record, done: Round, environment_steps: int) -> Spent:
    return Spent(
        last["updates"], last["seconds"] + done.seconds, last["environment_steps"] + environment_steps
    )


def _part(number: int) -> str:
    return f"round {number + 1}"


class _Expert:
    """Flies a network, and labels the states it visits."""

    def __init__(
        self, starts: Demonstrations, settings: Dagger, seed: int, progress: Progress | None
    ) -> None:
        self._starts, self._settings, self._seed, self._progress = starts, settings, seed, progress
        self._solver = Solver(starts.scene) if settings.labels == "solve" else None

    @property
    def episodes(self) -> int:
        """Episodes per round, at most one per start."""
        return min(self._settings.episodes, len(self._starts))

    def correct(self, network: PolicyNetwork, number: int) -> tuple[Round, Corrections]:
        settings, started = self._settings, perf_counter()
        rng = np.random.default_rng([self._seed, number])
        count = self.episodes
        starts = self._starts.select(np.sort(rng.permutation(len(self._starts))[:count]))
        visits = rollout(network.export({}), starts.scene, starts.column("seed").tolist(), record=True)
        gap = float(np.median(visits.cost / starts.column("cost") - 1.0))
        solves = 0
        if self._solver is None:
            corrections = label_by_gains(starts, visits)
        else:
            tell = partial(self._tell, number, count)
            corrections, solves = self._solver.label(starts, visits, settings.solves, rng, tell)
        corrections = corrections.thinned(settings.every)
        success = float(visits.is_success.mean())
        seconds = perf_counter() - started
        return Round(number, success, gap, len(corrections), solves, seconds), corrections

    def _tell(self, number: int, count: int, done: int) -> None:
        if self._progress is not None:
            self._progress(Status(done, count, f"{_part(number)}: {done} of {count} flights labeled"))


def _corrections(
    place: Path | None, identity: dict[str, Any], make: Callable[[], tuple[Round, Corrections]]
) -> tuple[Round, Corrections]:
    """The labels of a round: read from its folder, or made and written there."""
    path = None if place is None else place / CORRECTIONS
    if path is not None and path.is_file():
        return _read(path, identity)
    done, corrections = make()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {name: array for name in COLUMNS if (array := getattr(corrections, name)).size}
        facts = json.dumps({"identity": identity, "round": done._asdict()})
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, facts=np.array(facts), **arrays)
        write_atomically(path, content.getvalue())
    return done, corrections


def _read(path: Path, identity: dict[str, Any]) -> tuple[Round, Corrections]:
    try:
        # Nothing in it is compressed, and a number counts as 8 bytes.
        content = read_arrays(path, (*COLUMNS, "facts"), 8 * path.stat().st_size)
        facts = parse_json(str(content["facts"]), "facts")
        content.setdefault(PARAMETERS, np.zeros((len(content["states"]), 0)))
        arrays = [content[name] for name in COLUMNS]
        found, done, corrections = facts["identity"], Round(**facts["round"]), Corrections(*arrays)
        if len({array.shape[:1] for array in arrays}) != 1 or any(
            array.dtype.kind != "f" for array in arrays
        ):
            raise UnreadableError("its arrays should hold numbers, in as many rows each")
    except (UnreadableError, KeyError, TypeError) as error:
        raise CheckpointError(f"{path} cannot be read ({error}); remove its folder and later ones") from error
    if found != identity:
        raise CheckpointError(f"{path} is of another run; use another folder")
    return done, corrections
