"""Our schedule and sampler against diffusers' DDIM scheduler."""

import pytest
import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler

from symsteer.policies.training.diffusion import Diffusion


def reference(prediction, clip=False):
    return DDIMScheduler(
        num_train_timesteps=100,
        beta_schedule="squaredcos_cap_v2",
        prediction_type=prediction,
        clip_sample=clip,
        clip_sample_range=1.0,
        timestep_spacing="trailing",
    )


def test_schedule_and_forward_process():
    ours, theirs = Diffusion(100), reference("sample")
    signal = torch.tensor(ours.keep).square()
    assert torch.allclose(signal, theirs.alphas_cumprod, rtol=2e-4)
    assert torch.allclose(signal, theirs.alphas_cumprod, atol=1e-6)
    assert torch.allclose(torch.tensor(ours.spread).square(), 1 - signal, atol=1e-6)
    x0, noise = torch.randn(2, 100, 8, 7, generator=torch.Generator().manual_seed(0))
    t = torch.arange(100)
    assert torch.allclose(ours.add_noise(x0, noise, t), theirs.add_noise(x0, noise, t), atol=1e-5)


@pytest.mark.parametrize("steps", [1, 4, 10])
def test_timesteps(steps):
    theirs = reference("sample")
    theirs.set_timesteps(steps)
    assert Diffusion(100).timesteps(steps) == theirs.timesteps.tolist()


@pytest.mark.parametrize("prediction", ["sample", "epsilon"])
@pytest.mark.parametrize("clip", [False, True])
@pytest.mark.parametrize("steps", [4, 10])
def test_every_step_is_diffusers_step(prediction, clip, steps):
    """Per-axis clipping is what diffusers has, so the bound here is a clamp."""
    ours, theirs = Diffusion(100, prediction), reference(prediction, clip)
    theirs.set_timesteps(steps)
    generator = torch.Generator().manual_seed(0)
    levels = ours.timesteps(steps)
    bound = (lambda x: x.clamp(-1, 1)) if clip else None
    for t, t_next in zip(levels, [*levels[1:], -1], strict=True):
        x, output = torch.randn(2, 64, 8, 7, generator=generator).double()
        step = theirs.step(output, t, x, eta=0.0, use_clipped_model_output=clip).prev_sample
        mine = ours.ddim_step(output, t, t_next, x, bound)
        # diffusers keeps its schedule in float32: sqrt(a_t) at t = 99 has 4 good digits there.
        tolerance = 2e-3 if prediction == "epsilon" and t == 99 and not clip else 5e-5
        assert torch.allclose(mine, step, rtol=tolerance, atol=tolerance)


def test_the_sampler_follows_the_steps():
    theirs, answer = reference("sample"), torch.linspace(-1, 1, 7)
    x = noise = torch.randn(5, 8, 7, generator=torch.Generator().manual_seed(0))
    theirs.set_timesteps(4)
    for t in theirs.timesteps:
        x = theirs.step(0.5 * x + answer, int(t), x).prev_sample
    ours = Diffusion(100).sample(lambda x, t: 0.5 * x + answer, noise, 4)
    assert torch.allclose(ours, x, atol=1e-5)


def test_loss_targets():
    x0, noise = torch.randn(2, 4, 8, 7, generator=torch.Generator().manual_seed(0))
    t = torch.tensor([0, 30, 60, 99])
    assert Diffusion(prediction="sample").loss(x0, x0, noise, t) == 0
    assert Diffusion(prediction="epsilon").loss(noise, x0, noise, t) == 0
    assert Diffusion(prediction="sample").loss(noise, x0, noise, t) > 0
    expected = torch.nn.functional.mse_loss(x0, noise)
    for plain in (Diffusion(prediction="epsilon"), Diffusion(snr_cap=0.05)):
        assert torch.allclose(plain.loss(x0, noise, noise, t), expected)


def test_loss_weights_follow_the_signal_to_noise_ratio():
    process = Diffusion(100, snr_cap=5.0)
    snr = torch.tensor([(k / s) ** 2 for k, s in zip(process.keep, process.spread, strict=True)])
    weights = torch.tensor(process.weights)
    assert weights.mean().item() == pytest.approx(1.0)
    assert torch.allclose(weights / weights[0], snr.clamp(0.05, 5.0) / 5.0)
    output, x0 = torch.ones(2, 8, 7), torch.zeros(2, 8, 7)
    loss = process.loss(output, x0, x0, torch.tensor([10, 80]))
    assert loss.item() == pytest.approx(float(weights[[10, 80]].mean()), rel=1e-5)


@pytest.mark.parametrize("prediction", ["sample", "velocity"])
def test_a_step_of_flow_is_an_euler_step_along_the_velocity(prediction):
    flow = Diffusion(100, prediction, process="flow")
    assert flow.keep[-1] == 0
    assert flow.timesteps(4) == [99, 74, 49, 24]
    x, output = torch.randn(2, 16, 8, 7, generator=torch.Generator().manual_seed(0)).double()
    for t, t_next in ((99, 49), (49, 24), (24, -1)):
        time, later = (t + 1) / 100, (t_next + 1) / 100
        velocity = output if prediction == "velocity" else (x - output) / time
        expected = x + (later - time) * velocity
        assert torch.allclose(flow.ddim_step(output, t, t_next, x), expected, atol=1e-12)


@pytest.mark.parametrize("prediction", ["sample", "velocity"])
def test_flow_starts_at_the_noise_and_learns_straight_paths(prediction):
    flow = Diffusion(100, prediction, process="flow")
    x0, noise = torch.randn(2, 3, 8, 7, generator=torch.Generator().manual_seed(0))
    ends = flow.add_noise(x0, noise, torch.tensor([99, 49, 0]))
    assert torch.equal(ends[0], noise[0])
    assert torch.allclose(ends[1], (x0[1] + noise[1]) / 2)
    target = {"sample": x0, "velocity": noise - x0}[prediction]
    levels = torch.tensor([99, 49, 0])
    assert flow.loss(target, x0, noise, levels) == 0
    assert flow.loss(-target, x0, noise, levels) > 0
