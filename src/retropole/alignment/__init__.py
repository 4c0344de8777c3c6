"""The pose from matched poles: the paper's least squares, and returns on shared cylinders."""
