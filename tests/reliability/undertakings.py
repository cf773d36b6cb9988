"""The commands that write, small enough to be killed hundreds of times, and what they begin with."""

from pathlib import Path

from kill_harness import Undertaking

from dq_space_arm_env import Scene
from dq_space_arm_env.command_line import main
from dq_space_arm_env.validation import dump_yaml

SCENE = {
    "name": "short",
    "base": {"motion": "planar", "mass": 20, "inertia": [1, 1, 1]},
    "links": [
        {
            "name": "link", "mass": 2, "inertia": [0.01, 0.05, 0.05], "center_of_mass": [0.3, 0, 0],
            "joint": {"position": [0.3, 0, 0]},
        }
    ],
    "tip": {"position": [0.6, 0, 0]},
    "actuators": {"base_torque": {"limit": 2}, "joint_torque": {"limit": 0.5}},
    "target": {"pose": {"position": [0.6, 0.5, 0], "rotation": {"axis": [0, 0, 1], "angle": 60}}},
    "simulation": {"dt": 0.05, "steps": 60},
    "spread": {"joint_angles": 0.5, "base_position": 0.1, "base_rotation": 0.1},
}  # fmt: skip
_SMALL = {"hidden": [8], "activation": "tanh"}
_CLONING = {
    "name": "cloning", "optimization": {"updates": 60, "batch_size": 32, "warm_up": 5}, "validate_every": 10,
}  # fmt: skip
_SCHEDULE = {"total_steps": 2400, "evaluation_episodes": 4, "evaluate_every": 600, "checkpoint_every": 600}
_PRACTICE = {"copies": 4, "action_repeat": 6, "reward_scale": 0.01}
_PPO = {"n_steps": 10, "batch_size": 40, "n_epochs": 2}
CONFIGURATIONS = {
    "cloning": {"algorithm": _CLONING, "curve": {"every": 20, "episodes": 4}, "demonstrations": {}},
    "dagger": {
        "algorithm": {
            "name": "dagger", "cloning": _CLONING, "rounds": 2, "episodes": 4, "solves": 1,
            "optimization": {"updates": 20, "batch_size": 32},
        },
        "curve": {"every": 20, "episodes": 4},
        "demonstrations": {},
    },
    "ppo": {"algorithm": {"name": "PPO", **_PPO}, "environment": _PRACTICE, "schedule": _SCHEDULE},
    "residual": {
        "algorithm": {"name": "residual-PPO", **_PPO},
        "environment": {"copies": 4, "action_repeat": 6},
        "mismatch": {"mass_factors": [1.0], "noise": 0.01, "push": 0.02},
        "schedule": _SCHEDULE,
        "demonstrations": {},
    },
}  # fmt: skip


