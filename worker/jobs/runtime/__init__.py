"""Durable engine, queues, urgency, run records."""
