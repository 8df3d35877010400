"""Tries SymSteer in fresh environments with other versions: writes the table of docs/install.md.

python -m tools.matrix              # every cell, one after the other
python -m tools.matrix 3.12 3.13    # these; the rows of the others stay
python -m tools.matrix --quick      # without the default tests

Wheel and source distribution are those of the last commit, the tests those of this checkout. A
cell takes several GB while it runs and, on two idle cores, about twenty minutes. Needs uv and the
interpreters.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.names import check
from symsteer.terminal import complain
from tools.pages.marks import BEGIN, CHECKOUT, END, check_checkout, with_tables

PAGE = CHECKOUT / "docs" / "install.md"
LOGS = CHECKOUT / "build" / "matrix"
DEFAULT_TESTS = "not long and not slow and not gpu"


class Cell(NamedTuple):
    """An environment: its Python, and what uv installs; WHEEL stands for the wheel's path."""

    python: str
    install: tuple[str, ...]
    extras: str = "all"


CELLS = {
    "pinned": Cell("3.11", ("--no-deps", "-r", f"{CHECKOUT / 'requirements.txt'}", "WHEEL")),
    # diffusers 0.36 needs a newer torch.
    "oldest": Cell(
        "3.11", ("symsteer[dev] @ WHEEL", "torch==2.4.1", "numpy==1.26.4", "diffusers<0.36")
    ),
    "3.12": Cell("3.12", ("symsteer[test] @ WHEEL",), "none"),
    "3.13": Cell("3.13", ("symsteer[dev] @ WHEEL",)),
}

SHOWN = ("torch", "numpy", "mani-skill", "sapien", "mplib")
"""Packages whose versions the table has."""

HEADER = ("cell", "Python", *SHOWN, "extras", "`doctor`", "`sweep smoke`", "default tests", "date")


def rows_of(page: str) -> dict[str, list[str]]:
    """The rows of the page's table by cell."""
    lines = page.partition(BEGIN)[2].partition(END)[0].strip().splitlines()[2:]
    rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
    return {row[0]: row for row in rows}


def table(rows: Mapping[str, Sequence[str]]) -> str:
    """The rows of the cells that have one, as markdown."""
    lines = [HEADER, ("---",) * len(HEADER), *(rows[name] for name in CELLS if name in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def try_cell(name: str, wheel: Path, quick: bool) -> list[str]:
    """Make the environment of a cell, try it, and remove it; returns its row."""
    cell = CELLS[name]
    log = LOGS / f"{name}.log"
    log.unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(prefix="symsteer-matrix-") as folder:
        place = Path(folder)
        python, empty = place / "env" / "bin" / "python", place / "empty"
        empty.mkdir()
        steps = [arg.replace("WHEEL", f"file://{wheel}") for arg in cell.install]
        for made in (
            ["venv", "--seed", "--python", cell.python, f"{place / 'env'}"],
            ["pip", "install", "--python", f"{python}", *steps],
        ):
            if call(log, _uv(), *made, cwd=CHECKOUT):
                raise UserError(f"the environment {name} cannot be made; {log} says why")
        symsteer = f"{python.with_name('symsteer')}"
        doctor = call(log, symsteer, "doctor", cwd=empty)
        smoke = call(log, symsteer, "sweep", "smoke", "--workers", "2", cwd=empty)
        parallel = ("-n", "2", "--dist", "worksteal", "-p", "no:cacheprovider")
        tests = "not run"
        if not quick:
            pytest = (f"{python}", "-m", "pytest", *parallel, "-m", DEFAULT_TESTS)
            code = call(log, *pytest, cwd=CHECKOUT)
            tests = log.read_text().strip().splitlines()[-1].strip("= ").partition(" in ")[0]
            tests = tests if code in (0, 1) else "failed"
        listed = subprocess.check_output(
            [_uv(), "pip", "list", "--python", f"{python}", "--format", "json"], text=True
        )
        version = subprocess.check_output([f"{python}", "-VV"], text=True).split()[1]
    versions = {package["name"]: package["version"] for package in json.loads(listed)}
    # The builds of torch have one version; which was installed depends on the index.
    packages = [versions.get(package, "none").partition("+")[0] for package in SHOWN]
    states = ["failed" if code else "passed" for code in (doctor, smoke)]
    today = f"{datetime.now(UTC):%Y-%m-%d}"
    return [name, version, *packages, cell.extras, *states, tests, today]


def call(log: Path, *command: str, cwd: Path) -> int:
    """Run a command away from this environment, with its output in a log; returns its exit code."""
    own = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    environment = {name: value for name, value in os.environ.items() if name not in own}
    with log.open("a") as file:
        file.write(f"$ {' '.join(command)}\n")
        file.flush()
        done = subprocess.run(
            command,
            cwd=cwd,
            env={**environment, "OMP_NUM_THREADS": "1"},
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
        )
    return done.returncode


def build(folder: Path) -> Path:
    """The wheel of the last commit, built from its source distribution."""
    source, log = folder / "source", LOGS / "build.log"
    source.mkdir()
    archive = subprocess.check_output(["git", "-C", f"{CHECKOUT}", "archive", "HEAD"])
    subprocess.run(["tar", "-x", "-C", f"{source}"], input=archive, check=True)
    if call(log, _uv(), "build", "--out-dir", f"{folder}", f"{source}", cwd=folder):
        raise UserError(f"the wheel cannot be built; {log} says why")
    (wheel,) = folder.glob("*.whl")
    return wheel


def _uv() -> str:
    beside = Path(sys.executable).with_name("uv")
    uv = f"{beside}" if beside.is_file() else shutil.which("uv")
    if uv is None:
        raise UserError("uv is missing; install it with: pip install uv")
    return uv


def main(arguments: Sequence[str]) -> int:
    """Try the cells and write their rows; returns the exit code, 1 if one is not green."""
    try:
        check_checkout(PAGE)
        names = [argument for argument in arguments if argument != "--quick"]
        check("cell", names, CELLS)
        LOGS.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="symsteer-wheel-") as folder:
            wheel = build(Path(folder))
            made = {}
            for name in names or CELLS:
                made[name] = try_cell(name, wheel, "--quick" in arguments)
                print(" | ".join(made[name]), flush=True)
                page = PAGE.read_text()
                text = table({**rows_of(page), **made})
                write_together({PAGE: with_tables(page, text, PAGE.name).encode()})
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    return int(any("failed" in cell for row in made.values() for cell in row))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
