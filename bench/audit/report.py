"""Output of the audit: a text page of one result, tables of many, a map."""

from __future__ import annotations

import io
import json
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

from matplotlib import style as mpl_style
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from symsteer.bench.audit.estimates import Estimate
from symsteer.bench.audit.result import BIN, AuditResult, Defect
from symsteer.errors import UserError
from symsteer.files import csv_text, write_together

EXACT = 1e-3
"""Reward and observation defects below this are rounding errors, also of inverse kinematics."""

SIGNIFICANT = 0.01
"""Resets differ from their turned copies below this p-value."""

MEANING = {
    "tool": "turned copies of a decision move the tool to places that differ by",
    "object": "the object to places that differ by",
}
"""Defects of motion in words, before their share of the motion."""

MIN_COPIES = 3
"""Squares of the map with fewer copies are not drawn."""


def text(result: AuditResult) -> str:
    """A result as a page for the terminal."""
    s = result.settings
    visitors = " and ".join(f"{s.count} of the {v}" for v in s.visitors)
    lines = [
        f"{s.task}, {s.embodiment}, {_variant(result)}: group {s.group}, decisions of {s.chunk} "
        f"steps from {result.states} states",
        f"({visitors}; the object moves in {result.moving})",
        "",
        f"{'defect of a decision':26s} {_percent(result.decision)}, of the {result.part}",
    ]
    for body in ("tool", "object"):
        for subset in ("all", "moving") if body == "object" else ("all",):
            defect = result.defect(body, subset)  # type: ignore[arg-type]
            if defect is None:
                continue
            name = body if subset == "all" else f"{body}, where it moves"
            lines.append(f"{name:26s} {_relative(defect)}")
            mm = f"{_number(defect.mm, 2)} of {defect.displacement_mm:.1f} mm"
            lines.append(f"{'':26s} {mm}, {_number(defect.degrees, 2)} degrees")
    floors = [result.defect(b) for b in ("tool", "object")]  # type: ignore[arg-type]
    lines.append(
        f"{'floor (rounding alone)':26s} "
        + ", ".join(f"{d.body} {d.floor_mm:.2g} mm" for d in floors if d)
    )
    r = result.reward
    lines += [
        f"{'reward, mean of a step':26s} cost {_number(r['cost'], 3)}, "
        f"dense {_number(r['dense'], 4)}",
        f"{'  by way of the dynamics':26s} cost {_number(r['outcome_cost'], 3)}, "
        f"dense {_number(r['outcome_dense'], 4)}",
    ]
    worst = result.worst_field
    noise = " (random: Gaussians compared)" if result.random_observation else ""
    observed = _percent(worst.relative) if worst.relative else "no"
    lines.append(f"{'observation':26s} {observed} of the tool's displacement{noise}")
    if breaks_observation(result):
        unit = f", {_number(worst.value, 1)} mm" if worst.unit else ""
        lines.append(f"{'  most in':26s} {worst.name}{unit}")
    lines.append(
        f"{'resets':26s} energy distance {_number(result.resets, 3)}, p = {result.resets_p:.3g}"
    )
    if any(result.origin_mm):
        x, y = result.origin_mm
        lines.append(f"{'origin':26s} the group acts about ({x:.0f}, {y:.0f}) mm, the policy's")
    if s.embodiment != "floating":
        lines.append(
            f"{'reach':26s} {result.unreachable:.1%} of the turned states are out of reach"
        )
    top = _largest(result)
    if top is not None:
        lines.append(f"{'where':26s} {top}")
    return "\n".join([*lines, "", meaning(result), f"({result.seconds:.1f} s)"])


def breaks_observation(result: AuditResult) -> bool:
    """Whether the observation is broken, beyond rounding."""
    relative = result.worst_field.relative
    return relative is not None and relative.value > EXACT


def meaning(result: AuditResult) -> str:
    """A result in one sentence."""
    parts = [
        f"{MEANING[name]} {_short_percent(estimate.value)}"
        for name, estimate in result.parts.items()
        if name in MEANING
    ]
    broken: list[str] = []
    kept: list[str] = []
    reward = max(result.reward["cost"].value, result.reward["dense"].value)
    for name, is_broken in (
        ("reward", reward > EXACT),
        ("observation", breaks_observation(result)),
        ("resets", result.resets_p < SIGNIFICANT),
    ):
        (broken if is_broken else kept).append(name)
    parts.append(
        " and ".join(
            f"{_and(names)} {verb if len(names) == 1 and names != ['resets'] else plural}"
            for names, verb, plural in (
                (kept, "keeps the symmetry", "keep the symmetry"),
                (broken, "breaks it", "break it"),
            )
            if names
        )
    )
    sentence = "; ".join(parts)
    return sentence[0].upper() + sentence[1:] + "."


