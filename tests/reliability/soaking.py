"""Run by test_soak.py: step vector environments with random actions and resets; print sums and memory.

    python soaking.py STEPS SEED

STEPS counts those of all sub-environments. The output is one JSON object: for each case, sums of what the
environment returned as hexadecimal floats, a checksum that depends on the order, and resident memory in MB.
"""

import json
import os
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from dq_space_arm_env import DQSpaceArmVectorEnv, load_scene

COPIES = 1024
SAMPLES = 40  # of resident memory
CASES = [
    ("paper", AutoresetMode.NEXT_STEP, 0.4),
    ("random-masses", AutoresetMode.SAME_STEP, 0.25),
    ("random-target", AutoresetMode.DISABLED, 0.25),
    ("planar", AutoresetMode.SAME_STEP, 0.1),
]
"""Scene, what follows the end of an episode, and the share of the steps."""


def resident_memory() -> float:
    """Resident memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


class Soak:
    """An environment, random choices of its user, and the sums of what came back."""

    def __init__(self, scene: str, mode: AutoresetMode, seed: int) -> None:
        loaded = load_scene(scene)
        loaded = loaded.replace(simulation={"steps": 211})
        self.env, self.mode = DQSpaceArmVectorEnv(COPIES, loaded, mode), mode
        self.rng, self.order, self.sums = np.random.default_rng(seed), 0, dict.fromkeys(_SUMS, 0.0)
        self.actions = np.zeros(self.env.action_space.shape, np.float32)
        self.over = np.zeros(COPIES, bool)
        self.env.reset(seed=seed)
        self.known_state = self.env.states[0]
        self.env.reset(options={"initial_state": self.known_state})  # whatever it needs is compiled now

    def reset(self) -> None:
        """Reset some or all, with seeds, a given state or target, or nothing but a draw."""
        rng, options = self.rng, {}
        mask = rng.random(COPIES) < rng.choice([0.01, 0.3, 1.1])
        mask[rng.integers(COPIES)] = True
        kind = rng.integers(6)
        if kind == 0:
            options["nominal"] = True
        elif kind == 1:
            options["initial_state"] = self.known_state
        elif kind == 2:  # go on from where they are, at calm ones
            states = self.env.states
            states[np.abs(states).max(axis=1) > 10] = self.known_state
            options["initial_state"] = states
        elif kind == 3 and self.env.scene.name == "random-target":
            options["target"] = self.env.targets
        each = rng.integers(2**31, size=COPIES).tolist()
        seed = (None, each[0], each, [None, *each[1:]])[rng.integers(4)]
        self._reset(mask | self.over, options, seed)

    def _reset(self, mask: Any, options: dict[str, Any], seed: Any) -> None:
        observations, info = self.env.reset(seed=seed, options=options | {"reset_mask": mask})
        self.over &= ~mask
        self._add("resets", mask)
        self._add("observations", observations)
        self._add("errors", info["position_error"])

    def step(self) -> None:
        """Step with random actions, some at their limits or beyond them, sometimes none."""
        rng, actions = self.rng, self.actions
        chance = rng.random()
        if chance < 0.95:
            rng.random(out=actions, dtype=np.float32)
            actions -= np.float32(0.5)
            actions *= np.float32(rng.choice([0.2, 2.0, 2.0, 4.0]))
            if chance < 0.05:
                np.sign(actions, out=actions)
        else:
            actions[:] = 0
        observations, rewards, ends, _, info = self.env.step(actions)
        self._add("observations", observations)
        self._add("rewards", rewards)
        self._add("ends", ends)
        self._add("errors", info["attitude_error"])
        if self.mode is AutoresetMode.DISABLED and ends.any():
            self.over = ends.copy()
            self._reset(self.over, {}, None)
        if chance > 0.98:
            self.reset()
            self.order = zlib.crc32(observations.tobytes(), self.order)

    def _add(self, name: str, values: Any) -> None:
        self.sums[name] += float(np.sum(values))


_SUMS = ("observations", "rewards", "ends", "errors", "resets")


def soak(scene: str, mode: AutoresetMode, steps: int, seed: int) -> dict[str, Any]:
    """Take a number of steps; see the module for the result."""
    run, memory = Soak(scene, mode, seed), []
    calls = max(steps // COPIES, SAMPLES)
    for sample in range(SAMPLES):
        for _ in range(calls * sample // SAMPLES, calls * (sample + 1) // SAMPLES):
            run.step()
        memory.append(round(resident_memory(), 2))
    sums = {name: value.hex() for name, value in run.sums.items()}
    return {"steps": calls * COPIES, **sums, "order": run.order, "memory": memory}


if __name__ == "__main__":
    steps, seed = int(float(sys.argv[1])), int(sys.argv[2])
    print(json.dumps({scene: soak(scene, mode, int(share * steps), seed) for scene, mode, share in CASES}))
