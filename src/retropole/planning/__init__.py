"""Positions of the poles: before anyone drives out (docs/poles.md), and at live LiDARs."""
