"""Scripts and styles of the pages: SymSteer's own, Plotly, and DataTables as itables packs it.

They are files of installed packages, so a site asks no other host for anything.
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

from symsteer.errors import UserError

STATIC = Path(__file__).resolve().parent / "static"

EXPORT = re.compile(r"export\{([\w$,\s]+)\};")
"""The end of a JavaScript module, before its licences."""

GLOBAL = "SymSteerTables"
"""Name under which the pages find DataTables."""

PINNED = "install the version of requirements.txt"


def needs(*packages: str) -> None:
    """Check that optional packages are installed.

    Raises:
        UserError: one is not.
    """
    for package in packages:
        if importlib.util.find_spec(package) is None:
            raise UserError(
                f"the site needs the package {package}, which is not installed: "
                'pip install "symsteer[site]"'
            )


def assets() -> dict[str, bytes]:
    """Contents by address."""
    tables = _packaged("itables", "html/dt_bundle.js").decode()
    static = {f"assets/{path.name}": path.read_bytes() for path in sorted(STATIC.iterdir())}
    return static | {
        "assets/plotly.min.js": _packaged("plotly", "package_data/plotly.min.js"),
        "assets/datatables.js": as_script(tables).encode(),
        "assets/datatables.css": _packaged("itables", "html/dt_bundle.css"),
    }


def as_script(module: str) -> str:
    """A JavaScript module as a script that puts what it exports into `GLOBAL`.

    Browsers load no module from a page that was opened as a file.

    Raises:
        UserError: the module has no such end, or several.
    """
    exports = EXPORT.findall(module)
    if len(exports) != 1:
        raise UserError(f"itables packs DataTables in another form than expected; {PINNED}")
    names = (re.split(r"\s+as\s+", name.strip()) for name in exports[0].split(","))
    members = ",".join(f'"{name[-1]}":{name[0]}' for name in names)
    body = EXPORT.sub(lambda _: f"globalThis.{GLOBAL}={{{members}}};", module)
    return f'(()=>{{"use strict";{body}\n}})();\n'


def _packaged(package: str, name: str) -> bytes:
    """A file of an installed package, without importing it."""
    needs(package)
    spec = importlib.util.find_spec(package)
    for folder in (spec.submodule_search_locations or []) if spec else []:
        if (path := Path(folder, name)).is_file():
            return path.read_bytes()
    raise UserError(f"the installed {package} has no {name}: {PINNED}")
