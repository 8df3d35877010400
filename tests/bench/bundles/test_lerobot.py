"""Datasets and environments for LeRobot: by the format's text here, by lerobot in a slow test."""

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import h5py
import imageio.v2 as imageio
import numpy as np
import pytest

from symsteer.bench.bundles.film import PIXELS, RENDERING
from symsteer.bench.demos import load
from symsteer.bench.demos.files import checksum
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.tasks import make, task_class
from symsteer.errors import UserError

pd = pytest.importorskip("pandas", exc_type=ImportError)
parquet = pytest.importorskip("pyarrow.parquet", exc_type=ImportError)

from symsteer.bench.bundles.lerobot import write_dataset  # noqa: E402

ROOT = Path(__file__).parents[3]
EXAMPLE = ROOT / "examples" / "lerobot"
needs_vulkan = pytest.mark.skipif(not rendering_works(), reason="needs a Vulkan driver")


@pytest.fixture(scope="module")
def path(run):
    """The demonstrations of the run."""
    return next(run.parent.glob("base/*.h5"))


@pytest.fixture(scope="module")
def demos(path):
    return load(path)


@pytest.fixture(scope="module")
def dataset(path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("lerobot") / "dataset"
    assert "without a video" in write_dataset(path, folder, "off")
    return folder


@pytest.fixture(scope="module")
def filmed(path, tmp_path_factory):
    folder = tmp_path_factory.mktemp("lerobot") / "filmed"
    assert "with a video" in write_dataset(path, folder, "on")
    return folder


def info(folder):
    return json.loads((folder / "meta/info.json").read_text())


def rows(folder, name):
    return parquet.read_table(folder / f"{name}/chunk-000/file-000.parquet")


# ------------------------------------------------------------------ the files


def test_the_files_are_those_of_the_format(dataset, demos):
    files = (path for path in dataset.rglob("*") if path.is_file())
    names = {path.relative_to(dataset).as_posix() for path in files}
    assert names == {
        "README.md",
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        *(f"meta/{name}" for name in ("info.json", "stats.json", "symsteer.json", "tasks.parquet")),
    }
    found, frames = info(dataset), sum(len(taken) for _, taken in demos.episodes)
    assert found["data_path"].format(chunk_index=0, file_index=0) in names
    expected = {
        **{"codebase_version": "v3.0", "fps": 20, "video_path": None, "total_tasks": 1},
        **{"total_episodes": len(demos), "total_frames": frames},
        "splits": {"train": f"0:{len(demos)}"},
    }
    assert {key: found[key] for key in expected} == expected
    head, _, text = (dataset / "README.md").read_text().removeprefix("---\n").partition("---\n")
    assert "license: apache-2.0" in head
    assert "data_files: data/*/*.parquet" in head
    assert "symsteer demos" in text
    origin = json.loads((dataset / "meta/symsteer.json").read_text())
    assert origin["demonstrations"] == {"mode": "diverse", "count": 3, "seed": 0}
    assert origin["observation_layout"] == demos.observation_layout.to_json()


def test_frames_are_the_observations_and_actions_of_the_demonstrations(dataset, demos):
    table = rows(dataset, "data")
    columns = {n: np.array(table[n].to_pylist()) for n in table.column_names}
    obs = np.concatenate([seen[:-1] for seen, _ in demos.episodes])
    actions = np.concatenate([taken for _, taken in demos.episodes])
    lengths = [len(taken) for _, taken in demos.episodes]
    parts = [columns[f"observation.{name}"] for name in ("state", "environment_state")]
    np.testing.assert_array_equal(np.concatenate(parts, axis=1).astype(np.float32), obs)
    np.testing.assert_array_equal(columns["action"].astype(np.float32), actions)
    np.testing.assert_array_equal(columns["index"], np.arange(sum(lengths)))
    np.testing.assert_array_equal(columns["episode_index"], np.repeat(range(len(lengths)), lengths))
    steps = np.concatenate([np.arange(length) for length in lengths])
    np.testing.assert_array_equal(columns["frame_index"], steps)
    np.testing.assert_allclose(columns["timestamp"], steps / 20, atol=1e-6)
    ends = columns["frame_index"] == np.array(lengths)[columns["episode_index"]] - 1
    for name in ("next.reward", "next.success", "next.done"):
        np.testing.assert_array_equal(columns[name], ends)
    assert set(columns["task_index"]) == {0}
    features = info(dataset)["features"]
    assert features.keys() == columns.keys()
    for name, feature in features.items():
        kind = table.schema.field(name).type
        if feature["shape"] == [1]:
            assert str(kind).replace("float", "float32") == feature["dtype"]
        else:
            assert (str(kind.value_type), feature["dtype"]) == ("float", "float32")
            assert [kind.list_size] == feature["shape"] == [len(set(feature["names"]))]
    names = features["observation.environment_state"]["names"]
    assert names[:3] == ["cube_xy_0", "cube_xy_1", "cube_z"]


def test_episodes_and_tasks_are_listed(dataset, demos):
    episodes = rows(dataset, "meta/episodes").to_pandas()
    ends = np.cumsum([len(taken) for _, taken in demos.episodes]).tolist()
    assert episodes["dataset_to_index"].tolist() == ends
    assert episodes["dataset_from_index"].tolist() == [0, *ends[:-1]]
    assert episodes["length"].tolist() == np.diff([0, *ends]).tolist()
    assert episodes["episode_index"].tolist() == list(range(len(demos)))
    files = [
        f"{part}/{kind}_index" for part in ("data", "meta/episodes") for kind in ("chunk", "file")
    ]
    assert not episodes[files].to_numpy().any()
    (task,) = {task for tasks in episodes["tasks"] for task in tasks}
    tasks = pd.read_parquet(dataset / "meta/tasks.parquet")
    assert (tasks.index.tolist(), tasks["task_index"].tolist()) == ([task], [0])


def test_statistics_are_those_of_the_numbers(dataset, demos):
    stats = json.loads((dataset / "meta/stats.json").read_text())
    assert stats.keys() == info(dataset)["features"].keys()
    second = rows(dataset, "meta/episodes").to_pylist()[1]
    actions = [taken.double().numpy() for _, taken in demos.episodes]
    for found, values in (
        (stats["action"], np.concatenate(actions)),
        ({k.rpartition("/")[2]: v for k, v in second.items() if "/action/" in k}, actions[1]),
    ):
        assert found["count"] == [len(values)]
        wanted = {"min": values.min(0), "max": values.max(0), "std": values.std(0)}
        wanted |= {"mean": values.mean(0), "q10": np.quantile(values, 0.1, axis=0)}
        for name, value in wanted.items():
            np.testing.assert_allclose(found[name], value, atol=1e-9, err_msg=name)


@needs_vulkan
def test_the_video_has_a_frame_for_each_action(filmed, path, demos):
    found = info(filmed)
    video = found["video_path"].format(video_key="observation.image", chunk_index=0, file_index=0)
    frames = np.stack(imageio.mimread(filmed / video))
    assert frames.shape == (found["total_frames"], PIXELS, PIXELS, 3)
    assert found["features"]["observation.image"]["shape"] == [PIXELS, PIXELS, 3]
    episodes = rows(filmed, "meta/episodes").to_pylist()
    for episode in episodes:
        begin = episode["videos/observation.image/from_timestamp"]
        assert begin == pytest.approx(episode["dataset_from_index"] / found["fps"])
        assert episode["videos/observation.image/to_timestamp"] > begin
        assert np.shape(episode["stats/observation.image/mean"]) == (3, 1, 1)
    # The second episode begins with the picture of its seed.
    description = json.loads(path.with_suffix(".json").read_text())
    env = make("PickCube-v1", num_envs=1, **RENDERING)
    env.reset(seed=description["episodes"][1]["episode_seed"])
    picture = env.render()[0].numpy().astype(float)
    env.close()
    first = len(demos.episodes[0][1])
    error = np.abs(frames[[0, first]].astype(float) - picture).mean(axis=(1, 2, 3))
    assert error[1] < min(5, error[0])


# ------------------------------------------------------------------ mistakes


def test_a_folder_with_something_in_it_stays_as_it_is(path, tmp_path):
    (tmp_path / "mine").write_text("text")
    with pytest.raises(UserError, match="exists already"):
        write_dataset(path, tmp_path, "off")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


@pytest.mark.skipif(rendering_works(), reason="needs a machine without a Vulkan driver")
def test_a_video_where_nothing_renders_leaves_nothing_behind(path, tmp_path):
    with pytest.raises(UserError, match="Vulkan"):
        write_dataset(path, tmp_path / "new", "on")
    assert not list(tmp_path.iterdir())


def test_without_pyarrow_the_command_says_what_to_install(path, tmp_path, monkeypatch, command):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.delitem(sys.modules, "symsteer.bench.bundles.lerobot")
    code, shown = command("export-lerobot", path, "--out", tmp_path / "new")
    assert code == 2
    assert 'pip install "symsteer[lerobot]"' in shown.err


def test_the_command_line_writes_a_dataset(path, demos, tmp_path, command):
    code, shown = command("export-lerobot", path, "--videos", "off", "--out", tmp_path / "new")
    assert code == 0
    assert f"{len(demos)} episodes" in shown.out
    assert [found.name for found in tmp_path.iterdir()] == ["new"]


def test_demonstrations_of_others_are_refused(path, tmp_path):
    for file in (path, path.with_suffix(".json")):
        shutil.copy(file, tmp_path / f"theirs{file.suffix}")
    side = tmp_path / "theirs.json"
    description = json.loads(side.read_text())
    del description["symsteer"]["seed"]
    with h5py.File(tmp_path / "theirs.h5", "r+") as file:
        file.attrs["sha256"] = checksum(file, description)
    side.write_text(json.dumps(description))
    with pytest.raises(UserError, match="is not a file of SymSteer; write one with"):
        write_dataset(tmp_path / "theirs.h5", tmp_path / "new", "off")


# ------------------------------------------------------------------ the environment hub


@pytest.fixture(scope="module")
def hub():
    """The module as LeRobot loads it: from its path."""
    spec = importlib.util.spec_from_file_location("hub_env", EXAMPLE / "env.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_environment_plays_the_demonstrations(hub, path, demos):
    """Observations, actions and success are those of the dataset."""
    ((task, numbered),) = hub.make_env(n_envs=2, use_async_envs=True).items()
    envs = numbered[0]
    assert task == "PickCube-v1"
    assert envs.call("_max_episode_steps") == (50, 50)
    assert envs.call("task_description")[0] == "Pick up a cube and hold it at a goal in the air."
    description = json.loads(path.with_suffix(".json").read_text())
    seed = description["episodes"][1]["episode_seed"]
    seen, taken = demos.episodes[1]
    try:
        obs, _ = envs.reset(seed=[seed, seed])
        for step, action in enumerate(taken.numpy()):
            joined = np.concatenate([obs["agent_pos"], obs["environment_state"]], axis=1)
            np.testing.assert_allclose(joined[0], seen[step], atol=1e-5)
            obs, reward, terminated, _, info = envs.step(np.stack([action, 0 * action]))
        assert (reward.tolist(), terminated.tolist()) == ([1, 0], [True, False])
        assert info["final_info"]["is_success"].tolist() == [True, False]
    finally:
        envs.close()


def test_a_configuration_may_name_another_task(hub):
    config = type("EnvConfig", (), {"task": "PushCube-v1"})()
    ((task, numbered),) = hub.make_env(cfg=config).items()
    assert task == "PushCube-v1"
    assert numbered[0].envs[0].observation_space["environment_state"].shape == (
        *(sum(field.dim for field in task_class(task).task_fields),),
    )
    numbered[0].close()


@needs_vulkan
def test_the_environment_can_show_pictures(hub):
    env = hub.LeRobotEnv("PickCube-v1", images=True)
    obs, _ = env.reset(seed=0)
    assert obs in env.observation_space
    assert obs["pixels"].std() > 0
    assert env.render().shape == (PIXELS, PIXELS, 3)
    env.close()


# ------------------------------------------------------------------ lerobot itself


@pytest.fixture(scope="module")
def lerobot(tmp_path_factory):
    """Python of an environment with lerobot and this SymSteer, as examples/lerobot says."""
    folder = tmp_path_factory.mktemp("environment")
    uv, python = str(Path(sys.executable).with_name("uv")), str(folder / "bin" / "python")
    (line,) = (
        line
        for line in (EXAMPLE / "README.md").read_text().splitlines()
        if line.startswith("uv pip install")
    )
    words = line.replace('"', "").split()[1:]
    for command in (
        [uv, "venv", "--quiet", "--python", sys.executable, str(folder)],
        [uv, *words, "--quiet", "--python", python],
    ):
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        if done.returncode != 0:
            pytest.skip(f"lerobot cannot be installed: {done.stderr[-300:]}")
    return python


def told_by_lerobot(python, *arguments):
    script = Path(__file__).with_name("with_lerobot.py")
    out = arguments[1]
    done = subprocess.run(
        [python, "-W", "ignore", str(script), *map(str, arguments)],
        capture_output=True,
        text=True,
        env={"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "HOME": str(out.parent)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(out.read_text())


@pytest.mark.slow
def test_lerobot_reads_the_dataset_trains_on_it_and_evaluates(lerobot, dataset, demos, tmp_path):
    found = told_by_lerobot(lerobot, dataset, tmp_path / "found.json", EXAMPLE / "env.py")
    lengths = [len(taken) for _, taken in demos.episodes]
    assert (found["episodes"], found["frames"]) == (len(demos), sum(lengths))
    assert found["lengths"] == lengths
    assert found["fps"] == 20
    assert found["task"] == "Pick up a cube and hold it at a goal in the air."
    assert found["shapes"] == {
        name: [] if feature["shape"] == [1] else feature["shape"]
        for name, feature in info(dataset)["features"].items()
    }
    np.testing.assert_array_equal(np.float32(found["actions"]), demos.episodes[1][1].numpy())
    assert found["stats"] == json.loads((dataset / "meta/stats.json").read_text())["action"]
    assert np.isfinite(found["losses"]).all()
    assert found["env"] == "PickCube-v1"
    assert found["played"]["action"] == [2, 50, 7]
    assert found["done"] == [True, True]


@pytest.mark.slow
@needs_vulkan
def test_lerobot_reads_the_video(lerobot, filmed, demos, tmp_path):
    found = told_by_lerobot(lerobot, filmed, tmp_path / "found.json")
    path = filmed / "videos/observation.image/chunk-000/file-000.mp4"
    frames = np.stack(imageio.mimread(path)) / 255
    wanted = frames[[0, len(demos.episodes[0][1])]].transpose(0, 3, 1, 2)
    # Two decoders differ in rounding.
    np.testing.assert_allclose(found["pictures"]["observation.image"], wanted, atol=0.05)
