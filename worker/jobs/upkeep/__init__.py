"""Erasure after a withdrawal, unused files, backups."""
