"""One pole that a person carries through the view of two LiDARs: their pose and their clocks."""
