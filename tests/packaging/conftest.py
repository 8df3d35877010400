"""The wheel, and an environment that has it installed: built once for all packaging tests."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

FOLDERS = ("symsteer", "agents", "bench", "leaderboard", "policies")
"""Those with code."""


class Installed:
    """A virtual environment with the wheel and the pinned packages of the running environment.

    Args:
        folder: of the virtual environment.
    """

    def __init__(self, folder: Path):
        self.folder = folder
        paths = sysconfig.get_paths("venv", {"base": str(folder), "platbase": str(folder)})
        self.bin, self.site = Path(paths["scripts"]), Path(paths["purelib"])

    def run(self, cwd: Path, *command: str, path: Path | None = None) -> str:
        """Run a console script in a folder, with one more folder on its import path; stdout."""
        return call(str(self.bin / command[0]), *command[1:], cwd=cwd, path=path)


def call(*command: str, cwd: Path, path: Path | None = None) -> str:
    """Run a command that must not fail, without the import path of the tests; returns stdout."""
    own = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if name not in own}
    if path:
        environment["PYTHONPATH"] = str(path)
    result = subprocess.run(
        command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=1200
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def python(*arguments: str, cwd: Path) -> None:
    """Run the running interpreter."""
    call(sys.executable, *arguments, cwd=cwd)


def build_wheel(source: Path, out: Path) -> Path:
    """The wheel of a source tree, built without the network."""
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index")
    python("-m", "pip", "wheel", *options, "--wheel-dir", str(out), ".", cwd=source)
    (wheel,) = out.glob("*.whl")
    return wheel


@pytest.fixture(scope="session")
def source(tmp_path_factory) -> Path:
    """A copy of the files that belong to the repository."""
    pytest.importorskip("pip", reason="wheels are built with pip")
    folder = tmp_path_factory.mktemp("source") / "symsteer"
    which = ("--cached", "--others", "--exclude-standard")
    for name in call("git", "ls-files", "-z", *which, cwd=ROOT).split("\0"):
        if name and os.path.lexists(ROOT / name):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name, follow_symlinks=False)
    return folder


@pytest.fixture(scope="session")
def wheel(source, tmp_path_factory) -> Path:
    return build_wheel(source, tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="session")
def installed(wheel, tmp_path_factory) -> Installed:
    """The wheel in a fresh virtual environment, which lies inside another project's repository."""
    project = tmp_path_factory.mktemp("project")
    identity = ("-c", "user.name=Someone", "-c", "user.email=someone@example.org")
    for command in (("init", "--quiet"), ("commit", "--quiet", "--allow-empty", "-m", "theirs")):
        call("git", *identity, *command, cwd=project)
    environment = Installed(project / "environment")
    venv.create(environment.folder, with_pip=False)
    options = ("--quiet", "--no-deps", "--no-index")
    target = ("--python", str(environment.bin / "python"))
    python("-m", "pip", *target, "install", *options, str(wheel), cwd=project)
    # The pinned packages are on the path after the environment's own. Python does not read the
    # .pth files of folders that are added this way, so the checkout itself is not importable.
    pinned = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (environment.site / "pinned.pth").write_text("".join(f"{folder}\n" for folder in pinned))
    return environment
