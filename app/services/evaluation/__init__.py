"""The blinded evaluation: plan, ratings, unblinding."""
