"""The policy with escnn's layers, and escnn's networks as its encoder."""

import pytest
import torch

from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Group
from symsteer.policies.networks.equivariant import Lift, Project, RegularLinear
from tests.marks import need_escnn
from tests.policies.conftest import (
    ACT,
    OBS,
    decode_error,
    make_episodes,
    noises,
    observations,
    small_options,
    untrained,
)

nn = need_escnn().nn

from symsteer.policies.symmetry.with_escnn import EscnnDiffusionPolicy, EscnnLayer  # noqa: E402


class Encoded(EscnnDiffusionPolicy):
    """An escnn network with norms of vectors in between, which our layers do not have."""

    name = "encoded"

    def make_encoder(self, seen, embedding):
        space = seen.gspace
        hidden = nn.FieldType(space, [space.irrep(1)] * 6 + [space.trivial_repr] * 6)
        return nn.SequentialModule(
            nn.Linear(seen, hidden), nn.NormNonLinearity(hidden), nn.Linear(hidden, embedding)
        )


@pytest.mark.parametrize("name", ["C4", "C8", "D4"])
def test_it_has_the_parameters_and_the_functions_of_edp(name):
    """Every matrix of ours is one of escnn's."""
    ours, theirs = (untrained(policy, group=name) for policy in ("edp", "escnn"))
    group = Group.parse(name)
    # Ours also has biases of what turns, which have no effect.
    turning = ~ACT.repeat(8).invariant_mask(reflections=group.reflections)
    assert theirs.parameter_count() == ours.parameter_count() - turning.sum()
    for layer in (
        Lift(OBS, group, 2),
        RegularLinear(group, 2, 3),
        Project(group, 2, ACT),
    ):
        other = EscnnLayer(layer)
        columns = []
        for i in range(other.weight.numel()):
            other.weight.data = torch.eye(other.weight.numel())[i].double()
            columns.append(other.double().dense()[0].flatten())
        basis, wanted = torch.stack(columns, 1), layer.double().dense()[0].flatten()
        coefficients = torch.linalg.lstsq(basis, wanted[:, None]).solution
        assert torch.allclose((basis @ coefficients).squeeze(1), wanted, atol=1e-5)


@pytest.mark.parametrize("name", ["C1", "C8", "D4"])
def test_it_starts_as_edp_of_the_same_seed(name):
    ours, theirs = (untrained(policy, group=name) for policy in ("edp", "escnn"))
    obs, noise = observations(5), noises(5)
    assert ours.decode(obs, noise).abs().max() > 0.01
    assert torch.allclose(theirs.decode(obs, noise), ours.decode(obs, noise), atol=1e-5)


def test_an_escnn_network_may_encode_the_observation(tmp_path):
    options = small_options("escnn", steps=30, batch_size=32)
    policy = Encoded.fit(options, make_episodes(6, noise=0.2), OBS, ACT)
    assert decode_error(policy) <= 1e-5
    obs, noise = observations(4), noises(4)
    far = policy.decode(obs.flip(0), noise)
    assert not torch.allclose(policy.decode(obs, noise), far, atol=1e-2)
    again = load_policy(save_policy(policy, tmp_path / "policy.safetensors"))
    assert torch.equal(again.decode(obs, noise), policy.decode(obs, noise))
    losses = [loss for _, loss in policy.training_record["losses"]]
    assert losses[-1] < losses[0]
