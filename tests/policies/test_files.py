"""Saving and loading policies: bit-equal round trip, checksums, one-sentence errors."""

import copy
import errno
import functools
import hashlib
import json
import operator
import os
import re
import sys
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file

from symsteer.errors import UserError
from symsteer.policies import POLICIES, files
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Layout
from symsteer.registry import allow
from tests.policies.conftest import (
    ACT,
    OBS,
    as_type,
    make_episodes,
    noises,
    observations,
    small_options,
    untrained,
)


def decode(policy):
    kind = policy.obs_normalizer.scale.dtype
    noise = noises(6)[:, : policy.horizon]
    return policy.decode(observations(6).to(kind), noise.to(kind))


@pytest.mark.parametrize("name", POLICIES.names())
def test_every_policy_is_named_as_it_is_registered(name):
    kind = POLICIES.get(name)
    assert kind.name == POLICIES.name_of(kind) == name
    assert POLICIES.summary(name)
    assert kind.Options.from_json(kind.Options().to_json()) == kind.Options()


@pytest.mark.parametrize(
    "fields",
    [
        {"group": "C8"},
        {"group": "D4", "network": "unet"},
        {"name": "plain-augmented", "augmentation": "SO2", "hold": ("gripper", "z")},
        {"group": "D4", "action_frame": "goal"},
    ],
)
def test_round_trip_is_bit_equal(trained, tmp_path, fields):
    policy = copy.deepcopy(trained(**fields, steps=15))
    policy.report = {"success": 0.25}
    path = save_policy(policy, tmp_path / "run", extra={"note": [1, "two"]})
    assert path == tmp_path / "run" / "policy.safetensors"
    loaded = load_policy(tmp_path / "run", policy.obs_layout, policy.act_layout)
    assert torch.equal(decode(loaded), decode(policy))
    assert loaded.content_hash() == policy.content_hash()
    assert type(loaded) is type(policy)
    assert loaded.options == policy.options
    assert loaded.report == {"success": 0.25, "note": [1, "two"]}
    assert loaded.training_record == json.loads(json.dumps(policy.training_record))
    assert not any(p.requires_grad for p in loaded.parameters())
    assert not loaded.training
    assert os.listdir(tmp_path / "run") == ["policy.safetensors"]
    with as_type(torch.float64, policy):
        loaded = load_policy(save_policy(policy, tmp_path / "p.safetensors"))
        assert decode(loaded).dtype == torch.float64
        assert torch.equal(decode(loaded), decode(policy))


def test_hash_follows_what_decides_decoding():
    policy = untrained()
    before = policy.content_hash()
    policy.report = {"anything": 1}
    assert policy.content_hash() == before
    policy.act_normalizer.scale[0] += 1e-6
    assert policy.content_hash() != before


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    policy = untrained()
    path = save_policy(policy, tmp_path)
    old = path.read_bytes()

    def full_disk(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(UserError, match=r"policy\.safetensors cannot be written: No space"):
        save_policy(policy, tmp_path)
    assert path.read_bytes() == old
    assert os.listdir(tmp_path) == [path.name]


@pytest.fixture
def saved(tmp_path):
    return save_policy(untrained(), tmp_path, extra={"success": 0.25})


def rewrite(path, metadata=None, drop=None, scale=None, edit=None):
    """The same file with other metadata or tensors."""
    with safe_open(path, framework="pt") as file:
        tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        meta = {**file.metadata(), **(metadata or {})}
    if edit:
        meta["policy"] = meta["policy"].replace(*edit)
    if drop:
        del tensors[drop]
    if scale:
        tensors[scale] = tensors[scale] * 1.5
    save_file(tensors, path, meta)


def refuse(path, words, **expectations):
    with pytest.raises(UserError, match=words) as error:
        load_policy(path, **expectations)
    assert "\n" not in str(error.value)


DAMAGES = {
    "no file": (lambda path: path.unlink(), "no policy at"),
    "cut off": (lambda path: path.write_bytes(path.read_bytes()[:200]), "truncated"),
    "end missing": (lambda path: path.write_bytes(path.read_bytes()[:-100]), "truncated"),
    "empty": (lambda path: path.write_bytes(b""), "truncated"),
    "a text": (lambda path: path.write_text("just a long enough text"), "no safetensors file"),
    "other tensors": (lambda path: save_file({"x": torch.zeros(3)}, path), "no SymSteer policy"),
    "version": (lambda path: rewrite(path, {"version": "99"}), "version 99.* up to 3"),
    "report": (
        lambda path: rewrite(path, edit=('"success": 0.25', '"success": 0.95')),
        "does not match its checksum",
    ),
    "weight missing": (
        lambda path: rewrite(path, drop="denoiser.project.weight"),
        r"damaged.*project\.weight",
    ),
    "weight": (lambda path: rewrite(path, scale="denoiser.project.weight"), "checksum"),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_refused(saved, damage):
    destroy, words = DAMAGES[damage]
    destroy(saved)
    refuse(saved, words)


@pytest.mark.parametrize(
    "description",
    ["{", "{}", "[]", '{"config": {"name": "edp"}}', '{"name": "quantum", "extension": null}'],
)
def test_damaged_description(saved, description):
    digest = hashlib.sha256(description.encode()).hexdigest()
    rewrite(saved, {"policy": description, "policy_sha256": digest})
    refuse(saved, "damaged")


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["denoiser.project.weight", "act_normalizer.scale"])
def test_a_policy_that_decodes_to_nan_is_refused(tmp_path, name, value):
    policy = untrained()
    policy.state_dict()[name].flatten()[0] = value
    refuse(save_policy(policy, tmp_path), "decodes to NaN or infinity.*train it again")


@pytest.mark.parametrize("name", POLICIES.builtin)
def test_every_policy_is_tried_and_no_stream_of_random_numbers_moves(name, tmp_path):
    policy = untrained(name)
    before = torch.get_rng_state()
    assert files._is_finite(policy)
    assert torch.equal(torch.get_rng_state(), before)
    loaded = load_policy(save_policy(policy, tmp_path))
    assert torch.equal(decode(loaded), decode(policy))


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("options horizon", "8", "horizon: Input should be a valid integer"),
        ("options horizon", 10**9, "horizon: Input should be less than or equal to 1000"),
        ("options diffusion_steps", 10**9, "diffusion_steps: Input should be less than or equal"),
        ("options execute", 2.5, "execute: Input should be a valid integer"),
        ("options width", 10**5, "ask for a larger network than the file holds"),
        ("options depth", 10**9, "ask for a larger network than the file holds"),
        ("options hue", 1, "there is no option 'hue'"),
        ("obs_layout 0 multiplicity", 10**9, "obs_layout does not fit the normaliser"),
        ("report world", 3, "report.world: Input should be a valid dictionary"),
        ("report steerability", {"success": 2.0}, "report.steerability.success: Input should be"),
        ("report steerability", {"states": "x"}, "report.steerability.states: Input should be"),
        ("training_record seconds", float("nan"), "training_record.seconds: Input should be"),
        ("report", [[[]]], "report: Input should be"),
        ("report deep", functools.reduce(lambda x, _: [x], range(90), 1), "32 levels deep"),
    ],
)
def test_a_description_of_another_form_is_refused(saved, place, value, words):
    """Its checksum is right."""
    with safe_open(saved, framework="pt") as file:
        description = json.loads(file.metadata()["policy"])
    *path, last = (int(key) if key.isdigit() else key for key in place.split())
    functools.reduce(operator.getitem, path, description)[last] = value
    text = json.dumps(description)
    digest = hashlib.sha256(text.encode()).hexdigest()
    rewrite(saved, {"policy": text, "policy_sha256": digest})
    refuse(saved, f"{saved} .*{re.escape(words)}")


