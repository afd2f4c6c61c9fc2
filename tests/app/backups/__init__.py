"""Backups: made, restored, refused, drilled."""
