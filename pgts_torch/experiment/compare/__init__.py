"""Runs beside each other: learning curves with intervals, and tables. What it says, it says of all of them at once."""
