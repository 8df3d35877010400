"""TensorBoard events: the numbers of the record, training scalars, and charts of them.

docs/metrics.md has the formulas of all scalars.
"""

from __future__ import annotations

import contextlib
import functools
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from tensorboard.compat.proto.summary_pb2 import DATA_CLASS_SCALAR, Summary, SummaryMetadata
from tensorboard.compat.proto.tensor_pb2 import TensorProto
from tensorboard.compat.proto.tensor_shape_pb2 import TensorShapeProto
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.custom_scalar import metadata as custom_scalars
from tensorboard.plugins.scalar import metadata as scalar
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import RunConfig
from symsteer.errors import UserError
from symsteer.leaderboard.records import RunRecord, flat
from symsteer.policies import POLICIES
from symsteer.tables import markdown

Charts: TypeAlias = dict[str, dict[str, tuple[str, ...]]]
"""Tags of scalars by group of charts and title."""

DESCRIPTIONS = {
    "eval/success_once": "Share of held-out episodes with success at any step.",
    "eval/success_at_end": "Share of held-out episodes with success at the last step.",
    "eval/return": "Mean undiscounted return of held-out episodes.",
    "train/success_once": "Share of the last 100 training episodes with success.",
    "train/return": "Mean undiscounted return of the last 100 training episodes.",
    "train/episode_len": "Mean length of the last 100 training episodes, in control steps.",
    "train/alpha": "Entropy weight alpha, mean over the updates since the last point.",
    "train/entropy": "Mean of -log pi(w | s) on training batches, in nats per decision.",
    "reference/base_success": "Success of the frozen base policy with random noise.",
    "reference/q_low": "Lowest discounted return that the reward allows.",
    "reference/q_high": "Highest discounted return that the reward allows.",
    "reference/q_magnitude": "1: larger values belong to no feasible return.",
    "diag/q_mean": "Mean over held-out states of min_j Q_j(s, w), w from the actor.",
    "diag/q_bias": "Mean of Q minus the return, over decisions of fresh episodes.",
    "diag/q_correlation": "Pearson's correlation of Q and the return over these decisions.",
    "diag/q_magnitude": "Largest |Q| over the largest feasible one; above 1: diverged.",
    "diag/td_error": "Root mean square of the temporal-difference error on fresh episodes.",
    "diag/equivariance_actor": "Largest relative difference of mu(gs) and g mu(s) over the group.",
    "diag/equivariance_critic": "Relative standard deviation of Q over the group.",
    "log10/equivariance_actor": "log10 of diag/equivariance_actor; -8 also stands for less.",
    "log10/equivariance_critic": "log10 of diag/equivariance_critic; -8 also stands for less.",
    "losses/critic": "Squared temporal-difference error on training batches, summed over critics.",
    "losses/actor": "Mean of alpha log pi(w | s) - min_j Q_j(s, w) on training batches.",
    "time/env_steps_per_second": "Control steps over all seconds since the start of the run.",
}

FINAL_METRICS = tuple(tag for tag in DESCRIPTIONS if tag.startswith(("eval/", "diag/", "time/")))
"""Columns of the HParams tab: the last value of each of these scalars."""

POINTS: Charts = {
    "Success": {
        "held-out episodes (level line: the frozen base policy)": (
            "eval/success_once",
            "reference/base_success",
        ),
        "training, mean of the last 100 episodes": ("train/success_once",),
    },
    "Q-values": {
        "bias: Q minus the return": ("diag/q_bias",),
        "correlation of Q and the return": ("diag/q_correlation",),
    },
    "Equivariance errors, powers of ten (-2: 1 %)": {
        "of the actor": ("log10/equivariance_actor",),
        "of the critics": ("log10/equivariance_critic",),
    },
}
"""Charts of few and separate points, which are never smoothed."""

LINES: Charts = {
    "Q-values": {
        "mean, and its feasible bounds": ("diag/q_mean", "reference/q_low", "reference/q_high"),
        "largest |Q|; feasible up to 1": ("diag/q_magnitude", "reference/q_magnitude"),
    },
    "Learning": {
        "loss of the critics": ("losses/critic",),
        "loss of the actor": ("losses/actor",),
        "temperature alpha": ("train/alpha",),
        "entropy of the actor": ("train/entropy",),
    },
}
"""Charts whose lines TensorBoard may smooth."""

FIRST = ("run", "task", "embodiment", "variant", "agent", "seed")
"""Settings that the HParams tab shows first; the others can be selected."""

AT_THE_START = frozenset(
    {"run_id", "started", "provenance", "continued", "parameters", "base_policy", "feasible_q"}
)
"""What the text of a run has of the record, beside its configuration."""


