"""The field test: what a site measures against what is known, and how repeatable it is."""
