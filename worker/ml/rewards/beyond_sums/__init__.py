"""What weighted sums do not explain."""
