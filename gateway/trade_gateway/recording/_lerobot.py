"""Exports episodes as tables in the layout of LeRobot datasets v3.0, without pictures.

Facts of the layout: huggingface.co/docs/lerobot, "LeRobotDataset v3.0".
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any, Final

from trade.errors import ConfigurationError
from trade_gateway.recording._episodes import Episode

_FILE: Final = "chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_FIRST: Final = _FILE.format(chunk_index=0, file_index=0)
_WHERE: Final = ("data/chunk_index", "data/file_index", "meta/episodes/chunk_index", "meta/episodes/file_index")
"""For each episode, its files. All are in the first one."""
_VECTORS: Final = ("observation.state", "action")
_NUMBERS: Final = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_CARD: Final = """---
task_categories: [robotics]
tags: [LeRobot]
configs:
- config_name: default
  data_files: data/*/*.parquet
---
Joint angles in rad, and widths of grippers in m, of {robot}, exported by `trade export` from {source}.
`observation.state` is what was measured; `action` is what was measured one frame later, not what was commanded.
"""


def write(folder: Path, robot: str, joints: Sequence[str], fps: int, episodes: Sequence[Episode], source: str) -> None:
    """Creates a dataset.

    Args:
        folder: created; it may exist if it is empty.
        robot: the joints' robot.
        joints: their names, in the order of the frames.
        fps: frames per second.
        episodes: at least one.
        source: the recording.

    Raises:
        ConfigurationError: the folder is not empty, or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if any(folder.iterdir()):
            raise ConfigurationError(where=str(folder), problem="is not empty; existing files are not overwritten")
        for part in ("data/chunk-000", "meta/episodes/chunk-000"):
            (folder / part).mkdir(parents=True)
        tasks = list(dict.fromkeys(episode.task for episode in episodes))
        _write_data(folder / "data" / _FIRST, len(joints), fps, tasks, episodes)
        _write_episodes(folder / "meta/episodes" / _FIRST, episodes)
        _write_tasks(folder / "meta/tasks.parquet", tasks)
        _write_json(folder / "meta/info.json", _info(robot, joints, fps, len(tasks), episodes))
        _write_json(folder / "meta/stats.json", _stats(episodes))
        (folder / "README.md").write_text(_CARD.format(robot=robot, source=source), encoding="utf-8")
    except OSError as bad:
        raise ConfigurationError(where=str(folder), problem=f"cannot be written: {bad.strerror}") from None


def _write_data(path: Path, width: int, fps: int, tasks: Sequence[str], episodes: Sequence[Episode]) -> None:
    """Writes one group of rows per episode."""
    arrow, parquet = _libraries()
    vector = arrow.list_(arrow.float32(), width)
    columns = [(name, vector) for name in _VECTORS] + [
        (name, getattr(arrow, kind)()) for name, kind in _NUMBERS.items()
    ]
    schema = arrow.schema(columns)
    begun = 0
    with parquet.ParquetWriter(path, schema) as writer:
        for number, episode in enumerate(episodes):
            count = len(episode.states)
            rows: Mapping[str, Any] = {
                "observation.state": episode.states,
                "action": episode.actions,
                "timestamp": [frame / fps for frame in range(count)],
                "frame_index": range(count),
                "episode_index": [number] * count,
                "index": range(begun, begun + count),
                "task_index": [tasks.index(episode.task)] * count,
            }
            writer.write_table(arrow.table(dict(rows), schema=schema))
            begun += count


def _write_episodes(path: Path, episodes: Iterable[Episode]) -> None:
    arrow, parquet = _libraries()
    rows: list[dict[str, Any]] = []
    begun = 0
    for number, episode in enumerate(episodes):
        ended = begun + len(episode.states)
        span = {"length": ended - begun, "dataset_from_index": begun, "dataset_to_index": ended}
        rows.append({"episode_index": number, "tasks": [episode.task], **span, **dict.fromkeys(_WHERE, 0)})
        begun = ended
    parquet.write_table(arrow.Table.from_pylist(rows), path)


def _write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Writes the tasks. Readers expect a pandas frame with the task as index."""
    arrow, parquet = _libraries()
    kinds = (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in kinds
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": described, "pandas_version": "2.0.0"}
    table = arrow.table({"task_index": arrow.array(range(len(tasks)), arrow.int64()), "task": list(tasks)})
    parquet.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)


def _info(robot: str, joints: Sequence[str], fps: int, tasks: int, episodes: Sequence[Episode]) -> dict[str, Any]:
    vectors = {name: {"dtype": "float32", "shape": [len(joints)], "names": list(joints)} for name in _VECTORS}
    numbers = {name: {"dtype": kind, "shape": [1], "names": None} for name, kind in _NUMBERS.items()}
    return {
        "codebase_version": "v3.0",
        "robot_type": robot,
        "total_episodes": len(episodes),
        "total_frames": sum(len(episode.states) for episode in episodes),
        "total_tasks": tasks,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 500,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": f"data/{_FILE}",
        "video_path": None,
        "features": {**vectors, **numbers},
    }


def _stats(episodes: Sequence[Episode]) -> dict[str, dict[str, list[float]]]:
    """Statistics of each joint over all frames, for normalisation."""
    values = {
        "observation.state": [row for episode in episodes for row in episode.states],
        "action": [row for episode in episodes for row in episode.actions],
    }
    return {name: _stats_of(list(zip(*rows, strict=True))) for name, rows in values.items()}


def _stats_of(columns: Sequence[Sequence[float]]) -> dict[str, list[float]]:
    means = [math.fsum(column) / len(column) for column in columns]
    squares = [math.fsum((value - mean) ** 2 for value in column) for column, mean in zip(columns, means, strict=True)]
    return {
        "min": [min(column) for column in columns],
        "max": [max(column) for column in columns],
        "mean": means,
        "std": [math.sqrt(square / len(columns[0])) for square in squares],
        "count": [len(columns[0])],
    }


def _write_json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value, indent=4, ensure_ascii=False), encoding="utf-8")


def _libraries() -> tuple[Any, Any]:
    return import_module("pyarrow"), import_module("pyarrow.parquet")
