"""The durable engine, queues, urgency, run records."""
