"""Reinforcement learning on a learned reward, and the refinement of a filter by it."""
