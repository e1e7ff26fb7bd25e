"""The paper's published results, one small module each: what was printed, which runs it needs, how it is computed."""
