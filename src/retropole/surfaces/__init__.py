"""What two clouds have in common at a pose: averages, patches, visibility, registration."""
