"""Audits, loaded runs and films of tasks that show pictures: all see through the encoder."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import symsteer
from symsteer.bench.audit.defects import audit, reference_task, visit_all
from symsteer.bench.audit.result import AuditSettings
from symsteer.bench.audit.rollout import rotated_rollout_error
from symsteer.bench.runs import film as film_module
from symsteer.bench.runs.base_policy import prepare_base
from symsteer.bench.tasks import make, task_class
from symsteer.errors import UserError
from symsteer.policies.files import save_policy
from symsteer.policies.symmetry.lifted import EquivariantDiffusionPolicy, EquivariantOptions
from tests.bench.tiny_run import quiet, tiny_config
from tests.marks import need_escnn

TASKS = ["HeightPushCube-v1", "HandPushCube-v1"]
pytestmark = pytest.mark.parametrize("task", TASKS)


def untrained(task):
    need_escnn()
    known = task_class(task)
    options = EquivariantOptions(channels=8, width=16, depth=1, group="C4")
    torch.manual_seed(0)
    policy = EquivariantDiffusionPolicy(options, known.observation_layout, known.action_layout)
    # Weights that depend on what is seen.
    policy.eyes.scale.fill_(0.05)
    policy.eyes.weigh.weight.data *= 30
    return policy.freeze()


@pytest.fixture
def loaded(task, tmp_path):
    """A policy file as a user has it."""
    policy = untrained(task)
    policy.report["world"] = {"task": task, "embodiment": "floating"}
    return symsteer.load(save_policy(policy, tmp_path / "policy.safetensors"))


@pytest.mark.long
def test_an_audit_compares_what_the_encoder_tells(task):
    """Under quarter turns it finds the break that there is, and none beside it."""
    settings = AuditSettings(task=task, group="C4", count=8, resets=16)
    policy, reference = untrained(task), reference_task(settings)
    visited = visit_all(reference, settings, policy)
    worst = {}
    for variant in ("none", "perception_bias:1", "observation_noise:1"):
        changed = AuditSettings(**{**vars(settings), "variant": variant})
        result = audit(changed, reference, visited, policy)
        assert result.base_policy == policy.content_hash()[:12]
        assert {field.name for field in result.fields} == {f.name for f in policy.obs_layout.fields}
        assert result.random_observation == variant.startswith("observation_noise")
        worst[variant] = max(f.value.value for f in result.fields if f.unit == "mm")
    reference.close()
    assert worst["none"] < 0.1 * min(worst["perception_bias:1"], worst["observation_noise:1"])


def test_an_audit_says_what_it_needs(task):
    with pytest.raises(UserError, match="leave --base-policy none out, so that one is trained"):
        AuditSettings(task=task, states="expert").check()
    with pytest.raises(UserError, match=r"under D4 the encoder would be measured.*C_n, e.g. C4"):
        AuditSettings(task=task, group="D4").check()
    AuditSettings(task=task.removeprefix("Height").removeprefix("Hand"), group="D4").check()


def test_a_policy_is_checked_before_demonstrations_are_collected(task, tmp_path):
    for change in ({"policy_name": "edp-joint"}, {"policy_name": "plain-joint"}):
        with pytest.raises(UserError, match="the task shows a picture"):
            prepare_base(tiny_config(task=task, **change), quiet(runs=tmp_path))
    assert not any(tmp_path.iterdir())


def test_whole_episodes_of_the_policy_turn(task):
    error = rotated_rollout_error(task, episodes=1, actor=untrained(task), group="C4")
    assert "1 episodes" in error.summary()


def test_a_loaded_policy_acts_on_the_task_observation(loaded):
    env = loaded.make_env(num_envs=2)
    obs, _ = env.reset(seed=[0, 1])
    actions = loaded.act(obs)
    assert actions.shape == (2, loaded.policy.execute, loaded.policy.act_layout.dim)
    changed = obs.clone()
    changed[:, env.observation_layout.picture.columns] = 0
    acts = [
        loaded.policy.decode(loaded.policy.see(x), torch.zeros(2, 8, 7)) for x in (obs, changed)
    ]
    assert not torch.equal(*acts)
    env.close()


def test_the_frame_turns_the_picture_with_all_else(task):
    env = make(task, num_envs=2, variant="frame_rotation", strength=(0.0, 1.0))
    obs, _ = env.reset(seed=[4, 4])
    turned = env.observation_layout.rotate(obs[:1], torch.tensor([math.pi / 4]))
    torch.testing.assert_close(obs[1:], turned, atol=1e-5, rtol=0)
    assert not torch.equal(obs[0], obs[1])
    env.close()


def test_noise_moves_what_a_picture_shows(task):
    noisy, plain = (make(task, num_envs=2, variant=v) for v in ("observation_noise:1", "none"))
    (seen, _), (truth, _) = (env.reset(seed=[4, 5]) for env in (noisy, plain))
    seen, truth = seen.clone(), truth.clone()
    assert torch.equal(noisy.get_obs(), seen), "asked twice"
    changed = (seen != truth).any(0)
    picture = noisy.observation_layout.picture
    assert changed[picture.columns].any()
    assert not changed[picture.rest_columns].any()
    plain.manipulated.set_pose(noisy.seen(noisy.manipulated.pose, "object"))
    torch.testing.assert_close(plain.get_obs(), seen, atol=1e-4, rtol=0)
    for env in (noisy, plain):
        env.close()


def test_a_film_sees_the_picture(task, loaded, monkeypatch):
    def drawing(name, render, render_mode, human_render_camera_configs, **options):
        env = make(name, **options)
        env.render = lambda: torch.zeros(1, 20, 20, 3, dtype=torch.uint8)
        return env

    monkeypatch.setattr(film_module, "make", drawing)
    run = SimpleNamespace(config=tiny_config(task=task), policy=loaded.policy, agent=loaded.agent)
    frames, ending, _ = film_module._filmed(run, (), 0, every=10)
    assert len(frames) > 1
    assert np.shape(frames[0])[2] == 3
    assert ending
