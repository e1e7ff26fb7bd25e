"""Problem: speed is claimed by everybody; a reader wants to see it measured, beside others, on his own machine."""
