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
from pyarrow import parquet

from symsteer.bench.bundles.bundle import LICENCES
from symsteer.bench.bundles.fetch import Code
from symsteer.bench.bundles.film import CODEC, PIXELS, film_demonstrations
from symsteer.bench.demos import Demonstrations, load
from symsteer.bench.runs.film import FRAMES_PER_SECOND
from symsteer.bench.runs.folder import write_json
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.tasks import TASKS, task_class
from symsteer.bench.tasks.embodiments import BODIES
from symsteer.errors import UserError
from symsteer.files import staged
from symsteer.policies.geometry import Field, Layout
from symsteer.terminal import to_paste

VERSION = "v3.0"
IMAGE = "observation.image"
FIRST = "chunk-000/file-000"
CHUNK = "chunk-{chunk_index:03d}/file-{file_index:03d}"
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def write_dataset(path: Path, out: Path, videos: Literal["auto", "on", "off"] = "auto") -> str:
    """Write demonstrations as a LeRobot dataset; the folder appears whole or not at all.

    Args:
        path: the .h5 file of demonstrations, written by `symsteer demos` or by a run.
        out: a new folder.
        videos: whether to render the demonstrations; ``auto``: where a Vulkan driver works.

    Returns:
        What was written, in one line.

    Raises:
        UserError: if the demonstrations cannot be read or are not ours, ``out`` exists or cannot be
            written, or a video is wanted and nothing renders here.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise UserError(f"{out} exists already; give --out a new folder for the dataset")
    demos = load(path)
    task, embodiment = demos.meta["task"], demos.meta["embodiment"]
    if demos.meta["seed"] is None:
        raise UserError(f"{path} is not a file of SymSteer; write one with `symsteer demos`")
    lengths = [len(actions) for _, actions in demos.episodes]
    film = videos == "on" or (videos == "auto" and rendering_works())
    with staged(out) as partial:
        pixels = None
        if film:
            video = partial / "videos" / IMAGE / f"{FIRST}.mp4"
            pixels = film_demonstrations(path, task, embodiment, lengths, video)
        _write_tables(demos, lengths, pixels, partial)
        (partial / "README.md").write_text(_card(path.stem, demos.meta, film))
        origin = {
            "task": task,
            "embodiment": embodiment,
            "demonstrations": {
                "mode": demos.meta["mode"],
                "count": len(demos),
                "seed": demos.meta["seed"],
            },
            "code": Code.here().model_dump(),
            "observation_layout": demos.observation_layout.to_json(),
            "action_layout": demos.action_layout.to_json(),
        }
        write_json(partial / "meta/symsteer.json", origin)
    seen = "with a video" if film else "without a video"
    why = "" if film or videos == "off" else ", because no Vulkan driver was found"
    return f"wrote {out}: {len(lengths)} episodes, {sum(lengths)} frames, {seen}{why}"


def _card(name: str, meta: Mapping[str, Any], film: bool) -> str:
    """The text of the dataset, with the header that dataset hubs read."""
    world = ("--task", meta["task"], "--embodiment", meta["embodiment"])
    how = ("--count", meta["episodes"], "--mode", meta["mode"], "--seed", meta["seed"])
    command = to_paste("symsteer", "demos", f"{name}.h5", *world, *how)
    blocks = [
        "---\nlicense: apache-2.0\ntask_categories:\n- robotics\ntags:\n- LeRobot\nconfigs:\n"
        "- config_name: default\n  data_files: data/*/*.parquet\n---",
        f"# {name}",
        f"{meta['episodes']} {meta['mode']} demonstrations of a scripted expert, {meta['steps']} "
        f"frames, for `{meta['task']}` with the embodiment `{meta['embodiment']}`. Written by "
        f"{Code.here()}, in LeRobot's dataset format {VERSION}.",
        f"The task: {TASKS.summary(meta['task'])}",
        "`observation.state` is the gripper's pose and width, `observation.environment_state` what "
        "is observed of the objects; `meta/symsteer.json` says which numbers are vectors. Every "
        "episode ends with its success.",
        f"## How it was made\n\n```sh\n{command}\n```",
        f"## Licence\n\n{LICENCES}{' The video shows these assets.' * film}",
    ]
    return "\n\n".join(blocks) + "\n"


def _write_tables(
    demos: Demonstrations, lengths: Sequence[int], pixels: Sequence[np.ndarray] | None, out: Path
) -> None:
    """The frames, and all that LeRobot wants to know about them; ``pixels`` for statistics."""
    task = task_class(demos.meta["task"])
    obs = np.concatenate([seen[:-1].numpy() for seen, _ in demos.episodes])
    width = Layout(task.gripper_fields).dim
    step = np.concatenate([np.arange(length) for length in lengths])
    last = np.concatenate([np.arange(length) == length - 1 for length in lengths])
    columns = {
        "observation.state": obs[:, :width],
        "observation.environment_state": obs[:, width:],
        "action": np.concatenate([actions.numpy() for _, actions in demos.episodes]),
        "next.reward": last.astype(np.float32),
        "next.success": last,
        "next.done": last,
        "timestamp": (step / FRAMES_PER_SECOND).astype(np.float32),
        "frame_index": step,
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "index": np.arange(len(step)),
        "task_index": np.zeros(len(step), dtype=int),
    }
    names = {
        "observation.state": _names(task.gripper_fields),
        "observation.environment_state": _names(task.task_fields),
        "action": _names(demos.action_layout.fields),
    }
    features: dict[str, dict[str, Any]] = {
        name: {
            "dtype": str(values.dtype),
            "shape": list(values.shape[1:]) or [1],
            "names": names.get(name),
        }
        for name, values in columns.items()
    }
    if pixels is not None:
        features[IMAGE] = _video_feature()
    instruction = TASKS.summary(demos.meta["task"])
    ends = np.cumsum(lengths).tolist()
    episodes = []
    for i, (begin, end) in enumerate(zip([0, *ends], ends, strict=False)):
        seen = {} if pixels is None else {IMAGE: pixels[i]}
        stats = _statistics({name: values[begin:end] for name, values in columns.items()}, seen)
        episode = {
            "episode_index": i,
            "tasks": [instruction],
            "length": end - begin,
            "dataset_from_index": begin,
            "dataset_to_index": end,
        }
        files = ["data", "meta/episodes", *(f"videos/{name}" for name in seen)]
        episode |= {f"{file}/{kind}_index": 0 for file in files for kind in ("chunk", "file")}
        for name in seen:
            episode[f"videos/{name}/from_timestamp"] = begin / FRAMES_PER_SECOND
            episode[f"videos/{name}/to_timestamp"] = end / FRAMES_PER_SECOND
        for name, spread in stats.items():
            episode |= {f"stats/{name}/{kind}": value for kind, value in spread.items()}
        episodes.append(episode)
    tasks = pd.DataFrame({"task_index": [0]}, index=[instruction])
    for name, content in {
        f"data/{FIRST}": pa.table({n: _column(values) for n, values in columns.items()}),
        f"meta/episodes/{FIRST}": pa.Table.from_pylist(episodes),
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
            "robot_type": BODIES[demos.meta["embodiment"]].robot_uid,
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
            "features": features,
        },
    )


def _video_feature() -> dict[str, Any]:
    return {
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
    spreads = {n: _spread(values.reshape(len(values), -1)) for n, values in columns.items()}
    for name, pixels in pictures.items():
        # LeRobot wants a number of frames, and colours as [3, 1, 1].
        colours = _spread(pixels.reshape(-1, 3) / 255)
        spreads[name] = {k: [[[x]] for x in value] for k, value in colours.items()}
        spreads[name]["count"] = [len(pixels)]
    return spreads


def _spread(values: np.ndarray) -> dict[str, list]:
    """Statistics of the columns of ``values [T, D]``."""
    numbers = values.astype(np.float64)
    spread = {"min": values.min(0), "max": values.max(0)}
    spread |= {"mean": numbers.mean(0), "std": numbers.std(0)}
    spread |= {name: np.quantile(numbers, q, axis=0) for name, q in QUANTILES.items()}
    return {"count": [len(values)], **{name: value.tolist() for name, value in spread.items()}}
