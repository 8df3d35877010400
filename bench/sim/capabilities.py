"""What this machine can do, and what to install for more.

Runs without ManiSkill, torch or a driver: a failed import is a finding, not a crash.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from symsteer.bench.sim.headless import RENDERING_CURE, silence_import_noise
from symsteer.bench.sim.versions import PINNED, check_versions
from symsteer.errors import UserError

_RENDER_PROBE = (
    "import warnings; warnings.simplefilter('ignore'); import sapien; "
    "print(sapien.render.RenderSystem().device.name)"
)
_PROBE_SECONDS = 60


@dataclass(frozen=True)
class Check:
    """One finding about this machine.

    Attributes:
        name: what was checked.
        required: whether SymSteer needs it.
        ok: whether it was found.
        detail: what was found, one line.
        cure: what to do about it, one line; empty if nothing is needed.
    """

    name: str
    required: bool
    ok: bool
    detail: str
    cure: str = ""


class _AbsentError(Exception):
    """Something is not there; its arguments are the detail and the cure of a `Check`."""


def probe() -> list[Check]:
    """Check memory, packages, system libraries, CUDA, PhysX on GPU and rendering.

    Never raises: an unexpected error of a check is its finding.
    """
    return [_checked(name, required, find) for name, (required, find) in _CHECKS.items()]


def _checked(name: str, required: bool, find: Callable[[], str]) -> Check:
    try:
        return Check(name, required, True, find())
    except _AbsentError as absent:
        return Check(name, required, False, *absent.args)
    except Exception as error:
        return Check(name, required, False, f"{type(error).__name__}: {error}")


def _memory() -> str:
    usable = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    container = Path("/sys/fs/cgroup/memory.max")
    limit = container.read_text().strip() if container.exists() else "max"
    usable = usable if limit == "max" else min(usable, int(limit) / 2**30)
    if usable < 4:
        raise _AbsentError(
            f"{usable:.1f} GiB", "a demo run needs about 4 GiB: close other programs"
        )
    return f"{usable:.1f} GiB"


def _versions() -> str:
    try:
        check_versions()
    except UserError as error:
        raise _AbsentError(*str(error).split(": ", 1)) from error
    return ", ".join(f"{name} {version(name)}" for name in (*PINNED, "torch", "numpy"))


def _maniskill() -> str:
    silence_import_noise()
    try:
        importlib.import_module("mani_skill.envs")
    except Exception as error:
        # The usual reason is a missing shared library; the message begins with its name.
        library = str(error).split(":")[0]
        packages = {"libX11.so.6": "libx11-6", "libGL.so.1": "libgl1", "libEGL.so.1": "libegl1"}
        cure = "pip install --force-reinstall symsteer"
        if library in packages:
            cure = f"apt install {packages[library]}"
        raise _AbsentError(f"cannot be imported: {error}", cure) from error
    return "imports"


def _cuda() -> str:
    torch = importlib.import_module("torch")
    if not torch.cuda.is_available():
        raise _AbsentError(
            f"torch {torch.__version__} sees no GPU; everything runs on the CPU",
            "optional: an NVIDIA GPU with its driver and the CUDA build of torch",
        )
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return f"torch {torch.__version__}: {', '.join(names)}"


def _physx_gpu() -> str:
    physx = importlib.import_module("sapien.physx")
    library = Path.home() / ".sapien" / "physx" / physx.version() / "libPhysXGpu_64.so"
    if not importlib.import_module("torch").cuda.is_available():
        raise _AbsentError("needs CUDA; sim=cpu works without")
    if not library.exists():
        raise _AbsentError(
            f"{library.name} has not been downloaded yet",
            "optional: python -c 'import sapien.physx as p; p.enable_gpu()' downloads it; "
            "sim=cpu with the learner on CUDA works without",
        )
    try:
        ctypes.CDLL(str(library))
    except OSError as error:
        cure = f"delete {library.parent} and let SAPIEN download it again"
        raise _AbsentError(f"{library.name} does not load: {error}", cure) from error
    return f"{library.name} found: sim=cuda works"


def _rendering() -> str:
    # In a process of its own: a broken driver may crash it.
    command = [sys.executable, "-P", "-c", _RENDER_PROBE]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_SECONDS)
        devices = done.stdout.strip().splitlines() if done.returncode == 0 else []
        errors = done.stderr.strip().splitlines()
    except subprocess.TimeoutExpired:
        devices, errors = [], [f"the driver did not answer in {_PROBE_SECONDS} s"]
    if not devices:
        reason = errors[-1].split(": ", 1)[-1] if errors else "the driver crashed"
        raise _AbsentError(
            f"{reason}; pictures and videos need a Vulkan device, state-only runs do not",
            f"optional: {RENDERING_CURE}",
        )
    return f"Vulkan device: {devices[-1]}"


_CHECKS: dict[str, tuple[bool, Callable[[], str]]] = {
    "memory": (False, _memory),
    "package versions": (True, _versions),
    "ManiSkill": (True, _maniskill),
    "CUDA": (False, _cuda),
    "PhysX on GPU": (False, _physx_gpu),
    "rendering": (False, _rendering),
}
"""Whether SymSteer needs it, and how it is found."""
