"""The simulated robot, people and tasks. Importing this package registers its environments with Gymnasium."""

import gymnasium

FEEDING = "pbarl/Feeding-v0"
DRINKING = "pbarl/Drinking-v0"
SCRATCHING = "pbarl/Scratching-v0"

gymnasium.register(FEEDING, entry_point="worker.sim.feeding:FeedingEnv", max_episode_steps=None)
gymnasium.register(DRINKING, entry_point="worker.sim.drinking:DrinkingEnv", max_episode_steps=None)
gymnasium.register(SCRATCHING, entry_point="worker.sim.scratching:ScratchingEnv", max_episode_steps=None)
