"""TensorBoard events: the numbers of the record, and training scalars."""

from __future__ import annotations

import contextlib
import functools
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tensorboard.compat.proto.summary_pb2 import DATA_CLASS_SCALAR, Summary, SummaryMetadata
from tensorboard.compat.proto.tensor_pb2 import TensorProto
from tensorboard.compat.proto.tensor_shape_pb2 import TensorShapeProto
from tensorboard.plugins.custom_scalar import metadata as custom_scalars
from tensorboard.plugins.hparams import api_pb2, metadata, plugin_data_pb2
from tensorboard.plugins.scalar import metadata as scalar
from torch.utils.tensorboard import SummaryWriter

from symsteer.agents import AGENTS
from symsteer.bench.runs.charts import DESCRIPTIONS, LAYOUT
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.pictures import to_gif
from symsteer.errors import UserError
from symsteer.leaderboard.records import Provenance, RunRecord, flat
from symsteer.policies import POLICIES

IDENTITY = frozenset({"task", "embodiment", "variant", "agent", "seed"})
"""Settings that the HParams tab shows first; the others can be selected."""

FINAL_METRICS = (
    "eval/success_once",
    "eval/success_at_end",
    "eval/return",
    "eval/episode_len",
    "diag/q_mean",
    "diag/q_bias",
    "diag/q_correlation",
    "diag/q_magnitude",
    "diag/td_error",
    "diag/equivariance_actor",
    "diag/equivariance_critic",
    "diag/alpha",
    "time/env_steps_per_second",
)
"""Columns of the HParams tab: the last value of each of these scalars."""


class RunLog:
    """TensorBoard's view of one run: scalars against control steps, settings, pictures.

    Namespaces: ``eval/`` held-out episodes, ``train/`` training episodes and batches, ``losses/``,
    ``time/`` seconds and rates, ``diag/`` Q and equivariance diagnostics, ``log10/`` the same as
    powers of ten, ``reference/`` level lines. docs/metrics.md has the formulas.

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
        with self._reported():
            self.writer = SummaryWriter(str(folder), purge_step=purge_step)
            self._add(_layout())
            # A continued run may use another commit: its text is added to the first one.
            self.writer.add_text("config", config_text(record), purge_step)
            settings = _settings(record.config)
            known = {**_known_settings(), **settings}
            self._hparams(metadata.EXPERIMENT_TAG, experiment=_experiment(known))
            self._hparams(
                metadata.SESSION_START_INFO_TAG, session_start_info=_session(record, settings)
            )
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

    def film(self, tag: str, frames: Sequence[np.ndarray], rate: float, step: int) -> None:
        """Write ``frames``, each ``[height, width, 3]`` uint8, as a film, ``rate`` per second."""
        height, width, _ = frames[0].shape
        image = Summary.Image(
            height=height, width=width, colorspace=3, encoded_image_string=to_gif(frames, rate)
        )
        with self._reported():
            self._add(Summary(value=[Summary.Value(tag=tag, image=image)]), step)

    def finish(self) -> None:
        """Mark the run as finished in the HParams tab, and close."""
        end = plugin_data_pb2.SessionEndInfo(
            status=api_pb2.STATUS_SUCCESS, end_time_secs=time.time()
        )
        with contextlib.suppress(OSError):
            self._hparams(metadata.SESSION_END_INFO_TAG, session_end_info=end)
        self.close()

    def flush(self) -> None:
        """Write all events to disk."""
        with self._reported():
            self.writer.flush()

    def close(self) -> None:
        """Write all events to disk and close.

        The record is already closed, so errors are ignored.
        """
        with contextlib.suppress(OSError):
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

    def _hparams(self, tag: str, **content: Any) -> None:
        data = plugin_data_pb2.HParamsPluginData(**content)
        summary = Summary()
        summary.value.add(
            tag=tag, metadata=metadata.create_summary_metadata(data), tensor=metadata.NULL_TENSOR
        )
        # SummaryWriter's own add_hparams opens a second event file and renames the metrics.
        self._add(summary)

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
    tensor = TensorProto(
        dtype="DT_STRING", string_val=[LAYOUT.SerializeToString()], tensor_shape=TensorShapeProto()
    )
    value = Summary.Value(
        tag=custom_scalars.CONFIG_SUMMARY_TAG,
        tensor=tensor,
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


def _settings(config: Mapping[str, Any]) -> dict[str, bool | int | float | str]:
    """A configuration with dotted names and values of TensorBoard's types; "none" for None."""

    def known(value: Any) -> bool | int | float | str:
        if value is None:
            return "none"
        return value if isinstance(value, bool | int | float | str) else str(value)

    return {name: known(value) for name, value in flat(config).items()}


