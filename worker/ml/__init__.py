"""Reward models, policies and filters."""
