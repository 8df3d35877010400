"""One policy for several tasks: symmetric on each, the same with and without its embedding."""

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Layout, equivariance_error
from symsteer.policies.symmetry.joint import (
    TASK,
    columns_of,
    merged_layout,
    merged_observation,
)
from tests.policies.conftest import ACT, OBS, make_episodes, small_options

# A task that has less to see than the first one, and something else, among it a scalar whose
# values are far from 0.
KNOWN = Layout([field for field in OBS.fields if field.name != "goal"])
OTHER = Layout(
    [*KNOWN.fields[::-1], Field("far", 0), Field("arrow", 1), Field("spin", 0, odd=True)]
)
LAYOUTS = {"near": OBS, "other": OTHER}
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}


def other_episodes(count, seed):
    """Of the same robot, which goes the other way."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for obs, actions in make_episodes(count, seed=seed, noise=0.2):
        columns = torch.cat([torch.arange(OBS.dim)[OBS.slice(f.name)] for f in KNOWN.fields[::-1]])
        more = torch.randn(len(obs), 4, generator=generator)
        more[:, 0] += 5
        goal = OBS.slice("goal")
        actions = actions.clone()
        actions[:, ACT.slice("xy")] -= 1.5 * obs[: len(actions), goal]
        found.append((torch.cat([obs[:, columns], more], dim=1), actions))
    return found


def data(count=8):
    # Not in the order of the names.
    return {
        "other": (other_episodes(count, 5), OTHER),
        "near": (make_episodes(count, noise=0.2), OBS),
    }


def trained(name, **fields):
    kind = POLICIES.get(name)
    if name == "plain-joint":
        fields.setdefault("match_compute", False)
    options = small_options(name, **{"steps": 40, "batch_size": 32, "ema_decay": 0.9, **fields})
    merged, found = [], kind.of_task

    def remember(self, task, obs_layout):
        merged.append(self)
        return found(self, task, obs_layout)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kind, "of_task", remember)
        policies = kind.fit_tasks(options, data(), ACT)
    return merged[0], policies


@pytest.fixture(scope="module", params=["edp-joint", "plain-joint", "D4"])
def both(request):
    """The policy of all tasks, and those of one."""
    return trained("edp-joint", group="D4") if request.param == "D4" else trained(request.param)


def observations(task, count=16):
    episodes = data(2)[task][0] if task == "near" else other_episodes(2, 9)
    return torch.cat([obs for obs, _ in episodes])[:count]


def noises(count=16):
    return 1.5 * torch.randn(count, 8, ACT.dim, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("task", LAYOUTS)
def test_the_embedding_becomes_a_part_of_the_weights(both, task):
    whole, policies = both
    obs, noise = observations(task), noises()
    number = sorted(LAYOUTS).index(task)
    for policy in (whole, *policies.values()):
        policy.double()
    try:
        merged = merged_observation(obs.double(), LAYOUTS[task], whole.obs_layout, number)
        expected = whole.decode(merged, noise.double())
        assert torch.allclose(
            policies[task].decode(obs.double(), noise.double()), expected, atol=1e-6
        )
        wrong = merged_observation(obs.double(), LAYOUTS[task], whole.obs_layout, 1 - number)
        assert (whole.decode(wrong, noise.double()) - expected).abs().max() > 0.02
    finally:
        for policy in (whole, *policies.values()):
            policy.float()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("task", [*LAYOUTS, "all"])
def test_it_commutes_with_its_group_on_every_task(both, task, dtype):
    whole, policies = both
    policy = whole if task == "all" else policies[task]
    layout = policy.obs_layout
    obs = observations("near" if task == "all" else task).double() * 1.5
    if task == "all":
        obs = merged_observation(obs, OBS, layout, 0)
    policy.to(dtype)
    try:
        error = equivariance_error(
            lambda *inputs: policy.decode(*(x.to(dtype) for x in inputs)),
            (obs, noises().double()),
            (layout, ACT),
            ACT,
            policy.group,
        )
        assert error <= TOLERANCE[dtype]
        assert (policy.group.order == 1) == (policy.name == "plain-joint")
    finally:
        policy.float()


def test_each_task_has_a_file_of_its_own(both, tmp_path):
    _, policies = both
    for task, policy in policies.items():
        save_policy(policy, tmp_path / task)
        again = load_policy(tmp_path / task, LAYOUTS[task], ACT)
        obs, noise = observations(task), noises()
        assert torch.equal(again.decode(obs, noise), policy.decode(obs, noise))
        assert again.options.tasks == ("near", "other")
        assert again.content_hash() == policy.content_hash()


def test_steps_are_for_each_task():
    whole, policies = trained("edp-joint", steps=10)
    assert policies["near"].training_record["steps"] == 20
    assert policies["near"].training_record["episodes"] == 16
    # A run that asks for the same steps accepts the file.
    options = policies["near"].options
    assert type(whole)(options, OBS, ACT).options.steps == options.steps == 10


def test_it_learns_both_tasks():
    """Together, though from the same observations they want the opposite."""
    back = [(obs, -actions) for obs, actions in make_episodes(24, noise=0.2)]
    tasks = {"there": (make_episodes(24, noise=0.2), OBS), "back": (back, OBS)}
    options = small_options("edp-joint", steps=150, batch_size=64, ema_decay=0.9)
    policies = POLICIES.get("edp-joint").fit_tasks(options, tasks, ACT)
    obs, noise = observations("near"), noises()
    there, back = (policies[name].decode(obs, noise)[:, 0] for name in tasks)
    wanted = make_episodes(2, noise=0.0)
    wanted = torch.cat([actions for _, actions in wanted])[: len(obs)]
    xy = ACT.slice("xy")
    for got, sign in ((there, 1), (back, -1)):
        along = (got[:, xy] * sign * wanted[:, xy]).sum(dim=1)
        assert (along > 0).float().mean() > 0.8


def test_one_task_alone_is_the_ordinary_policy():
    for name in ("edp", "plain"):
        fields = {"match_compute": False} if name == "plain" else {}
        joint, plain = (
            POLICIES.get(n).fit(
                small_options(n, steps=10, batch_size=32, **fields), make_episodes(4), OBS, ACT
            )
            for n in (f"{name}-joint", name)
        )
        obs, noise = observations("near"), noises()
        assert torch.equal(joint.decode(obs, noise), plain.decode(obs, noise))


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


def test_mistakes():
    with pytest.raises(UserError, match="'goal' of b has another geometry than that of the other"):
        merged_layout({"a": Layout([Field("goal", 1)]), "b": Layout([Field("goal", 0)])})
    assert small_options("edp-joint", tasks=("b", "a", "b")).tasks == ("a", "b")
