import imageio.v2 as imageio
import numpy as np
import pytest
from PIL import Image, ImageSequence

from symsteer.bench.runs.film import film
from symsteer.bench.runs.run import execute
from symsteer.bench.sim.headless import rendering_works
from symsteer.errors import UserError
from tests.bench.tiny_run import tiny_config

pytestmark = pytest.mark.long

RENDERS = pytest.mark.skipif(not rendering_works(), reason="needs a Vulkan driver")


@pytest.fixture(scope="module")
def base(finished):
    """A run of the base policy beside the one that is finished."""
    return execute(tiny_config(agent="base"), finished[1].parent, progress=False)


def test_a_film_is_a_video_or_the_picture_of_paths(finished):
    path = film([finished[1]], "action_gain:1", episodes=2)
    if rendering_works():
        assert path.name == "film-action_gain=1.mp4"
        assert path.stat().st_size > 5000
    else:
        assert path.name == "paths-action_gain=1.png"
        assert np.asarray(Image.open(path)).std() > 10
    path.unlink()


def test_several_runs_are_side_by_side(finished, base, tmp_path):
    path = film([base, finished[1]], episodes=1)
    kind, suffix = ("film", "mp4") if rendering_works() else ("paths", "png")
    assert path == finished[1].parent / f"{kind}-PickCube-v1-floating-none.{suffix}"
    wide = imageio.mimread(path, memtest=False)[0] if kind == "film" else imageio.imread(path)
    path.unlink()
    alone = film([finished[1]], episodes=1)
    one = imageio.mimread(alone, memtest=False)[0] if kind == "film" else imageio.imread(alone)
    alone.unlink()
    assert wide.shape[1] == 2 * one.shape[1]


@RENDERS
def test_captions_say_who_solved_the_episode(finished, base, tmp_path):
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
        ({"out": "x.avi"}, "written to .mp4 or .gif"),
    ],
)
def test_mistakes(finished, tmp_path, options, words):
    if "out" in options:
        options = {"out": tmp_path / options["out"]}
    with pytest.raises(UserError, match=words):
        film([finished[1]], **options)


def test_runs_of_different_tasks_or_worlds_are_refused(finished, tmp_path):
    other = execute(tiny_config(agent="base", task="PushCube-v1"), tmp_path, progress=False)
    with pytest.raises(UserError, match="of different tasks"):
        film([finished[1], other])
    config = tiny_config(agent="base", variant="action_gain:1")
    broken = execute(config, finished[1].parent, progress=False)
    with pytest.raises(UserError, match=r"of different worlds \(action_gain:1, none\); say with"):
        film([finished[1], broken])