def test_other_layouts(saved):
    other = Layout([Field("tcp", 1), Field("else", 0)])
    refuse(saved, "observation layout.*else", expect_obs_layout=other)
    refuse(saved, "action layout.*else", expect_act_layout=other)
    load_policy(saved, expect_obs_layout=OBS, expect_act_layout=ACT)


def test_a_file_of_version_2():
    """Written by SymSteer 0.1 with this policy's tiny configuration."""
    folder = Path(__file__).parent / "data"
    expected = json.loads((folder / "version-2.json").read_text())
    policy = load_policy(folder / "version-2.safetensors")
    assert (policy.name, str(policy.group), policy.execute) == ("edp", "D4", 2)
    assert policy.content_hash() == expected["content_hash"]
    assert policy.report == {"steerability": {"success": 0.25}}
    obs, noise, actions = (torch.tensor(expected[key]) for key in ("obs", "noise", "actions"))
    assert torch.allclose(policy.decode(obs, noise), actions, atol=1e-5)


def test_the_policy_of_the_documentation(tmp_path, monkeypatch):
    """As a stranger's module: trained, saved, loaded by name; refused where it is missing."""
    page = (Path(__file__).parents[2] / "docs" / "policies.md").read_text()
    code = next(block for block in page.split("```python\n") if "class Mean(" in block)
    (tmp_path / "stranger.py").write_text(code.partition("```")[0])
    with monkeypatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        allow("stranger:Mean")
        kind = POLICIES.get("stranger:Mean")
        policy = kind.fit(kind.Options(horizon=4, execute=1), make_episodes(2), OBS, ACT)
        path = save_policy(policy, tmp_path)
        loaded = load_policy(path)
        assert (type(loaded), loaded.options) == (kind, policy.options)
        assert loaded.content_hash() == policy.content_hash()
        assert torch.equal(decode(loaded), decode(policy))
        loaded.options = kind.Options(horizon=4, execute=2)
        assert loaded.content_hash() != policy.content_hash()
        policy.mean = policy.mean[:2]
        refuse(save_policy(policy, tmp_path / "other"), "let the constructor of Mean build all")
    monkeypatch.delitem(sys.modules, "stranger")
    refuse(path, "'stranger:Mean'.*package stranger.*not installed")


def test_a_policy_that_no_other_program_can_import_is_not_saved(tmp_path):
    class Local(POLICIES.get("edp")):
        pass

    with pytest.raises(UserError, match="Local cannot be found"):
        save_policy(Local(small_options(), OBS, ACT), tmp_path)
