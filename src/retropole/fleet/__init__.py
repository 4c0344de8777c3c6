"""Thousands of sites: all calibrated, adjusted as one network, and watched over time."""
