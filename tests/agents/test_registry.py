"""The registry: SymSteer's agents, those of other distributions, and classes for trying."""

import sys
from importlib import metadata

import pytest

import symsteer.registry
from symsteer.agents import AGENTS
from symsteer.agents.agent import Agent
from symsteer.agents.equivariant import EquivariantAgent
from symsteer.errors import UserError
from symsteer.registry import NotAllowedError, allow

MINE = """
from symsteer.agents.standard import StandardAgent

class Mine(StandardAgent):
    '''My own agent.

    More about it.
    '''
    name = "mine"

class NoAgent:
    name = "none"
"""


@pytest.fixture
def module(monkeypatch, tmp_path):
    """Writes a module that can be imported for the length of a test."""
    monkeypatch.setattr(symsteer.registry, "_allowed", {})
    monkeypatch.syspath_prepend(tmp_path)
    before = set(sys.modules)

    def write(text, name="my_agents"):
        (tmp_path / f"{name}.py").write_text(text)

    yield write
    for name in set(sys.modules) - before:
        if name.startswith("my_"):
            del sys.modules[name]


@pytest.fixture
def entry_points(monkeypatch):
    """Stands in for installed distributions."""

    class Dist(metadata.Distribution):
        def __init__(self, name):
            self._name = name

        def read_text(self, filename):
            return f"Name: {self._name}\nVersion: 1.2\n" if filename == "METADATA" else None

        def locate_file(self, path):
            return path

    def install(*points):
        found = {}
        for distribution, name, value in points:
            point = metadata.EntryPoint(name, value, "symsteer.agents")._for(Dist(distribution))
            found.setdefault(name, []).append(point)
        monkeypatch.setattr(symsteer.registry, "_entry_points", lambda group: found)

    return install


def test_the_order_is_that_of_a_comparison():
    learners = ["standard", "standard-matched", "augmented", "equivariant", "residual-pathway"]
    assert AGENTS.names()[:5] == learners
    roles = [AGENTS.get(name).role for name in AGENTS.builtin]
    assert roles == ["learner"] * 15 + ["control"] + ["reference"] * 3


@pytest.mark.parametrize("name", AGENTS.builtin)
def test_each_agent_says_its_name_role_options_and_what_it_is(name):
    agent = AGENTS.get(name)
    assert agent.name == name
    assert AGENTS.summary(name) == agent.__doc__.partition("\n")[0].replace("``", "")
    assert agent.Options() == agent.Options()
    assert AGENTS.extension(name) is None


def test_an_entry_point_is_an_agent(module, entry_points):
    module(MINE)
    entry_points(("lab-agents", "mine", "my_agents:Mine"))
    assert AGENTS.names()[-1] == "mine"
    assert AGENTS.summary("mine") == "My own agent."
    assert issubclass(AGENTS.get("mine"), Agent)
    extension = AGENTS.extension("mine")
    assert (extension.kind, extension.name, extension.target) == ("agent", "mine", "my_agents:Mine")
    assert (extension.distribution, extension.version) == ("lab-agents", "1.2")
    assert len(extension.sha256) == 64


def test_a_class_can_be_tried_by_its_place_once_it_is_allowed(module):
    module(MINE)
    with pytest.raises(NotAllowedError, match="add --trust my_agents:Mine"):
        AGENTS.get("my_agents:Mine")
    assert "my_agents" not in sys.modules
    allow("my_agents:Mine")
    assert AGENTS.get("my_agents:Mine").name == "mine"
    first = AGENTS.extension("my_agents:Mine")
    assert (first.distribution, first.version) == (None, None)
    module(MINE + "\n# changed\n")
    assert AGENTS.extension("my_agents:Mine").sha256 != first.sha256


@pytest.mark.parametrize(
    ("text", "name", "sentence"),
    [
        (MINE, "my_agents:NoAgent", r"NoAgent cannot be used as agent; .*inherits from .*Agent"),
        (MINE, "my_agents:Mein", r"my_agents has no Mein"),
        (MINE, "my_agent:Mine", r"cannot be imported from my_agent .*ModuleNotFoundError"),
        ("x = 1 +", "my_agents:Mine", r"my_agents .*SyntaxError.*line 1"),
        ("import os\n\n1 / 0", "my_agents:Mine", r"ZeroDivisionError: division by zero, line 3"),
    ],
)
def test_what_cannot_be_an_agent_is_named(module, text, name, sentence):
    module(text)
    allow(name)
    with pytest.raises(UserError, match=sentence):
        AGENTS.get(name)


def test_an_unknown_name_gets_the_nearest():
    with pytest.raises(UserError, match=r"no agent 'equivarient'; did you mean 'equivariant'\?"):
        AGENTS.get("equivarient")


def test_two_distributions_with_one_name_are_refused(module, entry_points):
    module(MINE)
    entry_points(("a", "mine", "my_agents:Mine"), ("b", "mine", "my_agents:Mine"))
    with pytest.raises(UserError, match="a and b both offer the agent 'mine'"):
        AGENTS.get("mine")
    entry_points(("a", "equivariant", "my_agents:Mine"))
    with pytest.raises(UserError, match="symsteer and a both offer"):
        AGENTS.get("equivariant")


def test_a_broken_distribution_does_not_hide_the_others(entry_points):
    entry_points(("broken", "broken", "not_there:Agent"))
    assert AGENTS.get("equivariant") is EquivariantAgent
    assert AGENTS.summary("broken") == ""
    with pytest.raises(UserError, match="not_there"):
        AGENTS.get("broken")
