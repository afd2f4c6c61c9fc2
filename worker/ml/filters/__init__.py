"""Action filters: ours, and the paper's own."""
