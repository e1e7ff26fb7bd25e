"""Studies: conditions and seeds, the trials that they make, the store of the records, and the tables of them."""
