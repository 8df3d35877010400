"""Bundles: what goes in comes out, and nothing else is taken."""

import hashlib
import json
import re
import shlex
import shutil
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

import symsteer
from symsteer.bench.bundles.bundle import measure, write_bundle
from symsteer.bench.bundles.fetch import fetch_bundle, read_bundle
from symsteer.bench.demos import load
from symsteer.bench.runs.arguments import parse_run
from symsteer.bench.runs.base_policy import find_base, prepare_base
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.policies.files import load_policy, save_policy
from tests.bench.tiny_run import execute, quiet, tiny_config, without_clock


def members(bundle):
    with zipfile.ZipFile(bundle) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


# ------------------------------------------------------------------ there and back


def test_a_run_elsewhere_finds_what_was_unpacked(run, bundle, tmp_path):
    base = tmp_path / "runs" / "base"
    manifest, places = fetch_bundle(bundle, base)
    before = {path: path.stat().st_mtime_ns for path in base.rglob("*.*")}
    again = execute(tiny_config(agent="zero"), tmp_path / "runs")
    assert without_clock(again) == without_clock(run)
    # Neither the demonstrations nor the policy was made again.
    assert {path: path.stat().st_mtime_ns for path in base.rglob("*.*")} == before
    policy = places[manifest.path("policy")]
    assert load_policy(policy).content_hash() == load_policy(run).content_hash()
    assert symsteer.load(policy).world["task"] == "PickCube-v1"
    demos = load(places[manifest.path("demonstrations", ".h5")])
    assert len(demos) == manifest.demonstrations.count == 3


def test_unpacked_files_are_options_of_a_run(bundle, tmp_path):
    manifest, places = fetch_bundle(bundle, tmp_path / "unpacked")
    policy = places[manifest.path("policy")]
    wanted = load_policy(policy).content_hash()
    config = tiny_config(agent="zero")
    demos = places[manifest.path("demonstrations", ".h5")]
    with_policy = execute(config, tmp_path / "a", base_policy=policy)
    with_demos = execute(config, tmp_path / "b", demos=demos)
    # Such runs can be taken away, too; where the demonstrations are unknown, without them.
    for made, kind in ((with_policy, "policy"), (with_demos, "demonstrations")):
        assert load_policy(made).content_hash() == wanted
        manifest, absent = write_bundle(made, tmp_path / f"{kind}.zip")
        assert "does not have those that the policy was trained on" in absent
        assert manifest.origin.keys() == {kind}
        held = members(tmp_path / f"{kind}.zip")
        assert held.keys() == {"manifest.json", "CARD.md", manifest.path("policy")}
        assert manifest.origin[kind] in held["CARD.md"].decode()


def test_another_policy_of_the_same_settings_is_not_that_of_the_run(run, tmp_path):
    """A base policy from a file may have the settings of one in runs/base, not its weights."""
    copied = shutil.copytree(run.parent, tmp_path / "runs") / run.name
    policy = load_policy(copied)
    with torch.no_grad():
        next(iter(policy.parameters())).add_(1.0)
    save_policy(policy, copied)
    manifest, absent = write_bundle(copied, tmp_path / "other.zip")
    assert absent
    assert policy.content_hash()[:12] in manifest.name


def test_what_cannot_be_written_is_told_first(run, tmp_path):
    copied = shutil.copytree(run, tmp_path / run.name)
    (copied / "policy.safetensors").unlink()
    (tmp_path / "folder.zip").mkdir()
    for folder, name, words in (
        (copied, "a.zip", "has no base policy yet"),
        (run, "a.tar", "a name that ends in .zip"),
        (run, "folder.zip", "is a folder; name a file"),
    ):
        with pytest.raises(UserError, match=words):
            write_bundle(folder, tmp_path / name)


# ------------------------------------------------------------------ what a bundle says


