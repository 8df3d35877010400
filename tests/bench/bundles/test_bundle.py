"""Bundles: what goes in comes out, and nothing else is taken."""

import hashlib
import json
import re
import shutil
import stat
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
import torch

import symsteer
from symsteer.bench.bundles.bundle import write_bundle
from symsteer.bench.bundles.card import how_made
from symsteer.bench.bundles.contents import Contents, contents_of_run, contents_of_settings
from symsteer.bench.bundles.fetch import fetch_bundle, read_bundle
from symsteer.bench.bundles.measure import measure
from symsteer.bench.demos import load
from symsteer.bench.runs.arguments import parse_run
from symsteer.bench.runs.base_policy import demonstration_path, find_base, prepare_base
from symsteer.bench.runs.run import execute
from symsteer.bench.tasks import task_class
from symsteer.cli import main
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.files import load_policy, save_policy
from tests.bench.tiny_run import tiny_config, without_clock


def members(bundle):
    with zipfile.ZipFile(bundle) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def files_below(folder):
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*.*")}


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["symsteer", *map(str, arguments)])
    return main()


# ------------------------------------------------------------------ there and back


def test_a_run_elsewhere_finds_what_was_unpacked(run, bundle, tmp_path):
    base = tmp_path / "runs" / "base"
    manifest, places = fetch_bundle(bundle, base)
    before = {path: path.stat().st_mtime_ns for path in base.rglob("*.*")}
    again = execute(tiny_config(agent="zero"), tmp_path / "runs", progress=False)
    assert without_clock(again) == without_clock(run)
    # Neither the demonstrations nor the policy was made again.
    assert {path: path.stat().st_mtime_ns for path in base.rglob("*.*")} == before
    policy = places[manifest.path("policy")]
    assert load_policy(policy).content_hash() == load_policy(run).content_hash()
    assert symsteer.load(policy).world["task"] == "PickCube-v1"
    demos = load(places[manifest.path("demonstrations", ".h5")], "PickCube-v1", "floating")
    assert len(demos) == manifest.demonstrations.count == 3


def test_unpacked_files_are_options_of_a_run(bundle, tmp_path):
    manifest, places = fetch_bundle(bundle, tmp_path / "unpacked")
    policy = places[manifest.path("policy")]
    config = tiny_config(agent="zero")
    with_policy = execute(config, tmp_path / "a", policy=policy, progress=False)
    demos = places[manifest.path("demonstrations", ".h5")]
    with_demos = execute(config, tmp_path / "b", demonstrations=demos, progress=False)
    wanted = load_policy(policy).content_hash()
    assert load_policy(with_policy).content_hash() == wanted
    assert load_policy(with_demos).content_hash() == wanted
    # Such runs can be taken away, too; where the demonstrations are unknown, without them.
    assert contents_of_run(with_policy, "all").left_out
    manifest = write_bundle(contents_of_run(with_demos, "policy"), tmp_path / "b.zip")
    assert manifest.origin.keys() == {"demonstrations"}
    assert manifest.origin["demonstrations"] in members(tmp_path / "b.zip")["CARD.md"].decode()


def test_the_same_contents_give_the_same_bytes(run, bundle, tmp_path):
    write_bundle(contents_of_run(run, "all"), tmp_path / "again.zip")
    assert (tmp_path / "again.zip").read_bytes() == bundle.read_bytes()
    copied = shutil.copytree(run.parent, tmp_path / "elsewhere")
    write_bundle(contents_of_run(copied / run.name, "all"), tmp_path / "copy.zip")
    assert (tmp_path / "copy.zip").read_bytes() == bundle.read_bytes()


def test_settings_are_made_as_a_run_makes_them(run, bundle):
    """What runs/base has is taken; the rest is made, which is the same on the CPU."""
    made = contents_of_settings(tiny_config(agent="zero"), run.parent / "new", "all")
    assert made.policy.content_hash() == load_policy(run).content_hash()
    names = set(members(bundle))
    assert {made.demonstrations.name, f"{made.name}/policy.safetensors"} < names
    taken = contents_of_settings(tiny_config(agent="zero"), run.parent, "demonstrations")
    assert taken.demonstrations.parent == run.parent / "base"
    assert taken.policy is None


