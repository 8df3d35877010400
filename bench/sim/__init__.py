"""N parallel ManiSkill environments on any machine.

- `parallel`: makes environments of any ManiSkill task class, in one process or several.
- `environment`: the class behind it, on batched CPU physics or ManiSkill's GPU simulation.
- `headless`: lets state-only environments run without a Vulkan driver.
- `capabilities`: what this machine can do; works where importing ManiSkill fails, too.
"""
