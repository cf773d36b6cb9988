"""Demonstrations: optimal maneuvers from many starts, in files that agents learn from.

A folder of demonstrations holds shards, files with some dozens of problems each; `settings.json`, all that
they follow from; and `manifest.json`, written last, the outcome of every problem (`folder` draws the tree).
On a given kind of processor its bytes follow from the settings alone: an interrupted run, resumed by anyone,
ends with the same files.
"""

from experts.demonstrations.generation import Advance, generate_demonstrations
from experts.demonstrations.lerobot_export import export_to_lerobot
from experts.demonstrations.minari_export import export_to_minari
from experts.demonstrations.reading import Batch, Demonstration, Demonstrations, load_demonstrations
from experts.demonstrations.tensors import DemonstrationsError
from experts.executors import Executor, ProcessExecutor, SerialExecutor
from experts.ray_executor import RayExecutor

__all__ = [
    "Advance",
    "Batch",
    "Demonstration",
    "Demonstrations",
    "DemonstrationsError",
    "Executor",
    "ProcessExecutor",
    "RayExecutor",
    "SerialExecutor",
    "export_to_lerobot",
    "export_to_minari",
    "generate_demonstrations",
    "load_demonstrations",
]
