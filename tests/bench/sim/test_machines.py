"""Machines without Vulkan, CUDA or libraries, or with other versions of the simulator."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
import tomllib
import warnings
from importlib import metadata
from pathlib import Path

import pytest
import sapien.render
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv

from symsteer.bench.sim import capabilities, versions
from symsteer.bench.sim import environment as batched
from symsteer.bench.sim.capabilities import probe
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.sim.parallel import create
from symsteer.errors import UserError
from symsteer.extras import EXTRAS

ROOT = Path(__file__).parents[3]
NO_VULKAN = {"VK_ICD_FILENAMES": "/nonexistent.json", "VK_DRIVER_FILES": "/nonexistent.json"}


def run_python(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run code in a fresh interpreter."""
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": os.getcwd(), "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )


def test_headless_without_vulkan():
    """Without a driver, states work, also in stock ManiSkill; cameras are refused; no warnings.

    The first environment of a process frees its scenes like every other.
    """
    code = """
import gc
from symsteer.bench.sim import environment
from symsteer.bench.sim.headless import prepare_headless
from symsteer.bench.sim.parallel import create
from symsteer.errors import UserError
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
create(PickCubeEnv, 3, obs_mode="state").close()
gc.collect()
assert environment._count(environment._LIVE_SCENES) == 0
assert prepare_headless() is False
stock = PickCubeEnv(sim_backend="physx_cpu", render_backend="none", obs_mode="state")
for env in (create(PickCubeEnv, 2, obs_mode="state"), stock):
    env.step(env.action_space.sample())
for settings in (dict(render=True), dict(obs_mode="rgb")):
    try:
        create(PickCubeEnv, 1, **settings)
    except UserError as error:
        assert "Vulkan driver" in str(error)
    else:
        raise SystemExit("no error")
print("done")
"""
    result = run_python(code, **NO_VULKAN)
    assert result.stdout.strip().endswith("done"), result.stderr
    assert "Warning" not in result.stderr


def test_cameras_with_vulkan():
    """Human cameras and mounted sensors show each scene's own state."""
    if not rendering_works():
        pytest.skip("no Vulkan device")
    env = create(
        PickCubeEnv, 2, render=True, obs_mode="rgb+segmentation", robot_uids="panda_wristcam"
    )
    obs, _ = env.reset(seed=[1, 2])
    assert obs["sensor_data"]["hand_camera"]["rgb"].shape == (2, 128, 128, 3)
    first, second = env.render()
    assert (first != second).any()
    env.cube.set_pose(torch.tensor([[0, 0, 5.0, 1, 0, 0, 0]]).repeat(2, 1))
    env.scene._gpu_apply_all()
    env.scene._gpu_fetch_all()
    assert (env.render()[0] != first).any()


def test_the_renderer_is_started_once_for_each_environment():
    """Not for each material of an environment without cameras."""
    if not rendering_works():
        pytest.skip("no Vulkan device")
    env = create(PickCubeEnv, 1)
    assert isinstance(env._renderer, sapien.render.RenderMaterial)
    assert create(PickCubeEnv, 1, obs_mode="rgb")._renderer is None


def test_another_release_gives_one_warning(monkeypatch):
    """Whatever its distribution is called, and however many environments are made."""
    monkeypatch.setitem(versions.TESTED, "sapien", "9.9")
    monkeypatch.delenv("SYMSTEER_VERSIONS_SAID", raising=False)
    version = metadata.version

    def nightly(name):
        if name == "mani-skill":
            raise metadata.PackageNotFoundError(name)
        return "2030.1.1" if name == "mani-skill-nightly" else version(name)

    monkeypatch.setattr(metadata, "version", nightly)
    owners = {"mani_skill": ["mani-skill-nightly"]}
    monkeypatch.setattr(metadata, "packages_distributions", lambda: owners)
    words = r"tested with mani-skill 3\.0\.1 and sapien 9\.9; mani-skill-nightly 2030\.1\.1 and sap"
    with pytest.warns(UserWarning, match=words):
        create(PickCubeEnv, 1).close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        create(PickCubeEnv, 1).close()
    (check,) = [check for check in probe() if check.name == "tested simulator"]
    assert (check.ok, check.required) == (False, False)
    assert "sapien==9.9" in check.cure


def test_doctor_knows_what_the_package_asks_for():
    """Names of distributions, but for ManiSkill, which it checks by itself."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = {re.split(r"[<>=]", text)[0] for text in project["dependencies"]}
    assert asked == {*capabilities.REQUIRED.values(), "mani-skill"}
    assert {*project["optional-dependencies"]} == {*EXTRAS, "dev", "test"}


def test_doctor_and_other_verbs_without_a_package():
    """`doctor` names what is missing; other verbs name `doctor`."""
    code = """
import sys
for name in ("escnn", "h5py", "mani_skill", "optuna", "plotly", "ray", "tyro", "wandb"):
    sys.modules[name] = None
