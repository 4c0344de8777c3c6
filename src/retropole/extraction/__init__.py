"""From a cloud to its taped poles: clusters, lines, and the rules that a line must pass."""
