"""Many LiDARs in one frame: one adjustment of all of them, their placements and shared poles."""
