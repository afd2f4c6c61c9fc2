"""Every task there is, by the name under which studies know it."""

from worker.sim.assistive import AssistiveEnv
from worker.tasks.drinking.environment import DrinkingEnv
from worker.tasks.feeding.environment import FeedingEnv
from worker.tasks.scratching.environment import ScratchingEnv

ENVIRONMENTS: dict[str, type[AssistiveEnv]] = {env.task.name: env for env in (FeedingEnv, DrinkingEnv, ScratchingEnv)}
