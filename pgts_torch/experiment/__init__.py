"""The loop around the algorithm, the folder of a run and what is left in it."""