class RunLog:
    """TensorBoard's view of one run: scalars against control steps, settings, pictures.

    Namespaces: ``eval/`` held-out episodes, ``train/`` training episodes and batches, ``losses/``,
    ``time/`` seconds and rates, ``diag/`` Q and equivariance diagnostics, ``log10/`` the same as
    powers of ten, ``reference/`` level lines.

    Args:
        folder: the run's folder.
        record: the run's record at its start.
        purge_step: TensorBoard drops events of earlier processes at this step and later, because
            the run writes them again.

    Raises:
        UserError: here and in all methods that write, if the disk is full or read-only.
    """

    def __init__(self, folder: Path, record: RunRecord, purge_step: int = 0):
        self.folder, self._purge_step = folder, purge_step
        self._described: set[str] = set()
        _silence_writing_thread()
        # The end of the run's name: the tab would cut a whole one to the part that all runs share.
        settings = {"run": record.run_id.rpartition("-")[2], **_settings(record.config)}
        columns = {**dict.fromkeys(FIRST, ""), **_known_settings(), **settings}
        metrics = dict.fromkeys(FINAL_METRICS, 0.0)
        # Not SummaryWriter.add_hparams: it opens a second event file and renames the metrics.
        experiment, _, _ = hparams(columns, metrics)
        _, session, self._finished = hparams(settings, metrics)
        with self._reported():
            self.writer = SummaryWriter(str(folder), purge_step=purge_step)
            for summary in (_layout(), experiment, session):
                self._add(summary)
            # A continued run may use another commit: its text is added to the first one.
            self.writer.add_text("config", config_text(record), purge_step)
            self.writer.flush()

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """Write all values that are not None, by tag (``eval/success_once``)."""
        summary = Summary()
        for tag, value in values.items():
            if value is not None:
                summary.value.add(tag=tag, simple_value=value, metadata=self._description(tag))
        if summary.value:
            with self._reported():
                self._add(summary, step)

    def level(self, values: Mapping[str, float | None], budget: int) -> None:
        """Draw level lines from step 0 to the budget."""
        for step in (0, budget):
            if step >= self._purge_step:
                self.scalars(values, step)

    def picture(self, tag: str, picture: np.ndarray, step: int) -> None:
        """Write a picture ``[height, width, 3]`` uint8."""
        with self._reported():
            self.writer.add_image(tag, picture, step, dataformats="HWC")

    def flush(self) -> None:
        """Write all events to disk."""
        with self._reported():
            self.writer.flush()

    def end(self, finished: bool) -> None:
        """Write all events to disk and close; the HParams tab says whether the run has finished.

        The record is already closed, so errors are ignored.
        """
        with contextlib.suppress(OSError):
            if finished:
                self._add(self._finished)
            self.writer.close()

    @contextlib.contextmanager
    def _reported(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise UserError(
                f"cannot write TensorBoard's events to {self.folder}: {error.strerror}; free space "
                "or choose another folder, then continue the run"
            ) from error

    def _add(self, summary: Summary, step: int | None = None) -> None:
        assert self.writer.file_writer is not None
        self.writer.file_writer.add_summary(summary, step)

    def _description(self, tag: str) -> SummaryMetadata | None:
        """What TensorBoard says of a tag; it reads it at the first point."""
        if tag in self._described or tag not in DESCRIPTIONS:
            return None
        self._described.add(tag)
        described = scalar.create_summary_metadata(tag, DESCRIPTIONS[tag])
        described.data_class = DATA_CLASS_SCALAR  # TensorBoard's fast reader needs it
        return described


def _layout() -> Summary:
    """The charts.

    By default TensorBoard smooths the lines of a multi-line chart, fits the axis to the smoothed
    values, and cuts off the 5 % at either end, so that points are missing. It smooths no margin
    chart. So few and separate points are shown in margin charts whose margins have no width: lines
    through all points.
    """
    categories = []
    for title in dict.fromkeys((*POINTS, *LINES)):
        charts = []
        for name, tags in LINES.get(title, {}).items():
            lines = layout_pb2.MultilineChartContent(tag=[f"{tag}$" for tag in tags])
            charts.append(layout_pb2.Chart(title=name, multiline=lines))
        # TensorBoard shows the margin charts of a category after the others, the last one first.
        for name, tags in reversed(POINTS.get(title, {}).items()):
            kind = layout_pb2.MarginChartContent
            margin = kind(series=[kind.Series(value=t, lower=t, upper=t) for t in tags])
            charts.append(layout_pb2.Chart(title=name, margin=margin))
        categories.append(layout_pb2.Category(title=title, chart=charts))
    layout = layout_pb2.Layout(category=categories).SerializeToString()
    value = Summary.Value(
        tag=custom_scalars.CONFIG_SUMMARY_TAG,
        tensor=TensorProto(dtype="DT_STRING", string_val=[layout], tensor_shape=TensorShapeProto()),
        metadata=custom_scalars.create_summary_metadata(),
    )
    return Summary(value=[value])


@functools.cache
def _silence_writing_thread() -> None:
    """Stop TensorBoard's thread from printing tracebacks; later calls raise its errors."""
    others = threading.excepthook

    def hook(args: threading.ExceptHookArgs) -> None:
        ours = type(args.thread).__module__.startswith("tensorboard.")
        if not (ours and issubclass(args.exc_type, OSError)):
            others(args)

    threading.excepthook = hook


def _settings(config: Mapping[str, Any]) -> dict[str, float | str]:
    """A configuration with dotted names and numbers and texts as values; "none" for None."""

    def plain(value: Any) -> float | str:
        if isinstance(value, int | float) and not isinstance(value, bool):
            return value
        return "none" if value is None else str(value)

    return {name: plain(value) for name, value in flat(config).items()}


@functools.cache
def _known_settings() -> dict[str, float | str]:
    """The settings of all agents and policies of SymSteer, with their defaults.

    TensorBoard reads the columns of any one run, so they have to be those of all.
    """
    runs = [RunConfig(agent=name) for name in AGENTS.builtin]
    runs += [RunConfig(policy_name=name) for name in POLICIES.builtin]
    known: dict[str, float | str] = {"evaluation_variant": "none"}
    for run in runs:
        known |= _settings(run.to_json())
    return dict(sorted(known.items()))


def config_text(record: RunRecord) -> str:
    """A markdown table: facts about a run, and its whole configuration."""
    facts = flat(record.model_dump(mode="json", include=set(AT_THE_START))) | flat(record.config)
    rows = []
    for name, value in facts.items():
        if value is not None:
            text = str(value).replace("|", "\\|").replace("\n", " ")
            rows.append((name, f"`{text}`"))
    return markdown(("this run", ""), rows, left=2)
