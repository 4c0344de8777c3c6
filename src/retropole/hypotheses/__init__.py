"""Which poses there may be, and how probable each is: by poles, and by the surroundings."""
