"""A filter over the episodes of a probe: hypotheses of what holds for all touches, and their parameters."""
