"""Using what was trained: a run as an object that acts, and its videos."""

import dataclasses
import json
import shutil

import pytest
import torch

import symsteer
from symsteer.bench.runs.checkpoint import load_checkpoint, save_checkpoint
from symsteer.bench.runs.folder import is_finished, run_id
from symsteer.bench.runs.reproduce import reproduce
from symsteer.bench.runs.run import evaluate
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.errors import UserError
from symsteer.leaderboard.records import config_hash, read_record
from tests.bench.tiny_run import quiet, resume


def success(run, count, **options):
    """Play held-out episodes by hand, as the README does; whether each had a success."""
    env = run.make_env(num_envs=count, **options)
    obs, _ = env.reset(seed=held_out_seeds(count))
    found = torch.zeros(count, dtype=torch.bool)
    length = torch.zeros(count)
    while not (found | (env.elapsed_steps >= env.max_episode_steps)).all():
        for action in run.act(obs).unbind(1):
            obs, _, _, _, info = env.step(action)
            length += ~found
            found |= info["success"]
    env.close()
    return found


def test_a_loaded_run_plays_what_its_record_says(finished):
    config, folder = finished
    run = symsteer.load(folder)
    assert run.config == config
    final = read_record(folder / "record.json").final
    assert success(run, 3).tolist() == final.episodes.success_once
    obs = torch.randn(3, run.policy.obs_layout.dim)
    actions = run.act(obs)
    assert actions.shape == (3, run.policy.execute, run.policy.act_layout.dim)
    steered = run.policy.decode(obs, run.agent.act(obs, deterministic=True))
    assert torch.equal(actions, steered[:, : run.policy.execute])
    assert torch.equal(run.act(obs.numpy()), actions)
    assert not torch.equal(run.act(obs, deterministic=False), actions)
    for variant, names in (("action_gain:1", ["action_gain"]), (None, [])):
        env = run.make_env(num_envs=2, variant=variant)
        assert [one.name for one in env.variants] == names
        env.close()


def made_on_a_gpu(finished, tmp_path, option):
    """What a finished run on a GPU leaves behind: tensors of CUDA, and streams of its kind."""
    config, folder = finished
    config = dataclasses.replace(config, **{option: "cuda"})
    copy = tmp_path / run_id(config, {})
    shutil.copytree(folder, copy)
    for name in ("config.json", "record.json"):
        data = json.loads((copy / name).read_text())
        data.get("config", data)[option] = "cuda"
        if name == "record.json":
            data |= {"run_id": copy.name, "config_hash": config_hash(data["config"])}
        (copy / name).write_text(json.dumps(data))
    with pytest.MonkeyPatch.context() as patch:
        state = load_checkpoint(folder)
        agent = state["agent"]
        agent["generator"] = torch.zeros(16, dtype=torch.uint8)
        agent["generators"] = dict.fromkeys(agent["generators"], agent["generator"])
        patch.setattr(torch.serialization, "location_tag", lambda storage: "cuda:0")
        save_checkpoint(copy, state)
    assert is_finished(copy)
    return copy


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_a_run_of_a_gpu_is_used_without_one(finished, tmp_path):
    """It acts and is evaluated as on the CPU. It does not go on here, and nothing is lost."""
    of_a_gpu = made_on_a_gpu(finished, tmp_path, "device")
    found, same = (symsteer.load(folder) for folder in (of_a_gpu, finished[1]))
    obs = torch.randn(3, found.policy.obs_layout.dim)
    assert torch.equal(found.act(obs), same.act(obs))
    here, there = evaluate(of_a_gpu), evaluate(finished[1])
    assert here.evaluation.episodes == there.evaluation.episodes
    # Numbers of a GPU are not those of a processor, so it does not say whether they are equal.
    assert (here.recorded, there.recorded) == (None, True)
    before = {path: path.read_bytes() for path in of_a_gpu.iterdir() if path.is_file()}
    message = "was begun with --device cuda, but torch finds no CUDA device here"
    with pytest.raises(UserError, match=message):
        resume(of_a_gpu)
    with pytest.raises(UserError, match=message):
        reproduce(of_a_gpu, None, quiet())
    assert before == {path: path.read_bytes() for path in of_a_gpu.iterdir() if path.is_file()}
    simulated = made_on_a_gpu(finished, tmp_path, "sim")
    assert symsteer.load(simulated).act(obs).isfinite().all()
    with pytest.raises(UserError, match="was begun with --sim cuda"):
        evaluate(simulated)


def test_a_policy_file_plays_with_random_noise(finished):
    loaded = symsteer.load(finished[1] / "policy.safetensors")
    assert loaded.config is None
    assert loaded.agent.name == "base"
    assert loaded.world == {"task": "PickCube-v1", "embodiment": "floating", "variant": "none"}
    obs = torch.randn(3, loaded.policy.obs_layout.dim)
    assert not torch.equal(loaded.act(obs), loaded.act(obs))


def test_mistakes_in_loading(finished, tmp_path):
    with pytest.raises(UserError, match=r"no config\.json"):
        symsteer.load(tmp_path)
    with pytest.raises(UserError, match="no policy at"):
        symsteer.load(tmp_path / "policy.safetensors")
    with pytest.raises(UserError, match=r"have the shape \[N, \d+\], not \[3\]"):
        symsteer.load(finished[1]).act(torch.zeros(3))


def test_the_public_names_are_those_of_the_page():
    assert symsteer.__all__ == ["UserError", "__version__", "load", "make", "read_records"]
    assert all(hasattr(symsteer, name) for name in symsteer.__all__)
    with pytest.raises(AttributeError, match="no attribute 'mkae'"):
        _ = symsteer.mkae