# ------------------------------------------------------------------ what a bundle says


def test_the_manifest_lists_every_file_with_its_hash(run, bundle):
    found = members(bundle)
    manifest = json.loads(found["manifest.json"])
    listed = {file["path"]: file for file in manifest["files"]}
    assert listed.keys() == found.keys() - {"manifest.json"}
    for name, file in listed.items():
        assert file["size"] == len(found[name])
        assert file["sha256"] == hashlib.sha256(found[name]).hexdigest()
    task = task_class("PickCube-v1")
    assert manifest["observation_layout"] == task.observation_layout.to_json()
    assert manifest["action_layout"] == task.action_layout.to_json()
    assert (manifest["task"], manifest["embodiment"]) == ("PickCube-v1", "floating")
    assert manifest["demonstrations"] == {"mode": "diverse", "count": 3, "seed": 0}
    assert manifest["policy"] == tiny_config().to_json()["policy"]
    assert manifest["code"]["version"] == symsteer.__version__
    assert manifest["code"]["commit"] or manifest["code"]["sha256"]
    config = tiny_config()
    assert demonstration_path(config, run.parent).name in found
    assert f"{find_base(config, run.parent).name}/policy.safetensors" in found


def test_the_card_gives_what_was_measured(run, bundle):
    found = members(bundle)
    measured = json.loads(found["manifest.json"])["measured"]
    card = found["CARD.md"].decode()
    assert measured["episodes"] == tiny_config().evaluation.final_episodes
    assert f"{measured['successes']} of {measured['episodes']} held-out episodes" in card
    low, high = measured["interval"]
    assert 0 <= low <= measured["success"] <= high <= 1
    assert measured["steerability"] == load_policy(run).report["steerability"]
    assert "of 2 initial states are solved by at least one of 16 draws" in card
    assert measured["equivariance_error"] < 1e-4
    for name, data in found.items():
        if name not in ("CARD.md", "manifest.json"):
            assert f"| `{name}` | {len(data)} | `{hashlib.sha256(data).hexdigest()}` |" in card
    assert "Apache-2.0" in card
    assert "CC BY-NC 4.0" in card


def test_the_command_of_the_card_asks_for_the_same_policy(run, bundle):
    card = members(bundle)["CARD.md"].decode()
    (line,) = re.findall(r"^symsteer run (.* --policy\.name .*)$", card, flags=re.MULTILINE)
    config, _ = parse_run(line.split())
    assert find_base(config, run.parent) == find_base(tiny_config(), run.parent)


def test_flags_and_lists_of_the_command_are_as_they_are_typed():
    options = POLICIES.get("plain").Options(match_parameters=False, hold=("gripper", "yaw"))
    config = tiny_config(policy_name="plain", policy=options, seed=3)
    task = task_class(config.task)
    policy = POLICIES.get("plain")(options, task.observation_layout, task.action_layout)
    made = how_made(Contents("name", config, None, policy, None, {}))
    (line,) = re.findall(r"^symsteer run (.*)$", made, flags=re.MULTILINE)
    found, _ = parse_run(line.split())
    assert (found.policy, found.policy_seed) == (options, 3)
    assert found.demonstrations == config.demonstrations


def test_a_policy_without_symmetry_has_a_large_error(tmp_path):
    config = tiny_config(policy_name="plain")
    policy = prepare_base(config, tmp_path, progress=False)
    plain = measure(config, policy)
    assert plain.group == "C8"
    assert plain.equivariance_error > 1e-2
    del policy.report["steerability"]["solvable"]
    with pytest.raises(UserError, match="lacks a part of its steerability report"):
        measure(config, policy)


