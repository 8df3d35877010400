"""One registry for agents, policies, variants and tasks, open to other packages.

A name stands for a class. It comes from one of three places:

- SymSteer's own table: ``symsteer.agents.AGENTS``, ``symsteer.policies.POLICIES``,
  ``symsteer.bench.variants.VARIANTS``, ``symsteer.bench.tasks.TASKS``;
- an entry point of an installed distribution, in the group ``symsteer.agents``,
  ``symsteer.policies``, ``symsteer.variants`` or ``symsteer.tasks``;
- ``package.module:Class``, to try a class that is not installed. Importing it executes its code, so
  it needs consent (:func:`allow`): what a user types has it, what a file names does not.

Names and summaries are read without importing any of the classes: ``symsteer --help`` and
``symsteer list`` must not wait for torch or ManiSkill.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib
import importlib.util
import json
import os
import re
import sys
import traceback
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any, Generic, TypeVar

from symsteer.errors import UserError
from symsteer.names import unknown

T = TypeVar("T")

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,59}")
"""Names become parts of file names and records."""

TARGET = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


@dataclass(frozen=True)
class Extension:
    """Code from outside SymSteer that a run used.

    Attributes:
        kind: agent, policy, variant or task.
        name: as in the configuration.
        target: ``package.module:Class``.
        distribution, version: of the installed distribution; None for code that is not installed.
        sha256: of all Python files of the top-level package, see :func:`code_hash`.
    """

    kind: str
    name: str
    target: str
    distribution: str | None
    version: str | None
    sha256: str

    def to_json(self) -> dict[str, Any]:
        """Plain data."""
        return asdict(self)


class NotInstalledError(UserError):
    """Something needs a package that is not installed here."""


class NotAllowedError(UserError):
    """A file names code that the user has not consented to."""


ALLOWED = "SYMSTEER_ALLOWED"
"""Environment variable in which child processes find what :func:`allow` was told."""

_allowed: dict[str, str] = json.loads(os.environ.get(ALLOWED, "{}"))
"""``package.module:Class``, and the folder that was the current one when it was named."""


def allow(*texts: Any) -> None:
    """Consent to the code that texts name as ``package.module:Class``: importing it executes it.

    Its module may also lie in the current folder, in which nothing else is looked for.

    Args:
        texts: what a user has typed: such a name, or a variant's text with several; others do
            nothing.
    """
    for text in texts:
        for target in TARGET.findall(text) if isinstance(text, str) else ():
            _allowed.setdefault(target, os.getcwd())
    if _allowed:
        os.environ[ALLOWED] = json.dumps(_allowed)


class _Named:
    """Finds modules that were named as ``module:Class`` in the folder of that moment."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        folders = {t.partition(":")[0].partition(".")[0]: f for t, f in _allowed.items()}
        known = path is None and name in folders
        return PathFinder.find_spec(name, [folders[name]]) if known else None


# The last one: installed packages come first.
sys.meta_path.append(_Named)


class Registry(Generic[T]):
    """Classes of one kind by name.

    Args:
        kind: what the classes are, in one word, for messages.
        group: of the entry points.
        builtin: ``package.module:Class`` by name, in the order in which they are listed.
        base: ``package.module:Class`` that every class must inherit from.
    """

    def __init__(self, kind: str, group: str, builtin: Mapping[str, str], base: str):
        self.kind, self.group, self.builtin, self.base = kind, group, dict(builtin), base

    def names(self) -> list[str]:
        """SymSteer's own names in table order, then the sorted names of other distributions."""
        return [*self.builtin, *sorted(set(self._entry_points()) - set(self.builtin))]

    def __contains__(self, name: str) -> bool:
        return name in self.builtin or name in self._entry_points()

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def target(self, name: str) -> str:
        """``package.module:Class`` of a name.

        Raises:
            UserError: if there is no such name, or two distributions offer it.
        """
        if name in self:
            self._refuse_twins(name)
            return self.builtin.get(name) or self._entry_points()[name][0].value
        if TARGET.fullmatch(name):
            return name
        raise unknown(self.kind, name, self.names())

    def check_allowed(self, name: str, where: Path | None = None) -> None:
        """Refuse code that nobody has consented to; what is imported already harms no more.

        Args:
            name: any name.
            where: the file that names it, for the message.

        Raises:
            NotAllowedError: naming the option that consents.
        """
        module = name.partition(":")[0]
        if name in self or not TARGET.fullmatch(name):
            return
        if name not in _allowed and module not in sys.modules:
            raise NotAllowedError(
                f"{f'{where}: ' if where else ''}the {self.kind} {name} is code of another author, "
                f"which would be executed; if you trust it, add --trust {name} (in Python: import "
                f"{module} first)"
            )

    def get(self, name: str) -> T:
        """Import and return the class of a name.

        Raises:
            UserError: if there is no such name, its module cannot be imported, or it is not a
                class of this kind.
            NotAllowedError: if it is ``module:Class`` and nobody has consented to it.
        """
        target = self.target(name)
        self.check_allowed(name)
        if ":" not in name and not NAME.fullmatch(name):
            raise UserError(
                f"the {self.kind} name {name!r} of {target} cannot be part of file names; use at "
                "most 60 letters, digits, dots, dashes and underscores"
            )
        found = _load(target, f"the {self.kind} {name!r}")
        base = _load(self.base, f"the {self.kind} {name!r}")
        if not (isinstance(found, type) and issubclass(found, base)):
            module, _, attribute = self.base.partition(":")
            raise UserError(
                f"{target} cannot be used as {self.kind}; it must be a class that inherits from "
                f"{module}.{attribute}"
            )
        return found  # type: ignore[return-value]

    def name_of(self, found: type) -> str:
        """The name with which :meth:`get` finds a class; ``module:Class`` if it has no other.

        Raises:
            UserError: if the class cannot be imported by name.
        """
        target = f"{found.__module__}:{found.__qualname__}"
        targets = {name: points[0].value for name, points in self._entry_points().items()}
        names = [name for name, own in {**targets, **self.builtin}.items() if own == target]
        if not names and (found.__module__ == "__main__" or not TARGET.fullmatch(target)):
            raise UserError(
                f"the {self.kind} {found.__qualname__} cannot be found again by a name; define it "
                "at the top of a module that can be imported"
            )
        return names[0] if names else target

    def summary(self, name: str) -> str:
        """First line of the docstring of a name's class, read without importing it."""
        return summary_of(self.target(name))

    def extension(self, name: str) -> Extension | None:
        """The entry of a record for a name from outside SymSteer; None for SymSteer's own names.

        Raises:
            UserError: as :meth:`get`.
        """
        if name in self.builtin:
            return None
        self.get(name)
        target = self.target(name)
        package = target.partition(":")[0].partition(".")[0]
        points = self._entry_points().get(name)
        distribution = points[0].dist if points else _distribution_of(package)
        return Extension(
            self.kind,
            name,
            target,
            distribution.name if distribution else None,
            distribution.version if distribution else None,
            code_hash(package),
        )

    def require(self, name: str, target: str, distribution: str | None, where: Path) -> None:
        """Check that a class of another package, which a file names, can be found here.

        Args:
            name, target, distribution: as in :class:`Extension`.
            where: the file.

        Raises:
            NotInstalledError: naming the distribution to install.
            NotAllowedError: if it is ``module:Class`` and nobody has consented to it.
        """
        package = target.partition(":")[0].partition(".")[0]
        if name == target:
            self.check_allowed(name, where)
        if name in self or (name == target and importlib.util.find_spec(package) is not None):
            return
        source = f"distribution {distribution}" if distribution else f"package {package}"
        raise NotInstalledError(
            f"{where} needs the {self.kind} {name!r} of the {source}, which is not installed; "
            "install it"
        )

    def _entry_points(self) -> dict[str, list[metadata.EntryPoint]]:
        return _entry_points(self.group)

    def _refuse_twins(self, name: str) -> None:
        points = self._entry_points().get(name, [])
        owners = ["symsteer"] * (name in self.builtin)
        owners += [point.dist.name if point.dist else point.value for point in points]
        if len(owners) > 1:
            raise UserError(
                f"{' and '.join(owners)} both offer the {self.kind} {name!r}; uninstall one of them"
            )


