"""What the wheel holds."""

import email
import re
import tomllib
import zipfile
from pathlib import PurePosixPath

from packaging.specifiers import SpecifierSet

from symsteer.bench.sweep.suite import load_suite
from symsteer.cli import VERBS
from symsteer.demo import copy_base
from tests.packaging.conftest import FOLDERS, ROOT, build_wheel, python

AUDIT = "leaderboard/results/audit/summary.json"
"""What `report` needs for the map of advantage against measured defect."""


def contents(wheel):
    """Bytes by name, without the lists that the build itself writes."""
    with zipfile.ZipFile(wheel) as file:
        return {name: file.read(name) for name in file.namelist() if not name.endswith("/RECORD")}


def test_the_wheel_is_complete_and_installs_one_name(wheel, source, tmp_path):
    names = {name for name in contents(wheel) if ".dist-info/" not in name}
    wanted = {f"symsteer/{AUDIT}", "symsteer/py.typed"}
    for folder in FOLDERS:
        inside = "" if folder == "symsteer" else "symsteer/"
        for suffix in ("py", "toml"):
            found = (source / folder).rglob(f"*.{suffix}")
            wanted |= {inside + file.relative_to(source).as_posix() for file in found}
    site = "leaderboard/site/"
    for pattern in (
        f"{site}templates/*.html",
        f"{site}static/*",
        "agents/templates/*.txt",
        "leaderboard/studies/*.sha256",
    ):
        wanted |= {f"symsteer/{file.relative_to(source)}" for file in source.glob(pattern)}
    copy_base(load_suite("demo").runs[0], tmp_path)
    base = (file.relative_to(tmp_path) for file in tmp_path.rglob("*") if file.is_file())
    wanted |= {f"symsteer/leaderboard/results/{file}" for file in base}
    assert names == wanted


def test_the_version_is_that_of_the_newest_entry_in_the_changelog(wheel):
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    entries = [
        line.split("[")[1].split("]")[0]
        for line in (ROOT / "CHANGELOG.md").read_text().splitlines()
        if line.startswith("## [")
    ]
    citation = (ROOT / "CITATION.cff").read_text().splitlines()
    assert f"version: {version}" in citation
    assert entries[0] == version
    assert PurePosixPath(wheel.name).name.startswith(f"symsteer-{version}-")


def test_the_description_stands_alone(wheel):
    """It is read without the repository: there are no links and pictures to follow."""
    (name,) = (name for name in contents(wheel) if name.endswith("/METADATA"))
    metadata = email.message_from_bytes(contents(wheel)[name])
    text = metadata.get_payload()
    assert text == (ROOT / "PACKAGE.md").read_text()
    assert not re.search(r"\]\(|<\w+|https?:", text)
    verbs = set(re.findall(r"^symsteer (\w+)", text, re.MULTILINE))
    assert {"doctor", "run", "report"} <= verbs <= VERBS.keys()
    versions = SpecifierSet(metadata["Requires-Python"])
    for minor in range(9, 20):
        classifier = f"Programming Language :: Python :: 3.{minor}"
        assert (f"3.{minor}.1" in versions) == (classifier in metadata.get_all("Classifier"))


def test_a_source_distribution_is_complete_and_gives_the_same_wheel(wheel, source, tmp_path):
    build = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"
    python("-c", build, str(tmp_path), cwd=source)
    (archive,) = tmp_path.glob("*.tar.gz")
    python("-m", "tarfile", "-e", str(archive), str(tmp_path), cwd=tmp_path)
    unpacked = tmp_path / archive.name.removesuffix(".tar.gz")
    for file in source.rglob("*"):
        name = file.relative_to(source)
        own = {"build", "symsteer.egg-info", "symsteer"}  # of a build; links become folders
        assert name.parts[0] in own or (unpacked / name).exists(), name
    assert contents(build_wheel(unpacked, tmp_path)) == contents(wheel)
