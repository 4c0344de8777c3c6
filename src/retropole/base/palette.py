"""The colours of LiDARs, in every picture and file."""

GREY, BLUE, ORANGE, RED, GREEN = "#9aa0a6", "#0072b2", "#e69f00", "#d55e00", "#009e73"
"""Okabe and Ito's colours, which colour-blind readers distinguish."""

COLORS = (BLUE, ORANGE, "#cc79a7", RED, "#56b4e9", "#000000", "#b8a800", "#666666")
"""Of the LiDARs; more begin again. Green is that of the poles."""
