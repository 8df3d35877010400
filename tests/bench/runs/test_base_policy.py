"""A base policy from another package: trained, measured, saved and found again."""

import pytest

from symsteer.bench.runs.base_policy import describe_base, find_base, prepare_base, with_policy_of
from symsteer.bench.runs.config import build_config
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.files import policy_path
from symsteer.registry import allow
from tests.bench.tiny_run import tiny_config

STRANGER = '''
"""A policy from outside of SymSteer."""

from symsteer.policies.contract import ChunkPolicy


class Echo(ChunkPolicy):
    """Its noise is its action."""

    name = "echo"

    @classmethod
    def fit(cls, options, episodes, obs_layout, act_layout, seed=0, progress=None, device="cpu"):
        progress(1, 1, 0.0)
        return cls(options, obs_layout, act_layout).to(device).freeze()

    def decode(self, obs, noise):
        return noise.clamp(-1, 1)
'''


def test_a_policy_from_another_package(tmp_path, monkeypatch):
    (tmp_path / "stranger_policy.py").write_text(STRANGER)
    monkeypatch.syspath_prepend(tmp_path)
    name = "stranger_policy:Echo"
    allow(name)
    data = tiny_config().to_json() | {"policy": {"name": name, "horizon": 4, "execute": 2}}
    config = build_config(data, "test")
    assert find_base(config, tmp_path) is None
    base = prepare_base(config, tmp_path, progress=False)
    assert (base.name, base.horizon, base.execute) == ("echo", 4, 2)
    assert describe_base(base).episodes == 32
    # Found again instead of trained again.
    monkeypatch.setattr(POLICIES.get(name), "fit", None)
    again = prepare_base(config, tmp_path, progress=False)
    assert again.content_hash() == base.content_hash()
    # A run that names the file takes its settings; other settings are refused.
    path = policy_path(find_base(config, tmp_path))
    assert with_policy_of(config, path).policy_name == name
    other = build_config(data | {"policy": {"name": name, "horizon": 6, "execute": 2}}, "test")
    with pytest.raises(UserError, match="horizon 4, and this run asks for 6"):
        with_policy_of(other, path)
    # Changed code is another policy.
    (tmp_path / "stranger_policy.py").write_text(STRANGER + "\n")
    assert find_base(config, tmp_path) is None
