"""One policy for several tasks: symmetric on each, the same with and without its embedding."""

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Layout
from symsteer.policies.symmetry.joint import TASK, columns_of, merged_layout, merged_observation
from tests.policies.conftest import (
    ACT,
    OBS,
    as_type,
    assert_exact,
    fit,
    make_episodes,
    noises,
    small_options,
)

# A task that has less to see than the first one, and something else, among it a scalar whose
# values are far from 0.
KNOWN = Layout([field for field in OBS.fields if field.name != "goal"])
OTHER = Layout(
    [*KNOWN.fields[::-1], Field("far", 0), Field("arrow", 1), Field("spin", 0, odd=True)]
)
LAYOUTS = {"near": OBS, "other": OTHER}


def other_episodes(count, seed):
    """Of the same robot, which goes the other way."""
    generator = torch.Generator().manual_seed(seed)
    columns = torch.cat([torch.arange(OBS.dim)[OBS.slice(f.name)] for f in KNOWN.fields[::-1]])
    episodes = []
    for obs, actions in make_episodes(count, seed=seed, noise=0.2):
        more = torch.randn(len(obs), 4, generator=generator)
        more[:, 0] += 5
        actions[:, ACT.slice("xy")] -= 1.5 * obs[: len(actions), OBS.slice("goal")]
        episodes.append((torch.cat([obs[:, columns], more], dim=1), actions))
    return episodes


def trained(name, **fields):
    """The policy of all tasks, and those of one."""
    kind, merged = POLICIES.get(name), []
    few = {"match_compute": False} if name == "plain-joint" else {}
    options = small_options(name, steps=40, batch_size=32, ema_decay=0.9, **few, **fields)
    # Not in the order of the names.
    tasks = {
        "other": (other_episodes(8, 5), OTHER),
        "near": (make_episodes(8, noise=0.2), OBS),
    }
    of_task = kind.of_task
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kind, "of_task", lambda self, *of: merged.append(self) or of_task(self, *of))
        policies = kind.fit_tasks(options, tasks, ACT)
    return merged[0], policies


@pytest.fixture(scope="module", params=["edp-joint", "plain-joint", "D4"])
def both(request):
    return trained("edp-joint", group="D4") if request.param == "D4" else trained(request.param)


def observed(task):
    episodes = make_episodes(2, noise=0.2) if task == "near" else other_episodes(2, 9)
    return torch.cat([obs for obs, _ in episodes])[:16]


@pytest.mark.parametrize("task", LAYOUTS)
def test_the_embedding_becomes_a_part_of_the_weights(both, task):
    whole, policies = both
    obs, noise, number = observed(task).double(), noises(16).double(), sorted(LAYOUTS).index(task)
    with as_type(torch.float64, whole, *policies.values()):
        own, other = (
            whole.decode(merged_observation(obs, LAYOUTS[task], whole.obs_layout, n), noise)
            for n in (number, 1 - number)
        )
        assert torch.allclose(policies[task].decode(obs, noise), own, atol=1e-6)
        assert (other - own).abs().max() > 0.02


def test_it_commutes_with_its_group_on_every_task(both):
    whole, policies = both
    obs = {task: observed(task).double() * 1.5 for task in LAYOUTS}
    for task, policy in policies.items():
        assert_exact(policy, obs=obs[task])
    assert_exact(whole, obs=merged_observation(obs["near"], OBS, whole.obs_layout, 0))
    assert (whole.group.order == 1) == (whole.name == "plain-joint")


def test_each_task_has_a_file_of_its_own(both, tmp_path):
    _, policies = both
    for task, policy in policies.items():
        save_policy(policy, tmp_path / task)
        again = load_policy(tmp_path / task, LAYOUTS[task], ACT)
        obs, noise = observed(task), noises(16)
        assert torch.equal(again.decode(obs, noise), policy.decode(obs, noise))
        assert again.options.tasks == ("near", "other")
        assert again.content_hash() == policy.content_hash()


def test_steps_are_for_each_task(both):
    whole, policies = both
    record, options = policies["near"].training_record, policies["near"].options
    assert (record["steps"], record["episodes"]) == (80, 16)
    # A run that asks for the same steps accepts the file.
    assert type(whole)(options, OBS, ACT).options.steps == options.steps == 40


def test_it_learns_both_tasks():
    """Together, though from the same observations they want the opposite."""
    episodes = make_episodes(24, noise=0.2)
    tasks = {
        "there": (episodes, OBS),
        "back": ([(obs, -actions) for obs, actions in episodes], OBS),
    }
    options = small_options("edp-joint", steps=150, batch_size=64, ema_decay=0.9)
    policies = POLICIES.get("edp-joint").fit_tasks(options, tasks, ACT)
    wanted, xy = torch.cat([actions for _, actions in make_episodes(2)]), ACT.slice("xy")
    for name, sign in (("there", 1), ("back", -1)):
        chunk = policies[name].decode(observed("near"), noises(16))[:, 0]
        along = (chunk[:, xy] * sign * wanted[:16, xy]).sum(dim=1)
        assert (along > 0).float().mean() > 0.8


@pytest.mark.parametrize("name", ["edp", "plain"])
def test_one_task_alone_is_the_ordinary_policy(name):
    joint, ordinary = (fit(kind, steps=5) for kind in (f"{name}-joint", name))
    obs, noise = observed("near"), noises(16)
    assert torch.equal(joint.decode(obs, noise), ordinary.decode(obs, noise))


def test_merged_observations():
    merged = merged_layout(LAYOUTS)
    assert merged.fields[-1] == Field(TASK, 0, multiplicity=2)
    assert merged.dim == OBS.dim + 4 + 2
    obs = torch.rand(3, OTHER.dim) + 1
    placed = merged_observation(obs, OTHER, merged, 1)
    for field in OTHER.fields:
        assert torch.equal(placed[:, merged.slice(field.name)], obs[:, OTHER.slice(field.name)])
    assert placed[:, merged.slice("goal")].abs().max() == 0
    assert placed[:, merged.slice(TASK)].tolist() == [[0, 1]] * 3
    assert torch.equal(placed[:, columns_of(OTHER, merged)], obs)
    with pytest.raises(UserError, match="'goal' of b has another geometry than that of the other"):
        merged_layout({"a": Layout([Field("goal", 1)]), "b": Layout([Field("goal", 0)])})
    assert small_options("edp-joint", tasks=("b", "a", "b")).tasks == ("a", "b")