sys.argv = ["symsteer", "WORD"]
from symsteer.cli import main
sys.exit(main())
"""
    shown = run_python(code.replace("WORD", "doctor"))
    assert (shown.returncode, shown.stderr) == (1, "")
    lines = shown.stdout.splitlines()
    assert [line for line in lines if line.startswith("MISSING ManiSkill")]
    (place,) = [i for i, line in enumerate(lines) if line.startswith("MISSING packages")]
    assert lines[place + 1].endswith("-> pip install h5py tyro")
    (place,) = [i for i, line in enumerate(lines) if line.startswith("absent  extra escnn")]
    assert lines[place + 1].endswith("-> optional: pip install --no-deps escnn==1.0.11 joblib")
    shown = run_python(code.replace("WORD", "status"))
    assert shown.returncode == 1
    assert re.fullmatch(
        "error: a package cannot be imported: .*tyro.*; `symsteer doctor` says what to install\n",
        shown.stderr,
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sim": "gpu"}, 'Unknown simulator "gpu": choose "cpu" or "cuda"'),
        ({"num_envs": 0}, "at least one environment"),
    ],
)
def test_bad_settings(settings, message):
    """Each wrong setting is answered by one sentence."""
    with pytest.raises(UserError, match=message):
        create(PickCubeEnv, **{"num_envs": 2, **settings})


def test_more_scenes_than_a_process_can_hold(monkeypatch):
    """Closed environments free their scenes; too many scenes are refused before PhysX crashes."""
    gc.collect()
    before = batched._count(batched._LIVE_SCENES)
    monkeypatch.setattr("symsteer.bench.sim.environment.MAX_SCENES", before + 12)
    for _ in range(3):
        env = create(PickCubeEnv, 5, obs_mode="state")
        env.reset(seed=0, options={"reconfigure": True})
        env.close()
        del env
    env = create(PickCubeEnv, 7, obs_mode="state")
    with pytest.raises(UserError, match=r"7 were asked for.*workers"):
        env.reset(seed=0, options={"reconfigure": True})
    # The refused environment can still be used.
    env.reset(seed=0)
    assert env.step(torch.zeros(7, 8))[0].isfinite().all()
    with pytest.raises(UserError, match="workers"):
        create(PickCubeEnv, 13, obs_mode="state")


def test_dropped_scenes_are_collected_before_they_are_many(monkeypatch):
    monkeypatch.setattr("symsteer.bench.sim.environment.MAX_DROPPED", 3)
    gc.collect()
    gc.disable()
    try:
        env, dropped = create(PickCubeEnv, 2, obs_mode="state"), []
        for _ in range(4):
            env.reset(seed=0, options={"reconfigure": True})
            dropped.append(batched._count(batched._DROPPED_SCENES))
        env.close()
    finally:
        gc.enable()
    # The task still names actors of the last scene when the second one is dropped.
    assert dropped == [2, 2, 2, 2]


def test_physx_gpu_library_missing(monkeypatch):
    """A GPU without PhysX's library, which cannot be downloaded: one sentence with the cure."""

    def no_network():
        raise RuntimeError("<urlopen error [Errno -3] Temporary failure in name resolution>")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr("sapien.physx.enable_gpu", no_network)
    with pytest.raises(UserError, match=r"PhysX's GPU library[^\n]*use sim='cpu'"):
        create(PickCubeEnv, 2, sim="cuda")


@pytest.mark.gpu
def test_cuda():
    """ManiSkill's own GPU simulation, where its library is."""
    if not torch.cuda.is_available():
        pytest.skip("no CUDA")
    library = next(check for check in probe() if check.name == "PhysX on GPU")
    if not library.ok:
        pytest.skip(library.detail)
    env = create(PickCubeEnv, 4, sim="cuda", obs_mode="state")
    assert env.reset(seed=[1, 2, 3, 4])[0].is_cuda


def test_probe_of_this_machine():
    """Every finding is one line, and nothing required is missing."""
    checks = probe()
    assert len({check.name for check in checks}) == len(checks) == 7 + len(EXTRAS)
    for check in checks:
        assert "\n" not in check.detail + check.cure
        assert check.ok or not check.required, check


def test_probe_without_libraries():
    """With ManiSkill, SAPIEN and torch not importable, the probe names the package to install."""
    code = """
import sys
class Missing:
    def find_spec(self, name, path=None, target=None):
        if name in ("sapien", "mani_skill", "torch"):
            raise ImportError("libX11.so.6: cannot open shared object file: No such file")
sys.meta_path.insert(0, Missing())
from symsteer.bench.sim.capabilities import probe
for check in probe():
    print(check.name, check.ok, check.cure, sep="|")
"""
    result = run_python(code)
    assert "ManiSkill|False|apt install libx11-6" in result.stdout, result.stderr
    assert "CUDA|False|" in result.stdout
