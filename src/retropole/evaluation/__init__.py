"""How good a transform is, other methods on the same clouds, and the paper's tables reproduced."""
