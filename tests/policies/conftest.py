"""A small symmetric world for the policies' tests: a point mass with an equivariant controller."""

import contextlib

import pytest
import torch

from symsteer.policies import POLICIES
from symsteer.policies.geometry import Field, Group, Layout, equivariance_error
from tests.marks import policy_class

OBS = Layout(
    [
        Field("tcp", 1),
        Field("height", 0),
        Field("goal", 1),
        Field("rod", 2),
        Field("twist", 0, odd=True),
        Field("width", 0),
    ]
)
ACT = Layout(
    [
        Field("xy", 1),
        Field("z", 0),
        Field("tilt", 1, odd=True),
        Field("yaw", 0, odd=True),
        Field("gripper", 0),
    ]
)
SMALL = {
    "channels": 16,
    "width": 32,
    "depth": 2,
    "warmup_steps": 10,
    # So few steps of training leave more of the noise in a chunk.
    "sampling_steps": 4,
    "learning_rate": 4e-3,
    # Equal weights of all noise levels: the controller is learned within a few steps.
    "snr_cap": 0.05,
}


def controller(obs: torch.Tensor) -> torch.Tensor:
    """Actions [..., 7] that commute with every rotation and reflection of the plane."""
    tcp, goal = (torch.complex(*obs[..., OBS.slice(n)].unbind(-1)) for n in ("tcp", "goal"))
    rod = torch.complex(*obs[..., OBS.slice("rod")].unbind(-1))
    reach = goal - tcp
    xy = reach / reach.abs().clamp_min(0.25)
    tilt = 0.5j * rod * xy.conj()
    yaw = (xy.conj() * tcp).imag - obs[..., OBS.slice("twist")].squeeze(-1)
    z = -obs[..., OBS.slice("height")]
    gripper = torch.where(reach.abs() < 0.3, -1.0, 1.0).to(obs)
    return torch.cat(
        [
            torch.view_as_real(xy),
            z,
            torch.view_as_real(tilt),
            yaw.clamp(-1, 1)[..., None],
            gripper[..., None],
        ],
        dim=-1,
    )


def observations(count: int, seed: int = 0) -> torch.Tensor:
    """Random states ``[count, OBS.dim]``."""
    return _drawn(count, torch.Generator().manual_seed(seed))


def _drawn(count: int, generator: torch.Generator) -> torch.Tensor:
    obs = torch.rand(count, OBS.dim, generator=generator) * 2 - 1
    rod = obs[:, OBS.slice("rod")]
    obs[:, OBS.slice("rod")] = rod / rod.norm(dim=-1, keepdim=True)
    return obs


def noises(count: int, seed: int = 1) -> torch.Tensor:
    """Noise chunks ``[count, 8, ACT.dim]``."""
    return torch.randn(count, 8, ACT.dim, generator=torch.Generator().manual_seed(seed))


def make_episodes(count: int, seed: int = 0, length: int = 8, noise: float = 0.0):
    generator = torch.Generator().manual_seed(seed)
    obs = _drawn(count, generator)
    states, actions = [obs], []
    for _ in range(length):
        action = controller(obs)
        action = action + noise * torch.randn(action.shape, generator=generator)
        obs = obs.clone()
        obs[:, OBS.slice("tcp")] += 0.2 * action[:, ACT.slice("xy")]
        obs[:, OBS.slice("height")] += 0.2 * action[:, ACT.slice("z")]
        states.append(obs)
        actions.append(action)
    states, actions = torch.stack(states, dim=1), torch.stack(actions, dim=1)
    return [(states[i], actions[i]) for i in range(count)]


def small_options(name: str = "edp", **fields):
    """Options of a policy, small enough for tests."""
    kind = POLICIES.get(name).Options
    small = {key: value for key, value in SMALL.items() if hasattr(kind, key)}
    return kind(**{**small, **fields})


def fit(name: str = "edp", seed: int = 0, progress=None, episodes=None, **fields):
    """A policy trained for a few steps."""
    kind = policy_class(name)
    few = {"steps": 30, "batch_size": 32, "match_compute": False}
    few = {key: value for key, value in few.items() if hasattr(kind.Options, key)}
    episodes = make_episodes(6, noise=0.2) if episodes is None else episodes
    return kind.fit(small_options(name, **{**few, **fields}), episodes, OBS, ACT, seed, progress)


def untrained(name: str = "edp", layouts=(OBS, ACT), **fields):
    """A policy with random weights."""
    torch.manual_seed(0)
    return policy_class(name)(small_options(name, **fields), *layouts)


@pytest.fixture(scope="session")
def trained():
    """Policies trained briefly, each once; ``trained(name, **options)``."""
    cache = {}

    def get(name="edp", **fields):
        key = (name, *sorted(fields.items()))
        if key not in cache:
            short = {"steps": 120, "batch_size": 64, "ema_decay": 0.9}
            if fields.get("network") == "unet":
                short |= {"steps": 100, "batch_size": 32, "width": 16}
            cache[key] = fit(name, episodes=make_episodes(24, noise=0.2), **{**short, **fields})
        return cache[key]

    return get


@contextlib.contextmanager
def as_type(dtype, *policies):
    """Policies in another precision for a while."""
    for policy in policies:
        policy.to(dtype)
    try:
        yield
    finally:
        for policy in policies:
            policy.float()


def decode_error(policy, group=None, obs=None, layouts=None, dtype=torch.float32):
    """Relative equivariance error of decode; inputs are transformed in float64.

    Args:
        policy: of this precision.
        group: by default the policy's own.
        obs: by default states of the point mass, of which some are far out.
        layouts: of observation and action, how the world turns; by default as the policy believes.
        dtype: precision of the inputs.
    """
    obs_layout, act_layout = layouts or (policy.obs_layout, policy.act_layout)
    obs = 1.5 * observations(16) if obs is None else obs
    generator = torch.Generator().manual_seed(1)
    noise = 1.5 * torch.randn(len(obs), policy.horizon, act_layout.dim, generator=generator)
    return equivariance_error(
        lambda *inputs: policy.decode(*(x.to(dtype) for x in inputs)),
        (obs.double(), noise.double()),
        (obs_layout, act_layout),
        act_layout,
        group or policy.group,
    )


def assert_exact(policy, group: Group | None = None, obs=None, tolerance=1e-5):
    """It commutes with its group to rounding, in single and in double precision."""
    for dtype, bound in ((torch.float32, tolerance), (torch.float64, 1e-10)):
        with as_type(dtype, policy):
            assert decode_error(policy, group, obs, dtype=dtype) <= bound
