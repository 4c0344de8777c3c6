"""What is seen of a live rig, and the one next thing that the people beside it should do."""
