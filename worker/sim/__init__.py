"""Robot arm, seated person, physics.

Importing this package registers every installed task with Gymnasium: the task ``wipe_mouth`` is
``pbarl/WipeMouth-v0``; its code is imported when one is made.
"""

import gymnasium

from app.installed_tasks import catalogue
from app.installed_tasks.description import TaskDescription


def register_tasks() -> None:
    """Tell Gymnasium of every task that it does not know yet."""
    for task in catalogue.installed().tasks.values():
        if not isinstance(task.description, TaskDescription):
            continue  # a laboratory's environment has its own id
        name = f"pbarl/{''.join(word.capitalize() for word in task.name.split('_'))}-v0"
        if name not in gymnasium.registry:
            entry_point = f"{task.package}.{task.description.environment}"
            gymnasium.register(name, entry_point=entry_point, max_episode_steps=None)


register_tasks()
