"""Output of the audit: one list of its numbers, from which page, tables and files are made."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style as mpl_style
from matplotlib.figure import Figure

from symsteer.bench.audit.estimates import Measurement
from symsteer.bench.audit.result import BIN, BODIES, AuditResult, Body, Square, Subset
from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.tables import aligned, markdown
from symsteer.variant import UNBROKEN

EXACT = 1e-3
"""Reward and observation defects below this are rounding errors, also of inverse kinematics."""

SIGNIFICANT = 0.01
"""Resets differ from their turned copies below this p-value."""

MIN_COPIES = 3
"""Squares of the map with fewer copies are not drawn."""


@dataclass(frozen=True)
class AuditNumber:
    """A number with an interval that an audit has.

    Attributes:
        of: its value in a result; None if the body is at rest.
        text: what it is, on the page of one result.
        unit: shares are stored as such and shown in per cent.
        key: its name in table and summary; empty if only the page has it.
        column: its head in the markdown table; empty if that leaves it out.
        exact: shown as 0 if value and interval are below it.
    """

    of: Callable[[AuditResult], Measurement | None]
    text: str
    unit: str = "%"
    key: str = ""
    column: str = ""
    exact: float = 0.0

    def interval(self, result: AuditResult) -> tuple[float, ...] | None:
        """Value, low and high."""
        measured = self.of(result)
        return None if measured is None else astuple(measured)

    def show(self, interval: Sequence[float] | None, in_table: bool = False) -> str:
        """``value [low, high]`` with its unit, which in a table only shares have."""
        share = self.unit == "%"
        unit = "" if in_table and not share else self.unit
        return _interval(interval, 100 if share else 1, unit, self.exact)


def _motion(body: Body, name: str, subset: Subset = "all") -> Callable[[AuditResult], Any]:
    def of(result: AuditResult) -> Any:
        defect = result.defect(body, subset)
        return None if defect is None else getattr(defect, name)

    return of


NUMBERS = (
    AuditNumber(lambda r: r.decision, "defect of a decision", "%", "decision", "decision"),
    AuditNumber(_motion("tool", "horizontal"), "tool, horizontally", "%", "tool", "tool"),
    AuditNumber(
        _motion("tool", "vertical"), "tool, vertically", "%", "tool_vertical", "tool, vertical"
    ),
    AuditNumber(_motion("tool", "mm"), "tool", "mm", "tool_mm"),
    AuditNumber(_motion("tool", "degrees"), "tool, its orientation", "degrees", "tool_deg"),
    AuditNumber(_motion("object", "horizontal"), "object, horizontally", "%", "object", "object"),
    AuditNumber(_motion("object", "vertical"), "object, vertically", "%", "object_vertical"),
    AuditNumber(_motion("object", "mm"), "object", "mm", "object_mm", "object, mm"),
    AuditNumber(_motion("object", "degrees"), "object, its orientation", "degrees", "object_deg"),
    AuditNumber(_motion("object", "horizontal", "moving"), "object where it moves, horizontally"),
    AuditNumber(_motion("object", "vertical", "moving"), "object where it moves, vertically"),
    AuditNumber(_motion("object", "mm", "moving"), "object where it moves", "mm"),
    AuditNumber(lambda r: r.reward["cost"], "cost of a step", "%", "cost", "cost", EXACT),
    AuditNumber(
        lambda r: r.reward["dense"], "dense reward of a step", "%", "dense", "dense", EXACT
    ),
    AuditNumber(lambda r: r.reward["outcome_cost"], "cost, by way of the dynamics", exact=EXACT),
    AuditNumber(lambda r: r.reward["outcome_dense"], "dense, by way of the dynamics", exact=EXACT),
    AuditNumber(
        lambda r: r.worst_field.relative,
        "observation, of the tool's motion",
        "%",
        "observation",
        "observed",
        EXACT,
    ),
    AuditNumber(lambda r: r.resets, "resets, energy distance", "", "resets", "resets"),
)
"""All numbers with an interval, in the order of the page."""

LISTED = tuple(number for number in NUMBERS if number.key)
"""The numbers of table and summary."""

FACTS: dict[str, Callable[[AuditResult], Any]] = {
    "version": lambda r: r.version,
    "task": lambda r: r.settings.task,
    "embodiment": lambda r: r.settings.embodiment,
    "variant": lambda r: r.settings.variant,
    "group": lambda r: r.settings.group,
    "chunk": lambda r: r.settings.chunk,
    "states": lambda r: r.states,
    "moving": lambda r: r.moving,
    "unreachable": lambda r: _short(r.unreachable),
    "part": lambda r: r.part,
    "resets_p": lambda r: _short(r.resets_p),
    "field": lambda r: r.worst_field.name if breaks_observation(r) else None,
    "tool_floor_mm": lambda r: _short(_motion("tool", "floor_mm")(r)),
    "object_floor_mm": lambda r: _short(_motion("object", "floor_mm")(r)),
}
"""What else table and summary have."""


def breaks_observation(result: AuditResult) -> bool:
    """Whether the observation is broken, beyond rounding."""
    relative = result.worst_field.relative
    return relative is not None and relative.value > EXACT


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")


def text(result: AuditResult) -> str:
    """A result as a page for the terminal."""
    s, worst = result.settings, result.worst_field
    visitors = " and ".join(f"{s.count} of the {v}" for v in s.visitors)
    notes = {"decision": f"of the {result.part}", "resets": f"p = {result.resets_p:.3g}"}
    for body in BODIES:
        if defect := result.defect(body):
            notes[f"{body}_mm"] = (
                f"of {defect.displacement_mm:.1f} mm; rounding alone: {defect.floor_mm:.2g} mm"
            )
    if breaks_observation(result):
        size = f", {_interval(astuple(worst.value), 1, worst.unit)}" if worst.unit else ""
        random = "; random: Gaussians compared" if result.random_observation else ""
        notes["observation"] = f"most in {worst.name}{size}{random}"
    rows = [
        [number.text, number.show(number.interval(result)), notes.get(number.key, "")]
        for number in NUMBERS
        if number.key or number.of(result)
    ]
    for body in BODIES:
        if squares := _drawn(result, body):
            top = max(squares, key=lambda square: square.mm)
            place = f"in the square at ({top.x_mm:.0f}, {top.y_mm:.0f}) mm"
            rows.append([f"{body}, most in the map", f"{top.mm:.2g} mm", place])
    if any(result.origin_mm):
        x, y = result.origin_mm
        rows.append(["origin of the group", f"({x:.0f}, {y:.0f}) mm", "the policy's"])
    if s.embodiment != "floating":
        rows.append(["turned states out of reach", f"{result.unreachable:.1%}", ""])
    beside = {
        "reward": max(result.reward["cost"].value, result.reward["dense"].value) > EXACT,
        "observation": breaks_observation(result),
        "resets": result.resets_p < SIGNIFICANT,
    }
    broken = ", ".join(name for name, breaks in beside.items() if breaks) or "nothing"
    return (
        f"{s.task}, {s.embodiment}, {_variant(s.variant)}: group {s.group}, decisions of {s.chunk} "
        f"steps from {result.states} states\n({visitors}; the object moves in {result.moving})\n\n"
        f"{aligned((), rows, left=3)}\n\nBroken beyond rounding, beside motion: {broken}.\n"
        f"({result.seconds:.1f} s)"
    )


def _variant(name: str) -> str:
    return "unbroken" if name == UNBROKEN else name


def _drawn(result: AuditResult, body: Body) -> list[Square]:
    return [s for s in result.map if s.body == body and s.copies >= MIN_COPIES]


# ------------------------------------------------------------------------- tables


def summary(result: AuditResult) -> dict[str, Any]:
    """A row of the table: numbers with three digits, an interval as [value, low, high]."""
    row: dict[str, Any] = {name: get(result) for name, get in FACTS.items()}
    for number in LISTED:
        interval = number.interval(result)
        row[number.key] = interval and [_short(v) for v in interval]
    return row


def to_markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Rows of :func:`summary` as a markdown table."""
    several = len({(row["task"], row["embodiment"], row["group"]) for row in rows}) > 1
    table: list[dict[str, str]] = []
    for row in rows:
        name = "unbroken" if row["variant"] == UNBROKEN else f"`{row['variant']}`"
        if several:
            name = f"{row['task'].removesuffix('-v1')}, {row['embodiment']}, {name}"
        cells = {"variant": name}
        for number in LISTED:
            if number.column:
                cells[number.column] = number.show(row[number.key], in_table=True)
            if number.key == "decision":
                cells["part"] = row["part"]
            if number.key == "observation":
                cells["most in"] = f"`{row['field']}`" if row["field"] else "-"
        if row["resets_p"] >= SIGNIFICANT:
            cells["resets"] = "alike"
        table.append(cells | {"p": f"{row['resets_p']:.3f}"})
    return markdown(list(table[0]), [list(cells.values()) for cells in table]) + "\n"


