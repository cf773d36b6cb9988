"""Bring your own robot: a few lines of YAML, or your URDF, from description to solved maneuver.

Expect: a mistake is refused with a sentence; the robot in this file reaches its target. With --urdf, your
arm, on a base of 100 kg, moves every joint by 0.3 rad. Six joints take a minute, and the last iterations
barely lower the cost: the table shows whether the end is within the tolerances.

    python scripts/examples/own_scene.py [--urdf scripts/examples/small-arm.urdf --tip hand] [--out FOLDER]
"""

import argparse
import math
from importlib.util import find_spec
from pathlib import Path

import gymnasium
from ruamel.yaml import YAML

from dq_space_arm_env import SceneError, load_scene, scene_from_urdf
from experts import GuidedDDP
from experts.maneuver import Maneuver

ROBOT = """
name: inspector # a small planar satellite with a two-link arm
base: {motion: planar, mass: 40, inertia: [3, 3, 2]} # kg, kg m^2
links:
  - name: upper arm
    mass: 3
    inertia: [0.01, 0.1, 0.1]
    center_of_mass: [0.25, 0, 0] # m, in the frame of the joint
    joint: {position: [0.3, 0, 0]} # m, from the base's center of mass
  - {name: forearm, mass: 2, inertia: [0.01, 0.05, 0.05], center_of_mass: [0.2, 0, 0],
     joint: {position: [0.5, 0, 0]}}
tip: {position: [0.4, 0, 0]}
actuators: {base_torque: {limit: 1}, joint_torque: {limit: 0.5}} # N m; no thrusters
initial_state: {joint_angles: [0.4, -0.8]} # rad
target: {pose: {position: [0.75, 0.65, 0], rotation: {axis: [0, 0, 1], angle: 80}}}
"""


def main(arguments: list[str] | None = None) -> None:
    """Run the example."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--urdf", type=Path, help="your robot")
    parser.add_argument("--tip", default="tool0", help="link that should reach the target")
    parser.add_argument("--out", type=Path, default=Path("results/examples"))
    options = parser.parse_args(arguments)
    if options.urdf is None:
        data = YAML(typ="safe").load(ROBOT)
        try:
            load_scene({**data, "base": {**data["base"], "mass": -40}})
        except SceneError as error:
            print(f"refused: {error}\n")
        scene = load_scene(data)  # or load_scene("my_scene.yaml")
    else:
        spacecraft = {"mass": 100, "inertia": [10, 10, 10]}
        try:
            scene = scene_from_urdf(options.urdf, options.tip, spacecraft=spacecraft, joint_torque=2)
        except SceneError as error:
            parser.error(str(error))
    options.out.mkdir(parents=True, exist_ok=True)
    scene.to_yaml(options.out / "own_scene.yaml")  # every key, for editing
    solution = GuidedDDP(scene).solve()
    flown = Maneuver(scene, solution.states, solution.controls)
    print(f"{scene.name}: {solution.message}\n{'':6} {'attitude, deg':>14} {'position, m':>12}")
    for name, k in (("start", 0), ("end", -1)):
        print(f"{name:6} {math.degrees(flown.angle[k]):14.2f} {flown.distance[k]:12.4f}")
    print(f"{'asked':6} {scene.success.attitude_error_deg:14.2f} {scene.success.position_error:12.4f}")
    if find_spec("matplotlib") is None:
        print('no picture: it needs matplotlib (pip install "dq-space-arm[plots]")')
        return
    from matplotlib.figure import Figure

    env = gymnasium.make("DQSpaceArm-v0", scene=scene, render_mode="rgb_array")
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axes, (title, k) in zip(figure.subplots(1, 2), (("start", 0), ("end", -1)), strict=True):
        env.reset(options={"initial_state": solution.states[k]})
        axes.imshow(env.render())
        axes.set(title=title, xticks=[], yticks=[])
    figure.savefig(options.out / "own_scene.png", dpi=120)
    print(f"files: {options.out / 'own_scene.yaml'}, {options.out / 'own_scene.png'}")


if __name__ == "__main__":
    main()
