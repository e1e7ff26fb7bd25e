"""The published results: their claims, trials and tables, one module for each."""