def code_hash(package: str) -> str:
    """SHA-256 over names and contents of all Python files of a top-level package or module.

    Raises:
        UserError: if the package cannot be found.
    """
    spec = importlib.util.find_spec(package)
    if spec is None:
        raise UserError(f"the package {package} cannot be found; install it")
    digest = hashlib.sha256()
    if not spec.submodule_search_locations:
        digest.update(Path(str(spec.origin)).read_bytes())
        return digest.hexdigest()
    for folder in spec.submodule_search_locations:
        files = [
            Path(parent, file)
            for parent, _, names in os.walk(folder, followlinks=True)
            for file in names
            if file.endswith(".py")
        ]
        for file in sorted(files):
            digest.update(f"{file.relative_to(folder).as_posix()}\0".encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()


@functools.cache
def _entry_points(group: str) -> dict[str, list[metadata.EntryPoint]]:
    """The entry points of a group by name, each distribution once."""
    found: dict[str, dict[str, metadata.EntryPoint]] = {}
    for point in metadata.entry_points(group=group):
        owner = point.dist.name if point.dist else point.value
        found.setdefault(point.name, {}).setdefault(owner, point)
    return {name: list(owners.values()) for name, owners in found.items()}


def _distribution_of(package: str) -> metadata.Distribution | None:
    names = metadata.packages_distributions().get(package, [])
    return metadata.distribution(names[0]) if len(set(names)) == 1 else None


def _load(target: str, what: str) -> Any:
    module_name, _, attribute = target.partition(":")
    try:
        module = importlib.import_module(module_name)
    except UserError:
        raise
    # Importing a file can raise any exception.
    except Exception as error:
        missing = isinstance(error, ModuleNotFoundError)
        cure = "install it, or name its folder in PYTHONPATH" if missing else "correct or remove it"
        raise UserError(
            f"{what} cannot be imported from {module_name} ({type(error).__name__}: "
            f"{error}{_line(error, module_name)}); {cure}"
        ) from error
    if not hasattr(module, attribute):
        raise UserError(f"{what} cannot be found: {module_name} has no {attribute}; check the name")
    return getattr(module, attribute)


def _line(error: Exception, module: str) -> str:
    """The line of the module at which the import failed."""
    if isinstance(error, SyntaxError):  # its message names the line already
        return ""
    path = getattr(sys.modules.get(module), "__file__", None) or _file_of(module)
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f", line {frame.lineno}" for frame in frames if frame.filename == path]
    return lines[-1] if lines else ""


def _file_of(module: str) -> str | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    return spec.origin if spec else None


def summary_of(target: str) -> str:
    """First line of the docstring of ``module:Class`` or ``module:function``, from its source."""
    module, _, attribute = target.partition(":")
    for node in _definitions(_file_of(module)):
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and node.name == attribute:
            line = (ast.get_docstring(node) or "").partition("\n")[0].replace("``", "")
            return re.sub(r" \(docs/[\w.]+\)", "", line)
    return ""


@functools.cache
def _definitions(path: str | None) -> list[ast.stmt]:
    try:
        return ast.parse(Path(str(path)).read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return []
