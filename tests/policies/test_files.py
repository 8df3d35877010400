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


def decode(policy, world):
    noise = torch.randn(6, policy.horizon, 7, generator=torch.Generator().manual_seed(2))
    kind = policy.obs_normalizer.scale.dtype
    return policy.decode(world.observations(6).to(kind), noise.to(kind))


@pytest.mark.parametrize(
    "fields",
    [
        {"group": "C8"},
        {"group": "D4", "network": "unet"},
        {"name": "plain-augmented", "augmentation": "SO2", "hold": ("gripper", "z")},
        {"process": "flow", "prediction": "velocity", "action_frame": "goal"},
    ],
)
def test_round_trip_is_bit_equal(trained, world, tmp_path, fields):
    policy = trained(**fields, steps=5)
    policy.report = {"success": 0.25}
    path = save_policy(policy, tmp_path / "run", extra={"note": [1, "two"]})
    assert path == tmp_path / "run" / "policy.safetensors"
    loaded = load_policy(tmp_path / "run", policy.obs_layout, policy.act_layout)
    assert torch.equal(decode(loaded, world), decode(policy, world))
    assert loaded.content_hash() == policy.content_hash()
    assert type(loaded) is type(policy)
    assert loaded.options == policy.options
    assert loaded.report == {"success": 0.25, "note": [1, "two"]}
    assert loaded.training_record == json.loads(json.dumps(policy.training_record))
    assert not any(p.requires_grad for p in loaded.parameters())
    assert not loaded.training
    assert os.listdir(tmp_path / "run") == ["policy.safetensors"]


def test_double_precision_survives(trained, world, tmp_path):
    policy = trained(group="C8")
    policy.double()
    try:
        loaded = load_policy(save_policy(policy, tmp_path / "p.safetensors"))
        assert decode(loaded, world).dtype == torch.float64
        assert torch.equal(decode(loaded, world), decode(policy, world))
    finally:
        policy.float()


def test_hash_follows_what_decides_decoding(trained, tmp_path):
    policy = trained(group="C8")
    before = policy.content_hash()
    policy.report = {"anything": 1}
    assert policy.content_hash() == before
    scale = policy.act_normalizer.scale.clone()
    policy.act_normalizer.scale[0] += 1e-6
    changed = policy.content_hash()
    policy.act_normalizer.scale.copy_(scale)
    assert changed != before == policy.content_hash()


def test_a_failed_write_leaves_the_old_file(trained, tmp_path, monkeypatch):
    policy = trained(group="C8")
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
def saved(trained, tmp_path):
    return save_policy(trained(group="C8"), tmp_path, extra={"success": 0.25})


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
def test_a_policy_that_decodes_to_nan_is_refused(trained, tmp_path, name, value):
    policy = copy.deepcopy(trained(group="C8"))
    policy.state_dict()[name].flatten()[0] = value
    refuse(save_policy(policy, tmp_path), "decodes to NaN or infinity.*train it again")


@pytest.mark.parametrize("name", POLICIES.builtin)
def test_every_policy_is_tried_and_no_stream_of_random_numbers_moves(name, world, tmp_path):
    policy = world.untrained(name)
    before = torch.get_rng_state()
    assert files._is_finite(policy)
    assert torch.equal(torch.get_rng_state(), before)
    loaded = load_policy(save_policy(policy, tmp_path))
    assert torch.equal(decode(loaded, world), decode(policy, world))


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
        found = json.loads(file.metadata()["policy"])
    *path, last = (int(key) if key.isdigit() else key for key in place.split())
    functools.reduce(operator.getitem, path, found)[last] = value
    text = json.dumps(found)
    digest = hashlib.sha256(text.encode()).hexdigest()
    rewrite(saved, {"policy": text, "policy_sha256": digest})
    refuse(saved, f"{saved} .*{re.escape(words)}")


def test_other_layouts(saved, world):
    other = Layout([Field("tcp", 1), Field("else", 0)])
    refuse(saved, "observation layout.*else", expect_obs_layout=other)
    refuse(saved, "action layout.*else", expect_act_layout=other)
    load_policy(saved, expect_obs_layout=world.obs_layout, expect_act_layout=world.act_layout)


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


def test_the_policy_of_the_documentation(world, tmp_path, monkeypatch):
    """As a stranger's module: trained, saved, loaded by name; refused where it is missing."""
    page = (Path(__file__).parents[2] / "docs" / "policies.md").read_text()
    code = next(block for block in page.split("```python\n") if "class Mean(" in block)
    (tmp_path / "stranger.py").write_text(code.partition("```")[0])
    with monkeypatch.context() as patch:
        patch.syspath_prepend(tmp_path)
        allow("stranger:Mean")
        kind = POLICIES.get("stranger:Mean")
        options = kind.Options(horizon=4, execute=1)
        policy = kind.fit(options, world.episodes(2), world.obs_layout, world.act_layout)
        path = save_policy(policy, tmp_path)
        loaded = load_policy(path)
        assert type(loaded) is kind
        assert loaded.options == options
        assert loaded.content_hash() == policy.content_hash()
        assert torch.equal(decode(loaded, world), decode(policy, world))
        loaded.options = kind.Options(horizon=4, execute=2)
        assert loaded.content_hash() != policy.content_hash()
    monkeypatch.delitem(sys.modules, "stranger")
    refuse(path, "'stranger:Mean'.*package stranger.*not installed")


def test_a_policy_that_no_other_program_can_import_is_not_saved(world, tmp_path):
    class Local(type(world.untrained())):
        pass

    policy = Local(world.options(), world.obs_layout, world.act_layout)
    with pytest.raises(UserError, match="Local cannot be found"):
        save_policy(policy, tmp_path)
