"""The ground that LiDARs stand on: which returns are of it, and where they are over it."""
