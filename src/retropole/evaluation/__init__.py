"""How good a transform is, and other methods on the same clouds."""
