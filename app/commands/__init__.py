"""Commands about the audit log and deployment."""
