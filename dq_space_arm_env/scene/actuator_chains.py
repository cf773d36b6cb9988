"""Chains from command to output: actuators that delay their commands, or lag behind them."""

from typing import Any, NamedTuple

from dq_space_arm_env.scene.parameters import control_numbers

Scene = Any  # `schema.Scene`


class Chain(NamedTuple):
    """A control whose output is not its command; what is on the way is part of the state."""

    control: int  # its index
    name: str  # of the control
    unit: str  # of the control
    delay: int  # whole steps from the command to what the actuator follows
    time_constant: float | None  # with which the output follows, s; None: at once

    @property
    def names(self) -> list[str]:
        """Names of its states: commands in the order in which they act, then the output."""
        waiting = [f"{self.name} commanded {steps} before" for steps in range(self.delay, 0, -1)]
        return [*waiting, *([] if self.time_constant is None else [f"{self.name} output"])]


def chains(scene: Scene) -> tuple[Chain, ...]:
    """The chains of a scene's actuators.

    Args:
        scene: The scene.

    Returns:
        One for each control with a delay or a lag, in the order of the controls.
    """
    found, index = [], 0
    for field, numbers in control_numbers(scene).items():
        actuator = getattr(scene.actuators, field, None)  # wheels and thrusters, one by one, act at once
        for number in numbers:
            if actuator is not None and (actuator.delay or actuator.time_constant is not None):
                chain = Chain(index, number.name, number.limit.unit, actuator.delay, actuator.time_constant)
                found.append(chain)
            index += 1
    return tuple(found)
