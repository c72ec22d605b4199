"""Real arms with motors: limits and checks that all share, and their drivers."""
