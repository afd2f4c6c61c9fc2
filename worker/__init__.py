"""The worker: simulation, learning, clips, statistics, bundles."""
