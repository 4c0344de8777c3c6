"""Paths in, point clouds out."""
