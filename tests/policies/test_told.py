"""A policy that is told in words what to do: exact symmetry, the same words the same actions."""

import copy
import dataclasses
import re
import subprocess
import sys

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies import POLICIES, words
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Layout
from symsteer.policies.symmetry.joint import merged_observation
from tests.policies.conftest import (
    ACT,
    OBS,
    as_type,
    assert_exact,
    fit,
    make_episodes,
    noises,
    small_options,
    untrained,
)
from tests.policies.test_joint import OTHER, observed, other_episodes

PUSH, PULL = "PushCube-v1", "PullCube-v1"
"""Names of two tasks of the point mass; the second one goes the other way."""

TASKS = tuple(words._data()["tasks"])


def trained(**fields):
    """The policy of both tasks, and those of one."""
    kind, merged = POLICIES.get("edp-told"), []
    options = small_options("edp-told", steps=100, batch_size=32, ema_decay=0.9, **fields)
    tasks = {PUSH: (make_episodes(8, noise=0.2), OBS), PULL: (other_episodes(8, 5), OTHER)}
    of_task = kind.of_task
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kind, "of_task", lambda self, *of: merged.append(self) or of_task(self, *of))
        policies = kind.fit_tasks(options, tasks, ACT)
    return merged[0], policies


@pytest.fixture(scope="module", params=["C8", "D4"])
def both(request):
    return trained(group=request.param)


def said(policy, sentence):
    """The same policy, told something else."""
    return policy.used_with(dataclasses.replace(policy.options, instruction=sentence))


def test_it_commutes_with_its_group_whatever_it_is_told(both):
    whole, policies = both
    assert whole.group.order == 8
    obs = {PUSH: observed("near").double() * 1.5, PULL: observed("other").double() * 1.5}
    for task, policy in policies.items():
        for sentence in (words.sentences(PUSH)[0], *words.sentences(PULL, held_out=True)[:2]):
            assert_exact(said(policy, sentence), obs=obs[task])
    assert_exact(whole, obs=merged_observation(obs[PUSH], OBS, whole.obs_layout, 1))


def test_the_policy_of_a_task_is_that_of_all(both):
    whole, policies = both
    obs, noise = observed("other").double(), noises(16).double()
    # The second of the tasks in the order of their names.
    merged = merged_observation(obs, OTHER, whole.obs_layout, 0)
    with as_type(torch.float64, whole, policies[PULL]):
        assert torch.allclose(
            policies[PULL].decode(obs, noise), whole.decode(merged, noise), atol=1e-6
        )


def test_the_same_words_are_the_same_actions_and_others_are_not(both, tmp_path):
    policy = both[1][PUSH]
    obs, noise = observed("near"), noises(16)
    actions, hashes = {}, set()
    held_out = words.sentences(PUSH, held_out=True)[0]
    for sentence in (words.sentences(PUSH)[0], held_out, words.sentences(PULL)[0]):
        spoken = said(policy, sentence)
        save_policy(spoken, tmp_path)
        again = load_policy(tmp_path, OBS, ACT)
        assert again.options.instruction == sentence
        actions[sentence] = again.decode(obs, noise)
        assert torch.equal(actions[sentence], spoken.decode(obs, noise))
        hashes.add(again.content_hash())
    first, other, wrong = actions.values()
    assert (first - wrong).abs().max() > 0.05
    # Another wording of the same is nearer.
    assert 0 < (first - other).norm() < (first - wrong).norm()
    assert len(hashes) == 3
    assert said(policy, policy.options.instruction) is policy
    measured = load_policy(save_policy(policy, tmp_path))
    measured.report.update(world="flat", steerability=1)
    assert said(measured, held_out).report == {"world": "flat"}


@pytest.mark.long
def test_it_obeys():
    """From the same observations, two sentences that were never heard want the opposite."""
    episodes = make_episodes(24, noise=0.2)
    back = [(obs, -actions) for obs, actions in episodes]
    options = small_options("edp-told", steps=300, batch_size=64, ema_decay=0.9)
    tasks = {PUSH: (episodes, OBS), "PlaceSphere-v1": (back, OBS)}
    policies = POLICIES.get("edp-told").fit_tasks(options, tasks, ACT)
    wanted = torch.cat([actions for _, actions in make_episodes(2)])[:16, ACT.slice("xy")]
    for task, sign in ((PUSH, 1), ("PlaceSphere-v1", -1)):
        policy = said(policies[PUSH], words.sentences(task, held_out=True)[0])
        chunk = policy.decode(observed("near"), noises(16))[:, 0, ACT.slice("xy")]
        assert ((sign * chunk * wanted).sum(dim=1) > 0).float().mean() > 0.8


def test_sentences_take_nothing_from_the_generator_of_the_batches(both):
    """So a policy with a one-hot vector and the same seed sees the same batches."""
    policy, generator = copy.deepcopy(both[0]), torch.Generator().manual_seed(3)
    before, heard = generator.get_state(), []
    for _ in range(8):
        policy.augment(observed("near"), noises(16), generator)
        heard.append(policy.denoiser.heard)
    assert torch.equal(generator.get_state(), before)
    assert any(not torch.equal(heard[0], other) for other in heard)
    again = copy.deepcopy(both[0])
    again.augment(observed("near"), noises(16), torch.Generator().manual_seed(3))
    assert torch.equal(again.denoiser.heard, heard[0])


