"""Robot arm, seated person, physics.

Importing this package registers the tasks' environments with Gymnasium.
"""

import gymnasium

FEEDING = "pbarl/Feeding-v0"
DRINKING = "pbarl/Drinking-v0"
SCRATCHING = "pbarl/Scratching-v0"

gymnasium.register(FEEDING, entry_point="worker.tasks.feeding.environment:FeedingEnv", max_episode_steps=None)
gymnasium.register(DRINKING, entry_point="worker.tasks.drinking.environment:DrinkingEnv", max_episode_steps=None)
gymnasium.register(SCRATCHING, entry_point="worker.tasks.scratching.environment:ScratchingEnv", max_episode_steps=None)