def test_parts_alone(run, tmp_path):
    write_bundle(contents_of_run(run, "policy"), tmp_path / "p.zip")
    assert {name.rpartition(".")[2] for name in members(tmp_path / "p.zip")} == {
        *("json", "md", "safetensors")
    }
    manifest = write_bundle(contents_of_run(run, "demonstrations"), tmp_path / "d.zip")
    assert manifest.measured is None
    assert len(members(tmp_path / "d.zip")) == 4
    assert "symsteer demos" in members(tmp_path / "d.zip")["CARD.md"].decode()


def test_a_run_whose_demonstrations_are_gone(run, tmp_path):
    alone = shutil.copytree(run, tmp_path / run.name)
    contents = contents_of_run(alone, "all")
    assert contents.demonstrations is None
    assert "demonstrations" in contents.left_out
    assert contents_of_run(alone, "policy").left_out is None
    with pytest.raises(UserError, match="--contents policy"):
        contents_of_run(alone, "demonstrations")


def test_another_policy_of_the_same_settings_is_not_that_of_the_run(run, tmp_path):
    """A base policy from a file may have the settings of one in runs/base, not its weights."""
    copied = shutil.copytree(run.parent, tmp_path / "runs") / run.name
    policy = load_policy(copied)
    with torch.no_grad():
        next(iter(policy.parameters())).add_(1.0)
    save_policy(policy, copied)
    contents = contents_of_run(copied, "all")
    assert contents.demonstrations is None
    assert policy.content_hash()[:12] in contents.name


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


def damaged(files):
    name = files["manifest.json"]["files"][-1]["path"]
    files[name] = files[name][:-1] + bytes([files[name][-1] ^ 1])


def with_one_more(files):
    files["more.txt"] = b"text"


def with_one_less(files):
    del files[files["manifest.json"]["files"][-1]["path"]]


def larger(files):
    files["manifest.json"]["files"][-1]["size"] = 10**12


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (damaged, "does not have the hash"),
        (with_one_more, "exactly the files"),
        (with_one_less, "exactly the files"),
        (larger, "more bytes than it has"),
        (edited(version=2), "version 2 of the format"),
        (edited(version="1"), "version 1 of the format"),
        (edited(format="other"), "another format"),
        (edited(task="a task"), "wrong in task"),
        (edited(name=".."), "wrong in name"),
        (edited(name="a/b"), "wrong in name"),
        (edited(surprise=1), "wrong in surprise"),
        (edited(files=[{"path": "x"}]), "wrong in files.0"),
        *((renamed(name), "wrong in files") for name in ("x.sh", "CARD.md/policy.safetensors/x")),
        *(
            (renamed(name), "wrong in files")
            for name in ("../policy.safetensors", "policy.safetensors")
        ),
        *((renamed(name), "wrong in files") for name in ("../x", "/x", "a/../x", "a/b/c", ".x")),
        *((renamed(name), "wrong in files") for name in ("a/.x", "x\n", " ", "..", "a\\b", "~/x")),
    ],
)
def test_a_changed_bundle_is_refused_and_nothing_is_left(bundle, tmp_path, change, words):
    path = rewritten(bundle, tmp_path / "mutant.zip", change)
    with pytest.raises(UserError, match=re.escape(words)) as caught:
        fetch_bundle(path, tmp_path / "base")
    assert "mutant.zip" in str(caught.value)
    assert list(tmp_path.iterdir()) == [path]


def test_a_bundle_that_is_only_packed_again_is_accepted(bundle, tmp_path):
    assert read_bundle(rewritten(bundle, tmp_path / "same.zip"))[1].keys() == members(bundle).keys()


