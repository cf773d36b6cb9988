"""Demonstrations: optimal maneuvers from many starts, in files that agents learn from.

A folder of demonstrations is made of shards, files with some dozens of problems each, `settings.json` with
all that they follow from, and `manifest.json`, written last, with what became of every problem. Given the
processor, its bytes follow from the settings alone: whatever interrupts the work, whoever goes on with it,
ends with the same files.
"""

from experts.demonstrations.errors import DemonstrationsError
from experts.demonstrations.executors import Executor, ProcessExecutor, SerialExecutor
from experts.demonstrations.generation import Advance, generate_demonstrations
from experts.demonstrations.minari_export import export_to_minari
from experts.demonstrations.ray_executor import RayExecutor
from experts.demonstrations.reading import Batch, Demonstration, Demonstrations, load_demonstrations

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
    "export_to_minari",
    "generate_demonstrations",
    "load_demonstrations",
]
