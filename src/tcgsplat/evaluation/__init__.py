"""How good a run is, as numbers and as pictures; reads run directories and knows nothing of how they were made."""
