"""Demonstrations: collected, read back, read by ManiSkill's tools, refused when they are wrong."""

import json
import os
import shutil

import gymnasium as gym
import h5py
import numpy as np
import pytest
import torch
from mani_skill.trajectory import replay_trajectory
from mani_skill.trajectory.dataset import ManiSkillTrajectoryDataset
from mani_skill.trajectory.utils import dict_to_list_of_dicts

from symsteer.bench.demos import MODES, Diversity, collect, load
from symsteer.bench.sim.environment import make_env_class
from symsteer.bench.tasks import make, task_class
from symsteer.errors import UserError

TASK = "PickCube-v1"


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "clean.h5"
    seen = []
    collect(TASK, "floating", 6, "clean", 0, path, progress=lambda *now: seen.append(now))
    assert seen[-1] == (6, 6)
    return path


@pytest.fixture
def copy(clean, tmp_path):
    """A private copy of the clean file, to be damaged."""
    for path in (clean, clean.with_suffix(".json")):
        shutil.copy(path, tmp_path / path.name)
    return tmp_path / clean.name


def edit_json(path, change):
    side = path.with_suffix(".json")
    data = json.loads(side.read_text())
    change(data)
    side.write_text(json.dumps(data))


def test_round_trip(clean):
    """What is read replays: seeds and actions alone give the observations and the success."""
    demos, task = load(clean), task_class(TASK)
    assert (demos.meta["task"], demos.meta["embodiment"]) == (TASK, "floating")
    assert (demos.meta["mode"], demos.meta["seed"], len(demos)) == ("clean", 0, 6)
    assert demos.observation_layout == task.observation_layout
    assert demos.action_layout == task.action_layout
    few = load(clean, TASK, "floating", count=2)
    assert len(few) == 2
    assert load(clean).content_hash == demos.content_hash != few.content_hash
    records = json.loads(clean.with_suffix(".json").read_text())["episodes"]
    env = make(TASK, num_envs=6)
    first, _ = env.reset(seed=[record["episode_seed"] for record in records])
    assert torch.equal(first, torch.stack([obs[0] for obs, _ in demos.episodes]))
    for step in range(max(len(actions) for _, actions in demos.episodes)):
        playing = [i for i, (_, actions) in enumerate(demos.episodes) if step < len(actions)]
        action = torch.zeros(6, 7)
        for i in playing:
            action[i] = demos.episodes[i][1][step]
        now, _, terminated, _, info = env.step(action)
        for i in playing:
            obs, actions = demos.episodes[i]
            assert torch.allclose(now[i], obs[step + 1], atol=1e-5)
            last = step + 1 == len(actions)
            assert info["success"][i].item() == terminated[i].item() == last
    every = torch.cat([actions for _, actions in demos.episodes])
    assert every.dtype == torch.float32
    assert every.abs().max() <= 1 + 1e-6


def test_the_same_arguments_give_the_same_demonstrations(tmp_path):
    hashes = []
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        path = collect(TASK, "floating", 1, "diverse", seed, tmp_path / f"{name}.h5", num_envs=2)
        hashes.append(load(path, TASK, "floating").content_hash)
    assert hashes[0] == hashes[1] != hashes[2]


def test_two_may_write_the_same_demonstrations(tmp_path, monkeypatch):
    """The other one comes in the middle of this one's writing."""
    path = tmp_path / "demos.h5"
    arguments = (TASK, "floating", 2, "clean", 7, path)
    replace, calls = os.replace, []

    def interrupted(*paths):
        replace(*paths)
        calls.append(paths)
        if len(calls) == 1:
            with monkeypatch.context() as other_process:
                other_process.setattr("os.getpid", lambda: 1)
                collect(*arguments)

    monkeypatch.setattr("symsteer.files.os.replace", interrupted)
    collect(*arguments)
    assert len(calls) == 4
    assert len(load(path, TASK, "floating")) == 2
    assert sorted(p.name for p in tmp_path.iterdir()) == ["demos.h5", "demos.json"]


def test_diverse_demonstrations_carry_noise(tmp_path, clean):
    path = collect(TASK, "floating", 6, "diverse", 0, tmp_path / "diverse.h5")
    demos, tidy = load(path, TASK, "floating"), load(clean, TASK, "floating")
    assert demos.meta["mode"] == "diverse"
    starts = {tuple(obs[0].tolist()): actions[0] for obs, actions in tidy.episodes}
    pairs = [(a[0], starts[k]) for o, a in demos.episodes if (k := tuple(o[0].tolist())) in starts]
    assert len(pairs) >= 3
    xy, gripper = (demos.action_layout.slice(name) for name in ("xy", "gripper"))
    for noisy, plain in pairs:
        assert (noisy - plain)[xy].abs().max() > 1e-3
        assert noisy[gripper] == plain[gripper]
    assert demos.meta["steps"] > tidy.meta["steps"]


