"""Blinded evaluation: plan, ratings, key."""
