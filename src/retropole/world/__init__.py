"""Frames of maps: geodetic coordinates, projections, and poses in them."""
