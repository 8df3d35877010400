"""What this machine can do, and what to install for more.

Only the standard library is imported here: any package may be missing, and that is a finding.
"""

from __future__ import annotations

import argparse
import ctypes
import functools
import importlib
import os
import subprocess
import sys
import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from symsteer.bench.sim.headless import RENDERING_CURE, silence_import_noise
from symsteer.bench.sim.versions import TESTED, installed, untested
from symsteer.errors import UserError
from symsteer.extras import EXTRAS, command
from symsteer.names import check

REQUIRED = {
    "filelock": "filelock",
    "gymnasium": "gymnasium",
    "h5py": "h5py",
    "matplotlib": "matplotlib",
    "numpy": "numpy",
    "packaging": "packaging",
    "pebble": "pebble",
    "PIL": "pillow",
    "pydantic": "pydantic",
    "pytorch_kinematics": "pytorch-kinematics",
    "safetensors": "safetensors",
    "sapien": "sapien",
    "scipy": "scipy",
    "tensorboard": "tensorboard",
    "torch": "torch",
    "tqdm": "tqdm",
    "tyro": "tyro",
}
"""What every run imports besides ManiSkill, and the distribution that has it."""

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


def doctor(arguments: list[str]) -> int:
    """Show what this machine can do, and what to install for more."""
    parser = argparse.ArgumentParser("symsteer doctor", description=doctor.__doc__)
    parser.add_argument(
        "--quiet", action="store_true", help="Show only what is required and missing."
    )
    options, others = parser.parse_known_args(arguments)
    check("option of doctor", others, ["--quiet"])
    checks = probe()
    for one in checks:
        if options.quiet and (one.ok or not one.required):
            continue
        mark = "ok     " if one.ok else "MISSING" if one.required else "absent "
        print(f"{mark} {one.name:18s} {one.detail}")
        if not one.ok and one.cure:
            print(f"{'':26s} -> {one.cure}")
    return 0 if all(one.ok or not one.required for one in checks) else 1


def probe() -> list[Check]:
    """Check memory, packages, system libraries, CUDA, PhysX on GPU, rendering and extras.

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


def _packages() -> str:
    errors = _errors(REQUIRED)
    if errors:
        missing = " ".join(REQUIRED[name] for name in errors)
        raise _AbsentError("; ".join(errors.values()), f"pip install {missing}")
    names = ("torch", "numpy")
    versions = (f"{name} {importlib.import_module(name).__version__}" for name in names)
    return f"{', '.join(versions)}, and {len(REQUIRED) - len(names)} others"


def _errors(modules: Iterable[str]) -> dict[str, str]:
    """What went wrong with the modules that cannot be imported; packages raise all sorts."""
    silence_import_noise()
    errors = {}
    for name in modules:
        try:
            importlib.import_module(name)
        except Exception as error:
            kind = "" if isinstance(error, ImportError) else f"{type(error).__name__}: "
            errors[name] = textwrap.shorten(f"{kind}{error}", 200)
    return errors


def _simulator() -> str:
    if sentence := untested():
        pins = " ".join(f"{name}=={version}" for name, version in TESTED.items())
        raise _AbsentError(sentence, f"optional: pip install {pins}")
    return ", ".join(f"{name} {version}" for name, version in installed().items())


def _extra(name: str) -> str:
    if name == "escnn":
        try:
            importlib.import_module("symsteer.policies.geometry").escnn_package()
        except UserError as error:
            raise _AbsentError(f"{error.__cause__}", f"optional: {command(name)}") from error
    if errors := _errors(EXTRAS[name]):
        raise _AbsentError("; ".join(errors.values()), f"optional: {command(name)}")
    return "imports"


def _maniskill() -> str:
    silence_import_noise()
    try:
        importlib.import_module("mani_skill.envs")
    except Exception as error:
        # The usual reason is a missing shared library; the message begins with its name.
        library = str(error).split(":")[0]
        packages = {"libX11.so.6": "libx11-6", "libGL.so.1": "libgl1", "libEGL.so.1": "libegl1"}
        pins = " ".join(f"{name}=={version}" for name, version in TESTED.items())
        cure = f"pip install {pins}"
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
    "packages": (True, _packages),
    "ManiSkill": (True, _maniskill),
    "tested simulator": (False, _simulator),
    "CUDA": (False, _cuda),
    "PhysX on GPU": (False, _physx_gpu),
    "rendering": (False, _rendering),
    **{f"extra {name}": (False, functools.partial(_extra, name)) for name in EXTRAS},
}
"""Whether SymSteer needs it, and how it is found."""
