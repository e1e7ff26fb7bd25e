"""Published results, one module each: the claim, its trials and its tables."""