def _and(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def _variant(result: AuditResult) -> str:
    return "unbroken" if result.settings.variant == "none" else result.settings.variant


def _largest(result: AuditResult) -> str | None:
    drawn = [b for b in result.map if b.copies >= MIN_COPIES]
    tops = []
    for body in ("tool", "object"):
        bins = [b for b in drawn if b.body == body]
        if bins:
            top = max(bins, key=lambda b: b.mm)
            tops.append(f"({top.x_mm:.0f}, {top.y_mm:.0f}) mm: {body} {top.mm:.2g} mm")
    return "most in the square at " + "; ".join(tops) if tops else None


def _relative(defect: Defect) -> str:
    directions = {"horizontal": defect.horizontal, "vertical": defect.vertical}
    return ", ".join(f"{k} {_percent(v) if v else 'at rest'}" for k, v in directions.items())


def _short_percent(value: float) -> str:
    return f"{100 * value:.2g} % of their length" if value < 1 else f"{value:.2g} of their length"


def _percent(estimate: Estimate) -> str:
    value, low, high = (100 * v for v in (estimate.value, estimate.low, estimate.high))
    digits = 2 if abs(value) < 1 else 1
    return f"{value:.{digits}f} % [{low:.{digits}f}, {high:.{digits}f}]"


def _number(estimate: Estimate, digits: int) -> str:
    value, low, high = (_plain(v, digits) for v in (estimate.value, estimate.low, estimate.high))
    return f"{value} [{low}, {high}]"


def _plain(value: float, digits: int) -> str:
    rounded = f"{value:.{digits}f}"
    return rounded.lstrip("-") if float(rounded) == 0 else rounded


# ------------------------------------------------------------------------- tables

ESTIMATES = {
    "decision": lambda c: c.decision,
    "tool": lambda c: _of(c.defect("tool"), "horizontal"),
    "tool_vertical": lambda c: _of(c.defect("tool"), "vertical"),
    "tool_mm": lambda c: _of(c.defect("tool"), "mm"),
    "tool_deg": lambda c: _of(c.defect("tool"), "degrees"),
    "object": lambda c: _of(c.defect("object"), "horizontal"),
    "object_vertical": lambda c: _of(c.defect("object"), "vertical"),
    "object_mm": lambda c: _of(c.defect("object"), "mm"),
    "object_deg": lambda c: _of(c.defect("object"), "degrees"),
    "cost": lambda c: c.reward["cost"],
    "dense": lambda c: c.reward["dense"],
    "observation": lambda c: c.worst_field.relative,
    "resets": lambda c: c.resets,
}
"""Columns of the table that are numbers with an interval."""

PLAIN = {
    "version": lambda c: c.version,
    "task": lambda c: c.settings.task,
    "embodiment": lambda c: c.settings.embodiment,
    "variant": lambda c: c.settings.variant,
    "group": lambda c: c.settings.group,
    "chunk": lambda c: c.settings.chunk,
    "states": lambda c: c.states,
    "moving": lambda c: c.moving,
    "unreachable": lambda c: _short(c.unreachable),
    "part": lambda c: c.part,
    "resets_p": lambda c: _short(c.resets_p),
    "field": lambda c: c.worst_field.name if breaks_observation(c) else None,
    "tool_floor_mm": lambda c: _short(_of(c.defect("tool"), "floor_mm")),
    "object_floor_mm": lambda c: _short(_of(c.defect("object"), "floor_mm")),
}


def _of(defect: Defect | None, name: str) -> Any:
    return None if defect is None else getattr(defect, name)


def _short(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.3g}")


def summary(result: AuditResult) -> dict[str, Any]:
    """A row of the table: numbers with three digits, an interval as [value, low, high]."""
    row: dict[str, Any] = {name: get(result) for name, get in PLAIN.items()}
    for name, get in ESTIMATES.items():
        estimate = get(result)
        row[name] = estimate and [_short(v) for v in astuple(estimate)]
    return row


def to_csv(rows: Sequence[dict[str, Any]]) -> str:
    """Rows of :func:`summary` as CSV: three columns for each interval."""
    head = [*PLAIN, *(f"{name}{end}" for name in ESTIMATES for end in ("", "_low", "_high"))]
    table = [
        [row[name] for name in PLAIN] + [v for name in ESTIMATES for v in row[name] or [None] * 3]
        for row in rows
    ]
    return csv_text([head, *table])


def to_markdown(rows: Sequence[dict[str, Any]]) -> str:
    """Rows of :func:`summary` as a markdown table."""
    several = len({(r["task"], r["embodiment"], r["group"]) for r in rows}) > 1
    head = ["variant", "decision", "part", "tool", "tool, vertical", "object", "object, mm"]
    head += ["cost", "dense", "observed", "most in", "resets", "p"]
    lines = []
    for row in rows:
        name = "unbroken" if row["variant"] == "none" else f"`{row['variant']}`"
        if several:
            name = f"{row['task'].removesuffix('-v1')}, {row['embodiment']}, {name}"
        cells = [name, percent(row["decision"]), row["part"]]
        cells += [percent(row[c]) for c in ("tool", "tool_vertical", "object")]
        cells += [_interval(row["object_mm"], 1)]
        cells += [_interval(row[c], 100, "%", EXACT) for c in ("cost", "dense", "observation")]
        cells += [f"`{row['field']}`" if row["field"] else "-"]
        differ = row["resets_p"] < SIGNIFICANT
        cells += [_interval(row["resets"], 1) if differ else "alike", f"{row['resets_p']:.3f}"]
        lines.append("| " + " | ".join(cells) + " |")
    rule = "|---|" + "--:|" * (len(head) - 1)
    return "\n".join(["| " + " | ".join(head) + " |", rule, *lines]) + "\n"


def _interval(
    interval: list[float] | None, scale: float, unit: str = "", exact: float = 0.0
) -> str:
    """``value [low, high]``; just 0 if all three are below ``exact``."""
    if interval is None:
        return "at rest"
    if all(abs(v) < exact for v in interval):
        return "0"
    value, low, high = (_two(scale * v) for v in interval)
    return f"{value}{unit and ' ' + unit} [{low}, {high}]"


def percent(interval: list[float] | None) -> str:
    """An interval of shares in per cent."""
    return _interval(interval, 100, "%")


def percent_range(intervals: Sequence[list[float] | None], exact: float) -> str:
    """Smallest to largest value in per cent; just 0 if all are below ``exact``."""
    values = [i[0] for i in intervals if i is not None]
    if not values:
        return "at rest"
    if max(values) < exact:
        return "0"
    low, high = _two(100 * min(values)), _two(100 * max(values))
    return f"{low} %" if low == high else f"{low} to {high} %"


def _two(value: float) -> str:
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
    """Write ``audit.json``, ``map.csv`` and ``map.png``.

    Raises:
        UserError: the folder cannot be written.
    """
    head = ["body", "x_mm", "y_mm", "copies", "mm"]
    rows = [[b.body, b.x_mm, b.y_mm, b.copies, float(f"{b.mm:.4g}")] for b in result.map]
    picture = io.BytesIO()
    map_figure(result).savefig(picture, format="png", dpi=110, metadata={"Software": None})
    write_together(
        {
            folder / "map.csv": csv_text([head, *rows]).encode(),
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
    """Write ``table.csv``, ``table.md`` and ``summary.json`` of many results.

    Raises:
        UserError: the folder cannot be written.
    """
    rows = [summary(result) for result in results]
    write_together(
        {
            folder / "table.csv": to_csv(rows).encode(),
            folder / "table.md": to_markdown(rows).encode(),
            folder / "summary.json": summary_json(rows).encode(),
        }
    )


def summary_json(rows: Sequence[dict[str, Any]]) -> str:
    """JSON of rows of :func:`summary`, one per line."""
    return "[\n" + ",\n".join(json.dumps(row) for row in rows) + "\n]\n"


def map_figure(result: AuditResult) -> Figure:
    """Map of the workspace: distance of copies from the majority, for tool and object."""
    figure = Figure(figsize=(9, 4.2), layout="constrained")
    axes = figure.subplots(1, 2)
    side = 1e3 * BIN
    drawn = [b for b in result.map if b.copies >= MIN_COPIES]
    reach = max([abs(v) for b in drawn for v in (b.x_mm, b.y_mm)], default=100.0) + side
    for ax, body in zip(axes, ("tool", "object"), strict=True):
        bins = [b for b in drawn if b.body == body]
        top = max((b.mm for b in bins), default=0.0) or 1.0
        for b in bins:
            shade = b.mm / top
            ax.add_patch(
                Rectangle((b.x_mm - side / 2, b.y_mm - side / 2), side, side, color=_color(shade))
            )
            ax.text(
                b.x_mm,
                b.y_mm,
                f"{b.mm:.2g}",
                ha="center",
                va="center",
                fontsize=6,
                color="white" if shade > 0.55 else "black",
            )
        ax.plot(0, 0, "+", color="#0072B2", markersize=9)
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        ax.set(xlabel="x from the policy's origin, mm", ylabel="y, mm")
        ax.set_title(f"{body}: mm after {result.settings.chunk} steps", fontsize=10)
    s = result.settings
    figure.suptitle(f"{s.task}, {s.embodiment}, {_variant(result)}, {s.group}", fontsize=11)
    return figure


def _color(shade: float) -> tuple[float, float, float]:
    """White to vermilion to dark."""
    low, middle, high = (0.97, 0.97, 0.97), (0.84, 0.37, 0.0), (0.25, 0.06, 0.0)
    first, second, part = (low, middle, 2 * shade) if shade < 0.5 else (middle, high, 2 * shade - 1)
    r, g, b = (p + part * (q - p) for p, q in zip(first, second, strict=True))
    return r, g, b
