"""Data sets written under a hidden name and renamed when complete, so that nobody sees a partial one."""

import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from dq_space_arm_env.common.locks import locked
from experts.demonstrations.tensors import DemonstrationsError


@contextmanager
def staged(
    place: Path, staging: Path, *, marker: str, overwrite: bool, name: str, parts: Collection[str] = ()
) -> Iterator[Path]:
    """Yield a folder to write a data set in, and move it into place at the end of a `with` block.

    The next process removes the leftovers of a killed one; the lock vanishes with the process.

    Args:
        place: Where the data set belongs.
        staging: Hidden folder on the same disk, whose name follows from that of the data set.
        marker: File or folder that such a data set holds: nothing else is overwritten.
        overwrite: Whether to replace a data set, once the new one is complete.
        name: What messages call the data set.
        parts: All that such a data set may hold, else it is not overwritten either; none if it may be more.

    Yields:
        The folder to write, which does not exist yet, in the staging folder.

    Raises:
        DemonstrationsError: If something is in the place that may not be overwritten, or another process is
            writing it.
        OSError: If a folder cannot be created, moved or removed.
    """
    if not staging.exists():  # else a killed process left it, perhaps with what it was about to replace
        _check_free(place, marker, overwrite, name, parts)
    staging.mkdir(parents=True, exist_ok=True)
    with locked(staging / "lock", DemonstrationsError(f"another process is writing {name}")):
        made, replaced = staging / "made", staging / "replaced"
        try:
            _put_back(replaced, place)
            _check_free(place, marker, overwrite, name, parts)
            for leftover in staging.iterdir():
                if leftover.is_dir():  # all but the lock
                    shutil.rmtree(leftover)
            yield made
            if overwrite and place.exists():
                place.rename(replaced)
            made.rename(place)
        finally:
            _put_back(replaced, place)
            shutil.rmtree(staging, ignore_errors=True)  # Windows keeps a file that is locked


def _check_free(place: Path, marker: str, overwrite: bool, name: str, parts: Collection[str]) -> None:
    """Raise DemonstrationsError if something is in the place that may not be overwritten."""
    if not place.exists():
        return
    advice = "choose another name, or allow it to be overwritten (--overwrite, in Python overwrite=True)"
    if overwrite:
        found = f"no {marker}"
        if (place / marker).exists():
            others = sorted({path.name for path in place.iterdir()} - {*parts}) if parts else []
            if not others:
                return
            found = f"{others[0]!r} too"
        advice = f"it holds {found}, so it is not overwritten; choose another name"
    raise DemonstrationsError(f"{name} exists: {advice}")


def _put_back(replaced: Path, place: Path) -> None:
    """Undo the first of the two renames if the second did not happen."""
    if replaced.exists() and not place.exists():
        replaced.rename(place)
