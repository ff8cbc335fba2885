"""From a configuration to a run: the command line, the loop around the algorithm and what it leaves behind."""