def test_compressed_members_links_and_many_bytes_are_refused(bundle, tmp_path):
    squeezed = rewritten(bundle, tmp_path / "a.zip", compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(UserError, match="compressed"):
        read_bundle(squeezed)
    files = members(bundle)
    with zipfile.ZipFile(tmp_path / "b.zip", "w") as archive:
        for name, data in files.items():
            member = zipfile.ZipInfo(name)
            member.external_attr = (stat.S_IFLNK | 0o777) << 16
            archive.writestr(member, data)
    with pytest.raises(UserError, match="a link"):
        read_bundle(tmp_path / "b.zip")
    files["manifest.json"] += b" " * 2**21
    with zipfile.ZipFile(tmp_path / "c.zip", "w") as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    with pytest.raises(UserError, match="larger than listed"):
        read_bundle(tmp_path / "c.zip")


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_truncated_bundle_is_refused(bundle, tmp_path, share):
    data = bundle.read_bytes()
    path = tmp_path / "cut.zip"
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(UserError, match="truncated"):
        fetch_bundle(path, tmp_path / "base")
    assert list(tmp_path.iterdir()) == [path]


def test_foreign_files_are_refused(tmp_path):
    with zipfile.ZipFile(tmp_path / "theirs.zip", "w") as archive:
        archive.writestr("readme.txt", "hello")
    for path, words in (
        (tmp_path / "theirs.zip", "not a bundle of SymSteer"),
        (tmp_path / "nowhere.zip", "there is no file"),
        (tmp_path, "there is no file"),
        (Path("https://example.org/a.zip"), "download it"),
    ):
        with pytest.raises(UserError, match=words):
            fetch_bundle(path, tmp_path / "base")


def test_other_files_of_the_same_name_stay(bundle, tmp_path):
    _, places = fetch_bundle(bundle, tmp_path)
    before = files_below(tmp_path)
    fetch_bundle(bundle, tmp_path)
    assert files_below(tmp_path) == before
    policy = next(place for name, place in places.items() if name.endswith(".safetensors"))
    policy.write_bytes(b"mine")
    card = next(tmp_path.rglob("CARD.md"))
    card.unlink()
    with pytest.raises(UserError, match="is there already"):
        fetch_bundle(bundle, tmp_path)
    assert policy.read_bytes() == b"mine"
    assert not card.exists()


# ------------------------------------------------------------------ the command line


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


def test_export_and_fetch_on_the_command_line(run, bundle, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert command(monkeypatch, "export", run, "--out", "mine.zip") == 0
    assert "symsteer fetch-bundle mine.zip" in capsys.readouterr().out
    assert (tmp_path / "mine.zip").read_bytes() == bundle.read_bytes()
    assert command(monkeypatch, "fetch-bundle", "mine.zip") == 0
    shown = capsys.readouterr().out
    for word in ("--base-policy", "--demos"):
        (place,) = re.findall(rf"next: .* {word} (\S+)", shown)
        assert (tmp_path / place).is_file()
        assert place.startswith("runs/base/")


def test_a_policy_without_its_demonstrations_is_said(run, tmp_path, monkeypatch, capsys):
    alone = shutil.copytree(run, tmp_path / run.name)
    assert command(monkeypatch, "export", alone, "--out", tmp_path / "p.zip") == 0
    assert "the bundle has no demonstrations: " in capsys.readouterr().err


def test_settings_of_the_command_line_reach_the_files(tmp_path, monkeypatch):
    options = ("--count", 2, "--mode", "clean", "--seed", 4, "--contents", "demonstrations")
    path = tmp_path / "d.zip"
    arguments = ("--task", "PushCube-v1", *options, "--runs", tmp_path / "runs", "--out", path)
    assert command(monkeypatch, "export", *arguments) == 0
    manifest, files = read_bundle(path)
    assert manifest.task == "PushCube-v1"
    assert vars(manifest.demonstrations) == {"mode": "clean", "count": 2, "seed": 4}
    description = json.loads(files[manifest.path("demonstrations", ".json")])
    assert description["symsteer"]["mode"] == "clean"
    assert len(description["episodes"]) == 2


def test_fetching_needs_neither_torch_nor_maniskill(bundle, tmp_path):
    program = (
        "import sys; from symsteer.cli import main; "
        f"sys.argv = ['symsteer', 'fetch-bundle', {str(bundle)!r}, '--out', {str(tmp_path)!r}]\n"
        "main()\n"
        "heavy = {'torch', 'mani_skill', 'sapien'} & set(sys.modules)\n"
        "sys.exit(f'imported: {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