@functools.cache
def _known_settings() -> dict[str, bool | int | float | str]:
    """The settings of all agents and policies of SymSteer, with their defaults."""
    runs = [RunConfig(agent=name) for name in AGENTS.builtin]
    runs += [RunConfig(policy_name=name) for name in POLICIES.builtin]
    known: dict[str, bool | int | float | str] = {"evaluation_variant": "none"}
    for run in runs:
        known |= _settings(run.to_json())
    return dict(sorted(known.items()))


def config_text(record: RunRecord) -> str:
    """Two markdown tables: facts about a run, and its whole configuration."""
    base = record.base_policy
    facts = {
        "run": record.run_id,
        "started": record.started.isoformat(),
        "commit": _commit(record.provenance),
        "continued": "; ".join(map(_commit, record.continued)) or None,
        "device": f"{record.provenance.device}, {record.provenance.platform}",
        "packages": ", ".join(f"{k} {v}" for k, v in record.provenance.packages.items()),
        "parameters": f"{record.parameters.actor:,} in the actor, "
        f"{record.parameters.critic:,} in all critics",
        "base policy": f"{base.name}, group {base.group}, content {base.content_hash[:12]}",
        "its success": f"{_share(base.base_success)} of {base.episodes} episodes with random noise",
        "its steerability": f"{_share(base.solvable)} of the initial states are solved by one of "
        f"{base.draws} noise draws; the noise moves the normalised actions by "
        f"{base.action_std:.2f}"
        if base.action_std is not None
        else None,
        "its warning": base.warning,
        "feasible Q": f"{record.feasible_q.low:g} to {record.feasible_q.high:g}"
        if record.feasible_q
        else None,
    }
    return "\n".join(
        [
            *_table("this run", "", {k: v for k, v in facts.items() if v is not None}),
            "",
            *_table("setting", "value", _settings(record.config)),
        ]
    )


def _commit(provenance: Provenance) -> str:
    name = provenance.commit or "unknown"
    return f"{name} with uncommitted changes" if provenance.dirty else name


def _table(left: str, right: str, rows: Mapping[str, Any]) -> Iterator[str]:
    yield f"| {left} | {right} |"
    yield "| :-- | :-- |"
    for name, value in rows.items():
        text = str(value).replace("|", "\\|").replace("\n", " ")
        yield f"| {name} | `{text}` |"


def _share(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.0%}"


def _experiment(settings: Mapping[str, Any]) -> api_pb2.Experiment:
    """Columns of the HParams tab, equal for all runs: TensorBoard reads those of any one run."""
    types = {
        bool: api_pb2.DATA_TYPE_BOOL,
        int: api_pb2.DATA_TYPE_FLOAT64,
        float: api_pb2.DATA_TYPE_FLOAT64,
        str: api_pb2.DATA_TYPE_STRING,
    }
    return api_pb2.Experiment(
        hparam_infos=[
            api_pb2.HParamInfo(name=name, type=types[type(value)], differs=name in IDENTITY)
            for name, value in settings.items()
        ],
        metric_infos=[
            api_pb2.MetricInfo(name=api_pb2.MetricName(tag=tag)) for tag in FINAL_METRICS
        ],
    )


def _session(record: RunRecord, settings: Mapping[str, Any]) -> plugin_data_pb2.SessionStartInfo:
    # The first column of the table. A full run name would be cut to the part that all runs share.
    session = plugin_data_pb2.SessionStartInfo(
        group_name=record.run_id.rpartition("-")[2], start_time_secs=record.started.timestamp()
    )
    for name, value in settings.items():
        if isinstance(value, bool):
            session.hparams[name].bool_value = value
        elif isinstance(value, str):
            session.hparams[name].string_value = value
        else:
            session.hparams[name].number_value = value
    return session
