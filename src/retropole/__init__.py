"""Calibrate LiDARs to each other with poles wrapped in retro-reflective tape."""
