"""One HTML page about a run: what is known of it, its curves, and how they are written. It needs nothing but itself."""
