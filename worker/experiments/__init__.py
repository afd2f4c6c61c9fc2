"""Offline commands: benchmark, pre-training, surfaces."""
