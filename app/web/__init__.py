"""Routes: from HTTP to a service and back."""
