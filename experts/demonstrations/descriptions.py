"""The descriptions of a folder, `settings.json` and `manifest.json`: checked, then believed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dq_space_arm_env.common.bounded_reading import TEXT_BYTES, UnreadableError, read_mapping, read_text
from dq_space_arm_env.common.shown_text import shortened
from experts.demonstrations.folder import (
    MANIFEST,
    SETTINGS,
    SHARD_NAME,
    SHARDS,
    manifest_of,
    manifest_text,
    sha256_of,
)
from experts.demonstrations.settings import FORMAT
from experts.demonstrations.tensors import DemonstrationsError

_MANIFEST_BYTES = 2**28  # a million shards
_REMEDY = "run the command that made the folder again to repair it"
_Fields = Mapping[str, tuple[type, str]]
_SETTINGS: _Fields = {
    "scene": (dict, "a mapping"),
    "problems": (int, "a whole number"),
    "seed": (int, "a whole number"),
    "shard_size": (int, "a whole number"),
    "source": (str, "text"),
    "versions": (dict, "a mapping"),
}
_MANIFEST: _Fields = {
    "settings_sha256": (str, "text"),
    "demonstrations": (int, "a whole number"),
    "failures": (dict, "a mapping"),
    "shards": (list, "a list"),
}
_SHARD: _Fields = {
    "file": (str, "text"),
    "sha256": (str, "text"),
    "bytes": (int, "a whole number"),
    "demonstrations": (int, "a whole number"),
    "failures": (int, "a whole number"),
}


def checked_descriptions(folder: Path, verify: bool) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read settings and manifest of a complete folder; see `load_demonstrations`."""
    if not (folder / SETTINGS).exists():
        raise DemonstrationsError(f"{folder} holds no demonstrations: it has no {SETTINGS}")
    if not (folder / MANIFEST).exists():
        raise DemonstrationsError(
            f"{folder} is not complete: it has no {MANIFEST}; run the command that began it again to resume"
        )
    settings, manifest = _read_json(folder / SETTINGS), _read_json(folder / MANIFEST, _MANIFEST_BYTES)
    if settings.get("format") != FORMAT:
        raise DemonstrationsError(
            f"{folder} has format {shortened(settings.get('format'))}, this version reads {FORMAT}: generate "
            "it again"
        )
    _check_fields(folder / SETTINGS, settings, _SETTINGS)
    _check_fields(folder / MANIFEST, manifest, _MANIFEST)
    paths = [_checked_file(folder, shard, verify) for shard in manifest["shards"]]
    held = sum(shard["demonstrations"] for shard in manifest["shards"])
    if manifest["demonstrations"] != held:
        raise DemonstrationsError(
            f"{folder / MANIFEST} has {manifest['demonstrations']} demonstrations, its shards have {held}; "
            f"{_REMEDY}"
        )
    if verify:
        _verify_descriptions(folder, paths, manifest)
    return settings, manifest


def _read_json(path: Path, most: int = TEXT_BYTES) -> dict[str, Any]:
    try:
        return read_mapping(path, most)
    except UnreadableError as error:
        raise DemonstrationsError(f"{path} cannot be read ({error}); generate it again") from error


def _check_fields(path: Path, content: Any, fields: _Fields) -> None:
    """Refuse a mapping whose entries are missing or of another kind; whole numbers are 0 or greater."""
    if not isinstance(content, dict):
        raise DemonstrationsError(f"{path} holds {shortened(content, 60)}, it should be a mapping; {_REMEDY}")
    for name, (kind, wanted) in fields.items():
        value: Any = content.get(name)
        right = isinstance(value, kind) and not isinstance(value, bool)
        if not right or (isinstance(value, int) and not 0 <= value < 2**63):
            raise DemonstrationsError(
                f"{path}: {name} is {shortened(value)}, it should be {wanted}; {_REMEDY}"
            )


def _checked_file(folder: Path, shard: Any, verify: bool) -> Path:
    """Path of a shard, whose entry in the manifest and whose file fit each other."""
    _check_fields(folder / MANIFEST, shard, _SHARD)
    name = SHARD_NAME.fullmatch(shard["file"])
    if name is None or name[2] != shard["sha256"]:
        raise DemonstrationsError(
            f"{folder / MANIFEST}: file is {shortened(shard['file'])}, it should be a number and the hash "
            f"{shortened(shard['sha256'])}, in the folder {SHARDS}; {_REMEDY}"
        )
    path = folder / SHARDS / name[0]
    if not path.is_file():
        raise DemonstrationsError(f"{path} is missing; {_REMEDY}")
    if not path.resolve().is_relative_to(folder.resolve()):
        raise DemonstrationsError(f"{path} is a link out of the folder, it should be a file in it; {_REMEDY}")
    size = path.stat().st_size
    if size != shard["bytes"]:
        raise DemonstrationsError(f"{path} has {size} bytes instead of {shard['bytes']}; {_REMEDY}")
    if verify and sha256_of(path) != shard["sha256"]:
        raise DemonstrationsError(f"{path} is damaged: its hash is not that of the manifest; {_REMEDY}")
    return path


def _verify_descriptions(folder: Path, paths: list[Path], manifest: Mapping[str, Any]) -> None:
    """Compare settings and manifest with what follows from the files; the shards are checked already."""
    if sha256_of(folder / SETTINGS) != manifest["settings_sha256"]:
        raise DemonstrationsError(
            f"{folder / SETTINGS} is not what the demonstrations were made with: its hash is not that of the "
            f"manifest; restore it, or generate them again"
        )
    try:
        made = manifest_text(manifest_of(folder / SETTINGS, paths))
        kept = read_text(folder / MANIFEST, _MANIFEST_BYTES)
    except (KeyError, TypeError, ValueError) as error:
        raise DemonstrationsError(
            f"{folder}: a shard has other arrays than a shard should ({error})"
        ) from error
    if made != kept:
        raise DemonstrationsError(
            f"{folder / MANIFEST} is damaged: it is not what follows from settings and shards; {_REMEDY}"
        )
