"""The augmented agent: symmetry from data instead of architecture.

If the world is symmetric, a transition (s, w, a, r, s') that is rotated as a whole is another true
one with the same reward. The equivariant agent has this built in. This agent is plain and learns it
from batches in which every transition is rotated at random. It costs as much as `standard` and
can leave the symmetry. Where the world breaks the symmetry, some rotated transitions are false.
"""

from __future__ import annotations

from symsteer.agents.presets import defaults_of
from symsteer.agents.replay import Batch
from symsteer.agents.standard import StandardAgent
from symsteer.policies.geometry import Group
from symsteer.policies.symmetry.augmented import Augmentation


@defaults_of("minimax")
class AugmentedAgent(StandardAgent):
    """Plain actor, plain critics, every transition of a batch rotated at random."""

    name = "augmented"
    in_teams = True

    def augment(self, batch: Batch) -> Batch:
        """Each row is turned by an element of ``group`` of its own."""
        augmentation = Augmentation(Group.parse(self.options.group))
        # The agent's own generator: its state is in the checkpoint, so a resumed run repeats.
        count, rows = batch.obs.shape[-2], batch.obs.shape[:-1]
        drawn = self.random(lambda generator: augmentation.draw(count, generator)).flatten()
        turned = {}
        for name, layout in self.vector_fields.items():
            if name in batch:
                each = batch[name].flatten(0, len(rows) - 1)
                turned[name] = augmentation.apply(drawn, each, layout).unflatten(0, rows)
        return batch.replace(**turned)
