"""What this machine can do, and what to install for more.

Runs without ManiSkill, torch or a driver: a failed import is a finding, not a crash.
"""

from __future__ import annotations

import ctypes.util
import importlib
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, metadata, requires, version
from pathlib import Path

from packaging.requirements import Requirement

from symsteer.bench.sim.versions import PINNED

_RENDER_PROBE = (
    "import warnings; warnings.simplefilter('ignore'); import sapien; "
    "print(sapien.render.RenderSystem().device.name)"
)
_PROBE_SECONDS = 60

RENDERING_CURE = (
    "install your GPU's Vulkan driver, or (software rendering) apt install chromium and set "
    "VK_ICD_FILENAMES to /usr/lib/chromium/vk_swiftshader_icd.json"
)
"""How to get pictures and videos."""

_ROOT = Path(__file__).resolve().parents[2]
_IN_CHECKOUT = (_ROOT / "Makefile").is_file() and (_ROOT / "pyproject.toml").is_file()
_REINSTALL = "make setup" if _IN_CHECKOUT else "pip install --force-reinstall symsteer"

_DEVELOPMENT = "dev"
"""The extra that only developers of SymSteer need."""


@dataclass(frozen=True)
class Check:
    """One finding about this machine.

    Attributes:
        name: what was checked.
        ok: whether it was found.
        detail: what was found, one line.
        cure: what to do about it, one line; empty if nothing is needed.
        required: whether SymSteer needs it.
    """

    name: str
    ok: bool
    detail: str
    cure: str = ""
    required: bool = False


def probe() -> list[Check]:
    """Check processors, memory, packages, system libraries, CUDA, PhysX on GPU and rendering.

    Never raises: an unexpected error of a check is its finding.
    """
    return [_guarded(name, check) for name, check in _CHECKS.items()]


def _guarded(name: str, check: Callable[[], Check]) -> Check:
    try:
        return check()
    except Exception as error:
        return Check(name, False, f"{type(error).__name__}: {error}")


def _check_processors() -> Check:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return Check("processors", True, f"{cores} usable; one simulation process uses one")


def _check_memory() -> Check:
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    limit = _container_memory_gib()
    usable = total if limit is None else min(total, limit)
    enough = usable >= 4
    return Check(
        "memory",
        enough,
        f"{usable:.1f} GiB",
        "" if enough else "a demo run needs about 4 GiB: close other programs",
    )


def _container_memory_gib() -> float | None:
    path = Path("/sys/fs/cgroup/memory.max")
    text = path.read_text().strip() if path.exists() else "max"
    return None if text == "max" else int(text) / 2**30


def _check_python() -> Check:
    found = ".".join(map(str, sys.version_info[:3]))
    ok = sys.version_info[:2] == (3, 11)
    return Check("python", ok, found, "" if ok else "install Python 3.11", required=True)


def _check_versions() -> Check:
    requirements = _requirements("")
    wrong = [r for r in requirements if not _satisfied(r)]
    shown = [r.name for r in requirements if r.name in (*PINNED, "torch", "numpy")]
    details = [f"{r.name}{r.specifier} (found: {_installed(r.name)})" for r in wrong]
    packages = " ".join(f"'{r.name}{r.specifier}'" for r in wrong)
    return Check(
        "package versions",
        not wrong,
        f"wrong: {', '.join(details)}"
        if wrong
        else ", ".join(f"{name} {_installed(name)}" for name in shown),
        "" if not wrong else "make setup" if _IN_CHECKOUT else f"pip install {packages}",
        required=True,
    )


def _check_extras() -> Check:
    try:
        names = metadata("symsteer").get_all("Provides-Extra") or []
    except PackageNotFoundError:
        names = []
    extras = [name for name in names if name != _DEVELOPMENT]
    absent = [name for name in extras if not all(map(_satisfied, _requirements(name)))]
    found = ", ".join(name for name in extras if name not in absent) or "none"
    return Check(
        "optional packages",
        not absent,
        f"{found} found; absent: {', '.join(absent)}" if absent else f"{found} found",
        f"optional: {_install(absent)}" if absent else "",
    )


def _install(extras: Sequence[str]) -> str:
    return "make setup" if _IN_CHECKOUT else f"pip install 'symsteer[{','.join(extras)}]'"


