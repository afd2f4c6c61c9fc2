"""Every task there is, by the name under which studies know it."""

from worker.sim.assistive import AssistiveEnv
from worker.sim.drinking import DrinkingEnv
from worker.sim.feeding import FeedingEnv
from worker.sim.scratching import ScratchingEnv

ENVIRONMENTS: dict[str, type[AssistiveEnv]] = {env.task.name: env for env in (FeedingEnv, DrinkingEnv, ScratchingEnv)}
