"""Which pole is which: candidate poses, what a prior allows, what several placements share."""