def _requirements(extra: str) -> list[Requirement]:
    """Requirements of an extra; of SymSteer itself for ``""``.

    Only the simulator's pinned versions if SymSteer is not installed.
    """
    try:
        texts = requires("symsteer") or []
    except PackageNotFoundError:
        texts = [f"{package}=={wanted}" for package, wanted in PINNED.items()]
    found = []
    for requirement in map(Requirement, texts):
        always = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if always != bool(extra) and (always or requirement.marker.evaluate({"extra": extra})):  # type: ignore[union-attr]
            found.append(requirement)
    return found


def _installed(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "missing"


def _satisfied(requirement: Requirement) -> bool:
    installed = _installed(requirement.name)
    return installed != "missing" and requirement.specifier.contains(installed)


def _check_x11() -> Check:
    try:
        ctypes.CDLL("libX11.so.6")
    except OSError:
        return Check(
            "libX11",
            False,
            "libX11.so.6 is missing; SAPIEN links to it, also without a display",
            "apt install libx11-6 (Fedora: dnf install libX11)",
            required=True,
        )
    return Check("libX11", True, "found", required=True)


def _check_simulator() -> Check:
    from symsteer.bench.sim.headless import silence_import_noise

    silence_import_noise()
    try:
        importlib.import_module("mani_skill.envs")
    except Exception as error:
        # The usual reason is a missing shared library; the message begins with its name.
        library = str(error).split(":")[0]
        packages = {"libX11.so.6": "libx11-6", "libGL.so.1": "libgl1", "libEGL.so.1": "libegl1"}
        cure = f"apt install {packages[library]}" if library in packages else _REINSTALL
        return Check("ManiSkill", False, f"cannot be imported: {error}", cure, required=True)
    return Check("ManiSkill", True, "imports", required=True)


def _check_torch() -> Check:
    torch = importlib.import_module("torch")
    if not torch.cuda.is_available():
        return Check(
            "CUDA",
            False,
            f"torch {torch.__version__} sees no GPU; everything runs on the CPU",
            "optional: an NVIDIA GPU with its driver and the CUDA build of torch",
        )
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return Check("CUDA", True, f"torch {torch.__version__}: {', '.join(names)}")


def _check_physx_gpu() -> Check:
    physx = importlib.import_module("sapien.physx")
    library = Path.home() / ".sapien" / "physx" / physx.version() / "libPhysXGpu_64.so"
    torch = importlib.import_module("torch")
    if not torch.cuda.is_available():
        return Check("PhysX on GPU", False, "needs CUDA; sim=cpu works without", "")
    if not library.exists():
        return Check(
            "PhysX on GPU",
            False,
            f"{library.name} has not been downloaded yet",
            "optional: python -c 'import sapien.physx as p; p.enable_gpu()' downloads it; "
            "sim=cpu with the learner on CUDA works without",
        )
    try:
        ctypes.CDLL(str(library))
    except OSError as error:
        return Check(
            "PhysX on GPU",
            False,
            f"{library.name} does not load: {error}",
            f"delete {library.parent} and let SAPIEN download it again",
        )
    return Check("PhysX on GPU", True, f"{library.name} found: sim=cuda works")


def _check_rendering() -> Check:
    # In a process of its own: a broken driver may crash it.
    try:
        result = subprocess.run(
            [sys.executable, "-P", "-c", _RENDER_PROBE],
            capture_output=True,
            text=True,
            timeout=_PROBE_SECONDS,
        )
        lines = result.stdout.strip().splitlines()
        ok = result.returncode == 0 and bool(lines)
        errors = result.stderr.strip().splitlines()
    except subprocess.TimeoutExpired:
        ok, errors = False, [f"the driver did not answer in {_PROBE_SECONDS} s"]
    if ok:
        return Check("rendering", True, f"Vulkan device: {lines[-1]}")
    reason = errors[-1].split(": ", 1)[-1] if errors else "the driver crashed"
    return Check(
        "rendering",
        False,
        f"{reason}; pictures and videos need a Vulkan device, state-only runs do not",
        f"optional: {RENDERING_CURE}",
    )


def _check_tensorboard() -> Check:
    if (found := _installed("tensorboard")) == "missing":
        return Check("TensorBoard", False, found, "pip install tensorboard", required=True)
    return Check("TensorBoard", True, f"{found}: tensorboard --logdir runs", required=True)


_CHECKS: dict[str, Callable[[], Check]] = {
    "processors": _check_processors,
    "memory": _check_memory,
    "python": _check_python,
    "package versions": _check_versions,
    "optional packages": _check_extras,
    "libX11": _check_x11,
    "ManiSkill": _check_simulator,
    "CUDA": _check_torch,
    "PhysX on GPU": _check_physx_gpu,
    "rendering": _check_rendering,
    "TensorBoard": _check_tensorboard,
}
