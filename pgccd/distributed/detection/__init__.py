"""Detection on many ranks: each finds the contacts of its share of pairs."""
