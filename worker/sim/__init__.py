"""The simulated robot, people and tasks. Importing this package registers its environments with Gymnasium."""

import gymnasium

FEEDING = "pbarl/Feeding-v0"

gymnasium.register(FEEDING, entry_point="worker.sim.feeding:FeedingEnv", max_episode_steps=None)
