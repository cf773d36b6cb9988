"""Export demonstrations to LeRobot (LeRobotDataset v3.0), the format in which robot learning shares episodes.

    FOLDER
    |-- meta
    |   |-- info.json                             features with their shapes and names, counts, frame rate
    |   |-- stats.json                            statistics of each feature, for normalization
    |   |-- tasks.parquet                         the task in words
    |   |-- subtasks.parquet                      the phases of the scene, where it has some
    |   |-- episodes/chunk-000/file-000.parquet   a row for each episode: place, statistics, seed
    |   `-- demonstrations.json                   what the demonstrations follow from, the scene included
    |-- data/chunk-000/file-000.parquet           a row for each stage
    `-- README.md                                 data card

A row has `observation.state`, the observation; `action`; `next.reward` and `next.done`; `state`, the state of
the environment; `parameters` where something varies in the scene; `next.cost`, the violations that the action
is charged for, where it has constraints; and `subtask_index`, the phase, where it has phases. Arrays are
float64: actions repeat an episode's rewards bit for bit. The observation at the end, where no action is
taken, and the feedback gains have no place in this format; the shards and Minari data sets have both.

The format is that of LeRobot's own writer (`lerobot/datasets/lerobot_dataset.py`, version 0.4.4).
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dq_space_arm_env.common.files import to_json, write_atomically
from dq_space_arm_env.task.step_report import observation_entries
from experts.demonstrations.folder import CARD
from experts.demonstrations.reading import Demonstration, Demonstrations
from experts.demonstrations.shard import PARAMETERS
from experts.demonstrations.staging import staged
from experts.demonstrations.tensors import DemonstrationsError

VERSION = "v3.0"
INFO = "meta/info.json"
FILES = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
"""Path of a Parquet file in its folder."""
CHUNK, MEGABYTES = 1000, 100
"""Most files of a chunk, and most megabytes of a file: the defaults of LeRobot."""
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
LEROBOT_MISSING = 'this needs pyarrow: pip install "dq-space-arm[lerobot]"'
_ROWS = 256
"""Episodes of a row group."""
_COUNTERS = ("frame_index", "episode_index", "index", "task_index")
SUBTASK = "subtask_index"
"""What LeRobot calls the phase of a row."""

Statistics = dict[str, NDArray[Any]]
Features = dict[str, dict[str, Any]]


def export_to_lerobot(
    demonstrations: Demonstrations,
    out: str | os.PathLike[str],
    *,
    card: str | None = None,
    overwrite: bool = False,
    progress: Callable[[int], None] | None = None,
) -> Path:
    """Write demonstrations as a data set of LeRobot, episode by episode.

    `LeRobotDataset(repo_id, root=out)` reads it, as does any reader of Parquet.

    Args:
        demonstrations: Demonstrations to export.
        out: Folder to create.
        card: Text of a README.md beside the data.
        overwrite: Whether to replace a data set in this folder, once the new one is complete.
        progress: Called with the number of episodes written.

    Returns:
        The folder.

    Raises:
        DemonstrationsError: If pyarrow is not installed, there are no demonstrations, the folder exists,
            another process is writing it, or the disk is full. Nothing is changed then.
    """
    try:
        import pyarrow.parquet  # noqa: F401
    except ModuleNotFoundError as error:
        raise DemonstrationsError(LEROBOT_MISSING) from error
    if not len(demonstrations):
        raise DemonstrationsError(f"{demonstrations.path} has no demonstration to export")
    place = Path(os.path.abspath(out))  # noqa: PTH100 - resolve would follow links of parents too
    if place.is_symlink():
        place = place.resolve()  # else the link would be replaced, and what it leads to would stay
    staging = place.with_name(f".{place.name}.part")
    name = f"the LeRobot data set {place}"
    try:
        with staged(place, staging, marker=INFO, overwrite=overwrite, name=name) as folder:
            _write(folder, demonstrations, progress)
            if card is not None:
                write_atomically(folder / CARD, card)
    except OSError as error:
        reason = error.strerror or str(error)
        raise DemonstrationsError(
            f"the data set cannot be written: {reason}; nothing of it remains"
        ) from error
    return place


def _write(folder: Path, demonstrations: Demonstrations, progress: Callable[[int], None] | None) -> None:
    """Write everything but the card."""
    features, task = _features(demonstrations), _task(demonstrations)
    fps = _fps(demonstrations.scene.simulation.dt)
    total: dict[str, Statistics] = {}
    frames = 0
    with (
        _ParquetFiles(folder / "data", _schema(features)).opened() as data,
        _ParquetFiles(folder / "meta" / "episodes", _episode_schema(features), _ROWS).opened() as episodes,
    ):
        for number, demonstration in enumerate(demonstrations):
            columns = _columns(demonstrations, demonstration, fps)
            length = len(demonstration.rewards)
            columns |= {
                "episode_index": np.full(length, number),
                "index": np.arange(frames, frames + length),
                "task_index": np.zeros(length, dtype=np.int64),
            }
            chunk, file = data.write(columns)
            statistics = {name: _statistics(column) for name, column in columns.items()}
            total = {name: _merged(total.get(name), part) for name, part in statistics.items()}
            row = {
                "episode_index": number,
                "tasks": [task],
                "length": length,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": frames,
                "dataset_to_index": frames + length,
                "problem": demonstration.index,
                "seed": demonstration.seed,
                "cost": demonstration.cost,
            }
            for name, part in statistics.items():
                row |= {f"stats/{name}/{key}": value for key, value in part.items()}
            episodes.write_row(row)
            frames += length
            if progress is not None:
                progress(number + 1)
    _write_names(folder, "task", [task])
    if demonstrations.scene.phases:
        _write_names(folder, "subtask", [phase.name for phase in demonstrations.scene.phases])
    stats = {name: {key: value.tolist() for key, value in part.items()} for name, part in total.items()}
    write_atomically(folder / "meta" / "stats.json", to_json(stats))
    settings = json.dumps(dict(demonstrations.settings), indent=2) + "\n"  # as in `settings.json`: may be inf
    write_atomically(folder / "meta" / "demonstrations.json", settings)
    write_atomically(folder / INFO, to_json(_info(len(demonstrations), frames, fps, features)))


def _info(episodes: int, frames: int, fps: float, features: Features) -> dict[str, Any]:
    return {
        "codebase_version": VERSION,
        "robot_type": "dq_space_arm",
        "total_episodes": episodes,
        "total_frames": frames,
        "total_tasks": 1,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": MEGABYTES,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{episodes}"},
        "data_path": f"data/{FILES}",
        "video_path": None,
        "features": features,
    }


def _fps(dt: float) -> float:
    """Frames per second; an integer, as readers expect, where the time step allows it."""
    fps, whole = 1.0 / dt, round(1.0 / dt)
    return whole if abs(fps - whole) <= 1e-9 * fps else fps


def _task(demonstrations: Demonstrations) -> str:
    scene = demonstrations.scene
    return scene.description or f"Bring the tip of the arm to its target (scene {scene.name})"


def _features(demonstrations: Demonstrations) -> Features:
    """Describe the columns of a row."""
    kernels = demonstrations.kernels
    layout, varying = kernels.layout, kernels.parameters
    state = zip(layout.state.names, layout.state.units, strict=True)
    features = {
        "observation.state": _feature("float64", _with_units(observation_entries(demonstrations.scene))),
        "action": _feature("float64", list(layout.control.names)),
        "next.reward": _feature("float64", ["reward"]),
        "next.done": _feature("bool", ["done"]),
        "state": _feature("float64", _with_units(state)),
    }
    if demonstrations.scene.constraints:
        features["next.cost"] = _feature("float64", ["violations over tolerances"])
    if varying.names:
        named = zip(varying.names, varying.units, strict=True)
        features[PARAMETERS] = _feature("float64", _with_units(named))
    names = (*_COUNTERS, SUBTASK) if demonstrations.scene.phases else _COUNTERS
    counters = {name: {"dtype": "int64", "shape": [1], "names": None} for name in names}
    return features | {"timestamp": {"dtype": "float32", "shape": [1], "names": None}} | counters


def _feature(dtype: str, names: list[str]) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [len(names)], "names": names}


def _with_units(entries: Any) -> list[str]:
    return [f"{name} [{unit}]" for name, unit in entries]


def _columns(
    demonstrations: Demonstrations, demonstration: Demonstration, fps: float
) -> dict[str, NDArray[Any]]:
    """Columns of an episode that do not depend on those before it."""
    kernels, length = demonstrations.kernels, len(demonstration.rewards)
    stages = np.arange(length)
    columns = {
        "observation.state": demonstration.observations[:-1],
        "action": demonstration.actions,
        "next.reward": demonstration.rewards,
        "next.done": stages == length - 1,
        "state": demonstration.states[:-1],
        "timestamp": (stages / fps).astype(np.float32),
        "frame_index": stages,
    }
    if kernels.scene.constraints:
        columns["next.cost"] = demonstration.constraint_costs()[1:]
    if kernels.parameters.names:
        columns[PARAMETERS] = kernels.stage_parameters(demonstration.parameters)[:-1]
    if kernels.scene.phases:
        phases = columns[PARAMETERS][:, kernels.parameters.names.index("phase")]
        columns[SUBTASK] = phases.astype(np.int64)
    return columns


def _statistics(column: NDArray[Any]) -> Statistics:
    """Statistics of the rows of an episode, each of shape (n,); of the count, (1,)."""
    rows = column.reshape(len(column), -1).astype(np.float64)
    quantiles = dict(zip(QUANTILES, np.quantile(rows, list(QUANTILES.values()), axis=0), strict=True))
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
        "count": np.array([len(rows)]),
        **quantiles,
    }


def _merged(total: Statistics | None, part: Statistics) -> Statistics:
    """Statistics of two sets of rows; quantiles, as LeRobot does, by the mean of theirs.

    Mean and variance follow Chan, Golub and LeVeque (1979).
    """
    if total is None:
        return part
    count = total["count"] + part["count"]
    share = part["count"] / count
    merged = {name: total[name] + share * (part[name] - total[name]) for name in ("mean", *QUANTILES)}
    difference = part["mean"] - total["mean"]
    variance = (1.0 - share) * total["std"] ** 2 + share * part["std"] ** 2
    variance += share * (1.0 - share) * difference**2
    return {
        "min": np.minimum(total["min"], part["min"]),
        "max": np.maximum(total["max"], part["max"]),
        "std": np.sqrt(variance),
        "count": count,
        **merged,
    }


class _ParquetFiles:
    """A table in files of bounded size, `chunk-000/file-000.parquet` and on."""

    def __init__(self, folder: Path, schema: Any, rows: int = 0) -> None:
        """Describe the table; `rows` of `write_row` become a group."""
        self._folder, self._schema, self._group = folder, schema, rows
        self._number, self._size = -1, 0
        self._writer: Any = None
        self._rows: list[dict[str, Any]] = []

    @contextmanager
    def opened(self) -> Iterator["_ParquetFiles"]:
        """Complete the last file at the end of a `with` block, and close it in any case."""
        try:
            yield self
            self._flush()
        finally:
            if self._writer is not None:
                self._writer.close()

    def write(self, columns: Mapping[str, NDArray[Any]]) -> tuple[int, int]:
        """Write columns as a row group; return the numbers of its chunk and file."""
        import pyarrow

        arrays = [_arrow(columns[field.name], field.type) for field in self._schema]
        table = pyarrow.Table.from_arrays(arrays, schema=self._schema)
        place = self._place(table.nbytes)
        self._writer.write_table(table)
        return place

    def write_row(self, row: dict[str, Any]) -> None:
        """Write a row, to which the numbers of its chunk and file are added."""
        size = sum(value.nbytes for value in row.values() if isinstance(value, np.ndarray))
        chunk, file = self._place(size)
        self._rows.append({**row, "meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file})
        if len(self._rows) == self._group:
            self._flush()

    def _flush(self) -> None:
        """Write the rows that wait."""
        import pyarrow

        if self._rows:
            self._writer.write_table(pyarrow.Table.from_pylist(self._rows, schema=self._schema))
            self._rows = []

    def _place(self, size: int) -> tuple[int, int]:
        """Make room for some bytes, in a new file if need be; return the numbers of its chunk and file."""
        from pyarrow import parquet

        if self._writer is None or self._size + size > MEGABYTES * 2**20:
            if self._writer is not None:
                self._flush()
                self._writer.close()
            self._number, self._size = self._number + 1, 0
            chunk, file = divmod(self._number, CHUNK)
            path = self._folder / FILES.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            # A dictionary of numbers that hardly repeat would add a sixth.
            self._writer = parquet.ParquetWriter(path, self._schema, use_dictionary=False)
        self._size += size
        return divmod(self._number, CHUNK)


def _arrow(column: NDArray[Any], kind: Any) -> Any:
    """A column as pyarrow has it, of numbers or of lists of a fixed size."""
    import pyarrow

    flat = pyarrow.array(np.ascontiguousarray(column).reshape(-1))
    if pyarrow.types.is_fixed_size_list(kind):
        flat = pyarrow.FixedSizeListArray.from_arrays(flat, kind.list_size)
    return flat


def _schema(features: Features) -> Any:
    """Types of the columns of a stage: a number where a feature has one entry, as LeRobot reads it."""
    import pyarrow

    fields = []
    for name, feature in features.items():
        kind = pyarrow.bool_() if feature["dtype"] == "bool" else getattr(pyarrow, feature["dtype"])()
        (width,) = feature["shape"]
        fields.append((name, kind if width == 1 else pyarrow.list_(kind, width)))
    return pyarrow.schema(fields)


def _episode_schema(features: Features) -> Any:
    """Types of the columns of an episode."""
    import pyarrow

    numbers = ("data/chunk_index", "data/file_index", "dataset_from_index", "dataset_to_index")
    places = ("meta/episodes/chunk_index", "meta/episodes/file_index")
    whole, real = pyarrow.int64(), pyarrow.float64()
    fields = [("episode_index", whole), ("tasks", pyarrow.list_(pyarrow.string())), ("length", whole)]
    fields += [(name, whole) for name in (*numbers, "problem", "seed")] + [("cost", real)]
    for feature in features:
        fields += [
            (f"stats/{feature}/{key}", pyarrow.list_(real))
            for key in ("min", "max", "mean", "std", *QUANTILES)
        ]
        fields.append((f"stats/{feature}/count", pyarrow.list_(whole)))
    return pyarrow.schema(fields + [(name, whole) for name in places])


def _write_names(folder: Path, what: str, names: list[str]) -> None:
    """Write the table of tasks or subtasks. LeRobot reads it through pandas, with the words as its index."""
    import pyarrow
    from pyarrow import parquet

    number = f"{what}_index"
    pandas = {
        "index_columns": [what],
        "column_indexes": [],
        "columns": [_pandas_column(number, "int64", "int64"), _pandas_column(what, "unicode", "object")],
    }
    table = pyarrow.table({number: range(len(names)), what: names})
    table = table.replace_schema_metadata({"pandas": json.dumps(pandas)})
    parquet.write_table(table, folder / "meta" / f"{what}s.parquet")


def _pandas_column(name: str, pandas_type: str, numpy_type: str) -> dict[str, Any]:
    return {
        "name": name,
        "field_name": name,
        "pandas_type": pandas_type,
        "numpy_type": numpy_type,
        "metadata": None,
    }
