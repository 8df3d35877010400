"""The tasks that run without a Vulkan driver."""

from symsteer.bench.tasks import TASKS, task_class

STATE_TASKS = [name for name in TASKS.names() if not task_class(name).needs_cameras]
