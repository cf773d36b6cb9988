"""Load and validate scenes by name, path or content."""

import importlib.resources
from collections.abc import Mapping
from functools import lru_cache
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from dq_space_arm_env.common.bounded_reading import UnreadableError
from dq_space_arm_env.common.shown_text import shortened
from dq_space_arm_env.common.suggestions import did_you_mean
from dq_space_arm_env.scene.schema import Scene
from dq_space_arm_env.validation.problems import SceneError, problem_list
from dq_space_arm_env.validation.yaml_text import YAMLError, parse_yaml, read_yaml, yaml_problem

_SUFFIXES = (".yaml", ".yml")
_ROBOTS = (".urdf", ".xacro", ".xml")


def scenes_directory() -> Traversable:
    """Find the scenes that ship: in the installed package, or at the top of the checkout."""
    installed = importlib.resources.files("dq_space_arm_env") / "configs" / "scenes"
    checkout = Path(__file__).resolve().parents[2] / "configs" / "scenes"
    for directory in (installed, checkout):
        if directory.is_dir():
            return directory
    raise SceneError(
        f"the scenes that ship with the package are missing: neither {installed} nor {checkout} is a folder"
    )


def list_scenes() -> list[str]:
    """List the scenes that ship with the package.

    Returns:
        Their names, sorted.
    """
    files = (Path(entry.name) for entry in scenes_directory().iterdir())
    return sorted(file.stem for file in files if file.suffix == ".yaml")


def load_scene(source: str | Path | Mapping[str, Any] | Scene) -> Scene:
    """Load and validate a scene.

    Args:
        source: Name of a shipped scene ("paper"), path of a YAML file (with a slash or ending in .yaml), what
            such a file holds as a mapping, or a scene, which is validated again.

    Returns:
        The validated scene.

    Raises:
        SceneError: If it cannot be found, read or validated; the message lists every problem.
    """
    if isinstance(source, Scene):
        return _validated(source, f"scene {source.name!r}")
    if isinstance(source, str | Path) and str(source).lower().endswith(_ROBOTS):
        raise SceneError(
            f"{source}: this is a robot's file, not a scene's: `dq-space-arm scenes import FILE --tip LINK` "
            "makes a scene of it, in Python scene_from_urdf"
        )
    if isinstance(source, Path) or (isinstance(source, str) and _is_path(source)):
        return _read(Path(source))
    if isinstance(source, Mapping):
        return _validated(dict(source), f"scene {shortened(source.get('name'))}")
    if not isinstance(source, str):
        raise SceneError(
            f"{shortened(source)} is not a scene: give a name, the path of a YAML file, a mapping or a Scene"
        )
    names = list_scenes()
    if source not in names:
        known = f"the scenes are {', '.join(names)}; give your own file by its path, ending in .yaml"
        raise SceneError(f"no scene is named {shortened(source)}; {did_you_mean(source, names, known)}")
    return _shipped(source, (scenes_directory() / f"{source}.yaml").read_text(encoding="utf-8"))


def _is_path(source: str) -> bool:
    return "/" in source or "\\" in source or source.endswith(_SUFFIXES)


@lru_cache(maxsize=64)  # scenes do not change, and YAML takes 20 to 50 ms
def _shipped(name: str, text: str) -> Scene:
    """The shipped scene whose file has this text."""
    return _read(scenes_directory() / f"{name}.yaml")


def _read(file: Traversable) -> Scene:
    try:
        # A package in a zip file has its scenes there.
        data = read_yaml(file) if isinstance(file, Path) else parse_yaml(file.read_text(encoding="utf-8"))
    except UnreadableError as error:
        raise SceneError(str(error)) from error
    except YAMLError as error:
        raise SceneError(f"{file}: not valid YAML: {yaml_problem(error)}") from error
    if data is None:
        raise SceneError(f"{file}: the file is empty; a scene needs at least name, base and target")
    if not isinstance(data, dict):
        raise SceneError(f"{file}: must be a mapping (key: value) at the top, not a {type(data).__name__}")
    if isinstance(file, Path):
        _find_beside(file, data)
    return _validated(data, str(file))


def _find_beside(file: Path, data: dict[str, Any]) -> None:
    """Read the path of a target's poses from where the scene's file is."""
    target = data.get("target")
    motion = target.get("motion") if isinstance(target, dict) else None
    if isinstance(motion, dict) and motion.get("kind") == "file" and isinstance(motion.get("path"), str):
        motion["path"] = str(file.parent / motion["path"])


def _validated(data: object, origin: str) -> Scene:
    try:
        return Scene.model_validate(data)
    except ValidationError as error:
        raise SceneError(problem_list(origin, error)) from error
