"""Clusters of two nodes on this machine, and what must hold on them: make cluster."""
