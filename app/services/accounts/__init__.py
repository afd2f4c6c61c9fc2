"""Passwords, sessions, roles, API tokens."""
