"""Demonstrations as a LeRobot dataset, version 3.0 of its format; lerobot itself is not needed.

A frame is one control step: the observation before it, the action, the outcome after it. So the
last observation of an episode is left out. The gripper's fields are LeRobot's
``observation.state``, the task's fields its ``observation.environment_state``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow as pa
import torch
from pyarrow import parquet

from symsteer.bench.bundles.card import dataset_card
from symsteer.bench.bundles.contents import Contents
from symsteer.bench.bundles.film import CODEC, PIXELS, film_demonstrations
from symsteer.bench.bundles.manifest import Code
from symsteer.bench.demos import load
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.film import FRAMES_PER_SECOND
from symsteer.bench.runs.folder import write_json
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.tasks import TASKS, task_class
from symsteer.bench.tasks.embodiments import BODIES
from symsteer.errors import UserError
from symsteer.files import staged
from symsteer.policies.geometry import Field, Layout

VERSION = "v3.0"
IMAGE = "observation.image"
FIRST = "chunk-000/file-000"
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def split(obs: Any, task: str) -> tuple[Any, Any]:
    """The parts of an observation ``[..., obs_dim]`` of a task that LeRobot keeps apart.

    Returns:
        The gripper's fields and the task's fields.
    """
    width = Layout(task_class(task).gripper_fields).dim
    return obs[..., :width], obs[..., width:]


def check_folder(out: Path) -> None:
    """Check that a dataset can be written to a folder, before anything is computed.

    Raises:
        UserError: if something is there already.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise UserError(f"{out} exists already; give --out a new folder for the dataset")


def write_dataset(
    contents: Contents, out: Path, videos: Literal["auto", "on", "off"] = "auto"
) -> str:
    """Write demonstrations as a LeRobot dataset; the folder appears whole or not at all.

    Args:
        contents: whose demonstrations.
        out: a new folder.
        videos: whether to render the demonstrations; ``auto``: where a Vulkan driver works.

    Returns:
        What was written, in one line.

    Raises:
        UserError: if ``out`` exists or cannot be written, or a video is wanted and nothing renders
            here.
    """
    check_folder(out)
    assert contents.demonstrations is not None
    config, path = contents.config, contents.demonstrations
    demos = load(path, config.task, config.embodiment, config.demonstrations.count)
    lengths = [len(actions) for _, actions in demos.episodes]
    film = videos == "on" or (videos == "auto" and rendering_works())
    with staged(out) as partial:
        pixels = None
        if film:
            file = partial / "videos" / IMAGE / f"{FIRST}.mp4"
            pixels = film_demonstrations(config, path, lengths, file)
        _write_tables(config, _columns(demos.episodes, config.task), lengths, pixels, partial)
        card = dataset_card(contents, len(lengths), sum(lengths), film)
        (partial / "README.md").write_text(card)
        write_json(partial / "meta/symsteer.json", _origin(config))
    seen = "with a video" if film else "without a video"
    why = "" if film or videos == "off" else ", because no Vulkan driver was found"
    return f"wrote {out}: {len(lengths)} episodes, {sum(lengths)} frames, {seen}{why}"


def _columns(
    episodes: Sequence[tuple[torch.Tensor, torch.Tensor]], task: str
) -> dict[str, np.ndarray]:
    """All frames of all episodes by column; each episode ends with its only success."""
    lengths = [len(actions) for _, actions in episodes]
    state, environment = split(np.concatenate([obs[:-1].numpy() for obs, _ in episodes]), task)
    step = np.concatenate([np.arange(length) for length in lengths])
    last = np.concatenate([np.arange(length) == length - 1 for length in lengths])
    return {
        "observation.state": state,
        "observation.environment_state": environment,
        "action": np.concatenate([actions.numpy() for _, actions in episodes]),
        "next.reward": last.astype(np.float32),
        "next.success": last,
        "next.done": last,
        "timestamp": (step / FRAMES_PER_SECOND).astype(np.float32),
        "frame_index": step,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(len(step)),
        "task_index": np.zeros(len(step), dtype=int),
    }


