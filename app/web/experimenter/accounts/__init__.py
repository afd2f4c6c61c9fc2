"""Logins and accounts."""