def _interval(
    interval: Sequence[float] | None, scale: float, unit: str = "", exact: float = 0.0
) -> str:
    """``value [low, high]``; just 0 if all three are below ``exact``."""
    if interval is None:
        return "at rest"
    if all(abs(v) < exact for v in interval):
        return "0"
    value, low, high = (two_digits(scale * v) for v in interval)
    return f"{value}{unit and ' ' + unit} [{low}, {high}]"


def percent(interval: Sequence[float] | None) -> str:
    """An interval of shares in per cent."""
    return _interval(interval, 100, "%")


def two_digits(value: float) -> str:
    """Two significant digits, without an exponent."""
    if value == 0:
        return "0"
    if abs(value) >= 10:
        return f"{value:.0f}"
    rounded = f"{value:.2g}"
    return f"{float(rounded):.5f}".rstrip("0").rstrip(".") if "e" in rounded else rounded


# -------------------------------------------------------------------------- files


@mpl_style.context("default")  # no settings of a file in the current folder
def write_result(result: AuditResult, folder: Path) -> None:
    """Write ``audit.json`` and ``map.png``.

    Raises:
        UserError: the folder cannot be written.
    """
    picture = io.BytesIO()
    map_figure(result).savefig(picture, format="png", dpi=110, metadata={"Software": None})
    write_together(
        {
            folder / "map.png": picture.getvalue(),
            # Last: a folder with this file is complete, and is not measured again.
            folder / "audit.json": (json.dumps(result.to_json(), indent=1) + "\n").encode(),
        }
    )