def test_manifest_and_card_say_what_is_inside(run, bundle):
    held = members(bundle)
    manifest, card = json.loads(held["manifest.json"]), held["CARD.md"].decode()
    listed = {file["path"]: file for file in manifest["files"]}
    assert listed.keys() == held.keys() - {"manifest.json"}
    for name, file in listed.items():
        assert file["size"] == len(held[name])
        assert file["sha256"] == hashlib.sha256(held[name]).hexdigest()
        assert name == "CARD.md" or f"| `{name}` | {file['size']} | `{file['sha256']}` |" in card
    task = task_class("PickCube-v1")
    assert manifest["observation_layout"] == task.observation_layout.to_json()
    assert manifest["action_layout"] == task.action_layout.to_json()
    assert (manifest["task"], manifest["embodiment"]) == ("PickCube-v1", "floating")
    assert manifest["demonstrations"] == {"mode": "diverse", "count": 3, "seed": 0}
    assert manifest["policy"] == tiny_config().to_json()["policy"]
    assert manifest["code"]["version"] == symsteer.__version__
    assert manifest["code"]["commit"] or manifest["code"]["sha256"]
    for words in ("Apache-2.0", "CC BY-NC 4.0", "and the 3 diverse demonstrations"):
        assert words in card
    measured = manifest["measured"]
    assert measured["episodes"] == tiny_config().evaluation.final_episodes
    assert f"{measured['successes']} of {measured['episodes']} held-out episodes" in card
    low, high = measured["interval"]
    assert 0 <= low <= measured["success"] <= high <= 1
    assert measured["steerability"] == load_policy(run).report["steerability"]
    assert measured["equivariance_error"] < 1e-4
    # The command of the card asks for the same policy.
    (line,) = re.findall(r"^symsteer run (.* --policy\.name .*)$", card, flags=re.MULTILINE)
    config, _ = parse_run(shlex.split(line))
    assert find_base(config, run.parent) == find_base(tiny_config(), run.parent)


def test_a_policy_without_symmetry_has_a_large_error(run):
    config = tiny_config(policy_name="plain")
    policy = prepare_base(config, quiet(runs=run.parent))
    plain = measure(config, policy)
    assert plain["group"] == "C8"
    assert plain["equivariance_error"] > 1e-2
    del policy.report["steerability"]["solvable"]
    with pytest.raises(UserError, match="lacks a part of its steerability report"):
        measure(config, policy)


# ------------------------------------------------------------------ what is refused


def rewritten(bundle, path, change=lambda files: None, **options):
    """The bundle with other members; ``change`` edits name to bytes, the manifest as data."""
    files = members(bundle)
    files["manifest.json"] = json.loads(files["manifest.json"])
    change(files)
    files["manifest.json"] = json.dumps(files["manifest.json"]).encode()
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def renamed(to):
    def change(files):
        entry = files["manifest.json"]["files"][-1]
        files[to] = files.pop(entry["path"])
        entry["path"] = to

    return change


def edited(**values):
    return lambda files: files["manifest.json"].update(values)


def last(files):
    return files["manifest.json"]["files"][-1]


def damaged(files):
    name = last(files)["path"]
    files[name] = files[name][:-1] + bytes([files[name][-1] ^ 1])


WRONG_PATHS = (
    *("x.sh", "CARD.md/policy.safetensors/x", "../policy.safetensors", "policy.safetensors"),
    *("../x", "/x", "a/../x", "a/b/c", ".x", "a/.x", "x\n", " ", "..", "a\\b", "~/x"),
)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (damaged, "does not have the hash"),
        (lambda files: files.update({"more.txt": b"text"}), "exactly the files"),
        (lambda files: files.pop(last(files)["path"]), "exactly the files"),
        (lambda files: last(files).update(size=10**12), "more bytes than it has"),
        (edited(version=2), "version 2 of the format"),
        (edited(version="1"), "version 1 of the format"),
        (edited(format="other"), "not that of a bundle"),
        (edited(task="a task"), "wrong in task"),
        (edited(name=".."), "wrong in name"),
        (edited(name="a/b"), "wrong in name"),
        (edited(surprise=1), "wrong in surprise"),
        (edited(files=[{"path": "x"}]), "wrong in files.0"),
        (edited(licence=" " * 2**21), "larger than listed"),
        *((renamed(name), "wrong in files") for name in WRONG_PATHS),
    ],
)
def test_a_changed_bundle_is_refused_and_nothing_is_left(bundle, tmp_path, change, words):
    path = rewritten(bundle, tmp_path / "mutant.zip", change)
    with pytest.raises(UserError, match=re.escape(words)) as caught:
        fetch_bundle(path, tmp_path / "base")
    assert "mutant.zip" in str(caught.value)
    assert list(tmp_path.iterdir()) == [path]


