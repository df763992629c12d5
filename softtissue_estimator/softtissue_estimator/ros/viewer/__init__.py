"""The viewer as a node of its own: a live page of what the estimator's node says."""
