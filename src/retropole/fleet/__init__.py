"""Thousands of sites: calibrated together, adjusted as a network, watched over time."""
