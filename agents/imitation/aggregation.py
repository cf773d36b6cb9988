"""DAgger: the network flies, the expert says what it should have done there, and the network learns that too.

A network that has only seen the expert's way is lost where its own errors lead it. So training and flying
take turns, and what has been corrected is kept: after Ross, Gordon and Bagnell, "A Reduction of Imitation
Learning and Structured Prediction to No-Regret Online Learning" (AISTATS 2011), with the network flying from
the first round on.
"""

from __future__ import annotations

import copy
import io
import json
import os
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from agents.configuration.imitation import Dagger
from agents.imitation.checkpoints import CheckpointError
from agents.imitation.cloning import Cloned, Making, fingerprint
from agents.imitation.flights import record
from agents.imitation.labels import Solver, label_by_gains
from agents.imitation.objective import Objective
from agents.imitation.progress import Labeling
from agents.imitation.samples import NAMES, Corrections, Mixture, Statistics
from agents.imitation.trainer import Progress, Record, Spent, Trainer, Watch, torch_threads
from agents.policies.exported import ExportedPolicy
from agents.policies.network import PolicyNetwork
from experts.demonstrations import Demonstrations
from experts.files import write_atomically

CORRECTIONS = "corrections.npz"


class Round(NamedTuple):
    """What the network did at the beginning of a round.

    Attributes:
        number: Of the round, from 0.
        success: Share of its flights that arrived within the tolerances of the demonstrations, 0 to 1.
        gap: Median of J / J_expert - 1 over them, dimensionless.
        corrections: Time steps that the expert has labeled so far.
        solves: Plans that it has made for this round.
        seconds: Time to fly and to label, s.
    """

    number: int
    success: float
    gap: float
    corrections: int
    solves: int
    seconds: float


@dataclass(frozen=True, eq=False)
class Aggregated:
    """A corrected network.

    Attributes:
        network: The network.
        rounds: What it did at the beginning of every round.
        history: Of the training before and in every round, see `Trainer`.
        facts: JSON values: scene and training, for the exported policy.
    """

    network: PolicyNetwork
    rounds: list[Round]
    history: list[Record]
    facts: dict[str, Any]

    def export(self) -> ExportedPolicy:
        """Make the policy that needs NumPy alone.

        Returns:
            The policy; its metadata says for which scene and how it was trained.
        """
        return self.network.export(self.facts)


def aggregate(
    cloned: Cloned,
    demonstrations: Demonstrations,
    settings: Dagger | None = None,
    folder: str | os.PathLike[str] | None = None,
    *,
    making: Making | None = None,
    starts: Demonstrations | None = None,
    progress: Progress | None = None,
    watch: Watch | None = None,
) -> Aggregated:
    """Correct a network where it goes.

    A run that was interrupted is resumed by the same call: what the expert has labeled is kept, and so are
    checkpoints of the training.

    Args:
        cloned: Where to begin; it is left as it is.
        demonstrations: What it was trained on; the expert's corrections keep to their tolerances.
        settings: How to correct it; of how it was cloned, what was minimized and how often there was a
            checkpoint go on.
        folder: Where to keep what is needed to go on; None for nowhere.
        making: Seed and threads; `Making()` by default.
        starts: Demonstrations from whose starts it flies; those it was trained on by default.
        progress: Called now and then in every round.
        watch: Called with the network after every round; what it returns is added to the history.

    Returns:
        The network.

    Raises:
        CheckpointError: If the folder holds another run, or a damaged file.
        DemonstrationsError: If the expert finds no plan from any visited state.
    """
    settings, making = settings or Dagger(), making or Making()
    starts = demonstrations if starts is None else starts
    chosen = settings.model_dump(mode="json", exclude={"cloning"})
    facts = {**cloned.facts, "aggregation": {**chosen, "starts": fingerprint(starts)}}
    network = copy.deepcopy(cloned.network)
    statistics = Statistics.of(demonstrations)
    expert = _Expert(starts, settings, making.seed, progress)
    flown = expert.episodes * starts.scene.simulation.steps  # in a round
    rounds: list[Round] = []
    corrections: list[Corrections] = []
    history = list(cloned.history)
    for number in range(settings.rounds):
        place = None if folder is None else Path(folder) / f"round-{number:02d}"
        identity = {"training": facts["training"], "aggregation": facts["aggregation"], "round": number}
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
                before=_spent(history[-1], done, flown),
            )
            trainer.train(mixture, None, place, identity, progress=progress, watch=watch)
        history += trainer.history
    return Aggregated(network, rounds, history, facts)


def _spent(last: Record, done: Round, environment_steps: int) -> Spent:
    """What a network has cost when it is trained in a round."""
    return Spent(
        last["updates"], last["seconds"] + done.seconds, last["environment_steps"] + environment_steps
    )


def _part(number: int) -> str:
    return f"round {number + 1}"


class _Expert:
    """Lets a network fly, and labels where it has been."""

    def __init__(
        self, starts: Demonstrations, settings: Dagger, seed: int, progress: Progress | None
    ) -> None:
        self._starts, self._settings, self._seed, self._progress = starts, settings, seed, progress
        self._solver = Solver(starts.scene) if settings.labels == "solve" else None

    @property
    def episodes(self) -> int:
        """Of a round: there are no more than starts."""
        return min(self._settings.episodes, len(self._starts))

    def correct(self, network: PolicyNetwork, number: int) -> tuple[Round, Corrections]:
        settings, started = self._settings, perf_counter()
        rng = np.random.default_rng([self._seed, number])
        count = self.episodes
        starts = self._starts.select(np.sort(rng.permutation(len(self._starts))[:count]))
        visits = record(network.export({}), starts.scene, starts.column("seed").tolist())
        gap = float(np.median(visits.flights.cost / starts.column("cost") - 1.0))
        solves = 0
        if self._solver is None:
            corrections = label_by_gains(starts, visits)
        else:
            tell = partial(self._tell, number, count)
            corrections, solves = self._solver.label(starts, visits, settings.solves, rng, tell)
        corrections = corrections.thinned(settings.every)
        success = float(visits.flights.is_success.mean())
        seconds = perf_counter() - started
        return Round(number, success, gap, len(corrections), solves, seconds), corrections

    def _tell(self, number: int, count: int, done: int) -> None:
        if self._progress is not None:
            self._progress(Labeling(_part(number), done, count))


def _corrections(
    place: Path | None, identity: dict[str, Any], make: Callable[[], tuple[Round, Corrections]]
) -> tuple[Round, Corrections]:
    """What the expert has labeled in a round: read if it is there, else made, and written."""
    path = None if place is None else place / CORRECTIONS
    if path is not None and path.is_file():
        return _read(path, identity)
    done, corrections = make()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays = {name: getattr(corrections, name) for name in NAMES}
        facts = json.dumps({"identity": identity, "round": done._asdict()})
        content = io.BytesIO()
        np.savez(content, allow_pickle=False, facts=np.array(facts), **arrays)
        write_atomically(path, content.getvalue())
    return done, corrections


def _read(path: Path, identity: dict[str, Any]) -> tuple[Round, Corrections]:
    try:
        with np.load(path, allow_pickle=False) as content:
            facts = json.loads(str(content["facts"]))
            corrections = Corrections(*(content[name] for name in NAMES))
    except (OSError, ValueError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as error:
        raise CheckpointError(f"{path} cannot be read ({error}); remove its folder and later ones") from error
    if facts["identity"] != identity:
        raise CheckpointError(f"{path} is that of another run; take another folder")
    return Round(**facts["round"]), corrections
