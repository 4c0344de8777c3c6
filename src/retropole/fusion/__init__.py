"""Clouds of several LiDARs in one frame, and the surfaces that they see."""
