"""What `symsteer new agent` writes."""

import subprocess
import sys

import pytest

from symsteer.agents.new import new
from symsteer.errors import UserError

pytestmark = pytest.mark.long


def test_the_tests_of_new_agents_pass(tmp_path, capsys):
    new("agent", "my-agent", out=tmp_path)
    assert "symsteer run --agent my_agent:MyAgent" in capsys.readouterr().out
    new("agent", "plainer", like="standard", out=tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *("my_agent.py", "plainer.py", "test_my_agent.py", "test_plainer.py")
    ]
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "."]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "9 passed" in done.stdout


@pytest.mark.slow
def test_the_tests_of_a_new_agent_fail_if_it_is_broken(tmp_path):
    new("agent", "my-agent", out=tmp_path)
    file = tmp_path / "my_agent.py"
    text = file.read_text()
    broken = text.replace("return loss + ", "return -loss + ")
    assert broken != text
    file.write_text(broken)
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "learns", "."]
    assert subprocess.run(command, cwd=tmp_path, capture_output=True).returncode == 1


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("9x", "cannot be the name of an agent: use small letters"),
        ("../x", "cannot be the name"),
        ("class", "cannot be the name"),
        ("equivariant", "there is an agent 'equivariant' already"),
    ],
)
def test_names_that_are_refused(name, words, tmp_path):
    with pytest.raises(UserError, match=words):
        new("agent", name, out=tmp_path)
    assert not list(tmp_path.iterdir())


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "test_my_agent.py").write_text("mine")
    with pytest.raises(UserError, match=r"test_my_agent.py is there already"):
        new("agent", "my-agent", out=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["test_my_agent.py"]
    blocked = tmp_path / "test_my_agent.py" / "folder"
    with pytest.raises(UserError, match="cannot be written"):
        new("agent", "my-agent", out=blocked)