def test_maniskills_tools_read_our_files(clean):
    dataset = ManiSkillTrajectoryDataset(str(clean))
    demos = load(clean, TASK, "floating")
    assert np.array_equal(dataset.actions, torch.cat([a for _, a in demos.episodes]))
    assert dataset.success.sum() == 6
    assert dataset.env_id == "symsteer.bench.tasks:SymSteer/PickCube-v1"
    # ManiSkill's way of replaying by states: one unbatched numpy state after the other.
    env = gym.make(dataset.env_id, **dataset.env_kwargs)
    env.reset(seed=0)
    with h5py.File(clean) as file:
        states = dict_to_list_of_dicts(file["traj_2"]["env_states"])
    obs, _ = demos.episodes[2]
    for state, expected in zip(states, obs, strict=True):
        env.unwrapped.set_state_dict(state)
        assert torch.allclose(env.unwrapped.get_obs()[0], expected, atol=1e-5)


def test_maniskills_replay_script_replays_our_files(copy, capfd):
    # It asks for a render mode without rendering anything.
    words = ["--traj-path", copy, "--use-env-states", "--save-traj", "--count", 2]
    replay_trajectory.main(replay_trajectory.parse_args([*map(str, words), "-b", "physx_cpu"]))
    assert "2/2" in "".join(capfd.readouterr())
    # The copies that it writes name the task without our module.
    (replayed,) = (p for p in copy.parent.glob("*.h5") if p != copy)
    assert len(load(replayed, TASK, "floating")) == 2


@pytest.mark.parametrize("env_id", ["SymSteer/PickCube-v1", "PickCube-v1"])
def test_ids_of_other_writers_are_read(copy, env_id):
    edit_json(copy, lambda data: data["env_info"].update(env_id=env_id))
    # The checksum covers the description: it is the only thing that is wrong now.
    with pytest.raises(UserError, match="do not match the checksum"):
        load(copy, TASK, "floating")


def record_like_maniskill(path, task, robot, steps=70):
    """What ManiSkill publishes: stock environment, stock observations, states, no own section."""
    stock = next(base for base in task_class(task).__mro__ if base.__module__.startswith("mani_"))
    kwargs = {"obs_mode": "state", "control_mode": "pd_ee_delta_pose", "robot_uids": robot}
    env = make_env_class(stock, "cpu")(num_envs=1, **kwargs)
    seen = [env.reset(seed=3)[0]]
    size = (steps, *env.single_action_space.shape)
    actions = torch.rand(size, generator=torch.Generator().manual_seed(0)) * 2 - 1
    states, tcp = [env.get_state_dict()], [env.agent.tcp_pose.p.clone()]
    for action in actions:
        seen.append(env.step(action[None])[0].clone())
        states.append(env.get_state_dict())
        tcp.append(env.agent.tcp_pose.p.clone())
    with h5py.File(path, "w") as file:
        group = file.create_group("traj_0")
        group["obs"], group["actions"] = torch.cat(seen).numpy(), actions.numpy()
        for kind in ("actors", "articulations"):
            for name in states[0][kind]:
                rows = torch.cat([state[kind][name] for state in states])
                group[f"env_states/{kind}/{name}"] = rows.numpy()
    if robot == "panda":
        del kwargs["robot_uids"]
    side = {
        "env_info": {"env_id": task, "env_kwargs": kwargs, "max_episode_steps": 50},
        "episodes": [{"episode_id": 0, "episode_seed": 3}],
        "source_type": "rl",
    }
    path.with_suffix(".json").write_text(json.dumps(side))
    return torch.cat(tcp)


@pytest.mark.parametrize(
    ("task", "robot"),
    [("PushCube-v1", "panda"), ("StackCube-v1", "panda_wristcam")],
)
def test_files_in_maniskills_own_form(tmp_path, task, robot):
    path = tmp_path / "trajectory.h5"
    tcp = record_like_maniskill(path, task, robot)
    demos = load(path, task)
    ((obs, actions),) = demos.episodes
    layout = demos.observation_layout
    assert actions.shape == (70, 7)
    assert torch.allclose(obs[:, layout.slice("tcp_xy")], tcp[:, :2], atol=1e-5)
    assert torch.allclose(obs[:, layout.slice("tcp_z")], tcp[:, 2:], atol=1e-5)
    assert (demos.meta["mode"], demos.meta["source"]) == ("external", "rl")
    assert demos.meta["embodiment"] == "panda"
    refused(path, "recorded with 'panda', but 'floating'", task=task)
    with h5py.File(path, "r+") as file:
        states = file["traj_0/env_states/articulations"]
        cut(states, next(iter(states)), np.s_[:-1])
    refused(path, "has states of 'panda' of shape", task=task, embodiment="panda")
    edit_json(path, lambda data: data["episodes"][0].update(control_mode="pd_joint_pos"))
    refused(path, "with control mode pd_joint_pos, but pd_ee", task=task, embodiment="panda")


