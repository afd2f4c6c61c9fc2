"""Sessions, security headers, rate limits, uploads."""
