"""The checks of many sites over time: their history, and what changed."""
