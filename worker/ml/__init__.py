"""Reward models, policies, filters: plain torch and NumPy."""
