"""Erasure, unused files, backups."""