def _write_tables(
    config: RunConfig,
    columns: Mapping[str, np.ndarray],
    lengths: Sequence[int],
    pixels: Sequence[np.ndarray] | None,
    out: Path,
) -> None:
    """The frames, and all that LeRobot wants to know about them; ``pixels`` for statistics."""
    described = _features(config, columns, pixels is not None)
    instruction = TASKS.summary(config.task)
    ends = np.cumsum(lengths).tolist()
    rows = []
    for i, (begin, end) in enumerate(zip([0, *ends], ends, strict=False)):
        seen = {} if pixels is None else {IMAGE: pixels[i]}
        stats = _statistics({name: values[begin:end] for name, values in columns.items()}, seen)
        row = {
            "episode_index": i,
            "tasks": [instruction],
            "length": end - begin,
            "dataset_from_index": begin,
            "dataset_to_index": end,
        }
        parts = ["data", "meta/episodes", *(f"videos/{name}" for name in seen)]
        row |= {f"{part}/{kind}_index": 0 for part in parts for kind in ("chunk", "file")}
        for name in seen:
            row[f"videos/{name}/from_timestamp"] = begin / FRAMES_PER_SECOND
            row[f"videos/{name}/to_timestamp"] = end / FRAMES_PER_SECOND
        for name, found in stats.items():
            row |= {f"stats/{name}/{kind}": value for kind, value in found.items()}
        rows.append(row)
    table = pa.table({n: _column(values) for n, values in columns.items()})
    tasks = pd.DataFrame({"task_index": [0]}, index=[instruction])
    for name, content in {
        f"data/{FIRST}": table,
        f"meta/episodes/{FIRST}": pa.Table.from_pylist(rows),
        "meta/tasks": pa.Table.from_pandas(tasks),
    }.items():
        file = out / f"{name}.parquet"
        file.parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(content, file)
    seen = {} if pixels is None else {IMAGE: np.concatenate(pixels)}
    write_json(out / "meta/stats.json", _statistics(columns, seen))
    write_json(
        out / "meta/info.json",
        {
            "codebase_version": VERSION,
            "robot_type": BODIES[config.embodiment].robot_uid,
            "total_episodes": len(lengths),
            "total_frames": sum(lengths),
            "total_tasks": 1,
            "chunks_size": 1000,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "fps": FRAMES_PER_SECOND,
            "splits": {"train": f"0:{len(lengths)}"},
            "data_path": f"data/{CHUNK}.parquet",
            "video_path": None if pixels is None else f"videos/{{video_key}}/{CHUNK}.mp4",
            "features": described,
        },
    )


def _features(
    config: RunConfig, columns: Mapping[str, np.ndarray], film: bool
) -> dict[str, dict[str, Any]]:
    """Type, shape and names of every column, and of the video."""
    task = task_class(config.task)
    fields = {
        "observation.state": task.gripper_fields,
        "observation.environment_state": task.task_fields,
        "action": task.action_layout.fields,
    }
    found: dict[str, dict[str, Any]] = {}
    for name, values in columns.items():
        names = _names(fields[name]) if name in fields else None
        shape = list(values.shape[1:]) or [1]
        found[name] = {"dtype": str(values.dtype), "shape": shape, "names": names}
    if film:
        found[IMAGE] = {
            "dtype": "video",
            "shape": [PIXELS, PIXELS, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": PIXELS,
                "video.width": PIXELS,
                "video.codec": CODEC,
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": FRAMES_PER_SECOND,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    return found


def _names(fields: Sequence[Field]) -> list[str]:
    """A name for each number; those of a field with several are counted."""
    return [f"{f.name}_{i}" if f.dim > 1 else f.name for f in fields for i in range(f.dim)]


def _column(values: np.ndarray) -> pa.Array:
    flat = pa.array(values.reshape(-1))
    return flat if values.ndim == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _statistics(
    columns: Mapping[str, np.ndarray], pictures: Mapping[str, np.ndarray]
) -> dict[str, dict[str, Any]]:
    """Statistics of each number, and of each colour in [0, 1], as plain data."""
    found = {n: _spread(values.reshape(len(values), -1)) for n, values in columns.items()}
    for name, pixels in pictures.items():
        # LeRobot wants a number of frames, and colours as [3, 1, 1].
        colours = _spread(pixels.reshape(-1, 3) / 255)
        found[name] = {k: [[[x]] for x in value] for k, value in colours.items()}
        found[name]["count"] = [len(pixels)]
    return found


def _spread(values: np.ndarray) -> dict[str, list]:
    """Statistics of the columns of ``values [T, D]``."""
    numbers = values.astype(np.float64)
    spread = {"min": values.min(0), "max": values.max(0)}
    spread |= {"mean": numbers.mean(0), "std": numbers.std(0)}
    spread |= {name: np.quantile(numbers, q, axis=0) for name, q in QUANTILES.items()}
    return {"count": [len(values)], **{name: value.tolist() for name, value in spread.items()}}


def _origin(config: RunConfig) -> dict[str, Any]:
    """What SymSteer knows beyond LeRobot's format: settings, code, geometry of the vectors."""
    task = task_class(config.task)
    return {
        "task": config.task,
        "embodiment": config.embodiment,
        "demonstrations": vars(config.demonstrations),
        "code": Code.here().model_dump(),
        "observation_layout": task.observation_layout.to_json(),
        "action_layout": task.action_layout.to_json(),
    }
