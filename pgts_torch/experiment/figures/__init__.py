"""Every figure and table of the paper, its statements checked, and the questions it leaves open, as one document.

Each part computes plain data; pictures and the document are made from the data alone.
"""

PARTS = ("ladder", "random", "tightrope", "grid", "stationary", "depth")
"""In the order of the document."""
