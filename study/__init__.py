"""The paper reproduced: its figures and tables, its statements checked, its open questions tried, as one document.

`python -m study` in a checkout of the repository; no part of the package.

Each part computes plain data; pictures and the document are made from the data alone.
"""

PARTS = ("ladder", "random", "tightrope", "grid", "stationary", "depth", "bounds")
"""In the order of the document."""
