"""The ground below LiDARs: which returns are of it, and where they are over it."""
