"""Backups: made, verified, restored, rotated."""