def test_a_bundle_that_is_packed_again_is_accepted_if_its_members_are_plain(bundle, tmp_path):
    assert read_bundle(rewritten(bundle, tmp_path / "same.zip"))[1].keys() == members(bundle).keys()
    squeezed = rewritten(bundle, tmp_path / "a.zip", compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(UserError, match="compressed"):
        read_bundle(squeezed)
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        for name, data in members(bundle).items():
            member = zipfile.ZipInfo(name)
            member.external_attr = (stat.S_IFLNK | 0o777) << 16
            archive.writestr(member, data)
    with pytest.raises(UserError, match="a link"):
        read_bundle(tmp_path / "b.zip")


def test_what_is_no_bundle_is_refused(bundle, tmp_path):
    data = bundle.read_bytes()
    for share in (0.0, 0.1, 0.5, 0.99):
        (tmp_path / f"cut-{share}.zip").write_bytes(data[: int(share * len(data))])
    with zipfile.ZipFile(tmp_path / "theirs.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    for path, words in (
        *((path, "truncated") for path in tmp_path.glob("cut-*")),
        (tmp_path / "theirs.zip", "not that of a bundle"),
        (tmp_path / "nowhere.zip", "there is no file"),
        (tmp_path, "there is no file"),
        (Path("https://example.org/a.zip"), "download it"),
    ):
        with pytest.raises(UserError, match=words):
            fetch_bundle(path, tmp_path / "base")
    assert not (tmp_path / "base").exists()


def test_other_files_of_the_same_name_stay(bundle, tmp_path):
    _, places = fetch_bundle(bundle, tmp_path)
    assert fetch_bundle(bundle, tmp_path)[1] == places
    policy = next(place for name, place in places.items() if name.endswith(".safetensors"))
    policy.write_bytes(b"mine")
    card = next(tmp_path.rglob("CARD.md"))
    card.unlink()
    with pytest.raises(UserError, match="is there already"):
        fetch_bundle(bundle, tmp_path)
    assert policy.read_bytes() == b"mine"
    assert not card.exists()


def test_links_in_the_target_are_not_followed(bundle, tmp_path):
    manifest, _ = fetch_bundle(bundle, tmp_path / "intact")
    policy, demos = manifest.path("policy"), manifest.path("demonstrations", ".h5")
    for number, planted in enumerate((policy, Path(policy).parent, demos, "bundles")):
        out, elsewhere = tmp_path / f"out-{number}", tmp_path / f"elsewhere-{number}"
        link = out / planted
        link.parent.mkdir(parents=True)
        link.symlink_to(elsewhere)
        if link.suffix == "":
            elsewhere.mkdir()
        with pytest.raises(UserError, match="is a link, or in a folder that is one"):
            fetch_bundle(bundle, out)
        assert [p for folder in (out, elsewhere) for p in folder.rglob("*") if p.is_file()] == []
    # The folder itself may be one.
    (tmp_path / "named").symlink_to(tmp_path / "real")
    (tmp_path / "real").mkdir()
    fetch_bundle(bundle, tmp_path / "named")


# ------------------------------------------------------------------ the command line


def test_export_and_fetch_on_the_command_line(run, bundle, tmp_path, command, monkeypatch):
    """The same run gives the same bytes, also from another folder."""
    monkeypatch.chdir(tmp_path)
    copied = Path(shutil.copytree(run.parent, "elsewhere")) / run.name
    code, shown = command("export", copied, "--out", "mine.zip")
    assert code == 0
    assert "symsteer fetch-bundle mine.zip" in shown.out
    assert Path("mine.zip").read_bytes() == bundle.read_bytes()
    code, shown = command("fetch-bundle", "mine.zip")
    assert code == 0
    for word in ("--base-policy", "--demos"):
        (place,) = re.findall(rf"next: .* {word} (\S+)", shown.out)
        assert place.startswith("runs/base/")
        assert Path(place).is_file()


def test_older_bundles_may_have_demonstrations_alone(bundle, tmp_path, command):
    def without_policy(files):
        manifest = files["manifest.json"]
        manifest["measured"] = None
        policy = manifest["files"].pop()
        assert policy["role"] == "policy"
        del files[policy["path"]]

    path = rewritten(bundle, tmp_path / "old.zip", without_policy)
    code, shown = command("fetch-bundle", path, "--runs", tmp_path)
    assert code == 0
    assert "--demos" in shown.out
    assert "policy" not in shown.out


def test_fetching_needs_neither_torch_nor_maniskill(bundle, tmp_path):
    program = (
        "import sys; from symsteer.cli import main; "
        f"sys.argv = ['symsteer', 'fetch-bundle', {str(bundle)!r}, '--runs', {str(tmp_path)!r}]\n"
        "main()\n"
        "heavy = {'torch', 'mani_skill', 'sapien'} & set(sys.modules)\n"
        "sys.exit(f'imported: {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
