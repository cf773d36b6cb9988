"""Locks between processes, on the same folder from any container of a machine."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def locked(path: Path, refusal: Exception, *, seconds: float = 0.0) -> Iterator[None]:
    """Hold an exclusive lock inside a `with` block.

    The operating system releases it when the process ends, however it ends: processes that this one starts or
    forks do not hold it. The file stays behind, empty.

    Args:
        path: File that stands for what is locked, in a folder that exists.
        refusal: Raised if another process or thread holds the lock.
        seconds: How long to wait for it first, s; forever if negative.

    Raises:
        OSError: If the file cannot be created.
    """
    from filelock import FileLock, Timeout  # nothing else needs it

    lock = FileLock(path)
    try:
        lock.acquire(timeout=seconds)
    except Timeout as error:
        raise refusal from error
    try:
        yield
    finally:
        lock.release()
