"""TensorBoard as a view of the record: the same numbers, nothing that the record lacks."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter

# The tags of a Multiline chart are regular expressions.
LAYOUT = {
    "SymSteer": {
        "Success on held-out episodes": [
            "Multiline",
            ["^eval/success_once$", "^eval/success_at_end$"],
        ],
        "Q against its feasible band": ["Margin", ["diag/q_mean", "diag/q_low", "diag/q_high"]],
        "Q bias against fresh returns": ["Multiline", ["^diag/q_bias$"]],
        "Equivariance errors": ["Multiline", ["^diag/equivariance_(decode|actor|critic)$"]],
        "Temperature": ["Multiline", ["^diag/alpha$"]],
    }
}


class RunLog:
    """Scalars of one run, against control steps.

    Namespaces: ``eval/`` held-out episodes, ``train/`` training episodes, ``losses/``, ``time/``
    seconds and rates, ``diag/`` Q and equivariance diagnostics. docs/metrics.md has the formulas.

    Args:
        folder: the run's folder; the events stand beside its record.
        config: the resolved configuration.
        purge_step: for a run that continues: TensorBoard drops what the earlier session wrote at
            this step and later, since the continued run writes it again.
    """

    def __init__(self, folder: Path, config: Mapping[str, Any], purge_step: int | None = None):
        self.writer = SummaryWriter(str(folder), purge_step=purge_step)
        self.writer.add_custom_scalars(LAYOUT)
        text = json.dumps(config, indent=2).replace("\n", "  \n")
        self.writer.add_text("config", f"```\n{text}\n```")
        self._config = config

    def scalars(self, namespace: str, values: Mapping[str, float | None], step: int) -> None:
        """Write every value that was measured."""
        for name, value in values.items():
            if value is not None:
                self.writer.add_scalar(f"{namespace}/{name}", value, step)

    def finish(self, metrics: Mapping[str, float]) -> None:
        """Write the table of hyperparameters with the final metrics, and close."""
        hparams = {k: v for k, v in self._config.items() if isinstance(v, bool | int | float | str)}
        # run_name="." keeps the table in this run's own folder.
        self.writer.add_hparams(
            hparams, {f"final/{k}": v for k, v in metrics.items()}, run_name="."
        )
        self.close()

    def close(self) -> None:
        """Flush to disk."""
        self.writer.close()