def prepare(folder: Path) -> None:
    """Write scene, robot, solution, flight, demonstrations, configurations and a policy."""

    def run(command: str) -> None:
        assert main(command.format(folder).split()) == 0, command

    Scene.model_validate(SCENE).to_yaml(folder / "short.yaml")
    run("scenes export no-wrist --out {0}/robot.urdf")
    run("solve {0}/short.yaml --out {0}/solution")
    run("simulate {0}/short.yaml --policy gains --out {0}/flight.npz")
    for name, seed in (("data", 0), ("tests", 1)):
        made = f"demonstrations generate -n 8 --workers 1 --no-summary --seed {seed} --out {{0}}/{name}"
        run(made + " --scene {0}/short.yaml")
    for name, content in CONFIGURATIONS.items():
        source = {"demonstrations": {"folder": f"{folder}/data"}} if "demonstrations" in content else {}
        settings = {"name": name, "scene": f"{folder}/short.yaml", "network": _SMALL, **content, **source}
        (folder / f"{name}.yaml").write_text(dump_yaml(settings, ""))
    space = {"algorithm.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}
    (folder / "space.yaml").write_text(dump_yaml({"search": space}, ""))
    for name in ("cloning", "residual"):
        run(f"train {{0}}/{name}.yaml --out {{0}}/{name}")


EVERYTHING = ("*",)
_LOGS = ("*/log/*", "*/tensorboard/*", "*/.lock", "*/lock*")
_DATA = ("out/settings.json", "out/manifest.json", "out/shards/*", "out/README.md")
_RUN, _ROWS = ("out/policy.npz", "out/config.yaml"), ("out/comparison.json", "out/rows/*")
_GENERATE = "demonstrations generate --scene {inputs}/short.yaml --out out"
_SHARDS = _GENERATE + " -n 12 --shard-size 4 --no-summary --workers"
_BESIDE = "--scene {inputs}/short.yaml --out out"
_STARTS = _BESIDE + " --no-picture --workers 1"
UNDERTAKINGS = (
    Undertaking("scenes new", "scenes new my.yaml --from planar", EVERYTHING, once=True),
    Undertaking(
        "scenes import",
        "scenes import {inputs}/robot.urdf --tip tip --joint-torque 1 --out my.yaml",
        EVERYTHING,
        once=True,
    ),
    Undertaking("scenes export", "scenes export no-wrist --out out/robot.urdf", EVERYTHING, once=True),
    Undertaking("solve", "solve {inputs}/short.yaml --seed 3 --out out", EVERYTHING),
    Undertaking("solve --figures", "solve {inputs}/short.yaml --out out --figures", EVERYTHING, weight=0.3),
    Undertaking(
        "simulate", "simulate {inputs}/short.yaml --policy gains --noise 0.1 --seed 1 --out a.npz", EVERYTHING
    ),
    Undertaking(
        "replay", "replay {inputs}/solution/solution.npz {inputs}/flight.npz --out a.html", EVERYTHING
    ),
    Undertaking("demonstrations generate", _SHARDS + " 1", _DATA, _LOGS),
    Undertaking("demonstrations generate, 2 workers", _SHARDS + " 2", _DATA, _LOGS, weight=0.1),
    Undertaking(
        "demonstrations generate, summary", _GENERATE + " -n 4 --workers 1", _DATA, _LOGS, weight=0.3
    ),
    Undertaking(
        "demonstrations export",
        "demonstrations export {inputs}/data short/a-v0",
        ("*.hdf5",),
        (".short-a-v0.lock", "minari/.short-a-v0.lock"),
        once=True,
    ),
    Undertaking(
        "demonstrations export to LeRobot",
        "demonstrations export {inputs}/data out/set --format lerobot",
        EVERYTHING,
        once=True,
    ),
    Undertaking("train cloning", "train {inputs}/cloning.yaml --out out", _RUN, _LOGS),
    Undertaking("train dagger", "train {inputs}/dagger.yaml --out out", _RUN, _LOGS, weight=0.5),
    Undertaking("train ppo", "train {inputs}/ppo.yaml --out out", (*_RUN, "out/model.zip"), _LOGS),
    Undertaking("train residual", "train {inputs}/residual.yaml --out out", _RUN, _LOGS, weight=0.5),
    Undertaking(
        "train --seeds",
        "train {inputs}/cloning.yaml --seeds 2 --workers 2 --out out",
        ("out/*/policy.npz", "out/*/config.yaml"),
        ("*/log/*", "*/tensorboard/*", "*.lock", "out/*/progress.json"),
        weight=0.5,
    ),
    Undertaking(
        "search",
        "search {inputs}/ppo.yaml {inputs}/space.yaml --trials 3 --workers 1 --no-picture --out out",
        ("out/best.yaml", "out/trials/*/policy.npz", "out/trials/*/config.yaml"),
        ("*/tensorboard/*", "*.lock", "out/trials/*/progress.json"),
        weight=0.5,
    ),
    Undertaking("evaluate", "evaluate {inputs}/cloning -n 25 --workers 1 " + _BESIDE, EVERYTHING),
    Undertaking(
        "evaluate show", "evaluate show {inputs}/cloning --no-picture " + _BESIDE, EVERYTHING, weight=0.5
    ),
    Undertaking(
        "compare",
        "compare {inputs}/cloning -n 25 --controller open-loop gains " + _STARTS,
        _ROWS,
        weight=0.5,
    ),
    Undertaking(
        "compare residual",
        "compare residual {inputs}/residual -n 8 --condition pushes " + _STARTS,
        _ROWS,
        ("out/plans*/log/*",),
        weight=0.25,
    ),
    Undertaking(
        "compare cloning",
        "compare cloning --config {inputs}/cloning.yaml --demonstrations {inputs}/data --test-demonstrations "
        "{inputs}/tests --counts 4 --seeds 1 --updates 20 --tests 4 --no-picture --out out",
        ("out/cloning.json",),
        weight=0.25,
    ),
    Undertaking("report", "report {inputs}/short.yaml --quick --out out", weight=0.05),
    Undertaking(
        "reproduce_paper",
        "--scene {inputs}/short.yaml --out out --no-figures",
        EVERYTHING,
        program="scripts.reproduce_paper",
    ),
)
