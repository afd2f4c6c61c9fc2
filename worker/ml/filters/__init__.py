"""The personal action filter, ours and as printed."""
