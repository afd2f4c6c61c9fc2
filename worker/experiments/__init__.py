"""Offline commands: benchmark, pre-training."""