def test_without_words_it_is_the_ordinary_policy():
    told, ordinary = fit("edp-told", steps=5), fit("edp", steps=5)
    obs, noise = observed("near"), noises(16)
    assert torch.equal(told.decode(obs, noise), ordinary.decode(obs, noise))
    # Told always the same, it learns to hear nothing else.
    alone = fit("edp-told", steps=5, tasks=(PUSH,), instruction=words.sentences(PUSH)[0])
    assert not torch.equal(alone.decode(obs, noise), ordinary.decode(obs, noise))


def unit_vectors(sentences):
    """Their embeddings, of length 1."""
    embedded = torch.stack([words.embedding(sentence) for sentence in sentences])
    assert torch.allclose(embedded.abs().sum(dim=1), torch.tensor(4.0))
    return embedded / embedded.norm(dim=1, keepdim=True)


@pytest.mark.parametrize("held_out", [False, True])
def test_wordings_are_nearer_within_a_task_than_between_tasks(held_out):
    known = {task: unit_vectors(words.sentences(task)) for task in TASKS}
    for task in TASKS:
        own = unit_vectors(words.sentences(task, held_out))
        near = {other: (own @ known[other].T).mean() for other in TASKS}
        others = [value for other, value in near.items() if other != task]
        assert near[task] > 0.1 + sum(others) / len(others)
        assert near[task] >= max(others)


def test_the_embedding_is_the_same_in_another_process():
    sentence = words.sentences(PUSH, held_out=True)[0]
    code = f"from symsteer.policies.words import *; print(embedding({sentence!r}).tolist())"
    seen = {
        subprocess.run(
            [sys.executable, "-c", code],
            env={"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert seen == {f"{words.embedding(sentence).tolist()}\n"}
    # And on another machine.
    assert words.embedding("Push.")[:6].sign().tolist() == [-1, -1, -1, 1, -1, 1]


def test_the_sentences():
    data = words._data()
    assert len(TASKS) >= 8
    seen = [text for task in data["tasks"].values() for texts in task.values() for text in texts]
    assert len(set(seen)) == len(seen)
    for task in TASKS:
        wordings = data["tasks"][task]
        assert len(wordings["training"]) >= 7
        assert len(wordings["held_out"]) == 3
        for sentence in (*words.sentences(task), *words.sentences(task, held_out=True)):
            # This refuses directions of the plane, too.
            words.check_instruction(sentence)
        # Whatever order its words have, no held-out wording is one of the training.
        told, new = (unit_vectors(words.sentences(task, held_out)) for held_out in (False, True))
        assert (new @ told.T).max() < 0.99
        # As the file says.
        known = {
            word[:4] for sentence in words.sentences(task) for word in words.words_of(sentence)
        }
        for number, filled in enumerate(words.wordings(task, held_out=True)):
            beginnings = {word[:4] for sentence in filled for word in words.words_of(sentence)}
            assert bool(beginnings - known) == (number == 2)
    assert set(data["slots"]) == set(re.findall(r"{(\w+)}", " ".join(seen)))


@pytest.mark.parametrize(
    ("sentence", "problem"),
    [
        ("  ", "an instruction is an English sentence of letters"),
        ("Push the cube\x1b[2J", "an instruction is an English sentence of letters"),
        ("Push " + "on " * 99, "200 characters at most"),
        ("Push the cube to the left.", "names a direction \\('left'\\)"),
        ("Push the leftmost cube northwards.", "names a direction \\('leftmost'\\)"),
        ("Do it to the xyzzy.", "'Do it to the xyzzy.' has no word that tells a task"),
    ],
)
def test_what_cannot_be_followed_is_refused(sentence, problem):
    with pytest.raises(UserError, match=problem) as refused:
        small_options("edp-told", instruction=sentence)
    assert "say it as in 'Push the cube into the target.'" in str(refused.value)


def test_another_form_of_a_known_word_is_enough():
    assert small_options("edp-told", instruction="Pushing.").instruction == "Pushing."


def test_clouds_of_points_are_refused():
    cloud = Layout(
        [*OBS.fields, Field("cloud_xy", 1, multiplicity=5), Field("cloud_z", 0, multiplicity=5)]
    )
    with pytest.raises(UserError, match="edp-told takes no clouds or pictures"):
        untrained("edp-told", (cloud, ACT))


def test_options_in_a_run():
    options = small_options("edp-told", tasks=(PULL,))
    run = options.on(PUSH)
    assert (run.tasks, run.instruction) == ((PULL, PUSH), words.sentences(PUSH)[0])
    assert run.trained().on(PULL).instruction == words.sentences(PULL)[0]
    told = dataclasses.replace(options, instruction="Shove the block.")
    assert told.on(PUSH).instruction == "Shove the block."
    with pytest.raises(UserError, match="no task with sentences 'TiltedPushCube-v1'; did you"):
        options.on("TiltedPushCube-v1")
