"""Passwords, browser sessions, roles, API tokens."""
