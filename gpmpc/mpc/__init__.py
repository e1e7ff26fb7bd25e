"""Controllers: from a state and a reference to an input."""
