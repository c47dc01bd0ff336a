"""A sensor ball in an avalanche: Winkler 2025, sections 3 to 5."""
