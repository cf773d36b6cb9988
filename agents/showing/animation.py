"""A flight as an animated GIF, drawn by the environment's own renderer."""

from __future__ import annotations

from io import BytesIO

import gymnasium
import numpy as np

from agents.showing.beside_expert import Side

FRAMES_PER_SECOND = 20


def animation(side: Side) -> bytes:
    """Draw a maneuver, in its own time.

    Args:
        side: The maneuver.

    Returns:
        A GIF file, 640 x 480 pixels.

    Raises:
        ModuleNotFoundError: If Pillow is not installed, which the extra `plots` brings.
        DependencyNotInstalled: If the extra `render` is not installed.
    """
    from PIL import Image

    scene = side.maneuver.scene
    environment = gymnasium.make(
        "DQSpaceArm-v0", scene=scene, render_mode="rgb_array", disable_env_checker=True
    )
    limit = environment.unwrapped.kernels.layout.control_limit  # type: ignore[attr-defined]
    environment.reset(options={"initial_state": side.maneuver.states[0]})
    every = max(1, round(1.0 / (FRAMES_PER_SECOND * scene.simulation.dt)))
    frames = [np.asarray(environment.render())]
    for step, control in enumerate(side.maneuver.controls, 1):
        environment.step(control / limit)
        if step % every == 0:
            frames.append(np.asarray(environment.render()))
    environment.close()
    pictures = [Image.fromarray(frame).quantize(64) for frame in frames]
    file = BytesIO()
    duration = round(1000.0 * every * scene.simulation.dt)
    pictures[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=pictures[1:],
        duration=duration,
        loop=0,
        optimize=True,
    )
    return file.getvalue()
