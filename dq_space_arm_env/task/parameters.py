"""What a scene draws for each episode besides the state: target, masses and inertias.

Everything else is a constant of the machine code. The target comes first, all of it even if only its position
is drawn: an episode can then be given any. Of the drawn masses and inertias only what the equations of
motion read becomes a parameter, once per episode: with a payload, the mass, center of mass and inertia of the
last link together with it rather than the drawn factors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi

from dq_space_arm_env.dynamics.chain import Chain, RigidBody
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.scene.start import EpisodeStart, episode_start, number_of_draws, target_entries

Scalar = Any

_AXES = "xyz"
_POSE_NAMES = tuple(f"target q_{part}{index}" for part in "rd" for index in range(4))


@dataclass(frozen=True)
class EpisodeParameters:
    """A scene's parameters, and the constants of its model with symbols in their places."""

    names: tuple[str, ...]
    symbols: tuple[Scalar, ...]
    chain: Chain
    target: tuple[Scalar, ...]  # q_{D/I}, 8 numbers or symbols

    @classmethod
    def of(cls, scene: Scene) -> EpisodeParameters:
        """Collect a scene's parameters; none for a scene that draws states only."""
        collector = _Collector()
        start = _symbolic_start(scene)
        target = collector.target(scene, start)
        chain = collector.chain(Chain.from_scene(scene, start.masses))
        return cls(tuple(collector.names), tuple(collector.symbols), chain, target)

    @staticmethod
    def values(scene: Scene, draws: Sequence[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        """Compute an episode's initial state and parameters from its draws, see `episode_start`."""
        start = episode_start(scene, draws)
        collector = _Collector()
        collector.target(scene, start)
        collector.chain(Chain.from_scene(scene, start.masses))
        return start.state, collector.values


def _symbolic_start(scene: Scene) -> EpisodeStart:
    return episode_start(scene, [casadi.SX.sym(f"draw_{i}") for i in range(number_of_draws(scene))])


class _Collector:
    """Replaces whatever depends on draws by new symbols, always in the same order."""

    def __init__(self) -> None:
        self.names: list[str] = []
        self.symbols: list[Scalar] = []
        self.values: list[Scalar] = []

    def parameter(self, name: str, value: Scalar) -> Scalar:
        """The value itself if it is a number, otherwise a symbol."""
        return float(value) if casadi.SX(value).is_constant() else self._symbol(name, value)

    def _symbol(self, name: str, value: Scalar) -> Scalar:
        self.names.append(name)
        self.values.append(value)
        self.symbols.append(casadi.SX.sym(f"parameter_{len(self.symbols)}"))
        return self.symbols[-1]

    def target(self, scene: Scene, start: EpisodeStart) -> tuple[Scalar, ...]:
        """The target; in a planar scene four of its numbers are zero whatever is drawn."""
        entries = target_entries(scene)
        if not entries:
            return start.target
        return tuple(
            self._symbol(name, entry) if index in entries else 0.0
            for index, (name, entry) in enumerate(zip(_POSE_NAMES, start.target, strict=True))
        )

    def chain(self, chain: Chain) -> Chain:
        """A chain with symbols in place of everything that is not a number."""
        links = tuple(
            replace(link, body=self._body(f"link {number}", link.body))
            for number, link in enumerate(chain.links, start=1)
        )
        return replace(chain, base=self._body("base", chain.base), links=links)

    def _body(self, name: str, body: RigidBody) -> RigidBody:
        mass = self.parameter(f"{name} mass", body.mass)
        center = tuple(
            self.parameter(f"{name} center of mass {axis}", entry)
            for axis, entry in zip(_AXES, body.center_of_mass, strict=True)
        )
        inertia: list[list[Scalar]] = [[0.0] * 3 for _ in range(3)]
        for i in range(3):
            for j in range(i + 1):
                entry = self.parameter(f"{name} inertia {_AXES[j]}{_AXES[i]}", body.inertia[i][j])
                inertia[i][j] = inertia[j][i] = entry
        return RigidBody(mass, center, inertia)