def refused(path, words, *, task=TASK, embodiment="floating", count=None):
    with pytest.raises(UserError) as error:
        load(path, task, embodiment, count)
    assert words in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"task": "PushCube-v1"}, "PickCube-v1, but PushCube-v1 is wanted"),
        ({"task": "Nothing"}, "no task 'Nothing'"),
        ({"embodiment": "panda"}, "'floating', but 'panda' is wanted"),
        ({"embodiment": "hand"}, "no embodiment 'hand'"),
        ({"count": 7}, "holds 6 successful episodes, but 7 are wanted"),
    ],
)
def test_other_demonstrations_are_refused(clean, wanted, words):
    refused(clean, words, **wanted)


def cut(group, key, rows):
    values = group[key][rows]
    del group[key]
    group[key] = values


def not_a_number(group, key):
    group[key][2, 0] = np.nan


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda group: not_a_number(group, "actions"), "NaN or infinite actions in traj_1"),
        (lambda group: not_a_number(group, "obs"), "NaN or infinite observations in traj_1"),
        (lambda group: cut(group, "actions", np.s_[:, :4]), "7] is wanted"),
        (lambda group: cut(group, "actions", np.s_[:0]), "actions of shape [0, 7]"),
        (lambda group: cut(group, "obs", np.s_[:-1]), "observations of shape"),
        (lambda group: group.pop("actions"), "lacks actions or obs of traj_1"),
    ],
)
def test_damaged_arrays_are_refused(copy, change, words):
    with h5py.File(copy, "r+") as file:
        change(file["traj_1"])
    refused(copy, words)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda group, other: group.update({"obs": h5py.ExternalLink(other, "rows")}),
            "from another file",
        ),
        (
            lambda group, other: group.create_dataset("x", 4, "f4", external=[(other, 0, 16)]),
            "from another file",
        ),
        (
            lambda group, other: group.create_dataset("x", (2**32, 2**8), "f4", chunks=(1024, 256)),
            "unpacks to 4096.0 GiB",
        ),
    ],
)
def test_data_in_other_files_and_bombs_are_refused(copy, tmp_path, change, words):
    """At any depth, also of what is not read; tests/test_trust.py tries it with every verb."""
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["rows"] = np.zeros((4, 3), np.float32)
    with h5py.File(copy, "r+") as file:
        change(file["traj_0"].create_group("deep"), str(tmp_path / "other.h5"))
    refused(copy, words)


def test_damaged_files_are_refused(copy, tmp_path):
    whole, side = copy.read_bytes(), copy.with_suffix(".json")
    for content in (whole[: len(whole) // 2], b"nothing of the kind"):
        copy.write_bytes(content)
        refused(copy, "truncated or not an HDF5 file")
    copy.write_bytes(whole)
    text = side.read_text()
    edit_json(copy, lambda data: [episode.update(success=False) for episode in data["episodes"]])
    refused(copy, "holds 0 successful episodes")
    side.write_text(text)
    edit_json(copy, lambda data: data["episodes"].append(data["episodes"][0]))
    refused(copy, "an episode_id occurs twice")
    side.write_text("{")
    refused(copy, "does not describe ManiSkill trajectories")
    side.write_text('{"episodes": []}')
    refused(copy, "env_info")
    side.unlink()
    refused(copy, "clean.json is missing")
    refused(tmp_path / "nothing.h5", "no demonstration file")


def test_bad_arguments_of_collect_are_explained(tmp_path, monkeypatch):
    path = tmp_path / "a.h5"
    with pytest.raises(UserError, match="valid: clean, diverse"):
        collect(TASK, "floating", 1, "messy", 0, path)
    with pytest.raises(UserError, match="at least 1"):
        collect(TASK, "floating", 0, "clean", 0, path)
    with pytest.raises(UserError, match=r"\.h5"):
        collect(TASK, "floating", 1, "clean", 0, tmp_path / "a.hdf")
    monkeypatch.setitem(MODES, "diverse", Diversity(noise=30.0))
    monkeypatch.setitem(collect.__globals__, "ATTEMPTS_PER_DEMO", 2)
    with pytest.raises(UserError, match="succeeded only 0 times"):
        collect(TASK, "floating", 1, "diverse", 0, path)
    assert not path.exists()
