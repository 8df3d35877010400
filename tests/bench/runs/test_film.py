"""Films of runs, drawn where nothing can be rendered, and pictures of paths."""

import io
from pathlib import Path
from types import SimpleNamespace

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from PIL import Image, ImageSequence

from symsteer.bench.runs import film as film_module
from symsteer.bench.runs.film import film, to_gif
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.tasks import make
from symsteer.errors import UserError
from tests.bench.tiny_run import execute, tiny_config

pytestmark = pytest.mark.long


@pytest.fixture
def drawn(monkeypatch):
    """Where no Vulkan driver works, the frames of a film are grey, and the brighter the later."""
    if rendering_works():
        return

    def drawing(task, render, render_mode, human_render_camera_configs, **options):
        env, size = make(task, **options), film_module.SIZE
        grey = torch.ones(1, size, size, 3)
        env.render = lambda: (grey * (5 + 4 * env.elapsed_steps[0])).to(torch.uint8)
        return env

    monkeypatch.setattr(film_module, "make", drawing)
    monkeypatch.setattr(film_module, "rendering_works", lambda: True)


@pytest.fixture(scope="module")
def base(finished):
    """A run of the base policy beside the one that is finished."""
    return execute(tiny_config(agent="base"), finished[1].parent)


def test_a_gif_plays_the_frames_in_order_and_in_time():
    grey = [np.full((40, 60, 3), level, np.uint8) for level in (0, 100, 200)]
    moving = Image.open(io.BytesIO(to_gif(grey, rate=5)))
    assert (moving.format, moving.n_frames, moving.info["loop"]) == ("GIF", 3, 0)
    for frame, shown in zip(grey, ImageSequence.Iterator(moving), strict=True):
        assert shown.info["duration"] == 200
        assert np.abs(np.asarray(shown.convert("RGB")).astype(int) - frame).max() < 5


def test_a_film_of_one_run(finished, drawn):
    path = film([finished[1]], "action_gain:1", episodes=1)
    assert path.name == "film-action_gain=1.mp4"
    # To its time limit, from its start.
    assert len(imageio.mimread(path, memtest=False)) == 51
    path.unlink()


def test_paths_are_drawn_where_nothing_can_be_rendered(finished, base, monkeypatch):
    monkeypatch.setattr(film_module, "rendering_works", lambda: False)
    path = film([base, finished[1]], episodes=1)
    assert path == finished[1].parent / "paths-PickCube-v1-floating-none.png"
    wide = np.asarray(Image.open(path))
    assert wide.std() > 10
    path.unlink()
    alone = film([finished[1]], episodes=1)
    assert wide.shape[1] == 2 * np.asarray(Image.open(alone)).shape[1]
    alone.unlink()


def test_captions_say_who_solved_the_episode(finished, base, drawn, tmp_path):
    path = film([base, finished[1]], episodes=1, out=tmp_path / "both.gif")
    with Image.open(path) as moving:
        frames = [np.asarray(f.convert("RGB")).astype(int) for f in ImageSequence.Iterator(moving)]
    left, right = np.array_split(frames[0], 2, axis=1)
    # The same initial state, seen from the same place, below different captions.
    assert np.abs(left[30:] - right[30:]).mean() < 2
    assert np.abs(left[:26] - right[:26]).max() > 100
    # White captions become coloured ones.
    assert frames[0][:20].mean() > 230
    assert frames[-1][:20].mean() < 180


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"episodes": 0}, "--episodes is 0"),
        ({"variant": "action_gian:1"}, "did you mean 'action_gain'"),
        ({"out": Path("x.avi")}, "written to .mp4 or .gif"),
        ({"task": "PushCube-v1"}, "of different tasks"),
        ({"other": "action_gain:1"}, r"of different worlds \(action_gain:1, none\); say with"),
    ],
)
def test_mistakes(options, words, monkeypatch):
    change = {"task": options.pop("task", "PickCube-v1"), "variant": options.pop("other", "none")}
    runs = [SimpleNamespace(config=tiny_config(**one)) for one in ({}, change)]
    monkeypatch.setattr(film_module, "restored", lambda run: run)
    with pytest.raises(UserError, match=words):
        film(runs, **options)
