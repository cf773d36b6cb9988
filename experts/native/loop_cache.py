"""The machine code of compiled loops on disk, behind the guard of all machine code.

Numba's own cache unpickles whatever it finds beside the source. This one keeps a file for each loop and types
of arguments, and parses it only once it has been found sound. The key holds the source of all loops, as they
inline one another across files, and the versions of Python and numba.
"""

import hashlib
import pickle
import platform
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, cast

import numba
from numba.core.caching import FunctionCache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps

from dq_space_arm_env.common.code_cache import cache_directory, cache_key, is_kept, keep_code, read_code

_ROOMS = ("ddp", "native")  # of the package experts: what loops are made of


class LoopCache(FunctionCache):
    """The cache of one loop, in the form that numba's dispatchers use."""

    def __init__(self, loop: Callable[..., Any]) -> None:
        # Not that of numba, which looks for a folder to write to beside the source.
        self._py_func, self._name = loop, f"{Path(loop.__code__.co_filename).stem}.{loop.__name__}"
        self._enabled = True

    @property
    def cache_path(self) -> str:
        """Folder of the files."""
        return str(cache_directory())

    def flush(self) -> None:
        """Keep what there is: its key says whether it is up to date."""

    def holds(self, signature: Any, target: Any) -> bool:
        """Tell whether there is a file for arguments of some types."""
        return self._enabled and is_kept(self._name, self._key(signature, target.codegen()))

    def _load_overload(self, signature: Any, target: Any) -> Any:
        code = read_code(self._name, self._key(signature, target.codegen())) if self._enabled else None
        return None if code is None else CompileResult._rebuild(target, *pickle.loads(code))

    def _save_overload(self, signature: Any, result: Any) -> None:
        # Addresses in this process mean nothing to others.
        if self._enabled and not result.library.has_dynamic_globals:
            keep_code(self._name, self._key(signature, result.codegen), dumps(result._reduce()))

    def _key(self, signature: Any, codegen: Any) -> str:
        code, index_key = self._py_func.__code__, cast(Any, self)._index_key
        versions = (platform.python_implementation(), platform.python_version(), numba.__version__)
        parts = (code.co_firstlineno, *index_key(signature, codegen), *versions)
        return cache_key(_source_hash(code.co_filename), *map(str, parts))


@cache
def _source_hash(file: str) -> str:
    """Hash the source of a loop and of those that it may inline."""
    package = Path(__file__).parent.parent
    digest = hashlib.sha256()
    for path in sorted({Path(file), *(path for room in _ROOMS for path in (package / room).glob("*.py"))}):
        digest.update(path.read_bytes())
    return digest.hexdigest()
