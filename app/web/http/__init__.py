"""Who asks, security headers, rate limits."""
