"""Draws what each variant does to turned copies of one episode.

python -m tools.pictures.orbits    # writes docs/variants/*.png

Eight copies of a PushCube episode start turned by multiples of 45 degrees and execute the scripted
expert's actions, turned alike. In the unbroken world their paths are a star.
"""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np
import torch
from matplotlib import style as mpl_style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from symsteer.bench.sim.trees import join_trees, rows_of
from symsteer.bench.tasks import make
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import Expert
from symsteer.bench.variants import VARIANTS
from symsteer.files import write_together
from symsteer.policies.geometry import Group
from tools.pages.marks import CHECKOUT

FOLDER = CHECKOUT / "docs" / "variants"
TASK = "PushCube-v1"
SEED = 3
STARTS = 24
"""Resets of each of the eight environments; their cubes' positions are drawn as dots."""
LIMIT = 215
"""Half the side of a picture, mm."""
UNBROKEN, BROKEN, SEEN = "#9a9a9a", "#d55e00", "#0072b2"


@dataclass(frozen=True)
class Orbit:
    """One episode and its turned copies; positions in mm from the workspace's centre.

    Attributes:
        object, tool: paths in the plane, ``[T + 1, G, 2]``.
        seen: where the object is observed at the start, ``[G, 2]``.
        cost: mean cost of a step, ``[G]``.
        starts: positions of the object after other resets, ``[R, 2]``.
        origin: the centre that the policy assumes, ``[2]``.
    """

    object: np.ndarray
    tool: np.ndarray
    seen: np.ndarray
    cost: np.ndarray
    starts: np.ndarray
    origin: np.ndarray


def orbit(variant: str) -> Orbit:
    """Simulate the copies in a world with this variant."""
    elements = Group.parse("C8").elements
    plain = make(TASK, num_envs=len(elements))
    plain.reset(seed=[SEED] * len(elements))
    first = plain.get_state_dict()
    actions = _expert(plain)
    env = make(TASK, num_envs=len(elements), variant=variant)
    starts = []
    for draw in range(STARTS):
        env.reset(seed=[100 + draw * len(elements) + g for g in range(len(elements))])
        starts.append(env.manipulated.pose.p[:, :2].clone())
    env.reset(seed=[SEED] * len(elements))
    whole = env.get_state_dict()
    state = join_trees(
        [
            rows_of(plain.transform_state(first, *g), torch.tensor([row]))
            for row, g in enumerate(elements)
        ]
    )
    bodies = {kind: {**whole[kind], **state[kind]} for kind in ("actors", "articulations")}
    env.set_state_dict({**whole, **state, **bodies})
    obs = env.get_obs()
    seen = obs[:, env.observation_layout.slice("cube_xy")] + env.policy_origin
    cube, tool = [env.manipulated.pose.p.clone()], [env.agent.tcp_pose.p.clone()]
    cost = torch.ones(len(elements))
    for action in actions:
        turned = [env.action_layout.transform(action[None], *g) for g in elements]
        _, _, _, _, info = env.step(torch.cat(turned))
        cube.append(env.manipulated.pose.p.clone())
        tool.append(env.agent.tcp_pose.p.clone())
        if "extra_cost" in info:
            cost += info["extra_cost"] / len(actions)
    found = Orbit(
        _millimetres(torch.stack(cube), env),
        _millimetres(torch.stack(tool), env),
        _millimetres(seen, env),
        cost.numpy(),
        _millimetres(torch.cat(starts), env),
        _millimetres(env.policy_origin[0], env),
    )
    plain.close()
    env.close()
    return found


def _expert(env: SymmetricTask) -> list[torch.Tensor]:
    """The expert's actions of the first environment until success."""
    expert = Expert(env)
    actions: list[torch.Tensor] = []
    while len(actions) < env.max_episode_steps:
        action = expert.act()
        actions.append(action[0].clone())
        if env.step(action)[4]["success"][0]:
            break
    return actions


def _millimetres(points: torch.Tensor, env: SymmetricTask) -> np.ndarray:
    centre = torch.tensor(env.workspace_center[:2])
    return 1e3 * (points[..., :2] - centre).numpy()


@mpl_style.context("default")  # no settings of a file in the current folder
def draw(name: str, unbroken: Orbit, broken: Orbit) -> bytes:
    """A picture of the broken orbit over the unbroken one, PNG."""
    figure = Figure(figsize=(4, 4), layout="constrained")
    ax: Axes = figure.subplots()
    ax.plot(*broken.starts.T, ".", color="#56b4e9", alpha=0.5, markersize=3)
    for found, colour, wide in ((unbroken, UNBROKEN, 4.0), (broken, BROKEN, 1.6)):
        ax.plot(*found.object.transpose(2, 0, 1), color=colour, linewidth=wide)
        ax.plot(*found.object[0].T, "s", color=colour, markersize=wide + 2)
        ax.plot(*found.tool.transpose(2, 0, 1), color=colour, linewidth=wide / 2, linestyle=":")
    true = broken.object[0]
    if np.abs(broken.seen - true).max() > 1:
        for start, end in zip(true, broken.seen, strict=True):
            arrow = {
                "arrowstyle": "->",
                "color": SEEN,
                "linewidth": 1.4,
                "shrinkA": 0,
                "shrinkB": 0,
            }
            ax.annotate("", xy=end, xytext=start, arrowprops=arrow)
    if broken.cost.max() > 1:
        for end, cost in zip(broken.object[-1], broken.cost, strict=True):
            ax.annotate(f"{cost:.1f}", end, color=SEEN, fontsize=9, ha="center", va="center")
    ax.plot(*broken.origin, "+", color="black", markersize=10)
    ax.set(aspect="equal", xlim=(-LIMIT, LIMIT), ylim=(-LIMIT, LIMIT))
    ax.set(xlabel="x, mm", ylabel="y, mm")
    ax.set_title(name, fontsize=11, family="monospace")
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=100, metadata={"Software": None})
    return picture.getvalue()


def main() -> None:
    """Write a picture for each variant."""
    unbroken = orbit("none")
    names = [name for name in VARIANTS.names() if name != "none"]
    write_together(
        {FOLDER / f"{name}.png": draw(name, unbroken, orbit(f"{name}:1")) for name in names}
    )


if __name__ == "__main__":
    main()
