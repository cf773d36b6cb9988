"""What a user does first with an installed package, run by the Python of an otherwise empty environment.

`test_installation.py` runs it outside the repository. It prints one JSON object with what it found.
"""

import json
import sys
from pathlib import Path

import gymnasium
import numpy as np

import agents
import dq_space_arm_env
import experts
from agents.configuration import list_configurations, load_configuration
from agents.zoo import list_policies, load_policy
from dq_space_arm_env import list_scenes, load_scene, scene_from_urdf
from dq_space_arm_env.viewing.replay import Trajectory, write_replay
from experts import BoxDDP

ROBOT = """<robot name="stick"><link name="hull"/>
<joint name="shoulder" type="continuous"><parent link="hull"/><child link="arm"/><origin xyz="0.4 0 0"/>
  <axis xyz="0 1 0"/><limit effort="2" velocity="1"/></joint>
<link name="arm"><inertial><origin xyz="0.3 0 0"/><mass value="4"/>
  <inertia ixx="0.02" iyy="0.2" izz="0.2" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def main() -> None:
    """Use what is installed."""
    for package in (agents, dq_space_arm_env, experts):
        assert package.__file__ is not None
        folder = Path(package.__file__).parent
        assert folder.is_relative_to(sys.prefix), f"{folder} is not of this environment"
        assert (folder / "py.typed").is_file(), f"{folder} ships no type information"
    for scene in list_scenes():
        load_scene(scene)
    for configuration in list_configurations():
        load_configuration(configuration)

    env = gymnasium.make("DQSpaceArm-v0", scene="planar")
    observation, _ = env.reset(seed=0)
    action = np.zeros(env.action_space.shape, dtype=np.float32)
    _, reward, *_ = env.step(action)
    assert np.isfinite(observation).all()
    assert float(reward) < 0.0

    solution = BoxDDP("planar").solve()
    assert solution.converged, solution.message
    flight = Trajectory("expert", solution.states, solution.controls)
    write_replay(Path("replay.html"), [flight], load_scene("planar"))

    robot = scene_from_urdf(ROBOT, "arm", spacecraft={"mass": 100, "inertia": [10, 10, 10]})
    assert gymnasium.make("DQSpaceArm-v0", scene=robot).reset(seed=0)[0].shape == (17,)

    for name in list_policies():
        policy = load_policy(name)
        single = gymnasium.make("DQSpaceArm-v0", scene=policy.metadata["scene"])
        observation, _ = single.reset(seed=0)
        assert single.action_space.contains(policy(observation))
    assert not {"jax", "torch", "stable_baselines3", "matplotlib"} & set(sys.modules)
    found = {
        "version": dq_space_arm_env.__version__,
        "scenes": list_scenes(),
        "configurations": list_configurations(),
        "policies": list_policies(),
        "iterations": solution.iterations,
        "cost": solution.cost,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
