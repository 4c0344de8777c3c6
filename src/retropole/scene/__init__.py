"""What the surroundings say: registration, visibility, choice of the hypothesis, refinement."""
