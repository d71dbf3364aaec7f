"""Coming back: which submaps show the same place, how they stand to each other, and what follows for all of them."""
