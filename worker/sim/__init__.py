"""The simulated robot and people. Importing this package registers every installed task with Gymnasium.

The task ``feed_me`` is ``pbarl/FeedMe-v0``; its code is imported when one is made.
"""

import gymnasium

from installed_tasks import catalogue


def gymnasium_id(task: str) -> str:
    """The name under which Gymnasium knows a task."""
    return f"pbarl/{''.join(word.capitalize() for word in task.split('_'))}-v0"


for _task in catalogue.installed().tasks.values():
    gymnasium.register(
        gymnasium_id(_task.name),
        entry_point=f"{_task.package}.{_task.description.environment}",
        max_episode_steps=None,
    )
