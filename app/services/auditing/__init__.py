"""The audit log: check, look up, receipts."""
