"""The ground below LiDARs: its returns, and the poses of the LiDARs over it."""
