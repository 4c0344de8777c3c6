"""Where to stand the poles: before anyone drives out (docs/planning.md), and beside live LiDARs."""