def read_result(path: Path) -> AuditResult:
    """Read an ``audit.json``.

    Raises:
        UserError: the file is missing or damaged.
    """
    try:
        return AuditResult.from_json(json.loads(path.read_text("utf-8-sig")))
    except OSError as error:
        raise UserError(
            f"cannot read the audit {path}: {error.strerror}; name another, or run it again"
        ) from error
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is not the file of an audit ({error}); run the audit again"
        ) from error


def write_table(results: Sequence[AuditResult], folder: Path) -> None:
    """Write ``table.md`` and ``summary.json`` of many results.

    Raises:
        UserError: the folder cannot be written.
    """
    rows = [summary(result) for result in results]
    files = {"table.md": to_markdown(rows), "summary.json": summary_json(rows)}
    write_together({folder / name: content.encode() for name, content in files.items()})


def summary_json(rows: Sequence[dict[str, Any]]) -> str:
    """JSON of rows of :func:`summary`, one per line."""
    return "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n"


def map_figure(result: AuditResult) -> Figure:
    """Map of the workspace: distance of copies from the majority, for tool and object."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    side = 1e3 * BIN
    places = [abs(v) for body in BODIES for s in _drawn(result, body) for v in (s.x_mm, s.y_mm)]
    count = round(max(places, default=2 * side) / side) + 1
    edges = side * np.arange(-count, count + 1)
    for ax, body in zip(figure.subplots(1, 2), BODIES, strict=True):
        squares = _drawn(result, body)
        x, y, mm = ([getattr(s, name) for s in squares] for name in ("x_mm", "y_mm", "mm"))
        shades = ax.hist2d(x, y, bins=(edges, edges), weights=mm, cmin=1e-9, cmap="OrRd", vmin=0)[3]
        figure.colorbar(shades, ax=ax, shrink=0.8)
        ax.plot(0, 0, "+", color="#0072B2", markersize=9)
        ax.set(aspect="equal", xlabel="x from the policy's origin, mm", ylabel="y, mm")
        ax.set_title(f"{body}: mm after {result.settings.chunk} steps", fontsize=10)
    s = result.settings
    figure.suptitle(f"{s.task}, {s.embodiment}, {_variant(s.variant)}, {s.group}", fontsize=11)
    return figure
