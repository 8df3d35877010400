"""Perceptrons with a derivative that is written out, beside torch's own."""

import itertools

import pytest
import torch
import torch.nn.functional as F

from symsteer.agents import networks
from symsteer.agents.networks import Ensemble, Perceptron


def plain(self, weights, x):
    """What `Ensemble.propagate` computes, left to autograd."""
    for index, (matrix, bias) in enumerate(weights):
        if index:
            if self.layer_norm:
                x = F.layer_norm(x, x.shape[-1:])
            x = x.relu() if self.activation == "relu" else x.tanh()
        x = torch.baddbmm(bias, x, matrix.mT)
    return x


@pytest.mark.parametrize("many", [0, 10**9], ids=["formula", "torch"])
@pytest.mark.parametrize(
    ("sizes", "layer_norm", "activation"),
    [
        ((5, 8, 8, 1), True, "relu"),
        ((5, 8, 3), True, "tanh"),
        ((5, 8, 8, 2), False, "relu"),
        ((5, 8, 1), False, "tanh"),
        ((5, 1), True, "relu"),
    ],
)
def test_values_and_derivatives(sizes, layer_norm, activation, many, monkeypatch):
    monkeypatch.setattr(networks, "MANY", many)
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        numbers = torch.randn(*shape, generator=generator, dtype=torch.float64)
        return numbers.requires_grad_()

    members, count = 3, 6
    x = draw(members, count, sizes[0])
    weights = [(draw(members, b, a), draw(members, 1, b)) for a, b in itertools.pairwise(sizes)]
    flat = [tensor for layer in weights for tensor in layer]
    network = Ensemble.__new__(Ensemble)
    network.__dict__.update(layer_norm=layer_norm, activation=activation)
    out = Perceptron.apply(x, layer_norm, activation, *flat)
    expected = plain(network, weights, x)
    torch.testing.assert_close(out, expected)
    direction = torch.randn(out.shape, generator=generator, dtype=torch.float64)
    for wanted in ([x, *flat], [x], flat):
        mine, theirs = (torch.autograd.grad(y, wanted, direction, True) for y in (out, expected))
        torch.testing.assert_close(mine, theirs)


@pytest.mark.parametrize("name", ["standard", "equivariant"])
def test_a_hundred_updates_are_those_of_autograd(problem, name, monkeypatch):
    def trained():
        agent = problem.agent(name, dtype=torch.float64)
        agent.observe(problem.transition(256))
        for _ in range(100):
            agent.update(agent.new_batch())
        return {key: network.state_dict() for key, network in agent.networks.items()}

    mine = trained()
    monkeypatch.setattr(Ensemble, "propagate", plain)
    torch.testing.assert_close(mine, trained(), rtol=1e-5, atol=1e-5)
