"""From a cloud to its taped poles: clusters, lines, and the tests that a line must pass."""
