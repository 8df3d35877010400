"""SymSteer installed from its wheel and used in an empty folder, far from any checkout."""

import json
import re
from pathlib import Path

import pytest

from symsteer.registry import code_hash

pytestmark = pytest.mark.long

SUITE = """
[grid]
agent = ["base"]

[run]
task = "PickCube-v1"
demonstrations = { count = 3 }
policy = { channels = 8, width = 16, depth = 1, steps = 20 }
evaluation = { final_episodes = 3, final_diagnostic_episodes = 2, steerability_states = 2 }
"""

TAKE = """
from pathlib import Path
from symsteer.bench.sweep.suite import load_suite
from symsteer.demo import copy_base
copy_base(load_suite("demo").runs[0], Path("demo"))
"""
"""What `symsteer demo` does first."""

FOREIGN = 'raise ImportError("another project\'s package")\n'


def test_list_sweep_and_report_in_an_empty_folder(installed, tmp_path):
    where = "import symsteer; print(symsteer.__file__, symsteer.__version__)"
    file, version = installed.run(tmp_path, "python", "-c", where).split()
    assert Path(file).is_relative_to(installed.folder)
    names = installed.run(tmp_path, "symsteer", "list")
    for name in ("PickCube-v1", "action_gain", "equivariant", "golden-ticket", "smoke", "demo"):
        assert re.search(rf"^  {name} ", names, re.MULTILINE), names
    assert not list(tmp_path.iterdir())
    installed.run(tmp_path, "python", "-c", TAKE)
    assert list(tmp_path.glob("demo/base/*/policy.safetensors"))
    (tmp_path / "tiny.toml").write_text(SUITE)
    installed.run(tmp_path, "symsteer", "sweep", "tiny.toml", "--workers", "1")
    installed.run(tmp_path, "symsteer", "report", "runs")
    page = tmp_path / "runs" / "leaderboard" / "LEADERBOARD.md"
    assert "PickCube-v1" in page.read_text()
    assert list((page.parent / "figures").glob("*.svg"))
    assert "without the documentation" in installed.run(tmp_path, "symsteer", "site", "runs")
    assert (tmp_path / "site" / "index.html").is_file()
    (file,) = tmp_path.glob("runs/*/record.json")
    record = json.loads(file.read_text())
    assert record["schema_version"] == 6
    # Version and hash stand for the commit, though the environment lies in a repository.
    provenance = record["provenance"]
    assert (provenance["commit"], provenance["version"]) == (None, version)
    assert provenance["sha256"] == code_hash("symsteer")  # of the checkout: the same files
    assert provenance["extensions"] == []


@pytest.mark.slow
def test_a_foreign_package_of_the_same_name_is_never_imported(installed, tmp_path):
    """Packages ``agents`` exist: that of ``openai-agents``, for one."""
    foreign, folder = tmp_path / "foreign", tmp_path / "empty"
    folder.mkdir()
    for name in ("agents", "bench", "leaderboard", "policies"):
        (foreign / name).mkdir(parents=True)
        (foreign / name / "__init__.py").write_text(FOREIGN)
    (folder / "tiny.toml").write_text(SUITE)
    assert "equivariant" in installed.run(folder, "symsteer", "list", path=foreign)
    installed.run(folder, "symsteer", "sweep", "tiny.toml", "--workers", "1", path=foreign)
    assert len(list(folder.glob("runs/*/record.json"))) == 1
